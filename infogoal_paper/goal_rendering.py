"""Builds the goal images of Fetch tasks with MuJoCo's renderer and the scene, with all its meshes, of an installed
gymnasium-robotics.

The gripper, or the object, stands exactly at the goal. The shipped banks can be used without either package.
"""

import contextlib
import dataclasses
import datetime
import importlib.metadata
import importlib.util
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from infogoal_jax.data.goal_images import GRID, IMAGE_SHAPE, TEST, TRAIN, VALIDATION, GoalImages, grid_positions
from infogoal_jax.envs.fetch.environment import HIGHEST_GOAL
from infogoal_jax.envs.fetch.tasks import TASKS, Task
from infogoal_jax.errors import UserError, nearest, require

SPACING = 0.025
"""Step of the grid of goals, in m: half of the distance at which a goal counts as reached."""
COUNTS = {TRAIN: 8, VALIDATION: 8, TEST: 32}
FARTHEST = 0.2
"""A validation or test goal is at most this far from a training goal, in m."""
RENDERED = 256
"""Pixels that are drawn along each edge, averaged down to 64."""
ROUNDS, STEPS = 5, 200
"""The arm moves for this many times this many steps of 2 ms; after each round the pull on it is corrected by the error
that is left."""
WORST_GRIPPER = 0.005
"""The gripper may be this far from the goal at most, in m."""
GRIP_BELOW_LINK = 0.02
"""The point between the fingers is this far below the link that is pulled, in m."""
DOWNWARD = (1.0, 0.0, 1.0, 0.0)
"""Quaternion of a gripper that points down; not of length 1."""
AROUND_OBJECT = 0.0241
"""Each finger is open this far when it touches a cube with edges of 5 cm, in m."""
BASE = (("robot0:slide1", 0.48), ("robot0:slide2", 0.0))
"""Where the robot's base stands; the first slide joint depends on the task."""
INSTALL_SCENE = "pip install 'infogoal-jax[goal-images]', or pip install --no-deps gymnasium-robotics==1.4.2"
INSTALL_OPENGL = (
    "on a machine without a screen set MUJOCO_GL=egl, or install the renderer that needs no GPU "
    "(apt-get install libosmesa6) and set MUJOCO_GL=osmesa"
)
OPEN_OPENGL = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).close()"


def grid_of(task: Task) -> tuple[np.ndarray, tuple[int, int, int]]:
    """First position [3] (m) and shape of the grid that fills the goal space of a task."""
    across = round(2 * task.goal_range / SPACING) + 1
    low = np.array(task.start_grip) - task.goal_range
    if task.object_height is None:
        return low, (across, across, across)
    low[2] = task.object_height
    return low, (across, across, round(HIGHEST_GOAL / SPACING) + 1 if task.goals_in_air else 1)


def draw_goal(task: Task, generator: np.random.Generator) -> np.ndarray:
    """A goal [3] (m), drawn as the environment draws it."""
    goal = np.array(task.start_grip) + generator.uniform(-task.goal_range, task.goal_range, 3)
    if task.object_height is not None:
        lifted = task.goals_in_air and generator.random() < 0.5
        goal[2] = task.object_height + (generator.uniform(0, HIGHEST_GOAL) if lifted else 0)
    return goal


