"""From the numbers of runs to those of tables: statistics over seeds, goal sets and tasks; then success of a row of
Table I on a task, and whether the row counts.

Of one task: the mean with two intervals, over seeds (the goal sets as they are) and over goal sets. Over tasks: the
interquartile mean and the probability of improvement as rliable defines them (Agarwal et al., NeurIPS 2021), with the
percentile interval of a bootstrap that draws goal sets anew within each task, and seeds within each goal set. rliable
itself is no dependency: of its definitions two lines are needed here, and a test holds them against its published code.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from infogoal_jax.report.statistics import CONFIDENCE, mean_interval
from infogoal_paper import plan
from infogoal_paper.files import Result
from infogoal_paper.manifest import PRESET, parts_of
from infogoal_paper.numbers import Results
from infogoal_paper.paper import IMAGE_TASKS, LEARNERS, METHODS, TASKS, WITH_LOSS

REPETITIONS = 2000
"""Of the bootstrap."""
Scores = Sequence[np.ndarray]
"""Numbers of a method on a task: for each goal set those of its seeds, [seeds]; drawn ones [repetitions, seeds]."""


class TwoIntervals(NamedTuple):
    """A mean over goal sets and seeds. seeds: half the width of its interval over seeds, on these goal sets; sets: over
    goal sets; NaN where there is one seed, or one set."""

    mean: float
    seeds: float
    sets: float


class Bounds(NamedTuple):
    """A number and its interval, NaN where there is none."""

    value: float
    low: float
    high: float

    def show(self, decimals: int = 2) -> str:
        """`0.52 [0.48, 0.55]`, or `0.52`."""
        value, low, high = (f"{round(number, decimals) + 0.0:.{decimals}f}" for number in self)  # No -0.00.
        return f"{value} [{low}, {high}]" if math.isfinite(self.low) else value


class Spread(NamedTuple):
    """The variance of a mean, and its degrees of freedom."""

    variance: float
    freedom: float


def over_seeds_and_sets(scores: Scores) -> TwoIntervals:
    """The mean of the goal sets' means. Over seeds: Student's t with the variance within the sets; over sets: Student's
    t of the sets' means."""
    means = np.array([np.mean(each) for each in scores])
    spread = spread_of_seeds(scores)
    half = math.nan if spread is None else half_width(spread)
    return TwoIntervals(float(means.mean()), half, float(mean_interval(means).half_width))


def spread_of_seeds(scores: Scores) -> Spread | None:
    """How sure the mean of a task is on these goal sets; None where a goal set has one seed."""
    counts = np.array([len(each) for each in scores])
    if (counts < 2).any():
        return None
    variance = np.array([np.var(each, ddof=1) for each in scores])
    return Spread(float((variance / counts).sum()) / len(scores) ** 2, float((counts - 1).sum()))


def spread_of_sets(scores: Scores) -> Spread | None:
    """How sure the mean of a task is over goal sets; None where there is one."""
    if len(scores) < 2:
        return None
    return Spread(float(np.var([np.mean(each) for each in scores], ddof=1)) / len(scores), len(scores) - 1.0)


def half_width(spread: Spread) -> float:
    """Half the width of the interval of Student's t."""
    return float(stats.t.ppf((1 + CONFIDENCE) / 2, spread.freedom) * math.sqrt(spread.variance))


def over_tasks(tasks: Sequence[Scores]) -> Bounds:
    """The mean of the tasks' means, and its interval over seeds or over goal sets, whichever is wider. A task with one
    goal set counts in both with its seeds. Degrees of freedom are Satterthwaite's."""
    mean = float(np.mean([np.mean([np.mean(each) for each in scores]) for scores in tasks]))
    seeds = [spread_of_seeds(scores) for scores in tasks]
    sets = [spread_of_sets(scores) or own for scores, own in zip(tasks, seeds, strict=True)]
    halves = [half_width(mean_spread(each)) for each in (seeds, sets) if None not in each]
    half = max(halves, default=math.nan)
    return Bounds(mean, mean - half, mean + half)


def mean_spread(spreads: Sequence[Spread]) -> Spread:
    """The spread of the mean of independent means."""
    total = sum(spread.variance for spread in spreads)
    freedom = sum(spread.variance**2 / spread.freedom for spread in spreads)
    return Spread(total / len(spreads) ** 2, total**2 / freedom if freedom else spreads[0].freedom)


