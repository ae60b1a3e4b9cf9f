"""Rigid-body dynamics of one robot and its object: kinematics, inertia matrix and bias forces, for a tree that is known
at compile time.

The formulas are MuJoCo's (its documentation, Computation: kinematics, composite rigid bodies, recursive Newton-Euler).
`mjx.kinematics`, `mjx.crb` and `mjx.rne` compute the same by a walk over the bodies, one level after the other; here
all bodies are computed side by side, and sums along the tree are products with constant matrices, which takes a twelfth
of the operations to compile. tests/envs/fetch/test_multibody.py compares them with MuJoCo and MJX.

Velocities, momenta and inertias of bodies are all taken about one fixed point of the world, `origin`, so that those of
several bodies may be added.
"""

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from infogoal_jax.envs.fetch.contacts import Box
from infogoal_jax.envs.fetch.vectors import Quaternion, Rotation, Vector, joined, once, vectors

GRAVITY = 9.81
"""Acceleration of a body in free fall, in m / s^2."""


@flax.struct.dataclass
class Frames:
    """Poses of the robot's bodies, one for each joint: quaternion, rotation and position (m), each of arrays [b]."""

    quaternion: Quaternion
    rotation: Rotation
    position: Vector

    def __getitem__(self, index) -> "Frames":
        return Frames(self.quaternion[index], self.rotation[index], self.position[index])

    def point(self, place: Vector) -> Vector:
        """Where points are that lie at these places on the bodies (m)."""
        return self.position + self.rotation @ place


@flax.struct.dataclass
class Axes:
    """The motion of the bodies along each of the nv degrees of freedom: angular velocity, and linear velocity of the
    point at the origin, arrays [nv]."""

    angular: Vector
    linear: Vector


@flax.struct.dataclass
class Inertia:
    """Inertia of bodies about the origin: mass (kg), first moment (kg m) and second moments (kg m^2), arrays [b]."""

    mass: jax.Array
    moment: Vector
    xx: jax.Array
    yy: jax.Array
    zz: jax.Array
    xy: jax.Array
    xz: jax.Array
    yz: jax.Array

    def momentum(self, turning: Vector, moving: Vector) -> tuple[Vector, Vector]:
        """Angular and linear momentum of bodies with this angular velocity and this velocity of the point at the
        origin."""
        x, y, z = turning.x, turning.y, turning.z
        spin = Vector(
            self.xx * x + self.xy * y + self.xz * z,
            self.xy * x + self.yy * y + self.yz * z,
            self.xz * x + self.yz * y + self.zz * z,
        )
        return spin + self.moment.cross(moving), moving * self.mass + turning.cross(self.moment)