def choose_goals(task: Task, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions float32 [N, 3] and uses uint8 [N] of all goals of a bank: the grid, then goals drawn for training,
    validation and tests.

    Those for validation and tests are drawn again until each is near a training goal.
    """
    generator = np.random.default_rng([seed, *task.name.encode()])
    low, shape = grid_of(task)
    goals = grid_positions(low, SPACING, shape)
    positions, uses = list(goals), [GRID] * len(goals)
    training: list[np.ndarray] = []
    for use, count in COUNTS.items():
        drawn: list[np.ndarray] = []
        while len(drawn) < count:
            goal = draw_goal(task, generator)
            if use == TRAIN or np.linalg.norm(np.array(training) - goal, axis=1).min() < FARTHEST:
                drawn.append(goal)
        training = drawn if use == TRAIN else training
        positions += drawn
        uses += [use] * count
    return np.array(positions, np.float32), np.array(uses, np.uint8)


@dataclasses.dataclass(frozen=True)
class Camera:
    """Looks from `distance` (m) at the point `lookat` (m); angles in degrees as in MuJoCo. A small field of view keeps
    far goals as large as near ones."""

    lookat: tuple[float, float, float]
    azimuth: float
    elevation: float
    distance: float
    field_of_view: float = 15.0

    def project(self, positions) -> np.ndarray:
        """Project positions [..., 3] (m) into the image: row and column [..., 2] in pixels."""
        turn, rise = np.radians([self.azimuth, self.elevation])
        forward = np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
        right = np.array([np.sin(turn), -np.cos(turn), 0.0])
        seen = np.asarray(positions) - np.array(self.lookat) + self.distance * forward
        half = IMAGE_SHAPE[0] / 2
        scale = half / np.tan(np.radians(self.field_of_view / 2)) / (seen @ forward)
        return half + np.stack([-scale * (seen @ np.cross(right, forward)), scale * (seen @ right)], -1)

    def words(self) -> str:
        """The camera as text."""
        x, y, z = self.lookat
        return (
            f"looks at ({x}, {y}, {z}) m from {self.distance} m, azimuth {self.azimuth} degrees, elevation "
            f"{self.elevation} degrees, "
            f"vertical field of view {self.field_of_view} degrees"
        )


CAMERAS = {
    "fetch_reach": Camera((1.34, 0.75, 0.53), 132.0, -28.0, 2.2),
    # From low and nearly in front: the table shows below the gripper's housing, which otherwise hides the cube behind
    # it.
    "fetch_push": Camera((1.345, 0.76, 0.435), 168.0, -17.0, 1.7),
    "fetch_pick_and_place": Camera((1.34, 0.75, 0.635), 132.0, -26.0, 2.75),
}


def find_task(name: str) -> Task:
    """The task of this name, or a `UserError` if it has no goal images."""
    if name not in CAMERAS:
        raise UserError(
            f"task = {name!r}: no goal images of this task.{nearest(name, list(CAMERAS))} Known: {', '.join(CAMERAS)}"
        )
    return TASKS[name]


def find_scene(task: Task) -> Path:
    """The scene of a task in the installed gymnasium-robotics, which is not imported. Raises `UserError` if it is not
    there."""
    package = importlib.util.find_spec("gymnasium_robotics")
    if package is None or not package.submodule_search_locations:
        raise UserError(
            f"gymnasium-robotics = not installed: goal images are drawn with its meshes of the robot; {INSTALL_SCENE}"
        )
    folder = Path(next(iter(package.submodule_search_locations)))
    scene = folder / "envs" / "assets" / "fetch" / f"{task.name.removeprefix('fetch_')}.xml"
    require(
        scene.is_file(),
        "gymnasium-robotics",
        str(folder),
        f"has no file {scene.name} of the robot's scene; {INSTALL_SCENE}",
    )
    return scene


def check_opengl() -> None:
    """Raise `UserError` unless MuJoCo can render. This is tried in another process, because a failure leaves open
    contexts behind or ends the process."""
    try:
        tried = subprocess.run(
            [sys.executable, "-c", OPEN_OPENGL], capture_output=True, text=True, timeout=120, check=False
        )
        lines, failed = tried.stderr.strip().splitlines(), tried.returncode != 0
    except subprocess.TimeoutExpired:
        lines, failed = ["no answer within 120 s"], True
    if failed:
        reason = lines[-1] if lines else f"exit status {tried.returncode}"
        raise UserError(
            f"MUJOCO_GL = {os.environ.get('MUJOCO_GL', '')!r}: MuJoCo could not open OpenGL ({reason}); "
            f"{INSTALL_OPENGL}"
        )


def check(tasks: Sequence[str], seed: int = 0) -> None:
    """Raise `UserError` unless the banks of these tasks can be built here."""
    require(len(tasks) > 0, "tasks", tasks, f"give at least one of {', '.join(CAMERAS)}")
    for name in tasks:
        find_scene(find_task(name))
    require(seed >= 0, "seed", seed, "give a whole number of at least 0")
    check_opengl()


@contextlib.contextmanager
def studio(name: str) -> Iterator[Callable[[np.ndarray], tuple[np.ndarray, float]]]:
    """Open the scene of a task. Yields a function from a goal [3] (m) to its image, uint8 [64, 64, 3], and the error of
    the gripper's position (m)."""
    import mujoco

    task, camera = find_task(name), CAMERAS[name]
    model = mujoco.MjModel.from_xml_path(str(find_scene(task)))
    data = mujoco.MjData(model)
    for joint, value in (("robot0:slide0", task.base_x), *BASE):
        data.joint(joint).qpos = value
    start = data.qpos.copy()
    # The gripper follows the pulled body exactly, and nothing pushes it or the object away: some goals are so low that
    # the fingers enter the table.
    model.eq_data[:, :10] = (0, 0, 0, 0, 0, 0, 1, 0, 0, 0)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    model.vis.global_.fovy = camera.field_of_view
    # Long green lines that cross where the gripper is pulled to; not part of the robot.
    mark = model.body("robot0:mocap")
    model.geom_rgba[mark.geomadr[0] : mark.geomadr[0] + mark.geomnum[0], 3] = 0
    view, options = mujoco.MjvCamera(), mujoco.MjvOption()
    view.azimuth, view.elevation, view.distance, view.lookat[:] = (
        camera.azimuth,
        camera.elevation,
        camera.distance,
        camera.lookat,
    )
    options.sitegroup[:] = 0  # The red ball at the goal, and those in the object and the gripper.
    upright = np.zeros(9)
    mujoco.mju_quat2Mat(upright, np.array(DOWNWARD) / np.linalg.norm(DOWNWARD))

    def move_gripper(place: np.ndarray) -> float:
        """Pull the gripper to a position, from the start pose, so that an image depends on its goal alone."""
        mujoco.mj_resetData(model, data)
        data.qpos[:] = start
        data.mocap_pos[0], data.mocap_quat[0] = place, DOWNWARD
        data.mocap_pos[0, 2] += GRIP_BELOW_LINK
        for number in range(ROUNDS):
            mujoco.mj_step(model, data, nstep=STEPS)
            mujoco.mj_kinematics(model, data)
            missing = place - data.site("robot0:grip").xpos
            if number < ROUNDS - 1:
                data.mocap_pos[0] += missing
        return float(np.linalg.norm(missing))

    def take(goal: np.ndarray) -> tuple[np.ndarray, float]:
        goal = np.asarray(goal, float)
        held = task.goals_in_air
        error = move_gripper(goal if held or task.object_height is None else np.array(task.start_grip))
        for side in "lr":
            data.joint(f"robot0:{side}_gripper_finger_joint").qpos = AROUND_OBJECT if held else 0
        if task.object_height is not None:
            turned = np.array([1.0, 0.0, 0.0, 0.0])
            if held:  # Where the arm is stretched out the gripper leans, and what it holds with it.
                mujoco.mju_mat2Quat(
                    turned, (data.body("robot0:gripper_link").xmat.reshape(3, 3) @ upright.reshape(3, 3).T).ravel()
                )
            data.joint("object0:joint").qpos = np.concatenate([goal, turned])
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, view, options)
        return cv2.resize(renderer.render(), IMAGE_SHAPE[:2], interpolation=cv2.INTER_AREA), error

    renderer = mujoco.Renderer(model, RENDERED, RENDERED)
    try:
        yield take
    finally:
        renderer.close()


