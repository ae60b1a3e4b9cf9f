"""One page that shows everything: tables that sort, figures, verdicts, and the command of every number. It needs no
server and no other file."""

import base64
import html
from pathlib import Path

from infogoal_jax.reproduce.effects import INTERVALS
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.table_formats import Cell, Table
from infogoal_jax.reproduce.titles import DESCRIPTIONS

STYLE = """
:root{color-scheme:light dark}body{font:16px/1.5 system-ui,sans-serif;margin:0 auto;padding:1rem;max-width:80rem}
h1{font-size:1.6rem}h2{font-size:1.25rem;margin-top:2.2rem}nav a{margin-right:.9rem;white-space:nowrap}
.wide{overflow-x:auto;border:1px solid #8884}table{border-collapse:collapse;font-size:.86rem;width:100%}
th,td{padding:.3rem .55rem;border-bottom:1px solid #8883;text-align:left;vertical-align:top}
th{cursor:pointer;user-select:none;position:sticky;top:0;background:Canvas}th:hover{text-decoration:underline}
tbody td:first-child,thead th:first-child{position:sticky;left:0;background:Canvas}
.best{font-weight:700}.second{text-decoration:underline}.paper{color:#888;font-size:.92em;white-space:nowrap}
.number{white-space:nowrap}.number a{color:inherit;text-decoration:none}td:target{background:#fd08}
.holds{color:#1a7f37;font-weight:700}.fails{color:#cf222e;font-weight:700}
.told{color:#9a6700;font-weight:700}img{max-width:100%;height:auto;background:white}figure{margin:1.2rem 0}
figcaption,.foot{font-size:.86rem;color:#777}code{font-size:.82rem;overflow-wrap:anywhere}
[id^=over_tasks] td{white-space:nowrap}
@media(max-width:45rem){:is(#verdicts,#runs) thead{display:none}
:is(#verdicts,#runs) tr{display:block;padding:.5rem 0}:is(#verdicts,#runs) tr+tr{border-top:1px solid #8884}
:is(#verdicts,#runs) td{display:block;position:static;border:0;padding:.1rem .55rem;overflow-wrap:anywhere}
:is(#verdicts,#runs) td:empty{display:none}:is(#verdicts,#runs) td:first-child{font-weight:600}
#verdicts td:nth-child(5)::before{content:"test: "}#verdicts td:nth-child(6)::before{content:"in the paper: "}
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
KINDS = {"holds": "holds", "fails": "fails", "cannot be told": "told"}


def cell(value: Cell | str) -> str:
    """A cell of a table."""
    if isinstance(value, str):
        return f"<td>{html.escape(value)}</td>"
    rank = {1: "best", 2: "second"}.get(value.rank, "")
    paper = f' <span class="paper">({html.escape(value.paper)})</span>' if value.paper else ""
    number = "" if value.ours is None else f"{value.ours.mean:.6f}"
    words = f'<span class="{rank}">{html.escape(value.words())}</span>'
    words = f'<a href="#{html.escape(value.run)}">{words}</a>' if value.run and value.ours is not None else words
    return f'<td class="number" data-value="{number}">{words}{paper}</td>'


def table_of(head: list[str], rows: list[list[str]], name: str) -> str:
    """A table of cells that are written already."""
    heads = "".join(f"<th>{html.escape(title)}</th>" for title in head)
    body = "".join(f"<tr>{''.join(row)}</tr>" for row in rows)
    return f'<div class="wide" id="{name}"><table><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>'


def section(table: Table) -> str:
    """A table under its title."""
    rows = [[cell(value) for value in row] for row in table.rows]
    foot = "".join(f'<p class="foot">{html.escape(line)}</p>' for line in table.foot)
    return f"<h2>{html.escape(table.title)}</h2>{table_of(table.head, rows, table.name)}{foot}"


def verdicts(found: list) -> str:
    """The claims with their verdicts."""
    rows = []
    for claim, finding in found:
        why = f"; not counted: {'; '.join(finding.faults)}" if finding.faults else ""
        verdict = f'<td class="{KINDS[finding.verdict]}">{finding.verdict}</td>'
        effect = f'<td class="number">{html.escape(finding.shown)}</td>'
        rows.append([cell(claim.says), verdict, effect, cell(finding.words + why), cell(claim.test), cell(claim.where)])
    head = ["claim", "verdict", "effect [95 %]", "details", "test", "in the paper"]
    return f'<h2>Verdicts</h2>{table_of(head, rows, "verdicts")}<p class="foot">{INTERVALS}</p>'


def figure(path: Path) -> str:
    """A figure, in the page itself."""
    words = html.escape(DESCRIPTIONS[path.stem])
    content = base64.b64encode(path.read_bytes()).decode()
    return (
        f'<figure id="{path.stem}"><img alt="{words}" src="data:image/png;base64,{content}">'
        f"<figcaption>{words}</figcaption></figure>"
    )


def commands(results: Results) -> str:
    """Every run with the command that makes it."""
    rows = [
        [
            f'<td id="{html.escape(run.name)}">{html.escape(run.name)}</td>',
            cell(f"{result.evaluations['test_goal/success_rate'].shape[1] * result.about['updates']:,}"),
            cell(result.about["data"]),
            cell(result.about["machine"]),
            f"<td><code>{html.escape(result.command)}</code></td>",
        ]
        for run, result in sorted(results.items(), key=lambda item: item[0].name)
    ]
    head = ["run", "updates of each seed", "data", "machine", "command"]
    return f"<h2>Every run, and its command</h2>{table_of(head, rows, 'runs')}"


def page(shown: list[Table], found: list, pictures: list[Path], results: Results) -> str:
    """The page as HTML. pictures: the figures."""
    links = [("verdicts", "Verdicts"), *((table.name, table.title) for table in shown)]
    links += [(path.stem, DESCRIPTIONS[path.stem].partition(":")[0]) for path in pictures] + [("runs", "Runs")]
    nav = "".join(f'<a href="#{name}">{html.escape(words)}</a> ' for name, words in links)
    parts = [verdicts(found), *map(section, shown)]
    parts += ["<h2>Figures</h2>", *map(figure, pictures)] if pictures else []
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>InfoGoal, reproduced</title><style>{STYLE}</style></head><body>"
        "<h1>InfoGoal (Zou and Suzuki), reproduced</h1>"
        "<p>Written by <code>infogoal reproduce</code> from the numbers of the runs below. Datasets are stand-ins. "
        "A click on a column's head sorts its table, one on a number leads to its run and the command of it.</p>"
        f"<nav>{nav}</nav>{''.join(parts)}{commands(results)}"
        f"<script>{SORT}</script></body></html>\n"
    )
