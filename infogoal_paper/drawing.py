"""What is written of the numbers: tables, figures, the verdict on every claim, and one page that shows all of it. The
page needs no server and no other file: its tables sort, and it has the command of every number.

OUT/tables/NAME.md, .tex, .csv    OUT/figures/NAME.png (and .pdf or .svg)    OUT/reproduction.md    OUT/index.html
"""

import base64
import dataclasses
import hashlib
import html
import io
import os
import re
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image, PngImagePlugin

from infogoal_jax.report import canvas
from infogoal_jax.runs import disk
from infogoal_paper import claims, tables
from infogoal_paper.claims import INTERVALS
from infogoal_paper.figures import FIGURES
from infogoal_paper.manifest import BESIDE, STUDIES, VARIANTS, Choice
from infogoal_paper.numbers import Results
from infogoal_paper.paper import AGAINST, DESCRIPTIONS, SENTENCES
from infogoal_paper.scores import KINDS
from infogoal_paper.table_formats import WRITERS, Cell, Table, markdown, narrow

NUMBERS = "Numbers"
"""What a figure's file says beside its pixels: the digest of its numbers."""
BY_HAND = "<!-- by hand -->"
"""What stands below this line of the page of verdicts is written by hand, and is kept."""
ABOUT = """# The paper, reproduced

**Which claims of the paper hold here?** Those whose whole interval lies on their side: the verdicts below. They rest on
stand-in data, so that numbers compare methods and are not the paper's.

Written by `infogoal reproduce` from the numbers of the runs; a verdict says so where runs are missing.
"""


def draw(
    studies: tuple[str, ...], results: Results, out: Path, verdicts: Path | None = None, format: str = "png"
) -> list[Path]:
    """Write what these studies show, as far as there are numbers; the paths of the files. verdicts: the file of the
    verdicts, which are written with all studies; None: OUT/reproduction.md; format: figures are written in this one of
    `canvas.FORMATS` beside PNG, which the pages show."""
    results = {run: result for run, result in results.items() if run.of_paper}
    shown = [table for table in tables.all_tables(results) if is_shown(table.name, studies)]
    found, paths = claims.verdicts(results), write_tables(shown, out / "tables")
    with canvas.figure_style():
        for name in (study for study in studies if study in FIGURES):
            paths += draw_figure(name, results, out / "figures", format)
    pictures = current_figures(results, out / "figures")
    if set(studies) == set(STUDIES):
        paths.append(verdicts or out / "reproduction.md")
        disk.write_text(paths[-1], report(shown, found, pictures, paths[-1]))
    paths.append(out / "index.html")
    disk.write_text(paths[-1], page_of(shown, found, pictures, results))
    return paths


def write_tables(shown: list[Table], folder: Path) -> list[Path]:
    """Write tables in every format; the paths."""
    disk.make_folder(folder)
    paths = []
    for table in shown:
        for ending, write in WRITERS.items():
            paths.append(folder / f"{table.name}.{ending}")
            disk.write_text(paths[-1], write(table))
    return paths


def draw_figure(name: str, results: Results, folder: Path, format: str) -> list[Path]:
    """Write a figure as PNG and in this format; the paths. What was drawn before of other numbers is deleted."""
    return write_figure(FIGURES[name](results), folder / f"{name}.png", digest(results, name), format)


def write_figure(figure: Figure | None, path: Path, numbers: str, format: str) -> list[Path]:
    """Write a figure as this PNG, and beside it in this format; the paths. numbers: the digest of what it was drawn
    from. What was drawn before of other numbers is deleted."""
    if figure is None or drawn_from(path) != numbers:
        for ending in canvas.FORMATS:
            path.with_suffix(f".{ending}").unlink(missing_ok=True)
    if figure is None:
        return []
    save_in_few_colours(figure, path, numbers)
    if format == "png":
        return [path]
    canvas.save(figure, path.with_suffix(f".{format}"))
    return [path, path.with_suffix(f".{format}")]


def save_in_few_colours(figure: Figure, path: Path, numbers: str) -> None:
    """Write a figure as a PNG of 128 colours and 100 dots an inch, which takes a fifth of the space in the
    repository. numbers: the digest of what it was drawn from, which the file says."""
    drawn, words = io.BytesIO(), PngImagePlugin.PngInfo()
    figure.savefig(drawn, format="png", dpi=100)
    words.add_text(NUMBERS, numbers)
    picture = Image.open(drawn).convert("RGB").quantize(128, dither=Image.Dither.NONE)
    disk.make_folder(path.parent)
    disk.write_atomically(path, lambda file: picture.save(file, "PNG", optimize=True, pnginfo=words))