class Multibody:
    """The constants of a model whose robot has one joint a body, and whose object, if any, is a free body and comes
    last."""

    def __init__(self, model: mujoco.MjModel, has_object: bool, origin):
        joints = model.njnt - has_object
        bodies = model.jnt_bodyid[:joints]
        assert model.nv == joints + 6 * has_object and len(set(bodies)) == joints
        assert not model.jnt_pos[:joints].any() and (model.body_quat[bodies] == [1, 0, 0, 0]).all()
        self.origin, self.joints, self.has_object = Vector.of(np.asarray(origin, np.float32)), joints, has_object
        index = {int(body): joint for joint, body in enumerate(bodies)}
        world = joints
        self.parents = np.array([index.get(int(model.body_parentid[body]), world) for body in bodies])
        self.lineage = np.eye(joints, dtype=np.float32)  # [i, j]: whether joint j moves the body of joint i.
        for joint, parent in enumerate(self.parents):
            if parent != world:
                self.lineage[joint] += self.lineage[parent]
        self.jumps = jumps_to_the_root(self.parents)
        self.hinge = np.float32(model.jnt_type[:joints] == mujoco.mjtJoint.mjJNT_HINGE)
        self.axis, self.rest = vectors(model.jnt_axis[:joints]), np.float32(model.qpos0[:joints])
        self.offset, self.center = vectors(model.body_pos[bodies]), vectors(model.body_ipos[bodies])
        self.mass = np.float32(model.body_mass[bodies])
        turns = np.stack([matrix_of(quaternion) for quaternion in model.body_iquat[bodies]])
        self.principal = [
            vectors(turns[..., axis] * np.sqrt(model.body_inertia[bodies, axis, None])) for axis in range(3)
        ]
        self.damping, self.armature = np.float32(model.dof_damping), np.float32(model.dof_armature)
        self.stiffness, self.spring = np.float32(model.jnt_stiffness[:joints]), np.float32(model.qpos_spring[:joints])
        if has_object:
            thing = model.jnt_bodyid[-1]
            assert (model.body_iquat[thing] == [1, 0, 0, 0]).all() and not model.body_ipos[thing].any()
            self.thing_mass, self.thing_inertia = (
                np.float32(model.body_mass[thing]),
                np.float32(model.body_inertia[thing]),
            )

    def frames(self, position: jax.Array) -> Frames:
        """Where the bodies are at this position [nq]."""
        moved = position[: self.joints] - self.rest
        half = 0.5 * moved * self.hinge
        turn = Quaternion(jnp.cos(half), self.axis * jnp.sin(half))
        # Every turn is put behind that of its parent, then both behind that of the parent's own, and so on: three
        # products for seven joints. XLA's CPU fusions would compute each product anew for every number of the next; the
        # barrier stops that.
        for ancestor in self.jumps:
            turn = once(joined(turn, STILL)[ancestor] * turn)
        rotation = turn.rotation()
        step = joined(rotation, UPRIGHT)[self.parents] @ self.offset + (rotation @ self.axis) * (
            (1 - self.hinge) * moved
        )
        return Frames(turn, rotation, summed(self.lineage, step))

    def axes(self, frames: Frames) -> Axes:
        """How the robot moves with each of its joints."""
        axis = frames.rotation @ self.axis
        return Axes(axis * self.hinge, axis.cross(self.origin - frames.position) * self.hinge + axis * (1 - self.hinge))

    def thing_axes(self, thing: Box) -> Axes:
        """How the object, one of P = 1, moves with each of its six degrees of freedom: along the world's axes, and
        about its own."""
        turns = Vector.of(thing.rotation.array[0].T)
        return Axes(joined(NONE, turns), joined(STRAIGHT, turns.cross(self.origin - thing.center)))

    def inertia(self, frames: Frames) -> Inertia:
        """Inertia of each of the robot's bodies."""
        rotation = frames.rotation
        lever = frames.position + rotation @ self.center - self.origin
        moment = lever * self.mass
        axes = [rotation @ axis for axis in self.principal]

        def second(row: str, column: str) -> jax.Array:
            """A second moment, without the term that the distance from the origin adds along the diagonal."""
            spread = sum(getattr(axis, row) * getattr(axis, column) for axis in axes)
            return spread - getattr(moment, row) * getattr(lever, column)

        far = moment.dot(lever)
        return Inertia(
            self.mass,
            moment,
            second("x", "x") + far,
            second("y", "y") + far,
            second("z", "z") + far,
            second("x", "y"),
            second("x", "z"),
            second("y", "z"),
        )

    def inertia_matrix(self, inertia: Inertia, turn: Vector, move: Vector) -> jax.Array:
        """The robot's part of the inertia matrix, [joints, joints]: turn and move are its axes."""
        carried = summed(self.lineage.T, inertia).replace(mass=self.lineage.T @ self.mass)
        spin, push = once(carried.momentum(turn, move))
        products = spin[:, None].dot(turn[None]) + push[:, None].dot(move[None])
        shared = np.maximum(self.lineage, self.lineage.T)
        return jnp.where(self.lineage > 0, products, products.T) * shared + np.diag(self.armature[: self.joints])

    def velocities(self, turn: Vector, move: Vector, velocity: jax.Array) -> tuple[Vector, Vector]:
        """Angular velocity of each body, and velocity of its point at the origin."""
        return summed(self.lineage, (turn * velocity, move * velocity))

    def rates(self, turn: Vector, move: Vector, velocity: jax.Array) -> tuple[Vector, Vector, Vector, Vector]:
        """`velocities`, and their rates of change at constant joint velocities."""
        turning, moving = self.velocities(turn, move, velocity)
        changes = turning.cross(turn) * velocity, (turning.cross(move) + moving.cross(turn)) * velocity
        return turning, moving, *summed(self.lineage, changes)

    def body_rates(self, frames: Frames, velocity: jax.Array, body: int, changes: bool) -> list[Vector]:
        """`velocities` or, with their changes, `rates` of one body, at this velocity [nv]."""
        axes, of_bodies = self.axes(frames), self.rates if changes else self.velocities
        return [rate[body] for rate in of_bodies(axes.angular, axes.linear, velocity[: self.joints])]

    def bias(self, inertia: Inertia, turn: Vector, move: Vector, velocity: jax.Array) -> jax.Array:
        """The forces [joints] that keep the robot at this velocity [joints], against gravity."""
        turning, moving, turn_rate, move_rate = self.rates(turn, move, velocity)
        torque, thrust = inertia.momentum(turn_rate, move_rate.replace(z=move_rate.z + GRAVITY))
        spin, push = once(inertia.momentum(turning, moving))
        torque, thrust = torque + turning.cross(spin) + moving.cross(push), thrust + turning.cross(push)
        torque, thrust = summed(self.lineage.T, (torque, thrust))
        return torque.dot(turn) + thrust.dot(move)

    def dynamics(
        self, frames: Frames, thing: Box | None, position: jax.Array, velocity: jax.Array
    ) -> tuple[Axes, jax.Array, jax.Array]:
        """Axes, inertia matrix [nv, nv], and passive less bias forces [nv], at this position [nq] and velocity [nv].

        thing: the object, as one of P = 1, or None.
        """
        n = self.joints
        axes, bodies = once((self.axes(frames), self.inertia(frames)))
        inertia = self.inertia_matrix(bodies, axes.angular, axes.linear)
        force = self.stiffness * (self.spring - position[:n]) - self.bias(
            bodies, axes.angular, axes.linear, velocity[:n]
        )
        if self.has_object:
            axes = joined(axes, self.thing_axes(thing))
            whirl = Vector.of(velocity[n + 3 :])
            gyration = Vector.of(self.thing_inertia * velocity[n + 3 :]).cross(whirl).array
            fall = np.array([0, 0, -GRAVITY * self.thing_mass], np.float32)
            force = jnp.concatenate([force, fall, gyration])
            own = np.concatenate(
                [np.zeros(n, np.float32), np.full(3, self.thing_mass), self.thing_inertia + self.armature[n + 3 :]]
            )
            inertia = jnp.pad(inertia, (0, 6)) + np.diag(own)
        return axes, inertia, force - self.damping * velocity


