"""Statistics over tasks are those of rliable."""

import numpy as np
import pytest
from scipy import stats

from infogoal_jax.reproduce.scores import (
    bootstrap,
    interquartile_mean,
    over_seeds_and_sets,
    over_tasks,
    probability_of_improvement,
)


def rliable_iqm(scores: np.ndarray) -> float:
    """`aggregate_iqm` of rliable/metrics.py: scores [runs, tasks]."""
    return stats.trim_mean(scores, proportiontocut=0.25, axis=None)


def rliable_improvement(x: np.ndarray, y: np.ndarray) -> float:
    """`probability_of_improvement` of rliable/metrics.py: scores [runs, tasks]."""
    found = []
    for task in range(x.shape[1]):
        if np.array_equal(x[:, task], y[:, task]):
            found.append(0.5)
        else:
            wins, _ = stats.mannwhitneyu(x[:, task], y[:, task], alternative="greater")
            found.append(wins / (len(x) * len(y)))
    return np.mean(found)


@pytest.fixture
def scores():
    """Two methods, [runs, tasks], with ties."""
    draw = np.random.default_rng(0)
    return draw.integers(0, 9, (5, 6)) / 8, draw.integers(0, 9, (7, 6)) / 8


def of_one_set(scores: np.ndarray) -> list:
    """Scores [runs, tasks], by task and goal set: one goal set each."""
    return [[runs] for runs in scores.T]


def mean(tasks) -> np.ndarray:
    """The mean over tasks and goal sets."""
    return np.mean([np.mean([runs.mean(-1) for runs in sets], axis=0) for sets in tasks], axis=0)


def test_the_interquartile_mean_is_rliable_s(scores):
    for each in scores:
        assert interquartile_mean(of_one_set(each)) == pytest.approx(rliable_iqm(each), abs=1e-12)


def test_the_probability_of_improvement_is_rliable_s(scores):
    x, y = map(of_one_set, scores)
    assert probability_of_improvement(x, y) == pytest.approx(rliable_improvement(*scores), abs=1e-12)
    assert probability_of_improvement(x, x) == pytest.approx(0.5)


def test_tasks_and_goal_sets_with_more_runs_count_no_more():
    few, many = np.array([0.0, 0.1, 0.2, 0.3]), np.tile([0.6, 0.7, 0.8, 0.9], 3)
    for tasks in ([[few], [many]], [[few, many]]):
        assert interquartile_mean(tasks) == pytest.approx(interquartile_mean([[few], [many[:4]]]))


def test_runs_are_compared_on_the_same_goal_set():
    """A method that is better on each goal set by little is better for sure, however much the goal sets differ."""
    better, worse = ([np.array([level, level + 0.01]) + gain for level in (0.1, 0.5, 0.8)] for gain in (0.05, 0))
    assert probability_of_improvement([better], [worse]) == 1
    assert bootstrap(probability_of_improvement, [better], [worse]) == (1, 1, 1)


def test_the_bootstrap_draws_within_tasks():
    """Two tasks of equal runs each: whatever is drawn, the mean is the same; a pooled bootstrap would vary."""
    assert bootstrap(mean, [[np.zeros(5)], [np.ones(5)]]) == (0.5, 0.5, 0.5)


def test_the_bootstrap_draws_goal_sets_and_then_seeds():
    """Goal sets that differ, seeds that agree: a bootstrap of pooled runs would take them for 15 independent ones."""
    sets = [np.full(5, level) for level in (0.1, 0.5, 0.9)]
    value, low, high = bootstrap(mean, [sets])
    assert (value, low, high) == pytest.approx((0.5, 0.1, 0.9))


def test_the_bootstrap_covers_the_mean():
    """Of 200 samples of a known mean, about 95 % have it in their interval."""
    draw, inside = np.random.default_rng(0), 0
    for number in range(200):
        tasks = [[draw.normal(size=40)] for _ in range(3)]
        low, high = bootstrap(mean, tasks, seed=number)[1:]
        inside += low < 0 < high
    assert 0.9 < inside / 200 < 0.99


@pytest.mark.parametrize("spread", [0.0, 0.5], ids=["alike", "different"])
def test_the_interval_of_an_effect_covers_it_over_seeds_and_goal_sets(spread):
    """Of 400 effects on two tasks, one of three goal sets and one of one, at least 95 % have theirs in the interval."""
    draw, inside = np.random.default_rng(1), 0
    for _ in range(400):
        sets = [draw.normal(scale=spread) + draw.normal(scale=0.2, size=5) for _ in range(3)]
        _, low, high = over_tasks([sets, [draw.normal(scale=0.2, size=5)]])
        inside += low < 0 < high
    assert inside / 400 > 0.93


def test_the_interval_of_one_task_is_the_wider_one_of_the_table():
    for levels in ((0.1, 0.5, 0.9), (0.5, 0.5, 0.5)):
        scores = [np.array([level, level + 0.2]) for level in levels]
        table = over_seeds_and_sets(scores)
        value, low, high = over_tasks([scores])
        assert value == pytest.approx(table.mean)
        assert (high - low) / 2 == pytest.approx(max(table.seeds, table.sets))
    assert np.isnan(over_tasks([[np.array([0.1])]]).low)


def test_one_interval_is_over_seeds_and_one_over_sets():
    """Sets that differ much, seeds that agree: only the interval over sets is wide."""
    close = over_seeds_and_sets([np.array([level, level + 0.01]) for level in (0.1, 0.5, 0.9)])
    assert close.mean == pytest.approx(0.505) and close.seeds < 0.02 and close.sets > 0.9
    alone = over_seeds_and_sets([np.array([0.1, 0.2, 0.3])])
    assert alone.seeds == pytest.approx(stats.t.ppf(0.975, 2) * 0.1 / np.sqrt(3)) and np.isnan(alone.sets)
    assert np.isnan(over_seeds_and_sets([np.array([0.1]), np.array([0.3])]).seeds)
