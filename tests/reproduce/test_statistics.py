"""Statistics over tasks are those of rliable."""

import numpy as np
import pytest
from scipy import stats

from infogoal_jax.reproduce.statistics import (
    bootstrap,
    interquartile_mean,
    over_seeds_and_sets,
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


def test_the_interquartile_mean_is_rliable_s(scores):
    for each in scores:
        assert interquartile_mean(list(each.T)) == pytest.approx(rliable_iqm(each), abs=1e-12)


def test_the_probability_of_improvement_is_rliable_s(scores):
    x, y = scores
    assert probability_of_improvement(list(x.T), list(y.T)) == pytest.approx(rliable_improvement(x, y), abs=1e-12)
    assert probability_of_improvement(list(x.T), list(x.T)) == pytest.approx(0.5)


def test_tasks_with_more_runs_count_no_more():
    few, many = np.array([0.0, 0.1, 0.2, 0.3]), np.tile([0.6, 0.7, 0.8, 0.9], 3)
    assert interquartile_mean([few, many]) == pytest.approx(interquartile_mean([few, many[:4]]))


def test_the_bootstrap_draws_within_tasks():
    """Two tasks of equal runs each: whatever is drawn, the mean is the same; a pooled bootstrap would vary."""
    found = bootstrap(lambda tasks: np.mean([runs.mean(-1) for runs in tasks], axis=0), [np.zeros(5), np.ones(5)])
    assert found == (0.5, 0.5, 0.5)


def test_the_bootstrap_covers_the_mean():
    """Of 200 samples of a known mean, about 95 % have it in their interval."""
    draw, inside = np.random.default_rng(0), 0
    for number in range(200):
        tasks = [draw.normal(size=40) for _ in range(3)]
        low, high = bootstrap(lambda tasks: np.mean([runs.mean(-1) for runs in tasks], axis=0), tasks, seed=number)[1:]
        inside += low < 0 < high
    assert 0.9 < inside / 200 < 0.99


def test_one_interval_is_over_seeds_and_one_over_sets():
    """Sets that differ much, seeds that agree: only the interval over sets is wide."""
    close = over_seeds_and_sets([np.array([level, level + 0.01]) for level in (0.1, 0.5, 0.9)])
    assert close.mean == pytest.approx(0.505) and close.seeds < 0.02 and close.sets > 0.9
    alone = over_seeds_and_sets([np.array([0.1, 0.2, 0.3])])
    assert alone.seeds == pytest.approx(stats.t.ppf(0.975, 2) * 0.1 / np.sqrt(3)) and np.isnan(alone.sets)
    assert np.isnan(over_seeds_and_sets([np.array([0.1]), np.array([0.3])]).seeds)
