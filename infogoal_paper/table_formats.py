"""Tables, and how they are written: as Markdown, LaTeX and CSV from the same cells."""

import csv
import dataclasses
import io
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from infogoal_jax.report.statistics import Interval
from infogoal_paper.scores import TwoIntervals


class Cell(NamedTuple):
    """A number of a table.

    ours: None where there is no run.
    paper: in words.
    rank: 1 for the best of its column, 2 for the second best, else 0.
    marks: of what is wrong with it.
    run: the name of its first run.
    """

    ours: TwoIntervals | None
    paper: str = ""
    rank: int = 0
    marks: str = ""
    run: str = ""

    def words(self, short: bool = False) -> str:
        """`0.85 ± 0.03 / 0.07†`: mean, interval over seeds, interval over goal sets; nothing where there is no run.
        short: `0.85±0.07†`, with the wider of the two."""
        if self.ours is None:
            return ""
        if short:
            finite = [half for half in (self.ours.seeds, self.ours.sets) if math.isfinite(half)]
            return f"{self.ours.mean:.2f}{f'±{max(finite):.2f}' if finite else ''}{self.marks}"
        seeds = f" ± {self.ours.seeds:.2f}" if math.isfinite(self.ours.seeds) else ""
        sets = f" / {self.ours.sets:.2f}" if math.isfinite(self.ours.sets) else ""
        return f"{self.ours.mean:.2f}{seeds}{sets}{self.marks}"


@dataclasses.dataclass(frozen=True)
class Table:
    """A table.

    title: in words.
    head: of the columns.
    rows: name and cells, a cell or words.
    foot: lines below.
    """

    name: str
    title: str
    head: list[str]
    rows: list[list[Cell | str]]
    foot: list[str] = dataclasses.field(default_factory=list)


INTERVALS = "95 % interval over seeds / over goal sets"
WIDER = "the wider of its 95 % intervals over seeds and over goal sets"
"""What stands behind ± in a cell, and in a short one."""


def tight(interval: Interval, decimals: int = 2) -> str:
    """`0.52±0.03`: as `Interval.show`, for tables of many numbers."""
    return interval.show(decimals).replace(" ± ", "±")


def markdown_cell(cell: Cell | str, short: bool = False) -> str:
    """A cell in Markdown: best in bold, second best underlined, the paper's number in brackets."""
    if isinstance(cell, str):
        return cell
    words, paper = cell.words(short), f" ({cell.paper})" if cell.paper else ""
    words = f"**{words}**" if cell.rank == 1 else f"<u>{words}</u>" if cell.rank == 2 else words
    return (words + paper).strip()


def markdown_lines(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of words in Markdown, without a line behind it."""
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def markdown(table: Table, short: bool = False) -> str:
    """The table in Markdown. short: for a page, a cell has one interval, the wider one."""
    rows = [[markdown_cell(cell, short) for cell in row] for row in table.rows]
    foot = [line.replace(INTERVALS, WIDER) for line in table.foot] if short else table.foot
    return "\n".join([markdown_lines(table.head, rows), "", *foot]) + "\n"


def narrow(table: Table, heads: Iterable[str], names: Iterable[str] | None = None) -> Table:
    """The table with the columns of these heads beside the first, and the rows of these names; None: all of them."""
    kept = [0, *(place for place, head in enumerate(table.head) if place and head in set(heads))]
    names = [row[0] for row in table.rows] if names is None else list(names)
    rows = [[row[place] for place in kept] for row in table.rows if row[0] in names]
    return dataclasses.replace(table, head=[table.head[place] for place in kept], rows=rows)


def machines_in_words(machines: Iterable[str]) -> str:
    """Machines as `describe_machine` names them, `DEVICE, VERSIONS, DATE`: each once, with its first and last date."""
    dates: dict[str, set[str]] = {}
    for machine in machines:
        name, comma, date = machine.rpartition(", ")
        dates.setdefault(name if comma else date, set()).update({date} if comma else ())
    spans = {
        name: " to ".join(dict.fromkeys([min(found), max(found)])) if found else "" for name, found in dates.items()
    }
    return "; ".join(", ".join(filter(None, (name, span))) for name, span in spans.items())


def latex_cell(cell: Cell | str) -> str:
    """A cell in LaTeX."""
    if isinstance(cell, str):
        return latex_words(cell)
    words, paper = latex_words(cell.words()), f" ({cell.paper})" if cell.paper else ""
    words = rf"\textbf{{{words}}}" if cell.rank == 1 else rf"\underline{{{words}}}" if cell.rank == 2 else words
    return (words + paper).strip()


LATEX = {
    "%": r"\%",
    "±": r"$\pm$",
    "†": r"$\dagger$",
    "‡": r"$\ddagger$",
    "§": r"\S",
    "°": r"$^\circ$",
    "¶": r"\P",
    "◇": r"$\diamond$",
}
"""Characters of the tables that LaTeX writes otherwise."""


def latex_words(words: str) -> str:
    """Words as LaTeX has them."""
    for plain, written in LATEX.items():
        words = words.replace(plain, written)
    return words


def latex(table: Table) -> str:
    """The table in LaTeX, for the package booktabs."""
    lines = [rf"\begin{{tabular}}{{l{'c' * (len(table.head) - 1)}}}", r"\toprule"]
    lines += [" & ".join(map(latex_words, table.head)) + r" \\", r"\midrule"]
    lines += [" & ".join(map(latex_cell, row)) + r" \\" for row in table.rows]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", *(f"% {line}" for line in table.foot)]) + "\n"


def comma_separated(table: Table) -> str:
    """The table as CSV: of a cell the mean, both intervals, the paper's number, the rank and the marks in columns of
    their own."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    parts = ("mean", "interval over seeds", "interval over sets", "paper", "rank", "marks")
    wide = [any(isinstance(row[place], Cell) for row in table.rows) for place in range(len(table.head))]
    header = zip(table.head, wide, strict=True)
    writer.writerow(
        [
            name
            for title, of_cells in header
            for name in ([f"{title}: {part}" for part in parts] if of_cells else [title])
        ]
    )
    for row in table.rows:
        values = []
        for cell in row:
            if isinstance(cell, str):
                values.append(cell)
                continue
            ours = [""] * 3 if cell.ours is None else ["" if math.isnan(x) else f"{x:.4f}" for x in cell.ours]
            values += [*ours, cell.paper, cell.rank or "", cell.marks]
        writer.writerow(values)
    return text.getvalue()


WRITERS = {"md": markdown, "tex": latex, "csv": comma_separated}
"""By the ending of the file."""