def digest(results: Results, name: str) -> str:
    """What tells the numbers that a figure is drawn from: those of the runs of its study."""
    of_study = (STUDIES | BESIDE)[name](Choice())
    wanted = {run.row for run in of_study}
    found = hashlib.sha256()
    for run in sorted(results, key=lambda run: run.name):
        if run.row in wanted:
            found.update(run.name.encode())
            evaluations = {key: value.astype(np.float32) for key, value in results[run].evaluations.items()}
            for key, value in sorted((evaluations | results[run].arrays).items()):
                found.update(f"{key} {value.dtype} {value.shape}".encode() + np.ascontiguousarray(value).tobytes())
    return found.hexdigest()[:16]


def current_figures(results: Results, folder: Path) -> list[Path]:
    """The figures in this folder that were drawn from these numbers; one of other numbers must not be shown beside
    them."""
    return [path for name in FIGURES if drawn_from(path := folder / f"{name}.png") == digest(results, name)]


def drawn_from(path: Path) -> str | None:
    """The digest of the numbers that a figure was drawn from; None where there is no figure, or it does not say."""
    try:
        with Image.open(path) as image:
            return image.info.get(NUMBERS)
    except OSError:  # That it is no picture is one, too.
        return None


def is_shown(table: str, studies: tuple[str, ...]) -> bool:
    """Whether a table belongs to these studies; what it cost is always shown."""
    belongs = {
        "table1": ("table1", "equal_training", "over_tasks", "near_and_far", "fit", "order"),
        "table2": ("table2",),
    }
    return table == "costs" or any(table.startswith(belongs.get(study, ("-",))) for study in studies)


IN_FOLDER_ALONE = (
    *("near_and_far", "table1_text", "table2", "costs"),
    *(f"equal_training_{variant}" for variant in VARIANTS),
    *(f"over_tasks_{variant}" for variant in VARIANTS),
)
"""Tables that the page of verdicts leaves to the folder and to index.html: no verdict rests on them, or they repeat
rows of others."""
NOT_WITH_HER = KINDS["corrupted_train_goal"]
"""Goals that the page leaves out of the table with HER in every row."""
VERDICT_HEAD = ["claim", "verdict", "as Algorithm 1 [95 %]", "as the text [95 %]", "details", "test", "in the paper"]


def verdict_rows(found: list) -> list[list[str]]:
    """Of every claim what `VERDICT_HEAD` names. Details are those of the first reading, and of the second where they
    differ."""
    rows, usual = [], usual_count(found)
    for judged in found:
        claim, paper, text = judged.claim, judged.paper, judged.text
        effects, details = [paper.shown, "" if text is None else text.shown], paper.details
        if text is not None and text.verdict != paper.verdict:
            effects = [f"{each.verdict}: {each.shown}" for each in (paper, text)]
        if text is not None and text.details != paper.details:
            details += f". As the text: {text.details}"
        details = details.replace(f"; {usual}", "") if usual else details
        rows.append([claim.says, judged.verdict, *effects, details, claim.test, claim.where])
    return rows


def usual_count(found: list) -> str:
    """On how many seeds and goal sets most claims rest, in words; nothing without runs."""
    counts = [count for judged in found for count in re.findall(r"\d+ seeds? on \d+ goal sets?", judged.paper.words)]
    return max(set(counts), key=counts.count) if counts else ""


def verdict_table(found: list) -> Table:
    """Every claim with its verdict, effects, intervals and test."""
    rows = [[row[0], f"**{row[1]}**", *row[2:]] for row in verdict_rows(found)]
    return Table("verdicts", "Verdicts", VERDICT_HEAD, rows)


def said_once(found: list) -> str:
    """What most details would say."""
    return f" Unless details say otherwise, they rest on {usual}." if (usual := usual_count(found)) else ""


def decides(found: list) -> str:
    """Which sentence of the paper decides the claims on which its readings differ; nothing where they agree."""
    differ = sum(judged.verdict == claims.DEPENDS for judged in found)
    if not differ:
        return ""
    return (
        f"On {differ} the readings differ. One sentence decides whether InfoGoal relabels: {SENTENCES['infogoal']} "
        f"(Sec. V-C). Against it: {AGAINST}. On InfoBot and GCB the paper has no sentence."
    )


