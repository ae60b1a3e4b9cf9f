"""The comparison of methods over tasks: interquartile means, and how probably a run of InfoGoal is better."""

from collections.abc import Callable

import numpy as np

from infogoal_jax.reproduce.manifest import METHODS, VARIANTS
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.paper import TASKS
from infogoal_jax.reproduce.scores import KINDS, MARKS, NOT_COUNTED, ROWS, TITLES, Row, has_scores, rows_of
from infogoal_jax.reproduce.statistics import bootstrap, interquartile_mean, probability_of_improvement
from infogoal_jax.reproduce.table_formats import Table


def counts(row: Row) -> bool:
    """Whether a row counts for what is said over tasks."""
    return not NOT_COUNTED.intersection(row.faults())


def over_tasks(results: Results, variant: str) -> Table | None:
    """The interquartile mean of each method over the tasks on which its row counts, and the probability that InfoGoal
    is better over those on which both do; by kind of goals, of the tasks on which all of the methods ran."""
    rows = rows_of(results, variant, ROWS[variant])
    methods = [method for method in ROWS[variant] if any(known == method for _, known in rows)]
    if len(methods) < 2:
        return None
    tasks_of = {
        kind: [task for task in TASKS if all(has_scores(rows.get((task, method)), kind) for method in methods)]
        for kind in KINDS
    }
    kinds = [kind for kind in KINDS if tasks_of[kind]]
    if not kinds:
        return None
    head = ["method"]
    for kind in kinds:
        head += [f"IQM, {KINDS[kind]}", f"P(InfoGoal better), {KINDS[kind]}"]
    body = []
    for method in methods:
        cells = [METHODS[method]]
        for kind in kinds:
            ran = len(tasks_of[kind])
            own = [rows[task, method] for task in tasks_of[kind] if counts(rows[task, method])]
            cells.append(over_some(interquartile_mean, ran, [row.scores(kind) for row in own]))
            both = [pair for pair in pairs_of(rows, tasks_of[kind], method) if all(map(counts, pair))]
            scores = [[scores_of_sets(row, other, kind) for row, other in (pair, pair[::-1])] for pair in both]
            cells.append(
                over_some(probability_of_improvement, ran, *(list(each) for each in zip(*scores, strict=True)))
            )
        body.append(cells)
    filled = [place for place in range(len(head)) if any(row[place] for row in body)]
    head, body = [head[place] for place in filled], [[row[place] for place in filled] for row in body]
    foot = [
        "Interquartile mean over runs and tasks, and probability that a run of InfoGoal has more success than one of "
        "the method on the same goal set (rliable's definitions), with the 95 % interval of a bootstrap over goal sets "
        "and seeds within tasks. Rows that do not count are left out: interquartile means over different tasks are not "
        "to be compared."
    ]
    for kind in kinds:
        foot.append(f"{KINDS[kind]}: {', '.join(TITLES[task] for task in tasks_of[kind])}.")
        left = [left_out(rows, task, methods) for task in tasks_of[kind]]
        foot += [f"Left out of {KINDS[kind]}: {'; '.join(filter(None, left))}."] if any(left) else []
    found = {fault for row in rows.values() for fault in row.faults() if fault in NOT_COUNTED}
    foot += [f"{mark} {words}." for fault, (mark, words) in MARKS.items() if fault in found]
    return Table(f"over_tasks_{variant}", f"Over tasks, {VARIANTS[variant]}", head, body, foot)


def pairs_of(rows: dict[tuple[str, str], Row], tasks: list[str], method: str) -> list[tuple[Row, Row]]:
    """InfoGoal's row and the method's of these tasks, where both are there and are not the same."""
    there = [task for task in tasks if method != "infogoal" and (task, "infogoal") in rows]
    return [(rows[task, "infogoal"], rows[task, method]) for task in there]


def scores_of_sets(row: Row, other: Row, kind: str) -> list[np.ndarray]:
    """Success of a row on the goal sets that another one has too, [seeds] of each."""
    shared = {result.run.goal_set for result in other.results}
    return [
        scores for result, scores in zip(row.results, row.scores(kind), strict=True) if result.run.goal_set in shared
    ]


def over_some(function: Callable[..., np.ndarray], ran: int, *methods: list) -> str:
    """The function over the tasks that count with its interval, and of how many tasks these are; nothing for none."""
    if not methods or not methods[0] or not all(scores for tasks in methods for scores in tasks):
        return ""
    count = len(methods[0])
    return bootstrap(function, *methods).show() + (f", {count} of {ran} tasks" if count < ran else "")


def left_out(rows: dict[tuple[str, str], Row], task: str, methods: list[str]) -> str:
    """The methods whose rows on a task do not count, with their marks."""
    names = [f"{METHODS[method]}{rows[task, method].marks()}" for method in methods if not counts(rows[task, method])]
    return f"{', '.join(names)} on {TITLES[task]}" if names else ""
