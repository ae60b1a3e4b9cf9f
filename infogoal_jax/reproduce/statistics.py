"""Statistics over runs, goal sets and tasks.

Of one task: the mean with two intervals, over seeds (the goal sets as they are) and over goal sets. Over tasks: the
interquartile mean and the probability of improvement as rliable defines them (Agarwal et al., NeurIPS 2021), with the
percentile interval of a bootstrap that draws runs anew within each task. rliable itself is no dependency: of its
definitions two lines are needed here, and a test holds them against its published code.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from infogoal_jax.report.statistics import CONFIDENCE, mean_interval

REPETITIONS = 2000
"""Of the bootstrap."""
Scores = Sequence[np.ndarray]
"""Success of a method on a task: for each goal set that of its seeds, [seeds]."""


class TwoIntervals(NamedTuple):
    """A mean over goal sets and seeds. seeds: half the width of its interval over seeds, on these goal sets; sets: over
    goal sets; NaN where there is one seed, or one set."""

    mean: float
    seeds: float
    sets: float


class Bounds(NamedTuple):
    """A number and its interval."""

    value: float
    low: float
    high: float

    def show(self, decimals: int = 2) -> str:
        """`0.52 [0.48, 0.55]`."""
        value, low, high = (f"{round(number, decimals) + 0.0:.{decimals}f}" for number in self)  # No -0.00.
        return f"{value} [{low}, {high}]"


def over_seeds_and_sets(scores: Scores) -> TwoIntervals:
    """The mean of the goal sets' means. Over seeds: Student's t with the variance within the sets; over sets: Student's
    t of the sets' means."""
    means = np.array([np.mean(each) for each in scores])
    counts = np.array([len(each) for each in scores])
    half = math.nan
    if (counts > 1).all():
        variance = np.array([np.var(each, ddof=1) for each in scores])
        error = np.sqrt((variance / counts).sum()) / len(scores)
        half = float(stats.t.ppf((1 + CONFIDENCE) / 2, (counts - 1).sum()) * error)
    return TwoIntervals(float(means.mean()), half, float(mean_interval(means).half_width))


def interquartile_mean(tasks: Sequence[np.ndarray]) -> np.ndarray:
    """The mean of the middle half of all runs of all tasks, each task with the same weight: runs of each task [...,
    runs] to [...]."""
    return stats.trim_mean(np.concatenate(equally_many(tasks), axis=-1), proportiontocut=0.25, axis=-1)


def equally_many(tasks: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The runs of each task, repeated so often that all tasks have the same number of them."""
    common = math.lcm(*(runs.shape[-1] for runs in tasks))
    return [np.repeat(runs, common // runs.shape[-1], axis=-1) for runs in tasks]


def probability_of_improvement(first: Sequence[np.ndarray], second: Sequence[np.ndarray]) -> np.ndarray:
    """P(X > Y), ties counted half, for a run X of the first method and Y of the second on the same task, the mean over
    tasks: runs of each task [..., runs] to [...]."""
    wins = [
        ((x[..., :, None] > y[..., None, :]) + 0.5 * (x[..., :, None] == y[..., None, :])).mean((-2, -1))
        for x, y in zip(first, second, strict=True)
    ]
    return np.mean(wins, axis=0)


def bootstrap(function: Callable[..., np.ndarray], *methods: Sequence[np.ndarray], seed: int = 0) -> Bounds:
    """The function of the methods' runs by task, and its percentile interval: each repetition draws as many runs of
    each task anew, with replacement, for each method by itself."""
    random = np.random.default_rng(seed)
    drawn = [[runs[random.integers(0, len(runs), (REPETITIONS, len(runs)))] for runs in tasks] for tasks in methods]
    low, high = np.quantile(function(*drawn), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Bounds(float(function(*methods)), float(low), float(high))
