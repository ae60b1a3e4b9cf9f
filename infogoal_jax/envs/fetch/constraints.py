"""Constraint rows of one Fetch robot: the weld to the mocap body, joint limits and contacts, as MuJoCo defines them.

Formulas: MuJoCo's documentation, Modeling: solver parameters, and Computation: constraint model. `mjx.make_constraint` builds the same rows for any
model; here the model is known, so that the bodies of every row are static and its Jacobian is a sum over few joints.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

from infogoal_jax.envs.fetch.contacts import Contacts
from infogoal_jax.envs.fetch.solver import Rows


@dataclasses.dataclass(frozen=True, eq=False)
class Softness:
    """How a constraint gives way. reference: time constant (s) and damping ratio; impedance: MuJoCo's solimp (5 numbers); timestep in s;
    safe: whether the time constant is kept at two timesteps or more, as MuJoCo does."""

    reference: tuple[float, float]
    impedance: tuple[float, ...]
    timestep: float
    safe: bool = True

    def stiffness_and_damping(self) -> tuple[float, float]:
        """k (1 / s^2) and b (1 / s) of the reference acceleration -b v - k r."""
        time, ratio = (float(value) for value in self.reference)
        largest = float(self.impedance[1])
        if self.safe:
            time = max(time, 2 * self.timestep)
        return 1 / (largest * time * ratio) ** 2, 2 / (largest * time)

    def at(self, distance: jax.Array) -> jax.Array:
        """The impedance d(r) for violations [...] (m or rad)."""
        smallest, largest, width, middle, power = (float(value) for value in self.impedance)
        share = jnp.minimum(jnp.abs(distance) / width, 1.0)
        below = share**power / middle ** (power - 1)
        above = 1 - (1 - share) ** power / (1 - middle) ** (power - 1)
        return smallest + jnp.where(share < middle, below, above) * (largest - smallest)

    def rows(self, jacobian, velocity, violation, measure, inverse_weight, equality: bool, active=None) -> Rows:
        """Rows with this softness. jacobian [R, nv], velocity [nv], violation [R] (m or rad); measure [R]: what the impedance goes by."""
        stiffness, damping = self.stiffness_and_damping()
        impedance = self.at(measure)
        regularisation = jnp.maximum(inverse_weight * (1 - impedance) / impedance, 1e-15)
        reference = -damping * (jacobian * velocity).sum(-1) - stiffness * impedance * violation
        weight = 1 / regularisation if active is None else jnp.where(active, 1 / regularisation, 0.0)
        return Rows(jacobian, jnp.broadcast_to(weight, violation.shape), reference, jnp.full(violation.shape, equality))


def step_map(stiffness: float, damping: float, timestep: float) -> np.ndarray:
    """What one step of semi-implicit Euler does to (violation, velocity) of x'' = -k x - b x', [2, 2]."""
    kept = 1 - timestep * damping
    return np.array([[1 - timestep**2 * stiffness, timestep * kept], [-timestep * stiffness, kept]])


def lengthened(softness: Softness, timestep: float, duration: float) -> Softness:
    """The softness that moves an equality as far in `duration` seconds, in steps of `timestep`, as steps of the softness's own timestep do.

    With the same time constant, longer steps would overshoot (or, as MuJoCo then softens the constraint, lag behind); so stiffness and damping are
    chosen for the violation at the end of the duration to be the same, whatever violation and velocity it began with.
    """
    time, ratio = softness.reference
    short = np.linalg.matrix_power(step_map(1 / (time * ratio) ** 2, 2 / time, softness.timestep), round(duration / softness.timestep))

    def mismatch(values):
        long = np.linalg.matrix_power(step_map(1e3 * values[0], 1e2 * values[1], timestep), round(duration / timestep))
        return (long - short)[0] * np.array([1.0, 100.0])

    found = optimize.root(mismatch, np.array([1e-3 / (time * ratio) ** 2, 2e-2 / time]) * 0.6)
    assert found.success, found.message
    stiffness, damping = found.x * np.array([1e3, 1e2])
    return dataclasses.replace(softness, reference=(2 / damping, damping / 2 / np.sqrt(stiffness)), timestep=timestep, safe=False)


@dataclasses.dataclass(frozen=True, eq=False)
class ContactKind:
    """A pair of bodies, whose contact points share their physics.

    dofs: +-1 or 0 [nv], the joints that move the second body minus those that move the first; friction: coefficients of sliding and spinning;
    torsion: whether the contact resists spinning (MuJoCo's condim 4, otherwise 3); margin: distance (m) at which it begins to act.
    """

    dofs: np.ndarray
    friction: tuple[float, float]
    torsion: bool
    margin: float
    inverse_weight: float
    softness: Softness