def summed(weights: np.ndarray, tree):
    """Sums of the tree's arrays [n] under constant weights [m, n], all of them in one matrix product: arrays [m]."""
    leaves, structure = jax.tree.flatten(tree)
    sums = jnp.matmul(jnp.stack(leaves), weights.T, precision=jax.lax.Precision.HIGHEST)
    return structure.unflatten([row[0] for row in jax.lax.split(sums, [1] * len(leaves))])


def jumps_to_the_root(parents: np.ndarray) -> list[np.ndarray]:
    """Each body's ancestors 1, 2, 4, ... levels up, int [n], where n stands for the world as it does in `parents`:
    products along them reach from the root to every tip."""
    size = len(parents)
    ancestor = np.array([*parents, size])
    jumps = []
    while (ancestor < size).any():
        jumps.append(ancestor[:size])
        ancestor = ancestor[ancestor]
    return jumps


def matrix_of(quaternion: np.ndarray) -> np.ndarray:
    """The rotation matrix [3, 3] of a constant quaternion [4]."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


STILL = Quaternion.of(np.float32([[1, 0, 0, 0]]))
UPRIGHT = Rotation.of(np.eye(3, dtype=np.float32)[None])
STRAIGHT, NONE = vectors(np.eye(3)), vectors(np.zeros((3, 3)))
