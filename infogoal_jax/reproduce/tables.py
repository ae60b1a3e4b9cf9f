"""Tables I and II, the comparison over tasks and the cost, as Markdown, LaTeX and CSV from the same cells."""

import csv
import dataclasses
import io
import math
from typing import NamedTuple

import numpy as np

from infogoal_jax.reproduce.manifest import LEARNERS, METHODS, WAYS
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.paper import TASKS, reported
from infogoal_jax.reproduce.scores import KINDS, MARKS, TITLES, Row, columns, row_of, rows_of, scores_of
from infogoal_jax.reproduce.statistics import (
    TwoIntervals,
    bootstrap,
    interquartile_mean,
    over_seeds_and_sets,
    probability_of_improvement,
)

ROWS = {"paper": tuple(METHODS), "her": (*LEARNERS, "her")}
"""The rows of each way's table."""


class Cell(NamedTuple):
    """A number of a table. ours: None where there is no run; paper: in words; rank: 1 for the best of its column, 2 for
    the second best, else 0; marks: of what is wrong with it; run: the name of its first run."""

    ours: TwoIntervals | None
    paper: str = ""
    rank: int = 0
    marks: str = ""
    run: str = ""

    def words(self) -> str:
        """`0.85 ± 0.03 / 0.07†`: mean, interval over seeds, interval over goal sets; nothing where there is no run."""
        if self.ours is None:
            return ""
        seeds = f" ± {self.ours.seeds:.2f}" if math.isfinite(self.ours.seeds) else ""
        sets = f" / {self.ours.sets:.2f}" if math.isfinite(self.ours.sets) else ""
        return f"{self.ours.mean:.2f}{seeds}{sets}{self.marks}"


@dataclasses.dataclass(frozen=True)
class Table:
    """A table. title: in words; head: of the columns; rows: name and cells, a cell or words; foot: lines below."""

    name: str
    title: str
    head: list[str]
    rows: list[list[Cell | str]]
    foot: list[str] = dataclasses.field(default_factory=list)


def table1(results: Results, way: str) -> Table | None:
    """Table I in one of the ways; None where there are no runs."""
    rows = rows_of(results, way, ROWS[way])
    if not rows:
        return None
    shown = [(kind, task) for kind, task in columns() if any(known == task for known, _ in rows)]
    methods = [method for method in ROWS[way] if any(known == method for _, known in rows)]
    cells = {
        (method, kind, task): cell_of(rows.get((task, method)), way, kind, task, method)
        for method in methods
        for kind, task in shown
    }
    for kind, task in shown:
        column = {method: cells[method, kind, task] for method in methods}
        for method, rank in ranks(column).items():
            cells[method, kind, task] = column[method]._replace(rank=rank)
    head = ["method"]
    for kind, task in shown:
        head += [f"{TITLES[task]}, {KINDS[kind]}"]
    body = [[METHODS[method], *(cells[method, kind, task] for kind, task in shown)] for method in methods]
    found = {fault for row in rows.values() for fault in row.faults()}
    seeds = sorted({row.seeds for row in rows.values()})
    foot = [
        "Success rate: mean ± 95 % interval over seeds / over goal sets (Student t); in brackets the paper's number. "
        f"Bold: best of a column; underlined: second best. {' or '.join(map(str, seeds))} seed(s) on each goal set. "
        "Corrupted: background of weight 0.4."
    ]
    foot += [f"{mark} {words}." for fault, (mark, words) in MARKS.items() if fault in found]
    return Table(f"table1_{way}", f"Table I, {WAYS[way]}", head, body, foot)


def cell_of(row: Row | None, way: str, kind: str, task: str, method: str) -> Cell:
    """A cell of Table I. The paper has no second way."""
    paper = reported(task, kind, method) if way == "paper" or method == "her" else ""
    return Cell(None, paper) if row is None else Cell(row.mean(kind), paper, 0, row.marks(), row.results[0].run.name)


def ranks(column: dict[str, Cell]) -> dict[str, int]:
    """1 for the best of a column, 2 for the second best, by the two decimals that are shown; ties share a rank."""
    means = {name: round(cell.ours.mean, 2) for name, cell in column.items() if cell.ours is not None}
    order = sorted(set(means.values()), reverse=True)[:2]
    return {name: order.index(mean) + 1 for name, mean in means.items() if mean in order}


