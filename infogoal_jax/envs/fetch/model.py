"""The Fetch robot as a MuJoCo model: fetch.xml with the table and object of a task, and the parameters of every contact
pair."""

import dataclasses
import importlib.metadata
from pathlib import Path

import mujoco
import numpy as np

from infogoal_jax.envs.fetch.tasks import Task
from infogoal_jax.errors import UserError

ARM_XML = Path(__file__).with_name("fetch.xml")

# Inverse weights that scale a constraint's softness belong to the whole robot on its base; the compiler of the
# reference gives these for it.
INVERSE_WEIGHT = {
    "gripper": (0.04587898, 0.75853992),
    "palm": (0.04587898, 0),
    "right_finger": (0.05674991, 0),
    "left_finger": (0.05672457, 0),
    "upper_arm": (0.02392307, 0),
    "head_pan": (0.02125609, 0),
    "head_tilt": (0.0279764, 0),
    "shoulder": (0.01813626, 0),
    "torso": (0.02089039, 0),
    "table": (0, 0),
    "object": (0.5, 0),
}
JOINT_INVERSE_WEIGHT = {
    "torso": 0.05545951,
    "head_pan": 0.9545638,
    "head_tilt": 0.998428,
    "shoulder_pan": 0.07366371,
    "shoulder_lift": 0.34035614,
    "upperarm_roll": 0.8563917,
    "elbow_flex": 0.6829783,
    "forearm_roll": 0.3446229,
    "wrist_flex": 0.80945959,
    "wrist_roll": 0.86237761,
    "right_finger": 0.00972635,
    "left_finger": 0.00972635,
}
FINGERS = ("right_finger", "left_finger")
TRUNK = {"torso": (0.001256316, 0.003277019), "head_pan": (0.0, 0.0), "head_tilt": (0.060028835, 0.000072211)}
"""Joints of torso and head, with their positions and velocities at the start of every episode (as in tasks.py)."""


def check_versions() -> None:
    """Raise `UserError` unless MuJoCo and MJX are a tested pair: equal versions, at least 3.17 and below 4."""
    mujoco_version, mjx_version = importlib.metadata.version("mujoco"), importlib.metadata.version("mujoco-mjx")
    number = tuple(int(part) for part in mujoco_version.split(".")[:2])
    remedy = "; install a tested pair: pip install 'mujoco>=3.17,<4' 'mujoco-mjx>=3.17,<4'"
    if not (3, 17) <= number < (4, 0):
        raise UserError(f"mujoco = {mujoco_version}: must be at least 3.17 and below 4{remedy}")
    if mujoco_version.split(".")[:2] != mjx_version.split(".")[:2]:
        raise UserError(f"mujoco-mjx = {mjx_version}: must be of the version of mujoco, {mujoco_version}{remedy}")


@dataclasses.dataclass(frozen=True)
class Setting:
    """How a control step of 40 ms is simulated."""

    substeps: int = 8
    """Physics steps a control step."""
    whole_body: bool = False
    """Whether torso and head move and meet the arm, and closed fingers are two. Without, the arm passes through the
    head, and fingers that the task keeps closed are one block that opens nowhere: fewer joints and contacts, for the
    same motion wherever the arm is not driven into the robot itself."""

    @property
    def timestep(self) -> float:
        """Length of a physics step, in s."""
        return CONTROL_STEP / self.substeps


CONTROL_STEP = 0.04
REFERENCE_TIMESTEP = 0.002
FAST = Setting()
FAITHFUL = Setting(substeps=20, whole_body=True)


@dataclasses.dataclass(frozen=True)
class Pair:
    """Contact parameters of two geoms as MuJoCo mixes them from the reference's: the larger condim, friction and
    margin, the mean of solref and solimp."""

    friction: tuple[float, float]
    torsion: bool
    margin: float
    reference: tuple[float, float]
    impedance: tuple[float, ...]


FINGER_AND_THING = Pair((1.0, 0.05), True, 0.001, (0.015, 1.0), (0.945, 0.97, 0.0055, 0.5, 2.0))
THING_AND_GROUND = Pair((1.0, 0.005), False, 0.0, (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0))
PUCK_AND_TABLE = Pair((0.1, 0.005), False, 0.0, (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0))
MESH_AND_TABLE = Pair((1.0, 0.005), False, 0.001, (0.015, 1.0), (0.945, 0.97, 0.0055, 0.5, 2.0))
ROBOT_AND_ROBOT = Pair((1.0, 0.005), False, 0.001, (0.01, 1.0), (0.99, 0.99, 0.01, 0.5, 2.0))

ROBOT_PAIRS = (("head_pan", "upper_arm"), ("head_tilt", "upper_arm"), ("torso", "shoulder"))

CUBE_HALF = np.array([0.025, 0.025, 0.025], np.float32)
PUCK_RADIUS, PUCK_HALF_HEIGHT = 0.025, 0.02
PUCK_BLOCK_HALF = np.array([PUCK_RADIUS / 2**0.5, PUCK_RADIUS / 2**0.5, PUCK_HALF_HEIGHT], np.float32)
"""Half edges of the square block inscribed in the puck: its lower corners are the points that the puck stands on."""
TABLE = np.array([[1.05, 0.4, 0.0], [1.55, 1.1, 0.4]], np.float32)
LONG_TABLE = np.array([[0.69941906, 0.30018422, 0.0], [1.94941906, 1.20018422, 0.4]], np.float32)


def table_of(task: Task) -> np.ndarray:
    """Lowest and highest corner of the task's table, [2, 3] in m."""
    return LONG_TABLE if task.puck else TABLE


def load(task: Task, setting: Setting) -> mujoco.MjModel:
    """The robot, the table and the object of a task. Raises `UserError` for untested versions of MuJoCo."""
    check_versions()
    spec = mujoco.MjSpec.from_file(str(ARM_XML))
    spec.option.timestep = setting.timestep
    table = table_of(task)
    world = spec.worldbody
    spec.body("torso").pos[0] += task.base_x - 0.405
    if not setting.whole_body:
        spec.body("torso").pos[2] += TRUNK["torso"][0]
        for joint in (*TRUNK, *(FINGERS if task.blocks_fingers else ())):
            spec.delete(spec.joint(joint))
    world.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=table.mean(0),
        size=(table[1] - table[0]) / 2,
        contype=0,
        conaffinity=0,
    )
    world.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=0, conaffinity=0)
    if task.object_height is not None:
        thing = world.add_body(name="object", pos=[1.25, 0.53, task.object_height])
        thing.add_joint(name="object", type=mujoco.mjtJoint.mjJNT_FREE, damping=[0.01, 0, 0], armature=0)
        shape, size = (
            (mujoco.mjtGeom.mjGEOM_CYLINDER, [PUCK_RADIUS, PUCK_HALF_HEIGHT, 0])
            if task.puck
            else (mujoco.mjtGeom.mjGEOM_BOX, CUBE_HALF)
        )
        thing.add_geom(name="object", type=shape, size=size, mass=2, contype=0, conaffinity=0)
    model = spec.compile()
    # The weld holds the gripper, 0.1664 m along the wrist, to the mocap body's pose.
    model.eq_data[0, :3] = [0.1664, 0, 0]
    model.eq_data[0, 3:10] = [0, 0, 0, 1, 0, 0, 0]
    return model
