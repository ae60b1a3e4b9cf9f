"""Pictures of Fetch: rays meet shapes where they are, and every task, its arm and its goal are seen."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import envs
from infogoal_jax.envs import raycast
from infogoal_jax.envs.fetch import scene
from infogoal_jax.envs.fetch.scene import draw_fetch
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.envs.raycast import Box, Camera, Capsule, Cylinder, Ellipsoid
from infogoal_jax.errors import UserError

SIZE = (96, 128)
CONFIG = FetchConfig(ends_at_goal=False, episode_length=3)


def start(task: str):
    """A task and one of its first states, without compiling a simulation: MuJoCo has the kinematics too."""
    env = envs.load(task, CONFIG)
    return env, jax.jit(type(env).reset)(env, jax.random.key(0))


def surface_distance(shape, points: np.ndarray) -> np.ndarray:
    """How far points [N, 3] are from the surface of a shape."""
    if isinstance(shape, Capsule):
        axis = shape.end - shape.start
        share = np.clip((points - shape.start) @ axis / max(axis @ axis, 1e-12), 0, 1)
        return np.abs(np.linalg.norm(points - shape.start - share[:, None] * axis, axis=1) - shape.radius)
    local = (points - shape.center) @ shape.rotation
    if isinstance(shape, Ellipsoid):
        scaled = local / shape.half
        return np.abs((scaled**2).sum(1) - 1) / (2 * np.linalg.norm(scaled / shape.half, axis=1))  # To first order.
    if isinstance(shape, Box):
        return np.abs((np.abs(local) - shape.half).max(1))
    return np.abs(np.maximum(np.linalg.norm(local[:, :2], axis=1) - shape.radius, np.abs(local[:, 2]) - shape.half))


TURN = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
SHAPES = [
    Box(np.array([0.1, 0.2, 0.3]), TURN, np.array([0.3, 0.2, 0.1]), (1, 1, 1)),
    Cylinder(np.array([0.0, 0.1, 0.2]), TURN, 0.3, 0.2, (1, 1, 1)),
    Capsule(np.array([-0.2, 0.0, 0.0]), np.array([0.3, 0.2, 0.3]), 0.15, (1, 1, 1)),
    Capsule(np.zeros(3), np.zeros(3), 0.3, (1, 1, 1)),
    Ellipsoid(np.array([0.1, 0.0, 0.1]), TURN, np.array([0.4, 0.2, 0.25]), (1, 1, 1)),
]


@pytest.mark.parametrize("shape", SHAPES, ids=["box", "cylinder", "capsule", "sphere", "ellipsoid"])
def test_rays_meet_shapes_on_their_surface_from_outside(shape):
    camera = Camera([2.0, -1.5, 1.2], [0.0, 0.0, 0.1], (64, 64))
    rays = camera.rays.reshape(-1, 3)
    distance, normal = shape.hit(camera.position, rays)
    hits = np.isfinite(distance)
    assert 100 < hits.sum() < len(rays) / 2
    assert surface_distance(shape, camera.position + distance[hits, None] * rays[hits]).max() < 1e-3
    assert (
        np.allclose(np.linalg.norm(normal[hits], axis=1), 1, atol=1e-3)
        and (rays[hits] * normal[hits]).sum(1).max() < 1e-3
    )
    area = np.zeros((camera.height, camera.width), bool)
    area[camera.rectangle(shape)] = True
    assert area.ravel()[hits].all()


def test_of_two_shapes_the_nearer_one_is_seen_in_whatever_order():
    camera = Camera([0.0, -2.0, 0.5], [0.0, 0.0, 0.5], SIZE)
    near, far = (
        Capsule(np.array([0, y, 0.5]), np.array([0, y, 0.5]), 0.2, colour)
        for y, colour in ((-0.5, (1, 0, 0)), (0.5, (0, 0, 1)))
    )
    pictures = [raycast.empty_picture(camera) for _ in range(2)]
    for picture, shapes in zip(pictures, ([near, far], [far, near]), strict=True):
        for shape in shapes:
            raycast.cast(picture, camera, shape)
    assert np.array_equal(pictures[0].colour, pictures[1].colour)
    middle = raycast.developed(pictures[0], camera)[SIZE[0] // 2, SIZE[1] // 2]
    assert middle[0] > 100 and middle[2] < 60


@pytest.mark.parametrize("task", list(TASKS))
def test_every_task_can_be_drawn_and_its_goal_is_seen_where_it_lies(task):
    env, state = start(task)
    # Before the arm, as the camera sees it.
    goal = jnp.asarray(env.workspace.mean(0) + np.array([0.1, -0.15, -0.15]), jnp.float32)
    state = state.replace(desired_goal=goal)
    picture = draw_fetch(env, state, SIZE)
    assert picture.shape == (*SIZE, 3) and picture.dtype == np.uint8
    camera, _ = scene.still_scene(env.task, SIZE)
    column, row = np.round(camera.project(np.asarray(goal)[None])[0] / raycast.SUPERSAMPLING - 0.5).astype(int)
    red = picture[..., 0].astype(int) - picture[..., 1:].max(-1)
    assert red[row, column] > 60 and (red > 60).sum() < 80


def test_the_arm_is_one_chain_that_ends_where_the_observation_says():
    env, state = start("fetch_pick_and_place")
    position = np.asarray(state.motion.position)
    shapes = scene.moving_shapes(env, position)
    arm = shapes[: len(scene.ARM)]
    for first, second in itertools.pairwise(arm):
        assert np.allclose(first.end, second.start)
    fingers = [shape.center for shape in shapes if isinstance(shape, Box) and shape.colour == scene.FINGER]
    assert np.linalg.norm(np.mean(fingers, 0) - np.asarray(state.observation[:3])) < 0.03
    assert np.allclose(shapes[-1].center, state.observation[3:6], atol=1e-3)


def test_the_goal_turns_green_when_it_is_reached():
    env, state = start("fetch_reach")
    there = state.replace(desired_goal=env.achieved(state) + jnp.array([0.0, 0.0, 0.04]))
    away, near = (draw_fetch(env, which, SIZE).astype(int) for which in (state, there))
    assert (away[..., 0] - away[..., 1] > 60).any() and not (near[..., 0] - near[..., 1] > 60).any()


def test_a_batch_of_states_and_a_tiny_picture_are_refused():
    env, state = start("fetch_reach")
    with pytest.raises(UserError, match="one state at a time"):
        draw_fetch(env, jax.tree.map(lambda leaf: leaf[None], state), SIZE)
    with pytest.raises(UserError, match="size"):
        draw_fetch(env, state, (8, 8))