def over_tasks(results: Results, way: str) -> Table | None:
    """The interquartile mean of each method over tasks, and the probability that InfoGoal is better; by kind of goals,
    over the tasks on which all of the methods ran."""
    rows = rows_of(results, way, ROWS[way])
    methods = [method for method in ROWS[way] if any(known == method for _, known in rows)]
    if len(methods) < 2:
        return None
    tasks_of = {
        kind: [task for task in TASKS if all(has_scores(rows.get((task, method)), kind) for method in methods)]
        for kind in KINDS
    }
    kinds = [kind for kind in KINDS if tasks_of[kind]]
    if not kinds:
        return None
    head, body = ["method"], []
    for kind in kinds:
        head += [f"IQM, {KINDS[kind]}", f"P(InfoGoal better), {KINDS[kind]}"]
    runs = {
        (method, kind): [np.concatenate(rows[task, method].scores(kind)) for task in tasks_of[kind]]
        for method in methods
        for kind in kinds
    }
    for method in methods:
        cells = [METHODS[method]]
        for kind in kinds:
            cells.append(bootstrap(interquartile_mean, runs[method, kind]).show())
            against = method != "infogoal" and "infogoal" in methods
            better = runs.get(("infogoal", kind))
            cells.append(
                bootstrap(probability_of_improvement, better, runs[method, kind]).show() if against and better else ""
            )
        body.append(cells)
    foot = [
        "Interquartile mean over runs and tasks, and probability that a run of InfoGoal has more success than one of "
        "the method (rliable's definitions), with the 95 % interval of a bootstrap stratified by task."
    ]
    foot += [f"{KINDS[kind]}: {', '.join(TITLES[task] for task in tasks_of[kind])}." for kind in kinds]
    return Table(f"over_tasks_{way}", f"Over tasks, {WAYS[way]}", head, body, foot)


def has_scores(row: Row | None, kind: str) -> bool:
    """Whether a row has success on a kind of goals, of a seed that did not diverge."""
    scores = None if row is None else row.scores(kind)
    return scores is not None and all(len(each) for each in scores)


def table2(results: Results) -> Table | None:
    """Table II: beta, accuracy and KL that InfoGoal converges to."""
    body = []
    for task in TASKS:
        row = row_of(results, "paper", task, "infogoal")
        if row is None:
            continue
        cells: list[Cell | str] = [TITLES[task]]
        for metric, decimals in (("beta", 4), ("accuracy", 3), ("kl", 1)):
            values = [scores_of(result, f"infogoal/{metric}") for result in row.results]
            mean = over_seeds_and_sets(values)
            half = f" ± {mean.seeds:.{decimals}f}" if math.isfinite(mean.seeds) else ""
            cells.append(f"{mean.mean:.{decimals}f}{half}{row.marks()}")
        body.append([*cells, "0.013, 0.96" if task == "fetch_pick_and_place" else ""])
    foot = [
        "Mean ± 95 % interval over seeds. The paper's supplementary table could not be had; its text has PickAndPlace."
    ]
    head = ["task", "beta", "accuracy", "KL (nats)", "paper: beta, accuracy"]
    return Table("table2", "Table II: what InfoGoal converges to", head, body, foot) if body else None


def costs(results: Results) -> Table | None:
    """Programs, seconds of compiling and of running, by task."""
    body, machines, totals = [], {}, np.zeros(4)
    for task in TASKS:
        own = [result for run, result in results.items() if run.task == task]
        programs = {"\n".join(result.about["program"]["runs"]): result.about["program"] for result in own}
        if not own:
            continue
        compiling, running = (
            sum(program[f"{name}_seconds"] for program in programs.values()) for name in ("compile", "run")
        )
        measuring = sum(result.about["measure_seconds"] for result in own)
        numbers = np.array([len(own), len(programs), compiling + measuring, running])
        totals += numbers
        body.append([TITLES[task], *(f"{number:,.0f}" for number in numbers), f"{numbers[2:].sum() / 60:,.0f}"])
        machines |= dict.fromkeys(result.about["machine"] for result in own)
    if not body:
        return None
    body.append(["all", *(f"{number:,.0f}" for number in totals), f"{totals[2:].sum() / 60:,.0f}"])
    head = ["task", "runs", "programs", "compiling and measuring (s)", "training (s)", "minutes in all"]
    return Table("costs", "What it cost", head, body, [f"{'; '.join(machines)}."])


def all_tables(results: Results) -> list[Table]:
    """Every table that there are numbers for."""
    made = [make(results, way) for way in WAYS for make in (table1, over_tasks)]
    return [table for table in (*made, table2(results), costs(results)) if table is not None]


def markdown_cell(cell: Cell | str) -> str:
    """A cell in Markdown: best in bold, second best underlined, the paper's number in brackets."""
    if isinstance(cell, str):
        return cell
    words, paper = cell.words(), f" ({cell.paper})" if cell.paper else ""
    words = f"**{words}**" if cell.rank == 1 else f"<u>{words}</u>" if cell.rank == 2 else words
    return (words + paper).strip()


def markdown(table: Table) -> str:
    """The table in Markdown."""
    lines = [f"| {' | '.join(table.head)} |", "|" + "---|" * len(table.head)]
    lines += [f"| {' | '.join(markdown_cell(cell) for cell in row)} |" for row in table.rows]
    return "\n".join([*lines, "", *table.foot]) + "\n"


def latex_cell(cell: Cell | str) -> str:
    """A cell in LaTeX."""
    if isinstance(cell, str):
        return latex_words(cell)
    words, paper = latex_words(cell.words()), f" ({cell.paper})" if cell.paper else ""
    words = rf"\textbf{{{words}}}" if cell.rank == 1 else rf"\underline{{{words}}}" if cell.rank == 2 else words
    return (words + paper).strip()


def latex_words(words: str) -> str:
    """Words as LaTeX has them."""
    for plain, written in {"%": r"\%", "±": r"$\pm$", "†": r"$\dagger$", "‡": r"$\ddagger$", "§": r"\S"}.items():
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