def report(shown: list[Table], found: list, pictures: list[Path], path: Path) -> str:
    """The page of verdicts, as Markdown. pictures: the figures; path: of the page."""
    counts = [judged.verdict for judged in found]
    words = {"holds": ("holds", "hold"), "fails": ("fails", "fail"), "cannot be told": ("cannot be told",) * 2}
    words[claims.DEPENDS] = (claims.DEPENDS, "depend on the reading")
    kinds = ", ".join(f"{counts.count(kind)} {forms[counts.count(kind) != 1]}" for kind, forms in words.items())
    lines = [ABOUT, "## Verdicts", "", f"{len(found)} claims: {kinds}. {INTERVALS}{said_once(found)}", ""]
    lines += [decides(found), ""] if decides(found) else []
    lines.append(markdown(verdict_table(found)))
    for table in shown:
        if table.name == "table1_her":
            table = narrow(table, [head for head in table.head if NOT_WITH_HER not in head])
            table = dataclasses.replace(table, foot=[line for line in table.foot if NOT_WITH_HER not in line])
        lines += [] if table.name in IN_FOLDER_ALONE else [f"## {table.title}", "", markdown(table, short=True)]
    lines += ["## Figures", ""] if pictures else []
    for picture in pictures:
        words, there = DESCRIPTIONS[picture.stem], Path(os.path.relpath(picture, path.parent)).as_posix()
        lines += [f"![{picture.stem}]({there})", "", f"*{words}.*", ""]
    return "\n".join([*lines, BY_HAND]) + kept_by_hand(path)


def kept_by_hand(path: Path) -> str:
    """What was written by hand in the page of verdicts."""
    if not path.exists():
        return "\n"
    return path.read_text().partition(BY_HAND)[2] or "\n"


STYLE = """
:root{color-scheme:light dark}body{font:16px/1.5 system-ui,sans-serif;margin:0 auto;padding:1rem;max-width:80rem}
h1{font-size:1.6rem}h2{font-size:1.25rem;margin-top:2.2rem}nav a{margin-right:.9rem;display:inline-block}
.wide{overflow-x:auto;border:1px solid #8884}table{border-collapse:collapse;font-size:.86rem;width:100%}
th,td{padding:.3rem .55rem;border-bottom:1px solid #8883;text-align:left;vertical-align:top}
th{cursor:pointer;user-select:none;position:sticky;top:0;background:Canvas}th:hover{text-decoration:underline}
tbody td:first-child,thead th:first-child{position:sticky;left:0;background:Canvas}
.best{font-weight:700}.second{text-decoration:underline}.paper{color:#888;font-size:.92em;white-space:nowrap}
.number{white-space:nowrap}.number a{color:inherit;text-decoration:none}td:target{background:#fd08}
.holds{color:#1a7f37;font-weight:700}.fails{color:#cf222e;font-weight:700}
.told{color:#9a6700;font-weight:700}img{max-width:100%;height:auto;background:white}figure{margin:1.2rem 0}
figcaption,.foot{font-size:.86rem;color:#777}code{font-size:.82rem;overflow-wrap:anywhere}
[id^=over_tasks] td,#costs td{white-space:nowrap}
@media(max-width:45rem){:is(#verdicts,#runs) thead{display:none}
:is(#verdicts,#runs) tr{display:block;padding:.5rem 0}:is(#verdicts,#runs) tr+tr{border-top:1px solid #8884}
:is(#verdicts,#runs) td{display:block;position:static;border:0;padding:.1rem .55rem;overflow-wrap:anywhere}
:is(#verdicts,#runs) td:empty{display:none}:is(#verdicts,#runs) td:first-child{font-weight:600}
#verdicts td:nth-child(6)::before{content:"test: "}#verdicts td:nth-child(7)::before{content:"in the paper: "}
#runs td:nth-child(2)::after{content:" updates of each seed"}}
"""
SORT = """
document.querySelectorAll("th").forEach(head=>head.addEventListener("click",()=>{
const table=head.closest("table"),body=table.tBodies[0],place=[...head.parentNode.children].indexOf(head);
const up=head.dataset.up!=="1";head.dataset.up=up?"1":"0";
const value=row=>{const words=row.cells[place].dataset.value??row.cells[place].textContent.trim();
const number=parseFloat(words.replace(/,/g,""));return Number.isNaN(number)?words.toLowerCase():number};
[...body.rows].sort((a,b)=>{const x=value(a),y=value(b);
if(x===""||y==="")return (x==="")-(y==="");
const order=typeof x===typeof y?(x<y?-1:x>y?1:0):typeof x==="number"?-1:1;
return up?order:-order}).forEach(row=>body.append(row))}));
"""
VERDICT_CLASSES = {"holds": "holds", "fails": "fails", "cannot be told": "told", claims.DEPENDS: "told"}


