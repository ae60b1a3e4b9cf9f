"""The continuous goal space, and the tasks in the plane that have one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import UserError, envs
from infogoal_jax.goals import GoalBox, is_goal, no_goals_like
from infogoal_jax.relabelling.her import soon

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


def test_soon_is_geometric_and_cut_off():
    before, until = jnp.zeros(20_000, jnp.int32), jnp.full(20_000, 5, jnp.int32)
    drawn = np.asarray(soon(jnp.float32(0.5))(jax.random.key(1), before, until))
    shares = np.bincount(drawn, minlength=5) / len(drawn)
    np.testing.assert_allclose(shares, 0.5 ** np.arange(5) / (0.5 ** np.arange(5)).sum(), atol=0.02)


def test_nobody_walks_through_the_walls_of_the_maze():
    """A step never ends in another room unless it went through a door, and every room can be reached."""
    maze = envs.load("point_maze")
    places = jax.random.uniform(KEYS[0], (4000, 2), jnp.float32, 0.02, 2.98)
    actions = jax.random.uniform(KEYS[1], (4000, 2), jnp.float32, -1.0, 1.0)
    moved = np.asarray(jax.jit(jax.vmap(maze.move))(places, actions))
    rooms, after = np.floor(np.asarray(places)).astype(int), np.floor(moved).astype(int)
    through = {
        tuple(map(tuple, pair)) for pair in zip(rooms.tolist(), after.tolist(), strict=True) if pair[0] != pair[1]
    }
    reached, frontier = {(0, 0)}, [(0, 0)]
    while frontier:
        here = frontier.pop()
        for there in {b for a, b in through if a == here} - reached:
            reached.add(there)
            frontier.append(there)
    assert len(reached) == 9 and ((0, 1), (1, 1)) not in through and ((2, 1), (2, 2)) in through


@pytest.mark.parametrize("task", ["point_maze", "reacher"])
def test_an_episode_in_the_plane_ends_at_its_goal(task):
    env = envs.load(task)
    state = jax.jit(env.reset)(jax.random.key(0))
    there = state.replace(goal=env.achieved_goal(state.world))
    after = env.step(there, jnp.zeros(2))
    assert after.terminated and not after.truncated and not env.reached(env.achieved(state), state.goal)
    broken = env.step(state.replace(world=state.world * jnp.nan), jnp.zeros(2))
    assert broken.diverged and broken.truncated and not broken.terminated
