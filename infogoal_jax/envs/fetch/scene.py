"""Rendering of Fetch scenes: the robot, the table, the object and the goal as simple shapes, and pictures of them.

The physics has no shape for links that never touch anything; here they are capsules from joint to joint.
"""

import functools

import mujoco
import numpy as np

from infogoal_jax.envs import raycast
from infogoal_jax.envs.fetch import model
from infogoal_jax.envs.fetch.environment import Fetch, FetchState
from infogoal_jax.envs.fetch.tasks import Task
from infogoal_jax.envs.raycast import (
    GOAL,
    GROUND,
    INK,
    REACHED,
    TOP,
    Box,
    Camera,
    Capsule,
    Cylinder,
    Picture,
    Shape,
    cast,
    cast_shadows,
    write_words,
)
from infogoal_jax.errors import require

SHELL, JOINT, BLUE, FINGER = (0.93, 0.93, 0.92), (0.27, 0.29, 0.32), (0.16, 0.42, 0.72), (0.22, 0.23, 0.25)
WOOD, CUBE, PUCK = (0.80, 0.69, 0.54), (0.05, 0.47, 0.50), (0.05, 0.47, 0.50)
GOAL_RADIUS = 0.025

ARM = (
    ("shoulder_pan", "shoulder_lift", 0.062, SHELL),
    ("shoulder_lift", "upperarm_roll", 0.056, BLUE),
    ("upperarm_roll", "elbow_flex", 0.052, SHELL),
    ("elbow_flex", "forearm_roll", 0.048, BLUE),
    ("forearm_roll", "wrist_flex", 0.045, SHELL),
    ("wrist_flex", "wrist_roll", 0.042, BLUE),
)
"""Links as capsules: from which body's origin to which, radius (m), colour."""
PALM = Box(np.array([0.095, 0.0, 0.0]), np.eye(3), np.array([0.032, 0.062, 0.036]), JOINT)
"""The gripper's housing, in the frame of the wrist."""
BASE_X = 0.0869
"""The base stands this far before the torso, in m."""


def body_poses(env: Fetch, position: np.ndarray) -> mujoco.MjData:
    """Poses of all bodies at joint positions [nq], by MuJoCo's own kinematics, which needs no compilation."""
    data = mujoco.MjData(env.physics.mujoco_model)
    data.qpos[:] = position
    mujoco.mj_kinematics(env.physics.mujoco_model, data)
    return data


def still_shapes(task: Task) -> list[Shape]:
    """The robot's base and torso, and last the table."""
    x, y = task.base_x + 0.2, 0.7441
    low, high = model.table_of(task)

    def standing(x: float, bottom: float, top: float, radius: float, colour) -> Cylinder:
        return Cylinder(np.array([x, y, (bottom + top) / 2]), np.eye(3), radius, (top - bottom) / 2, colour)

    return [
        standing(x + BASE_X, 0.03, 0.17, 0.27, JOINT),
        standing(x + BASE_X, 0.17, 0.34, 0.265, SHELL),
        standing(x, 0.34, 0.40, 0.17, JOINT),
        Capsule(np.array([x, y, 0.45]), np.array([x - 0.01, y, 0.93]), 0.115, SHELL),
        standing(x + 0.055, 0.93, 1.0, 0.05, JOINT),
        Capsule(np.array([x + 0.14, y - 0.09, 1.045]), np.array([x + 0.14, y + 0.09, 1.045]), 0.058, SHELL),
        Capsule(np.array([x + 0.192, y - 0.06, 1.045]), np.array([x + 0.192, y + 0.06, 1.045]), 0.018, FINGER),
        Box((low + high) / 2, np.eye(3), (high - low) / 2, WOOD),
    ]


def moving_shapes(env: Fetch, position: np.ndarray) -> list[Shape]:
    """The arm, the gripper and the object at joint positions [nq]."""
    data, mj = body_poses(env, position), env.physics.mujoco_model
    shapes: list[Shape] = [
        Capsule(data.body(first).xpos, data.body(last).xpos, radius, colour) for first, last, radius, colour in ARM
    ]
    wrist = data.body("wrist_roll")
    rotation = wrist.xmat.reshape(3, 3)
    shapes.append(Capsule(wrist.xpos, wrist.xpos + rotation @ [0.03, 0.0, 0.0], 0.036, SHELL))
    shapes.append(Box(wrist.xpos + rotation @ PALM.center, rotation, PALM.half, PALM.colour))
    for finger in model.FINGERS:
        geom = data.geom(finger)
        shapes.append(Box(geom.xpos, geom.xmat.reshape(3, 3), mj.geom(finger).size, FINGER))
    if env.task.object_height is not None:
        geom = data.geom("object")
        size, turn = mj.geom("object").size, geom.xmat.reshape(3, 3)
        shapes.append(
            Cylinder(geom.xpos, turn, size[0], size[1], PUCK) if env.task.puck else Box(geom.xpos, turn, size, CUBE)
        )
    return shapes


@functools.lru_cache(maxsize=4)
def still_scene(task: Task, size: tuple[int, int]) -> tuple[Camera, Picture]:
    """The camera of a task and the picture of everything that never moves. size: pixels (height, width)."""
    table = model.table_of(task)
    middle = table.mean(0)[:2]
    reach = 1.95 if not task.puck else 2.45
    target = np.array([middle[0] - 0.19, middle[1], 0.52])
    camera = Camera(target + reach * raycast.direction(-42.0, 24.0), target, size)
    picture = raycast.empty_picture(camera)
    *robot, surface = still_shapes(task)
    cast(picture, camera, surface, top=True)
    for shape in robot:
        cast(picture, camera, shape)
    cast_shadows(picture, camera, [*robot, surface], {GROUND: 0.0})
    cast_shadows(picture, camera, robot, {TOP: float(table[1, 2])})
    return camera, picture


def draw_fetch(env: Fetch, state: FetchState, size: tuple[int, int] = (480, 640)) -> np.ndarray:
    """A picture uint8 [H, W, 3] (RGB) of one state, which says the step and the distance to the goal. size: pixels
    (height, width).

    Raises `UserError` for a size that cannot be drawn, or a batch of states.
    """
    require(
        len(size) == 2 and all(64 <= side <= 2160 for side in size),
        "size",
        size,
        "give height and width of 64 to 2160 pixels",
    )
    position, goal, record = (
        np.asarray(part, float) for part in (state.motion.position, state.desired_goal, env.achieved(state))
    )
    require(position.ndim == 1, "state", f"a batch of shape {position.shape[:-1]}", "draw one state at a time")
    camera, still = still_scene(env.task, tuple(size))
    picture = still.copy()
    moving = moving_shapes(env, position)
    distance = float(np.linalg.norm(record - goal))
    reached = bool(env.reached(record, goal))
    marker = Capsule(goal, goal, GOAL_RADIUS, REACHED if reached else GOAL)
    cast_shadows(picture, camera, [*moving, marker], {GROUND: 0.0, TOP: float(model.table_of(env.task)[1, 2])})
    for shape in moving:
        cast(picture, camera, shape)
    raycast.cast_marker(picture, camera, marker, 0.72, 0.35)
    frame = raycast.developed(picture, camera)
    words = f"step {int(state.time)}   {100 * distance:.1f} cm to the goal" + ("   reached" if reached else "")
    write_words(frame, words, REACHED if reached else INK)
    return frame
