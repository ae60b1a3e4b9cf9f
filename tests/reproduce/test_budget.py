"""Training stops where success on training goals has levelled off, and not before."""

import numpy as np
import pytest

from infogoal_jax.reproduce import completion
from infogoal_jax.reproduce.paper import TASKS


def curve(*values: float) -> np.ndarray:
    """Two seeds around these values, [2, evaluations]."""
    return np.array(values) + np.array([[-0.05], [0.05]])


@pytest.mark.parametrize(
    ("values", "count"),
    [
        ((1, 1, 1, 1, 1, 1), 6),
        ((0, 0, 0, 0, 0, 0), 6),
        ((1, 1, 1, 1, 1), None),
        (np.linspace(0, 1, 15), None),
        ((0, 0.2, 0.4, 0.6, 0.8, 1, 1, 1, 1, 1, 1), 11),
        ((0.9, 0.9, 0.9, 0.5, 0.5, 0.5), 6),
    ],
)
def test_a_curve_levels_off_where_its_last_window_is_no_higher(values, count):
    assert completion.levelled(curve(*values)) == count
    assert completion.still_rises(curve(*values)) == (count is None)


def test_what_comes_after_changes_nothing():
    """Lanes of one program that have levelled off go on with the others: their number stays."""
    early = curve(0, 0.5, 1, 1, 1, 1, 1, 1)
    late = np.concatenate([early, curve(0.2, 0.1, 0.9)], axis=1)
    assert completion.levelled(early) == completion.levelled(late) and completion.shown(early) == completion.shown(late)


def test_numbers_are_of_the_last_window():
    assert completion.shown(curve(*np.linspace(0, 1, 15))) == slice(12, 15)
    assert completion.shown(curve(1, 1, 1, 1, 1, 1, 0.5)) == slice(3, 6)


def test_a_run_is_trained_once_it_levelled_off_or_came_to_the_ceiling():
    ceiling = completion.budget_of("object_search").evaluations
    assert completion.is_trained(curve(1, 1, 1, 1, 1, 1), "object_search")
    assert not completion.is_trained(curve(*np.linspace(0, 1, ceiling - 1)), "object_search")
    assert completion.is_trained(curve(*np.linspace(0, 1, ceiling)), "object_search")


@pytest.mark.parametrize("task", TASKS)
def test_every_task_has_a_budget(task):
    found = completion.budget_of(task)
    assert found.chunk > 0 and found.evaluations == completion.MOST
