"""The tasks in the plane, and what `GoalTask` keeps for them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import envs

KEYS = jax.random.split(jax.random.key(0), 2)


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
