"""The shapes of a Fetch robot and its object that can touch something: where they are, the points at which they touch,
and the constants of these points, both in one order.

The hand meets the table and the object as boxes, the palm the table as a sphere, and parts of the robot each other as
capsules.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from infogoal_jax.envs.fetch import contacts, model, multibody
from infogoal_jax.envs.fetch.constraints import ContactKind, FrictionPyramids, Softness
from infogoal_jax.envs.fetch.contacts import Box, Capsule, Contacts
from infogoal_jax.envs.fetch.multibody import Frames
from infogoal_jax.envs.fetch.tasks import Task
from infogoal_jax.envs.fetch.vectors import Quaternion, Vector, joined, vectors


class Shapes:
    """The shapes of one task in one setting, and what they touch."""

    def __init__(self, mj: mujoco.MjModel, task: Task, setting: model.Setting):
        self.mujoco_model, self.puck, self.timestep = mj, task.puck, setting.timestep
        self.has_object = task.object_height is not None
        self.first_of_object = mj.njnt - self.has_object  # Its place in the position; the robot's joints come first.
        self.one_hand = task.blocks_fingers and not setting.whole_body
        right, left = (mj.geom(name) for name in model.FINGERS)
        place, half = np.float32([right.pos, left.pos]), np.float32([right.size, left.size])
        if self.one_hand:  # One block, as wide as both.
            place, half = place.mean(0, keepdims=True), half[:1] + np.abs(place[:1] - place[1:]) / 2
        wrist = joint_of(mj, "wrist_roll")
        self.wrist = slice(wrist, wrist + 1)
        self.fingers = slice(self.first_of_object - 2, self.first_of_object)
        self.hand_place, self.hand_half = Vector.of(place), Vector.of(half)
        palm = mj.geom("palm")
        self.palm_place, self.palm_radius = vectors(palm.pos), float(palm.size[0])
        self.table = contacts.block(model.table_of(task))
        self.robot_pairs = model.ROBOT_PAIRS if setting.whole_body else ()
        self.capsules = [[self.capsule(name) for name in names] for names in zip(*self.robot_pairs, strict=True)]
        self.pyramids = FrictionPyramids(self.kinds(task))

    def capsule(self, name: str) -> tuple[int, Capsule]:
        """A capsule of the robot: the joint that moves it, and where it lies on its body."""
        geom = self.mujoco_model.geom(name)
        axis = multibody.matrix_of(geom.quat)[:, 2] * geom.size[1]
        joint = joint_of(self.mujoco_model, geom.bodyid[0])
        return joint, Capsule(vectors(geom.pos), vectors(axis), np.float32(geom.size[0]))

    def kind(self, pair: model.Pair, first: str, second: str) -> ContactKind:
        """The constants of the contacts of two shapes."""
        weight = sum(model.INVERSE_WEIGHT[geom][0] for geom in (first, second))
        if self.one_hand and not {first, second}.isdisjoint(model.FINGERS):
            weight = weight / 2  # One block is as stiff as two fingers side by side.
        bodies = (self.mujoco_model.geom(name).bodyid[0] for name in (first, second))
        before, after = (moving_dofs(self.mujoco_model, body) for body in bodies)
        softness = Softness(pair.reference, pair.impedance, self.timestep)
        return ContactKind(after - before, pair.friction, pair.torsion, pair.margin, weight, softness)

    def kinds(self, task: Task) -> list[ContactKind]:
        """The constants of each contact point, in the order of `contacts`."""
        fingers = model.FINGERS[:1] if self.one_hand else model.FINGERS
        boxes = [self.kind(model.FINGER_AND_THING, "table", finger) for finger in fingers]
        rounded = [self.kind(model.MESH_AND_TABLE, "table", "palm")]
        rounded += [self.kind(model.ROBOT_AND_ROBOT, *pair) for pair in self.robot_pairs]
        if self.has_object:
            on_fingers = [self.kind(model.FINGER_AND_THING, finger, "object") for finger in fingers]
            on_ground = self.kind(model.PUCK_AND_TABLE if task.puck else model.THING_AND_GROUND, "table", "object")
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
                upright, radius, half_height = beside.rotation.z, model.PUCK_RADIUS, model.PUCK_HALF_HEIGHT
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
        half = model.PUCK_BLOCK_HALF if self.puck else model.CUBE_HALF
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
