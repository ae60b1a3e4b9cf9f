"""The tasks in the plane, and what `GoalTask` keeps for them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import checks, envs
from infogoal_jax.envs import plane

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


@pytest.mark.parametrize("task", ["point_maze", pytest.param("reacher", marks=pytest.mark.long)])
def test_an_episode_in_the_plane_ends_at_its_goal(task):
    env = envs.load(task)
    step, state = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(0))
    there = state.replace(desired_goal=env.achieved_goal(state.world))
    after = step(there, np.zeros(2, np.float32))
    assert after.terminated and not after.truncated and not env.reached(env.achieved(state), state.desired_goal)
    broken = step(state.replace(world=state.world * np.float32(np.nan)), np.zeros(2, np.float32))
    assert broken.diverged and broken.truncated and not broken.terminated


@pytest.mark.parametrize("task", ["point_maze", "reacher"])
def test_a_picture_shows_the_body_and_the_goal_where_they_are(task):
    env = envs.load(task)
    state = jax.jit(env.reset_to)(jax.random.key(0), jnp.array([1.5, 0.5]))
    picture, pixels = (
        np.asarray(jax.jit(env.draw)(state)),
        plane.pixels_of(*((0, 3) if task == "point_maze" else (-2.2, 2.2))),
    )

    def middle(colour):
        return np.asarray(pixels)[(picture == colour).all(-1)].mean(0)

    assert picture.dtype == np.uint8 and picture.shape == (plane.PIXELS, plane.PIXELS, 3)
    np.testing.assert_allclose(middle(plane.GOAL), [1.5, 0.5], atol=0.05)
    body = state.world if task == "point_maze" else middle_of_the_arm(state.world)
    np.testing.assert_allclose(middle(plane.BODY), body, atol=0.1)


def middle_of_the_arm(angles):
    """The mean place of its two parts, [2]."""
    first, second = np.array([[np.cos(angle), np.sin(angle)] for angle in (angles[0], angles[0] + angles[1])])
    return (first / 2 + first + second / 2) / 2


def test_walls_of_a_picture_have_the_doors_of_the_maze():
    """A step over a wall is possible exactly where the picture has none."""
    env = envs.load("point_maze")
    state = jax.jit(env.reset_to)(jax.random.key(0), jnp.array([0.5, 0.5]))
    picture, pixels = np.asarray(jax.jit(env.draw)(state)), np.asarray(plane.pixels_of(0.0, 3.0))
    wall = (picture == plane.WALL).all(-1)
    beside = np.abs(pixels[..., 0] - 0.96) < 0.013  # Left of the wall at x = 1, whose pixels are the next to the right.
    places = pixels[beside]
    moved = np.asarray(jax.jit(jax.vmap(env.move, (0, None)))(places, np.array([1.0, 0.0], np.float32)))
    crossed = moved[:, 0] > 1
    shown = wall[np.abs(pixels[..., 0] - 1.0125) < 0.0126]
    assert crossed.any() and not crossed.all()
    np.testing.assert_array_equal(crossed, ~shown)
