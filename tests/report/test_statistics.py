"""Intervals over seeds: Student's t, at each point of a curve, and of paired differences."""

import math

import numpy as np
import pytest
from scipy import stats

from infogoal_jax.errors import UserError
from infogoal_jax.report.statistics import mean_interval, paired_difference


def test_interval_is_students_t():
    values = [0.2, 0.5, 0.6, 0.9]
    interval = mean_interval(values)
    low, high = stats.t.interval(0.95, 3, loc=np.mean(values), scale=stats.sem(values))
    np.testing.assert_allclose((interval.mean, interval.low, interval.high), (0.55, low, high))
    # By hand: t(0.975, 1) = 12.706, and the standard error of two numbers is half of their difference.
    assert mean_interval([1.0, 3.0]).half_width == pytest.approx(12.7062, abs=1e-4)


def test_interval_is_taken_at_each_point_of_a_curve():
    curves = np.random.default_rng(0).normal(size=(5, 7))
    interval = mean_interval(curves)
    assert interval.mean.shape == interval.half_width.shape == (7,)
    assert interval.half_width[2] == pytest.approx(mean_interval(curves[:, 2]).half_width)


def test_one_seed_has_no_interval_and_none_has_no_mean():
    one, none = mean_interval([0.52]), mean_interval([])
    assert one.mean == 0.52 and math.isnan(one.half_width) and one.show() == "0.52"
    assert math.isnan(none.mean) and none.show() == "-"
    assert mean_interval([0.5, 0.5]).show() == "0.50 ± 0.00"


def test_paired_difference_is_first_minus_second_and_forgets_what_seeds_share():
    luck = np.random.default_rng(1).normal(size=8)
    difference = paired_difference(luck + 0.3 + 0.01 * np.arange(8), luck)
    assert difference.mean == pytest.approx(0.335)
    assert difference.low > 0 > paired_difference(luck, luck + 0.3 + 0.01 * np.arange(8)).high
    assert difference.half_width < mean_interval(luck).half_width / 10
    with pytest.raises(UserError, match="same seeds"):
        paired_difference([1.0, 2.0], [1.0])