def html_cell(value: Cell | str) -> str:
    """A cell of a table."""
    if isinstance(value, str):
        return f"<td>{html.escape(value)}</td>"
    rank = {1: "best", 2: "second"}.get(value.rank, "")
    paper = f' <span class="paper">({html.escape(value.paper)})</span>' if value.paper else ""
    number = "" if value.ours is None else f"{value.ours.mean:.6f}"
    words = f'<span class="{rank}">{html.escape(value.words())}</span>'
    words = f'<a href="#{html.escape(value.run)}">{words}</a>' if value.run and value.ours is not None else words
    return f'<td class="number" data-value="{number}">{words}{paper}</td>'


def html_table(head: list[str], rows: list[list[str]], name: str) -> str:
    """A table of cells that are written already."""
    heads = "".join(f"<th>{html.escape(title)}</th>" for title in head)
    body = "".join(f"<tr>{''.join(row)}</tr>" for row in rows)
    return f'<div class="wide" id="{name}"><table><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>'


def table_section(table: Table) -> str:
    """A table under its title."""
    rows = [[html_cell(value) for value in row] for row in table.rows]
    foot = "".join(f'<p class="foot">{html.escape(line)}</p>' for line in table.foot)
    return f"<h2>{html.escape(table.title)}</h2>{html_table(table.head, rows, table.name)}{foot}"


def verdict_section(found: list) -> str:
    """The claims with their verdicts."""
    rows = []
    for says, verdict, *effects, details, test, where in verdict_rows(found):
        rows.append([html_cell(says), f'<td class="{VERDICT_CLASSES[verdict]}">{verdict}</td>'])
        rows[-1] += [f'<td class="number">{html.escape(effect)}</td>' for effect in effects]
        rows[-1] += map(html_cell, (details, test, where))
    foot = html.escape(f"{INTERVALS}{said_once(found)} {decides(found)}")
    return f'<h2>Verdicts</h2>{html_table(VERDICT_HEAD, rows, "verdicts")}<p class="foot">{foot}</p>'


def figure_section(path: Path) -> str:
    """A figure, in the page itself."""
    words = html.escape(DESCRIPTIONS[path.stem])
    content = base64.b64encode(path.read_bytes()).decode()
    return (
        f'<figure id="{path.stem}"><img alt="{words}" src="data:image/png;base64,{content}">'
        f"<figcaption>{words}</figcaption></figure>"
    )


def run_section(results: Results) -> str:
    """Every run with the command that makes it."""
    rows = [
        [
            f'<td id="{html.escape(run.name)}">{html.escape(run.name)}</td>',
            html_cell(f"{result.evaluations['test_goal/success_rate'].shape[1] * result.about['updates']:,}"),
            html_cell(result.about["data"]),
            html_cell(result.about["machine"]),
            f"<td><code>{html.escape(result.command)}</code></td>",
        ]
        for run, result in sorted(results.items(), key=lambda item: item[0].name)
    ]
    head = ["run", "updates of each seed", "data", "machine", "command"]
    return f"<h2>Every run, and its command</h2>{html_table(head, rows, 'runs')}"


def page_of(shown: list[Table], found: list, pictures: list[Path], results: Results) -> str:
    """The page as HTML. pictures: the figures."""
    links = [("verdicts", "Verdicts"), *((table.name, table.title) for table in shown)]
    links += [(path.stem, DESCRIPTIONS[path.stem].partition(":")[0]) for path in pictures] + [("runs", "Runs")]
    nav = "".join(f'<a href="#{name}">{html.escape(words)}</a> ' for name, words in links)
    parts = [verdict_section(found), *map(table_section, shown)]
    parts += ["<h2>Figures</h2>", *map(figure_section, pictures)] if pictures else []
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>InfoGoal, reproduced</title><style>{STYLE}</style></head><body>"
        "<h1>InfoGoal (Zou and Suzuki), reproduced</h1>"
        "<p>Written by <code>infogoal reproduce</code> from the numbers of the runs below. Datasets are stand-ins. "
        "A click on a column's head sorts its table, one on a number leads to its run and the command of it.</p>"
        f"<nav>{nav}</nav>{''.join(parts)}{run_section(results)}"
        f"<script>{SORT}</script></body></html>\n"
    )
