"""The tests that decide what the paper says of beta: what it converges to, and fixed ones beside the adaptive one
(Figures 13 to 15)."""

from collections.abc import Callable, Sequence

import numpy as np

from infogoal_jax.report.statistics import mean_interval
from infogoal_jax.reproduce.effects import (
    Finding,
    Paired,
    combined,
    difference,
    finding,
    lacking_rows,
    mean_of,
    metric_of,
    of_row,
    success,
)
from infogoal_jax.reproduce.evidence import COMPARABLE
from infogoal_jax.reproduce.manifest import FETCH, FIXED_BETAS, PRESET, fixed
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.scores import Row, row_of

CORRUPTED = ("corrupted_train_goal", "corrupted_test_goal")
Rows = dict[str, Row]


def infogoal_on_pick_and_place(results: Results, lane: str = PRESET[0]) -> Row | None:
    """The row of InfoGoal on FetchPickAndPlace."""
    return row_of(results, "paper", "fetch_pick_and_place", "infogoal", lane)


def near(metric: str, target: float, tolerance: float, ratio: bool = False) -> Callable[[Results], Finding]:
    """The tolerance minus the distance of what a metric of InfoGoal converges to on FetchPickAndPlace from the paper's
    number. ratio: the distance is that of logarithms, and the tolerance a factor."""

    def left(value: float) -> float:
        off = abs(np.log(value / target)) if ratio else abs(value - target)
        return (np.log(tolerance) if ratio else tolerance) - off

    def find(results: Results) -> Finding:
        row = infogoal_on_pick_and_place(results)
        if row is None:
            return Finding(None, "no runs")
        values = of_row(row, metric_of(f"infogoal/{metric}"))
        shown = mean_interval([value for seeds in values.values() for value in seeds.values()]).show(4)
        words = f"{metric} {shown}, the paper {target}; the effect is what it may still be off"
        return finding({row.results[0].run.task: combined(left, values)}, words, [row], decimals=4)

    return find


def rows_of_lane(results: Results, lane: str) -> Rows | None:
    """The rows of InfoGoal under a lane on the three Fetch tasks; None unless all of them ran."""
    rows = {task: row_of(results, "paper", task, "infogoal", lane) for task in FETCH}
    return None if None in rows.values() else rows


def gains(first: Rows, second: Rows, kinds: Sequence[str]) -> dict[str, Paired]:
    """Success of the first rows minus that of the second, mean over kinds of goals, by task."""
    numbers = [
        {task: mean_of([of_row(row, success(kind)) for kind in kinds]) for task, row in rows.items()}
        for rows in (first, second)
    ]
    return {task: difference(numbers[0][task], numbers[1][task]) for task in first}


def mean_success(rows: Rows, kinds: Sequence[str]) -> float:
    """Success of rows, mean over tasks and kinds of goals."""
    return float(np.mean([row.mean(kind).mean for row in rows.values() for kind in kinds]))


def fixed_against_adaptive(results: Results) -> Finding:
    """Adaptive minus the best fixed beta, mean over the three Fetch tasks and both kinds of corrupted goals. A row that
    does not count might be the best, so that nothing can be told."""
    lanes = {beta: rows for beta in FIXED_BETAS if (rows := rows_of_lane(results, fixed(beta)[0])) is not None}
    adaptive = rows_of_lane(results, PRESET[0])
    if not lanes or adaptive is None:
        return Finding(None, "no runs")
    means = {beta: mean_success(rows, CORRUPTED) for beta, rows in lanes.items()}
    best = max(means, key=means.get)
    words = f"adaptive {mean_success(adaptive, CORRUPTED):.2f}, best fixed beta {best:g} {means[best]:.2f}"
    every = [*adaptive.values(), *(row for rows in lanes.values() for row in rows.values())]
    found = finding(gains(adaptive, lanes[best], CORRUPTED), words, every, above=-COMPARABLE)
    return found if len(lanes) == len(FIXED_BETAS) else lacking_rows(found)


def beta_gain(better: float, worse: float) -> Callable[[Results], Finding]:
    """Success on corrupted test goals under one fixed beta minus that under another."""
    kinds = CORRUPTED[1:]

    def find(results: Results) -> Finding:
        first, second = (rows_of_lane(results, fixed(beta)[0]) for beta in (better, worse))
        if first is None or second is None:
            return Finding(None, "no runs")
        words = ", ".join(
            f"beta {beta:g}: {mean_success(rows, kinds):.2f}" for beta, rows in ((better, first), (worse, second))
        )
        return finding(gains(first, second, kinds), words, [*first.values(), *second.values()])

    return find


def less_information(results: Results) -> Finding:
    """How many times larger the KL of the codes is under the adaptive beta than under a fixed one of 0.1, as a
    logarithm."""
    rows = [infogoal_on_pick_and_place(results, lane) for lane in (PRESET[0], fixed(0.1)[0])]
    if None in rows:
        return Finding(None, "no runs")
    adaptive, high = (of_row(row, metric_of("infogoal/kl")) for row in rows)
    ratio = combined(lambda x, y: np.log(max(x, 1e-6)) - np.log(max(y, 1e-6)), adaptive, high)
    means = [np.mean([value for seeds in each.values() for value in seeds.values()]) for each in (adaptive, high)]
    words = f"log ratio of the KL: adaptive {means[0]:.1f}, beta 0.1 {means[1]:.2f} nats"
    return finding({rows[0].results[0].run.task: ratio}, words, rows)
