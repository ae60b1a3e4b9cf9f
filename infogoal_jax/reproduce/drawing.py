"""What is written of the numbers: tables, figures, the verdict on every claim, and the page that shows all of it.

OUT/tables/NAME.md, .tex, .csv    OUT/figures/NAME.png    OUT/reproduction.md    OUT/index.html
"""

import os
from pathlib import Path

from infogoal_jax.report import canvas
from infogoal_jax.reproduce import claims, page, tables
from infogoal_jax.reproduce.figures import FIGURES
from infogoal_jax.reproduce.manifest import STUDIES
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.tables import Table
from infogoal_jax.reproduce.titles import DESCRIPTIONS
from infogoal_jax.runs import disk

BY_HAND = "<!-- by hand -->"
"""What stands below this line of the page of verdicts is written by hand, and is kept."""
ABOUT = """# The paper, reproduced

Written by `infogoal reproduce`: Tables I and II, Figures 8 to 15 and a verdict on each claim of the paper, from the
numbers of the runs. [reproducing.md](reproducing.md) says how runs are made and repeated. Datasets are stand-ins
(README), so that numbers compare methods on them.
"""


def draw(studies: tuple[str, ...], results: Results, out: Path, verdicts: Path | None = None) -> list[Path]:
    """Write what these studies show, as far as there are numbers; the paths of the files. verdicts: the file of the
    verdicts, which are written with all studies; None: OUT/reproduction.md."""
    shown = [table for table in tables.all_tables(results) if is_shown(table.name, studies)]
    found, paths = claims.verdicts(results), []
    disk.make_folder(out / "tables")
    for table in shown:
        for ending, write in tables.WRITERS.items():
            paths.append(out / "tables" / f"{table.name}.{ending}")
            disk.write_text(paths[-1], write(table))
    for name in (study for study in studies if study in FIGURES):
        figure = FIGURES[name](results)
        if figure is not None:
            paths.append(out / "figures" / f"{name}.png")
            canvas.save(figure, paths[-1])
    if set(studies) == set(STUDIES):
        paths.append(verdicts or out / "reproduction.md")
        disk.write_text(paths[-1], report(shown, found, out / "figures", paths[-1]))
    paths.append(out / "index.html")
    disk.write_text(paths[-1], page.page(shown, found, out / "figures", results))
    return paths


def is_shown(table: str, studies: tuple[str, ...]) -> bool:
    """Whether a table belongs to these studies; what it cost is always shown."""
    belongs = {"table1": ("table1", "over_tasks"), "table2": ("table2",)}
    return table == "costs" or any(table.startswith(belongs.get(study, ("-",))) for study in studies)


def verdict_table(found: list) -> Table:
    """Every claim with its test, effect, interval and verdict."""
    rows = []
    for claim, finding in found:
        why = f"; not counted: {'; '.join(finding.faults)}" if finding.faults else ""
        rows.append([claim.says, f"**{finding.verdict}**", finding.shown, finding.words + why, claim.test, claim.where])
    head = ["claim", "verdict", "effect [95 %]", "details", "test", "in the paper"]
    return Table("verdicts", "Verdicts", head, rows)


def report(shown: list[Table], found: list, pictures: Path, path: Path) -> str:
    """The page of verdicts, as Markdown. pictures: the folder of the figures; path: of the page."""
    figures = Path(os.path.relpath(pictures, path.parent)).as_posix()
    counts = [finding.verdict for _, finding in found]
    kinds = ", ".join(f"{counts.count(kind)} {kind}" for kind in ("holds", "fails", "cannot be told"))
    lines = [ABOUT, "## Verdicts", "", f"{len(found)} claims: {kinds}.", "", tables.markdown(verdict_table(found))]
    for table in shown:
        lines += [f"## {table.title}", "", tables.markdown(table)]
    drawn = [name for name in FIGURES if (pictures / f"{name}.png").exists()]
    lines += ["## Figures", ""] if drawn else []
    for name in drawn:
        lines += [f"![{DESCRIPTIONS[name]}]({figures}/{name}.png)", "", f"*{DESCRIPTIONS[name]}.*", ""]
    return "\n".join([*lines, BY_HAND]) + kept_by_hand(path)


def kept_by_hand(path: Path) -> str:
    """What was written by hand in the page of verdicts."""
    if not path.exists():
        return "\n"
    return path.read_text().partition(BY_HAND)[2] or "\n"