def point_jacobian(data, centers: jax.Array, points: jax.Array) -> jax.Array:
    """How points [n, 3] move with each joint, [n, nv, 3], if all joints moved them. centers [nv, 3]: where the joints' axes in `data.cdof` are
    taken about."""
    angular, linear = data.cdof[:, :3], data.cdof[:, 3:]
    return linear + jnp.cross(angular, points[:, None, :] - centers)


def contact_rows(data, centers: jax.Array, contacts: Contacts, kind: ContactKind) -> Rows:
    """The pyramid of each contact point: normal +- friction x tangent for two tangents, and for the spin if the kind resists it."""
    moves = point_jacobian(data, centers, contacts.position) * kind.dofs[:, None]  # [n, nv, 3]
    along = jnp.einsum("nij,nvj->niv", contacts.frame, moves, precision=jax.lax.Precision.HIGHEST)  # [n, 3, nv]
    sliding, torsional = kind.friction
    edges = [sliding * along[:, 1], sliding * along[:, 2]]
    if kind.torsion:
        edges.append(torsional * (contacts.frame[:, :1] * data.cdof[:, :3]).sum(-1) * kind.dofs)
    jacobian = jnp.stack([along[:, 0] + side * edge for edge in edges for side in (1, -1)], axis=1)  # [n, 4 or 6, nv]
    violation = contacts.distance - kind.margin
    repeated = jnp.repeat(violation, jacobian.shape[1])
    weight = kind.inverse_weight * (1 + sliding**2) * 2 * sliding**2
    flat = jacobian.reshape(-1, jacobian.shape[-1])
    return kind.softness.rows(flat, data.qvel, repeated, repeated, weight, equality=False, active=repeated < 0)


def limit_row(data, joint: int, span: np.ndarray, inverse_weight: float, softness: Softness) -> Rows:
    """The limit of one joint (index into qpos and qvel) with lowest and highest position [2]."""
    position = data.qpos[joint]
    above, below = position - span[0], span[1] - position
    violation = jnp.minimum(above, below)[None]
    unit = np.eye(data.qvel.shape[0], dtype=np.float32)[joint]
    jacobian = (unit * jnp.where(above < below, 1.0, -1.0))[None]
    return softness.rows(jacobian, data.qvel, violation, violation, inverse_weight, equality=False, active=violation < 0)


def weld_rows(data, centers, dofs, position, quaternion, target, target_quaternion, inverse_weight, softness: Softness) -> Rows:
    """The weld of a point of the arm (position [3], quaternion [4]) to the mocap body's pose: three rows in m, three in half radians.

    dofs: 0 or 1 [nv], the joints that move the point; inverse_weight: of translation and of rotation.
    """
    linear = -(point_jacobian(data, centers, position[None])[0] * dofs[:, None])  # Mocap minus arm; the mocap body has no joints.
    # Orientation error conj(q) q_target, and its derivative 1/2 conj(q) (-w) q_target for a turn of the arm by w.
    inverse = quaternion * np.array([1.0, -1.0, -1.0, -1.0], np.float32)
    error = quaternion_product(inverse, target_quaternion)
    turns = jnp.concatenate([jnp.zeros((data.cdof.shape[0], 1)), -data.cdof[:, :3] * dofs[:, None]], -1)
    angular = 0.5 * quaternion_product(quaternion_product(inverse, turns), target_quaternion)[:, 1:]
    jacobian = jnp.concatenate([linear.T, angular.T])
    violation = jnp.concatenate([target - position, error[1:]])
    weight = np.repeat(np.asarray(inverse_weight, np.float32), 3)
    return softness.rows(jacobian, data.qvel, violation, jnp.sqrt((violation**2).sum()) * jnp.ones(6), weight, equality=True)


def quaternion_product(left: jax.Array, right: jax.Array) -> jax.Array:
    """Hamilton's product of quaternions [..., 4] (w, x, y, z)."""
    w, vector = left[..., :1], left[..., 1:]
    other, direction = right[..., :1], right[..., 1:]
    scalar = w * other - (vector * direction).sum(-1, keepdims=True)
    return jnp.concatenate([scalar, w * direction + other * vector + jnp.cross(vector, direction)], -1)


def stack(*parts: Rows) -> Rows:
    """All rows of the parts, one after the other."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