def build(
    name: str, seed: int = 0, follow: Callable[[Sequence, str], Iterable] = lambda goals, name: goals
) -> GoalImages:
    """The bank of a task; seed: of the goals for training, validation and tests, the grid is always the same.

    follow: gives the goals of the task one by one and shows how far it is, as `rich.progress.track` does. Raises
    `UserError` if gymnasium-robotics or OpenGL is missing.
    """
    check([name], seed)
    task = find_task(name)
    positions, uses = choose_goals(task, seed)
    images, errors = np.empty((len(positions), *IMAGE_SHAPE), np.uint8), np.empty(len(positions))
    with studio(name) as take:
        for row in follow(range(len(positions)), name):
            images[row], errors[row] = take(positions[row])
    worst = int(errors.argmax())
    require(
        errors[worst] < WORST_GRIPPER,
        "gymnasium-robotics",
        importlib.metadata.version("gymnasium-robotics"),
        f"in its scene the gripper stays {1000 * errors[worst]:.1f} mm from the goal {positions[worst].tolist()}; "
        f"{INSTALL_SCENE}",
    )
    low, shape = grid_of(task)
    least, most = pixel_shifts(name)
    today = datetime.date.today()
    about = {
        "task": name,
        "seed": seed,
        "spacing": f"{100 * SPACING} cm",
        "camera": CAMERAS[name].words(),
        "one step of the grid": f"{least:.1f} to {most:.1f} pixels",
        "worst error of the gripper's position": f"{1000 * errors[worst]:.2f} mm",
        "mujoco": importlib.metadata.version("mujoco"),
        "gymnasium-robotics": importlib.metadata.version("gymnasium-robotics"),
        "built": f"{today.day} {today:%B %Y}",
    }
    return GoalImages(name, images, positions, uses, SPACING, low, shape, about)


def pixel_shifts(name: str) -> tuple[float, float]:
    """The smallest and the largest shift in a task's image, in pixels, of a goal that moves one step along the grid."""
    low, shape = grid_of(find_task(name))
    pixels = CAMERAS[name].project(grid_positions(low, SPACING, shape)).reshape(*shape, 2)
    shifts = [np.linalg.norm(np.diff(pixels, axis=axis), axis=-1).ravel() for axis in range(3)]
    return min(shift.min(initial=math.inf) for shift in shifts), max(shift.max(initial=0) for shift in shifts)
