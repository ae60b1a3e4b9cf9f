"""What decides a claim: an effect with its interval, and why it may not count.

An effect is a mean over tasks, their goal sets and seeds of differences that are paired by goal set and seed. Its 95 %
interval is that over seeds or that over goal sets, as in the table, whichever is wider. A claim holds where the whole
interval lies on its side, fails where it lies on the other, and else cannot be told. Nor can one that rests on fewer
than three seeds, or on a row of which the table says that it does not count.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from infogoal_jax.reproduce.files import Result
from infogoal_jax.reproduce.manifest import METHODS
from infogoal_jax.reproduce.scores import MARKS, NOT_COUNTED, TITLES, Row, scores_of
from infogoal_jax.reproduce.statistics import Bounds, over_tasks

Verdict = Literal["holds", "fails", "cannot be told"]
Paired = dict[int, dict[int, float]]
"""A number of each seed, by goal set and seed."""
INTERVALS = "Effects are paired by goal set and seed; intervals are over seeds or goal sets, whichever is wider."
LEAST_SEEDS = 3
"""On each goal set, for anything to be told."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """What the numbers say about a claim. effect: the number that decides it, with its interval; None without runs;
    above: the claim holds if the effect lies above it; words: what the effect is, and what else is to be known; faults:
    why it does not count."""

    effect: Bounds | None
    words: str
    above: float = 0.0
    faults: tuple[str, ...] = ()
    decimals: int = 2

    @property
    def shown(self) -> str:
        """The effect and its interval; nothing without runs."""
        return "" if self.effect is None else self.effect.show(self.decimals)

    @property
    def verdict(self) -> Verdict:
        """Holds, fails, or cannot be told."""
        if self.effect is None or self.faults or not math.isfinite(self.effect.low):
            return "cannot be told"
        if self.effect.low > self.above:
            return "holds"
        return "fails" if self.effect.high < self.above else "cannot be told"


def finding(
    tasks: dict[str, Paired], words: str, rows: Sequence[Row | None] = (), above: float = 0.0, decimals: int = 2
) -> Finding:
    """The mean effect over tasks and its interval. rows: that it rests on."""
    values = [[np.array([*seeds.values()]) for seeds in sets.values()] for sets in tasks.values() if sets]
    if not values:
        return Finding(None, "no runs", above, faults_of(*rows))
    seeds = [len(each) for scores in values for each in scores]
    few = (f"fewer than {LEAST_SEEDS} seeds",) if min(seeds) < LEAST_SEEDS else ()
    over = f"{count_of(seeds, 'seed')} on {count_of([len(scores) for scores in values], 'goal set')}"
    return Finding(over_tasks(values), f"{words}; {over}", above, faults_of(*rows) + few, decimals)


def lacking_rows(found: Finding) -> Finding:
    """The finding, of whose rows some did not run."""
    return dataclasses.replace(found, faults=(*found.faults, "rows are missing"))


def count_of(counts: Sequence[int], name: str) -> str:
    """`3 goal sets`, `1 to 3 goal sets`."""
    low, high = min(counts), max(counts)
    return f"{low if low == high else f'{low} to {high}'} {name}{'s' * (high > 1)}"


def faults_of(*rows: Row | None) -> tuple[str, ...]:
    """Why some of these rows do not count, in words."""
    found = {fault for row in rows if row is not None for fault in row.faults()} & NOT_COUNTED
    return tuple(MARKS[fault][1] for fault in sorted(found))


def by_seed(result: Result, values: np.ndarray) -> dict[int, float]:
    """Values [seeds] of a run by seed, without those that are no numbers and the seeds that diverged."""
    kept = (seed for seed in result.run.seeds if seed not in result.about["diverged"])
    own = {seed: float(values[result.run.seeds.index(seed)]) for seed in kept}
    return {seed: value for seed, value in own.items() if math.isfinite(value)}


def metric_of(metric: str) -> Callable[[Result], dict[int, float]]:
    """A metric of a run by seed, over the evaluations that count."""

    def find(result: Result) -> dict[int, float]:
        kept = [seed for seed in result.run.seeds if seed not in result.about["diverged"]]
        return dict(zip(kept, scores_of(result, metric).tolist(), strict=True))

    return find


def success(kind: str) -> Callable[[Result], dict[int, float]]:
    """Success on a kind of goals by seed."""
    return metric_of(f"{kind}/success_rate")


def of_row(row: Row, number: Callable[[Result], dict[int, float]]) -> Paired:
    """A number of each run of a row."""
    found = {result.run.goal_set: number(result) for result in row.results}
    return {place: seeds for place, seeds in found.items() if seeds}


def combined(function: Callable[..., float], *several: Paired) -> Paired:
    """The function of several numbers on the same goal set and seed, where all have one."""
    found = {}
    for place in set(several[0]).intersection(*several[1:]):
        seeds = sorted(set(several[0][place]).intersection(*(each[place] for each in several[1:])))
        if seeds:
            found[place] = {seed: float(function(*(each[place][seed] for each in several))) for seed in seeds}
    return dict(sorted(found.items()))


def difference(first: Paired, second: Paired) -> Paired:
    """The first minus the second."""
    return combined(lambda x, y: x - y, first, second)


def mean_of(several: Sequence[Paired]) -> Paired:
    """The mean of several: methods share seeds, and the runs that they are compared with."""
    return combined(lambda *values: np.mean(values), *several)


def by_task(tasks: dict[str, Paired]) -> str:
    """`mean over Push 0.12, EQA 0.15`: a mean may hide a task that is otherwise."""
    means = {task: np.mean([np.mean([*seeds.values()]) for seeds in sets.values()]) for task, sets in tasks.items()}
    return f"mean over {', '.join(f'{TITLES[task]} {mean + 0.0:.2f}' for task, mean in means.items())}"


def left_out_words(left_out: Sequence[str]) -> str:
    """Which comparisons are left out, and why."""
    return f"; left out, because a row does not count: {', '.join(left_out)}" if left_out else ""


def pair_words(one: str, two: str, task: str) -> str:
    """`HER and DQN/HRAC/CQL on ObjSearch`."""
    return f"{METHODS[one]} and {METHODS[two]} on {TITLES[task]}"