def interquartile_mean(tasks: Sequence[Scores]) -> np.ndarray:
    """The mean of the middle half of all runs of all tasks, each task with the same weight, and each goal set within
    it."""
    of_tasks = [np.concatenate(equally_many(scores), axis=-1) for scores in tasks]
    return stats.trim_mean(np.concatenate(equally_many(of_tasks), axis=-1), proportiontocut=0.25, axis=-1)


def equally_many(groups: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The runs of each group, repeated so often that all groups have the same number of them."""
    common = math.lcm(*(runs.shape[-1] for runs in groups))
    return [np.repeat(runs, common // runs.shape[-1], axis=-1) for runs in groups]


def probability_of_improvement(first: Sequence[Scores], second: Sequence[Scores]) -> np.ndarray:
    """P(X > Y), ties counted half, for a run X of the first method and Y of the second on the same goal set: the mean
    over goal sets, then over tasks."""
    return np.mean(
        [
            np.mean([wins(x, y) for x, y in zip(one, two, strict=True)], axis=0)
            for one, two in zip(first, second, strict=True)
        ],
        axis=0,
    )


def wins(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The share of pairs of runs [..., runs] in which the first is larger, ties counted half."""
    return ((x[..., :, None] > y[..., None, :]) + 0.5 * (x[..., :, None] == y[..., None, :])).mean((-2, -1))


def bootstrap(function: Callable[..., np.ndarray], *methods: Sequence[Scores], seed: int = 0) -> Bounds:
    """The function of the methods' numbers by task and goal set, and its percentile interval.

    Each repetition draws goal sets of each task anew, with replacement and the same for all methods, and seeds of each
    drawn goal set, for each method by itself: as many as the goal set with the fewest has.
    """
    random = np.random.default_rng(seed)
    places = [random.integers(0, len(scores), (REPETITIONS, len(scores))) for scores in methods[0]]
    drawn = [[redrawn(scores, own, random) for scores, own in zip(tasks, places, strict=True)] for tasks in methods]
    low, high = np.quantile(function(*drawn), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Bounds(float(function(*methods)), float(low), float(high))


def redrawn(scores: Scores, places: np.ndarray, random: np.random.Generator) -> list[np.ndarray]:
    """Seeds of the goal sets at these places [repetitions, sets], drawn anew: [repetitions, seeds] of each."""
    shape = (*places.shape, min(len(each) for each in scores))
    every = np.stack([np.asarray(each)[random.integers(0, len(each), shape)] for each in scores])
    chosen = np.take_along_axis(every, places[None, :, :, None], axis=0)[0]
    return list(np.moveaxis(chosen, 1, 0))


ROWS = {"paper": tuple(METHODS), "her": (*LEARNERS, "her"), "text": tuple(METHODS)}
"""The rows of each variant of Table I."""
KINDS = {"test_goal": "test", "corrupted_test_goal": "corrupted test", "corrupted_train_goal": "corrupted training"}
"""The kinds of goals of Table I, as metrics name them, and in words."""
TITLES = {
    "object_search": "ObjSearch",
    "object_manipulation": "ObjMani",
    "fetch_reach": "Reach",
    "fetch_push": "Push",
    "fetch_pick_and_place": "PickAndPlace",
    "embodied_qa": "EQA",
}
"""Tasks as Table I names them."""
LEAST_SHARE = 0.01
"""Of the goal encoder's gradient that a method's own loss has to make; below it the row is the bare agent's."""
MARKS = {
    "rises": ("†", "it had not levelled off where training stopped"),
    "off": ("‡", f"the method's own loss makes less than {LEAST_SHARE:.0%} of the goal encoder's gradient"),
    "diverged": ("§", "seeds diverged and are left out"),
    "unmeasured": ("°", "the share of the method's own loss in the gradient was not measured"),
    "sets": ("¶", "other methods ran on goal sets of the task on which it did not"),
    "former": ("◇", "the preset has changed since it was trained"),
}
"""What is wrong with a row: its mark, and in words."""
NOT_COUNTED = {"rises", "off", "unmeasured"}
"""Faults with which a row does not count for verdicts. Rows on different goal sets are compared on those that both
have."""


class Row(NamedTuple):
    """A method on a task: its runs, one a goal set. lacking: goal sets on which other methods of its table ran."""

    results: tuple[Result, ...]
    lacking: frozenset[int] = frozenset()

    def scores(self, kind: str) -> list[np.ndarray] | None:
        """Success on a kind of goals, [seeds] of each goal set, without seeds that diverged; None where the task has no
        such goals."""
        if any(f"{kind}/success_rate" not in result.evaluations for result in self.results):
            return None
        return [scores_of(result, f"{kind}/success_rate") for result in self.results]

    def mean(self, kind: str) -> TwoIntervals | None:
        """The mean over goal sets and seeds with its intervals."""
        scores = self.scores(kind)
        return None if scores is None or not all(len(each) for each in scores) else over_seeds_and_sets(scores)

    def faults(self) -> list[str]:
        """What is wrong with the row, keys of `MARKS`; a row without any counts."""
        found = []
        if any(plan.still_rises(result.evaluations["train_goal/success_rate"]) for result in self.results):
            found.append("rises")
        shares = [result.about["learner_share"] for result in self.results]
        measured = [share for share in shares if share is not None]
        if any(not share >= LEAST_SHARE for share in measured):
            found.append("off")
        if not measured and self.results[0].run.method in WITH_LOSS:
            found.append("unmeasured")
        if any(result.about["diverged"] for result in self.results):
            found.append("diverged")
        if self.lacking:
            found.append("sets")
        if any(result.has_former_settings for result in self.results):
            found.append("former")
        return found

    def marks(self) -> str:
        """The marks of what is wrong."""
        return "".join(MARKS[fault][0] for fault in self.faults())

    @property
    def seeds(self) -> int:
        """How many there are of each goal set at least."""
        return min(len(result.run.seeds) for result in self.results)


def scores_of(result: Result, metric: str, which: slice | None = None) -> np.ndarray:
    """A metric of a run, [seeds], without the seeds that diverged: the mean over these evaluations, or over those that
    count."""
    which = plan.shown(result.evaluations["train_goal/success_rate"]) if which is None else which
    return result.evaluations[metric][result.kept, which].mean(1)


def by_goal_set(results: Results, row: tuple) -> dict[int, Result]:
    """The runs of a row (`Run.row`) by goal set, those of the most seeds where there are several."""
    by_seeds = sorted((run for run in results if run.row == row), key=lambda run: len(run.seeds))
    return {run.goal_set: results[run] for run in by_seeds}


def row_of(
    results: Results, variant: str, task: str, method: str, setting: str = PRESET[0], explorer=None
) -> Row | None:
    """The runs of a row of Table I, or of another setting or explorer; None where there are none."""
    parts = parts_of(variant, task, method)
    if parts is None:
        return None
    by_set = by_goal_set(results, (task, method, parts[0], explorer, setting, None, "visited"))
    if not by_set:
        return None
    in_table = explorer is None and setting == PRESET[0]  # What is beside it is run on the first goal set alone.
    lacking = goal_sets_of(results, variant, task) - by_set.keys() if in_table else frozenset()
    return Row(tuple(by_set[number] for number in sorted(by_set)), lacking)


def goal_sets_of(results: Results, variant: str, task: str) -> frozenset[int]:
    """The goal sets of a task on which at least one row of a variant's table ran."""
    relabellings = {method: parts[0] for method in METHODS if (parts := parts_of(variant, task, method)) is not None}
    return frozenset(
        run.goal_set
        for run in results
        if (run.task, run.explorer, run.setting.name) == (task, None, PRESET[0])
        and run.of_paper
        and run.method in relabellings
        and run.relabelling == relabellings[run.method]
    )


def rows_of(results: Results, variant: str, methods) -> dict[tuple[str, str], Row]:
    """Every row that there is, by (task, method)."""
    found = {(task, method): row_of(results, variant, task, method) for task in TASKS for method in methods}
    return {key: row for key, row in found.items() if row is not None}


def columns() -> list[tuple[str, str]]:
    """(kind of goals, task) of the columns of Table I."""
    return [(kind, task) for kind in KINDS for task in (TASKS if kind == "test_goal" else IMAGE_TASKS)]


def has_scores(row: Row | None, kind: str) -> bool:
    """Whether a row has success on a kind of goals, of a seed that did not diverge."""
    scores = None if row is None else row.scores(kind)
    return scores is not None and all(len(each) for each in scores)
