"""Tables I and II, and all tables that there are numbers for."""

import functools
import math

import numpy as np

from infogoal_jax.goal_uses import TEST
from infogoal_jax.reproduce.costs import costs
from infogoal_jax.reproduce.manifest import FETCH, METHODS, VARIANTS, Choice, runs_of
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.over_tasks import over_tasks
from infogoal_jax.reproduce.paper import TASKS, reported
from infogoal_jax.reproduce.scores import (
    KINDS,
    MARKS,
    ROWS,
    TITLES,
    Row,
    columns,
    has_scores,
    row_of,
    rows_of,
    scores_of,
)
from infogoal_jax.reproduce.statistics import over_seeds_and_sets
from infogoal_jax.reproduce.table_formats import Cell, Table


def table1(results: Results, variant: str) -> Table | None:
    """Table I in one of the variants; None where there are no runs."""
    rows = rows_of(results, variant, ROWS[variant])
    if not rows:
        return None
    shown = [(kind, task) for kind, task in columns() if any(known == task for known, _ in rows)]
    methods = [method for method in ROWS[variant] if any(known == method for _, known in rows)]
    cells = {
        (method, kind, task): cell_of(rows.get((task, method)), variant, kind, task, method)
        for method in methods
        for kind, task in shown
    }
    for kind, task in shown:
        if is_complete(rows, variant, kind, task):
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
        "Bold: best of a column; underlined: second best, in columns in which every method ran on every goal set. "
        f"{' or '.join(map(str, seeds))} seed(s) on each goal set. Corrupted: background of weight 0.4."
    ]
    foot += [f"{mark} {words}." for fault, (mark, words) in MARKS.items() if fault in found]
    return Table(f"table1_{variant}", f"Table I, {VARIANTS[variant]}", head, body, foot)


def cell_of(row: Row | None, variant: str, kind: str, task: str, method: str) -> Cell:
    """A cell of Table I. The paper has no second variant."""
    paper = reported(task, kind, method) if variant == "paper" or method == "her" else ""
    return Cell(None, paper) if row is None else Cell(row.mean(kind), paper, 0, row.marks(), row.results[0].run.name)


def ranks(column: dict[str, Cell]) -> dict[str, int]:
    """1 for the best of a column, 2 for the second best, by the two decimals that are shown; ties share a rank."""
    means = {name: round(cell.ours.mean, 2) for name, cell in column.items() if cell.ours is not None}
    order = sorted(set(means.values()), reverse=True)[:2]
    return {name: order.index(mean) + 1 for name, mean in means.items() if mean in order}


def is_complete(rows: dict[tuple[str, str], Row], variant: str, kind: str, task: str) -> bool:
    """Whether each method that the variant and the task allow has its number, and all of them on the same goal sets."""
    wanted = [rows.get((task, method)) for method in ROWS[variant] if is_planned(variant, task, method)]
    sets = {None if row is None else tuple(result.run.goal_set for result in row.results) for row in wanted}
    return len(sets) == 1 and all(has_scores(row, kind) for row in wanted)


@functools.cache
def is_planned(variant: str, task: str, method: str) -> bool:
    """Whether a variant has this row on a task."""
    return bool(runs_of(("table1",), Choice((task,), (method,), (variant,), seeds=1)))


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


def near_and_far(results: Results) -> Table | None:
    """Success on test goals of Fetch near a training goal and far from all of them, at the evaluation at which the run
    levelled off; of the runs that recorded which are near."""
    head, columns = ["method"], []
    for task in FETCH:
        rows = {method: row_of(results, "paper", task, method) for method in METHODS}
        rows = {method: row for method, row in rows.items() if row and all("near" in x.arrays for x in row.results)}
        if rows:
            head += [f"{TITLES[task]}, near", f"{TITLES[task]}, far"]
            columns += [(rows, True), (rows, False)]
    body = [
        [METHODS[method], *(near_cell(rows.get(method), near) for rows, near in columns)]
        for method in METHODS
        if any(method in rows for rows, _ in columns)
    ]
    foot = [
        "Success rate on clean test goals that count as reached from a training goal (near), and on the others (far): "
        "mean ± 95 % interval over seeds / over goal sets."
    ]
    return Table("near_and_far", "Near and far test goals of Fetch", head, body, foot) if body else None


def near_cell(row: Row | None, near: bool) -> Cell:
    """The success of a row on its near test goals, or on its far ones."""
    if row is None:
        return Cell(None)
    scores = []
    for result in row.results:
        kept = [place for place, seed in enumerate(result.run.seeds) if seed not in result.about["diverged"]]
        part = (result.arrays["uses"] == TEST) & (result.arrays["near"] == near)
        scores.append((result.arrays["first_reached"][kept][:, part] <= result.about["episode_length"]).mean((1, 2)))
    found = over_seeds_and_sets(scores) if all(len(each) and np.isfinite(each).all() for each in scores) else None
    return Cell(found, "", 0, row.marks(), row.results[0].run.name)


def all_tables(results: Results) -> list[Table]:
    """Every table that there are numbers for."""
    made = [make(results, variant) for variant in VARIANTS for make in (table1, over_tasks)]
    return [table for table in (*made, table2(results), near_and_far(results), costs(results)) if table is not None]
