"""The tasks in the plane, and what `GoalTask` keeps for them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import checks, envs

MODES = {
    "64 bits": lambda: jax.enable_x64(True),
    "ranks": lambda: jax.numpy_rank_promotion("raise"),
    "types": lambda: jax.numpy_dtype_promotion("strict"),
}
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


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("task", ["point_maze", "reacher"])
def test_an_episode_has_its_types_whatever_jax_is_set_to(task, mode):
    env = envs.load(task)

    def stepped():
        def step(key, action):
            state = env.step(env.reset(key), action)
            record = env.achieved(state)
            return state, env.observe(state), env.cell_of(record), env.goals.inputs_of(record), env.goals.use(record)

        key = jax.eval_shape(lambda: jax.random.key(0))
        return checks.shapes(jax.eval_shape(step, key, jax.ShapeDtypeStruct((2,), "float32")))

    with MODES[mode]():
        found = stepped()
    assert found == stepped()


@pytest.mark.parametrize("task", ["point_maze", "reacher"])
def test_an_episode_in_the_plane_ends_at_its_goal(task):
    env = envs.load(task)
    state = jax.jit(env.reset)(jax.random.key(0))
    there = state.replace(goal=env.achieved_goal(state.world))
    after = env.step(there, jnp.zeros(2))
    assert after.terminated and not after.truncated and not env.reached(env.achieved(state), state.goal)
    broken = env.step(state.replace(world=state.world * jnp.nan), jnp.zeros(2))
    assert broken.diverged and broken.truncated and not broken.terminated
