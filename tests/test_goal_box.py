"""The continuous goal space."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import UserError
from infogoal_jax.goals import GoalBox, is_goal, no_goals_like

KEYS = jax.random.split(jax.random.key(0), 2000)
BOX = GoalBox.of([0.0, -1.0], [2.0, 1.0], use_of=lambda goal: goal[0] > 1.5, num_evaluated=8)


def test_training_goals_are_never_held_out_and_evaluation_asks_for_both():
    drawn = np.asarray(jax.jit(jax.vmap(BOX.draw))(KEYS))
    assert (drawn[:, 0] <= 1.5).all() and drawn[:, 0].max() > 1.4
    assert BOX.groups == ("train", "test")
    train, test = np.asarray(BOX.in_groups())
    assert train.sum() == test.sum() == 8
    assert (np.asarray(BOX.evaluated)[test, 0] > 1.5).all() and (np.asarray(BOX.evaluated)[train, 0] <= 1.5).all()


def test_protocols_say_which_achieved_goals_may_be_learned_from():
    goals = jnp.array([[1.0, 0.0], [1.9, 0.0]])
    for known_goals, found in {"visited": [True, True], "held_out": [True, False], "train": [True, False]}.items():
        np.testing.assert_array_equal(BOX.usable(goals, known_goals), found)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0.0], [0.0]), "high"),
        (([0.0, 1.0], [1.0]), "high"),
        (([np.nan], [1.0]), "low"),
        (([0.0], [1.0], lambda key: jnp.full(1, 2.0, jnp.float32)), "sampler"),
        (([0.0], [1.0], lambda key: jnp.zeros(2, jnp.float32)), "sampler"),
        (([0.0], [1.0], None, lambda goal: goal[0] > 0.01), "use_of"),
    ],
)
def test_a_space_that_cannot_be_trained_on_is_refused(arguments, message):
    low, high, *functions = arguments
    with pytest.raises(UserError, match=message):
        GoalBox.of(low, high, **dict(zip(("sampler", "use_of"), functions, strict=False)))


@pytest.mark.parametrize("goals", [[[3.0, 0.0]], [[np.nan, 0.0]], [0.5, 0.0], [[1, 2, 3]]])
def test_goals_that_are_none_of_the_space_are_refused(goals):
    with pytest.raises(UserError, match="goals"):
        BOX.checked(goals, "goals", axes=1)


def test_no_goal_is_no_goal():
    for goals in (jnp.arange(3), jnp.zeros((3, 2))):
        assert is_goal(goals).all() and not is_goal(no_goals_like(goals)).any()
