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


def unit(**functions):
    """The space from 0 to 1 in both axes."""
    return GoalBox.of([0.0, 0.0], [1.0, 1.0], **functions)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GoalBox.of([0.0], [0.0]), "high"),
        (lambda: GoalBox.of([0.0, 1.0], [1.0]), "high"),
        (lambda: GoalBox.of([np.nan], [1.0]), "low"),
        (lambda: GoalBox.of([-1e39], [1e39]), "low = .*finite numbers that float32 holds"),
        (lambda: GoalBox.of([-3e38], [3e38]), "high = .*too far"),
        (lambda: GoalBox.of([0.0], [1e-45]), "high = .*too near"),
        (lambda: GoalBox.of(np.zeros(5000), np.ones(5000)), "low = '5000 numbers': give 1 to 4096"),
        (lambda: jax.jit(lambda low: GoalBox.of(low, [1.0]).low)(jnp.zeros(1)), "low = 'a traced array'"),
        (lambda: unit(num_evaluated=10**6), "num_evaluated = 1000000: give a whole number from 1 to 4096"),
        (lambda: unit(use_of=lambda goal: goal[0]), "use_of = 'float32 .*return bool"),
        (lambda: unit(use_of=lambda goal: goal > 0.5), r"use_of = 'bool \[2\]'"),
        (lambda: unit(use_of=lambda goal: 3), r"use_of = \[3\]: give positions in"),
        (lambda: unit(sampler=lambda key: jax.random.uniform(key, (2,)) * jnp.nan), r"sampler = \[\[nan, nan\]\]"),
        (lambda: unit(sampler=lambda key: jnp.full(2, 2.0, jnp.float32)), "sampler"),
        (lambda: unit(sampler=lambda key: jnp.zeros(3, jnp.float32)), "sampler"),
        (lambda: unit(use_of=lambda goal: goal[0] > 0.01), "use_of"),
        (lambda: unit(sampler=lambda key: exit(0)), "sampler: raised SystemExit when it was traced: 0"),
        (lambda: unit(seen=lambda goals: None), "seen = 'NoneType': return float32"),
        (lambda: unit(seen=len), "seen"),
        (lambda: unit(seen=lambda goals: goals[..., 0]), r"seen = 'float32 \[\]'"),
        (lambda: unit(seen=lambda goals: goals.astype(jnp.int32)), "seen = 'int32"),
        (lambda: unit(seen=lambda goals: jnp.zeros(3)), r"seen: is float32 \[3\]; give float32 \[2, 3\]"),
        (lambda: unit(seen=lambda goals: goals / 0.0), "seen = .*finite numbers for every goal"),
        (lambda: unit(seen=lambda goals: 1 / 0), "seen: raised ZeroDivisionError"),
        (lambda: unit(seen=lambda goals: jnp.zeros((*goals.shape[:-1], 3, 8, 8), jnp.uint8)), "seen = .*channels last"),
        (lambda: unit().only("test"), r"group = 'test': give one of \('train',\)"),
        (lambda: unit().checked([1e39, 0.0], "goal", 0), "goal = .*lies outside"),
    ],
    ids=range(27),
)
def test_a_space_that_cannot_be_trained_on_is_refused(make, message):
    with pytest.raises(UserError, match=message):
        make()


def test_goals_may_be_seen_as_vectors_or_images():
    assert unit(seen=jnp.sin).inputs_of(jnp.zeros((3, 2))).shape == (3, 2)
    images = unit(seen=lambda goals: jnp.zeros((*goals.shape[:-1], 8, 8, 3), jnp.uint8))
    assert images.inputs_of(jnp.zeros((3, 2))).shape == (3, 8, 8, 3)


@pytest.mark.parametrize("goals", [[[3.0, 0.0]], [[np.nan, 0.0]], [0.5, 0.0], [[1, 2, 3]]])
def test_goals_that_are_none_of_the_space_are_refused(goals):
    with pytest.raises(UserError, match="goals"):
        BOX.checked(goals, "goals", axes=1)


def test_no_goal_is_no_goal():
    for goals in (jnp.arange(3), jnp.zeros((3, 2))):
        assert is_goal(goals).all() and not is_goal(no_goals_like(goals)).any()
