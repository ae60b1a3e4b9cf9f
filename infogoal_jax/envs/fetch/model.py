"""The Fetch robot as a MuJoCo model: fetch.xml with the table and object of a task, and the parameters of every contact
pair. And the shapes of robot and object that can touch something: where they are, the points at which they touch, and
the constants of these points, both in one order.

The hand meets the table and the object as boxes, the palm the table as a sphere, and parts of the robot each other as
capsules.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from infogoal_jax.envs.fetch import contacts, multibody
from infogoal_jax.envs.fetch.constraints import ContactKind, FrictionPyramids, Softness
from infogoal_jax.envs.fetch.contacts import Box, Capsule, Contacts
from infogoal_jax.envs.fetch.multibody import Frames
from infogoal_jax.envs.fetch.tasks import Task
from infogoal_jax.envs.fetch.vectors import Quaternion, Vector, joined, vectors

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
    """The robot, the table and the object of a task."""
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
    compiled = spec.compile()
    # The weld holds the gripper, 0.1664 m along the wrist, to the mocap body's pose.
    compiled.eq_data[0, :3] = [0.1664, 0, 0]
    compiled.eq_data[0, 3:10] = [0, 0, 0, 1, 0, 0, 0]
    return compiled


class Shapes:
    """The shapes of one task in one setting, and what they touch."""

    def __init__(self, mj: mujoco.MjModel, task: Task, setting: Setting):
        self.mujoco_model, self.puck, self.timestep = mj, task.puck, setting.timestep
        self.has_object = task.object_height is not None
        self.first_of_object = mj.njnt - self.has_object  # Its place in the position; the robot's joints come first.
        self.one_hand = task.blocks_fingers and not setting.whole_body
        right, left = (mj.geom(name) for name in FINGERS)
        place, half = np.float32([right.pos, left.pos]), np.float32([right.size, left.size])
        if self.one_hand:  # One block, as wide as both.
            place, half = place.mean(0, keepdims=True), half[:1] + np.abs(place[:1] - place[1:]) / 2
        wrist = joint_of(mj, "wrist_roll")
        self.wrist = slice(wrist, wrist + 1)
        self.fingers = slice(self.first_of_object - 2, self.first_of_object)
        self.hand_place, self.hand_half = Vector.of(place), Vector.of(half)
        palm = mj.geom("palm")
        self.palm_place, self.palm_radius = vectors(palm.pos), float(palm.size[0])
        self.table = contacts.block(table_of(task))
        self.robot_pairs = ROBOT_PAIRS if setting.whole_body else ()
        self.capsules = [[self.capsule(name) for name in names] for names in zip(*self.robot_pairs, strict=True)]
        self.pyramids = FrictionPyramids(self.kinds(task))

    def capsule(self, name: str) -> tuple[int, Capsule]:
        """A capsule of the robot: the joint that moves it, and where it lies on its body."""
        geom = self.mujoco_model.geom(name)
        axis = multibody.matrix_of(geom.quat)[:, 2] * geom.size[1]
        joint = joint_of(self.mujoco_model, geom.bodyid[0])
        return joint, Capsule(vectors(geom.pos), vectors(axis), np.float32(geom.size[0]))

    def kind(self, pair: Pair, first: str, second: str) -> ContactKind:
        """The constants of the contacts of two shapes."""
        weight = sum(INVERSE_WEIGHT[geom][0] for geom in (first, second))
        if self.one_hand and not {first, second}.isdisjoint(FINGERS):
            weight = weight / 2  # One block is as stiff as two fingers side by side.
        bodies = (self.mujoco_model.geom(name).bodyid[0] for name in (first, second))
        before, after = (moving_dofs(self.mujoco_model, body) for body in bodies)
        softness = Softness(pair.reference, pair.impedance, self.timestep)
        return ContactKind(after - before, pair.friction, pair.torsion, pair.margin, weight, softness)

    def kinds(self, task: Task) -> list[ContactKind]:
        """The constants of each contact point, in the order of `contacts`."""
        fingers = FINGERS[:1] if self.one_hand else FINGERS
        boxes = [self.kind(FINGER_AND_THING, "table", finger) for finger in fingers]
        rounded = [self.kind(MESH_AND_TABLE, "table", "palm")]
        rounded += [self.kind(ROBOT_AND_ROBOT, *pair) for pair in self.robot_pairs]
        if self.has_object:
            on_fingers = [self.kind(FINGER_AND_THING, finger, "object") for finger in fingers]
            on_ground = self.kind(PUCK_AND_TABLE if task.puck else THING_AND_GROUND, "table", "object")
            if task.puck:
                boxes, rounded = [*boxes, on_ground], on_fingers + rounded
            else:
                boxes = [*boxes, *on_fingers, on_ground]
        return boxes * 4 + rounded

    def contacts(self, frames: Frames, thing: Box | None) -> Contacts:
        """All contact points. thing: the object, or None."""
        wrist = frames[self.wrist]
        hands = wrist if self.one_hand else frames[self.fingers]
        fingers = Box(hands.point(self.hand_place), hands.rotation, self.hand_half)
        pairs = [(*contacts.table_under(self.table, fingers), fingers)]
        rounded = [contacts.sphere_on_box(self.table, wrist.point(self.palm_place), self.palm_radius)]
        if self.has_object:
            beside = jax.tree.map(lambda leaf: jnp.repeat(leaf, len(self.hand_half.x)), thing)
            if self.puck:
                upright, radius, half_height = beside.rotation.z, PUCK_RADIUS, PUCK_HALF_HEIGHT
                rounded.insert(0, contacts.box_on_puck(fingers, beside.center, upright, radius, half_height))
            else:
                pairs.append((fingers, jax.tree.map(jnp.zeros_like, fingers.center), beside))
            pairs.append((*contacts.ground_under(self.table, thing), thing))
        if self.robot_pairs:
            rounded.append(contacts.capsule_on_capsule(*(placed(frames, capsules) for capsules in self.capsules)))
        first, handicap, second = (joined(*parts) for parts in zip(*pairs, strict=True))
        return joined(contacts.box_on_box(first, second, handicap), *rounded)

    def thing_at(self, position: jax.Array) -> Box | None:
        """The object at this position [nq], as one of P = 1: a cube, or the box whose lower corners are the points that
        a puck stands on."""
        if not self.has_object:
            return None
        own = position[None, self.first_of_object :]
        half = PUCK_BLOCK_HALF if self.puck else CUBE_HALF
        return Box(Vector.of(own[:, :3]), Quaternion.of(own[:, 3:]).rotation(), Vector.of(half[None]))


def placed(frames: Frames, capsules: list[tuple[int, Capsule]]) -> Capsule:
    """Capsules of the robot where they are now, side by side."""
    joints = np.array([joint for joint, _ in capsules])
    shapes = jax.tree.map(lambda *leaves: np.stack(leaves), *[shape for _, shape in capsules])
    bodies = frames[joints]
    return Capsule(bodies.point(shapes.center), bodies.rotation @ shapes.half, shapes.radius)


def joint_of(mj: mujoco.MjModel, body: str | int) -> int:
    """The joint that moves this body of the robot."""
    return int(mj.body(body).jntadr[0])


def moving_dofs(mj: mujoco.MjModel, body: int) -> np.ndarray:
    """1 for each degree of freedom that moves the body, else 0: float32 [nv]."""
    mask = np.zeros(mj.nv, np.float32)
    while body:
        first, count = mj.body_dofadr[body], mj.body_dofnum[body]
        mask[first : first + count] = 1
        body = mj.body_parentid[body]
    return mask
