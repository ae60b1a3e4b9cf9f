"""What is written of the numbers: tables, figures, the verdict on every claim, and the page that shows all of it.

OUT/tables/NAME.md, .tex, .csv    OUT/figures/NAME.png (and .pdf or .svg)    OUT/reproduction.md    OUT/index.html
"""

import hashlib
import os
from pathlib import Path

import numpy as np
from PIL import Image

from infogoal_jax.report import canvas
from infogoal_jax.reproduce import claims, page, tables
from infogoal_jax.reproduce.effects import INTERVALS
from infogoal_jax.reproduce.figures import FIGURES
from infogoal_jax.reproduce.manifest import STUDIES, Choice
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.table_formats import WRITERS, Table, markdown
from infogoal_jax.reproduce.titles import DESCRIPTIONS
from infogoal_jax.runs import disk

NUMBERS = "Numbers"
"""What a figure's file says beside its pixels: the digest of its numbers."""
BY_HAND = "<!-- by hand -->"
"""What stands below this line of the page of verdicts is written by hand, and is kept."""
ABOUT = """# The paper, reproduced

Written by `infogoal reproduce` from the numbers of the runs: a verdict on each claim of the paper, and those of its
tables and figures that there are runs for. A verdict says so where runs are missing. [reproducing.md](reproducing.md)
says how runs are made and repeated. Datasets are stand-ins (README), so that numbers compare methods on them.
"""


def draw(
    studies: tuple[str, ...], results: Results, out: Path, verdicts: Path | None = None, format: str = "png"
) -> list[Path]:
    """Write what these studies show, as far as there are numbers; the paths of the files. verdicts: the file of the
    verdicts, which are written with all studies; None: OUT/reproduction.md; format: figures are written in this one of
    `canvas.FORMATS` beside PNG, which the pages show."""
    shown = [table for table in tables.all_tables(results) if is_shown(table.name, studies)]
    found, paths = claims.verdicts(results), []
    disk.make_folder(out / "tables")
    for table in shown:
        for ending, write in WRITERS.items():
            paths.append(out / "tables" / f"{table.name}.{ending}")
            disk.write_text(paths[-1], write(table))
    with canvas.figure_style():
        for name in (study for study in studies if study in FIGURES):
            paths += draw_figure(name, results, out / "figures", format)
    pictures = current_figures(results, out / "figures")
    if set(studies) == set(STUDIES):
        paths.append(verdicts or out / "reproduction.md")
        disk.write_text(paths[-1], report(shown, found, pictures, paths[-1]))
    paths.append(out / "index.html")
    disk.write_text(paths[-1], page.page(shown, found, pictures, results))
    return paths


def draw_figure(name: str, results: Results, folder: Path, format: str) -> list[Path]:
    """Write a figure as PNG and in this format; the paths. What was drawn before of other numbers is deleted."""
    figure, path, numbers = FIGURES[name](results), folder / f"{name}.png", digest(results, name)
    if figure is None or drawn_from(path) != numbers:
        for ending in canvas.FORMATS:
            path.with_suffix(f".{ending}").unlink(missing_ok=True)
    if figure is None:
        return []
    canvas.save(figure, path, metadata={NUMBERS: numbers})
    if format == "png":
        return [path]
    canvas.save(figure, path.with_suffix(f".{format}"))
    return [path, path.with_suffix(f".{format}")]


def digest(results: Results, name: str) -> str:
    """What tells the numbers that a figure is drawn from: those of the runs of its study."""
    of_study = STUDIES[name](Choice())
    wanted = {(run.task, run.method, run.relabelling, run.explorer, run.lane.name) for run in of_study}
    found = hashlib.sha256()
    for run in sorted(results, key=lambda run: run.name):
        if (run.task, run.method, run.relabelling, run.explorer, run.lane.name) in wanted:
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
    belongs = {"table1": ("table1", "over_tasks", "near_and_far"), "table2": ("table2",)}
    return table == "costs" or any(table.startswith(belongs.get(study, ("-",))) for study in studies)


def verdict_table(found: list) -> Table:
    """Every claim with its test, effect, interval and verdict."""
    rows = []
    for claim, finding in found:
        why = f"; not counted: {'; '.join(finding.faults)}" if finding.faults else ""
        rows.append([claim.says, f"**{finding.verdict}**", finding.shown, finding.words + why, claim.test, claim.where])
    head = ["claim", "verdict", "effect [95 %]", "details", "test", "in the paper"]
    return Table("verdicts", "Verdicts", head, rows)


def report(shown: list[Table], found: list, pictures: list[Path], path: Path) -> str:
    """The page of verdicts, as Markdown. pictures: the figures; path: of the page."""
    counts = [finding.verdict for _, finding in found]
    kinds = ", ".join(f"{counts.count(kind)} {kind}" for kind in ("holds", "fails", "cannot be told"))
    lines = [ABOUT, "## Verdicts", "", f"{len(found)} claims: {kinds}. {INTERVALS}", "", markdown(verdict_table(found))]
    for table in shown:
        lines += [f"## {table.title}", "", markdown(table)]
    lines += ["## Figures", ""] if pictures else []
    for picture in pictures:
        words, there = DESCRIPTIONS[picture.stem], Path(os.path.relpath(picture, path.parent)).as_posix()
        lines += [f"![{words}]({there})", "", f"*{words}.*", ""]
    return "\n".join([*lines, BY_HAND]) + kept_by_hand(path)


def kept_by_hand(path: Path) -> str:
    """What was written by hand in the page of verdicts."""
    if not path.exists():
        return "\n"
    return path.read_text().partition(BY_HAND)[2] or "\n"
