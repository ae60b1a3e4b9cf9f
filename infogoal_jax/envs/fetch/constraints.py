"""Constraint rows of one Fetch robot: the weld to the mocap body, joint limits and contacts, as MuJoCo defines them.

Formulas: MuJoCo's documentation, Modeling: solver parameters, and Computation: constraint model. `mjx.make_constraint`
builds the same rows for any model; here the model is known, so that all rows are computed side by side, and constants
are arrays made beforehand.
"""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.envs.fetch import solver
from infogoal_jax.envs.fetch.contacts import Contacts, tangents
from infogoal_jax.envs.fetch.multibody import Axes
from infogoal_jax.envs.fetch.vectors import Quaternion, Vector, joined, once


@dataclasses.dataclass(frozen=True, eq=False)
class Softness:
    """The softness of a constraint.

    reference: time constant (s) and damping ratio.
    impedance: MuJoCo's solimp (5 numbers, the last two 0.5 and 2).
    timestep: s.
    safe: whether the time constant is kept at two timesteps or more, as MuJoCo does.
    """

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


class RowKinds:
    """The constants of R rows: arrays float32 [R]."""

    def __init__(self, *kinds: tuple[Softness, float]):
        """kinds: softness and inverse weight of each row."""
        assert all(tuple(softness.impedance[3:]) == (0.5, 2.0) for softness, _ in kinds)
        self.stiffness, self.damping = np.float32([softness.stiffness_and_damping() for softness, _ in kinds]).T
        self.smallest, self.largest, self.width = np.float32([softness.impedance[:3] for softness, _ in kinds]).T
        self.inverse_weight = np.float32([weight for _, weight in kinds])

    def impedance(self, violation: jax.Array) -> jax.Array:
        """d(r) for violations [R] (m or rad)."""
        share = jnp.minimum(jnp.abs(violation) / self.width, 1.0)
        risen = jnp.where(share < 0.5, 2 * share**2, 1 - 2 * (1 - share) ** 2)
        return self.smallest + risen * (self.largest - self.smallest)

    def rows(
        self, jacobian: jax.Array, velocity: jax.Array, violation: jax.Array, measure: jax.Array, active: jax.Array
    ) -> solver.ConstraintRows:
        """Rows of these kinds. jacobian [nv, R], velocity [nv], violation [R] (m or rad); measure [R]: what the
        impedance goes by; active: bool [R]."""
        impedance = self.impedance(measure)
        regularisation = jnp.maximum(self.inverse_weight * (1 - impedance) / impedance, 1e-15)
        reference = -self.damping * solver.times(jacobian.T, velocity) - self.stiffness * impedance * violation
        return solver.ConstraintRows(jacobian, jnp.where(active, 1 / regularisation, 0.0), reference)


def step_map(stiffness: float, damping: float, timestep: float) -> np.ndarray:
    """The matrix [2, 2] by which one step of semi-implicit Euler maps (violation, velocity) of x'' = -k x - b x'."""
    kept = 1 - timestep * damping
    return np.array([[1 - timestep**2 * stiffness, timestep * kept], [-timestep * stiffness, kept]])


def lengthened(softness: Softness, timestep: float, duration: float) -> Softness:
    """The softness with which steps of `timestep` move an equality as far in `duration` seconds as steps of the given
    softness's own timestep do.

    With the same time constant, longer steps would overshoot (or, as MuJoCo then softens the constraint, lag behind);
    so stiffness and damping are chosen for the violation at the end of the duration to be the same, whatever violation
    and velocity it began with.
    """
    time, ratio = softness.reference
    short = np.linalg.matrix_power(
        step_map(1 / (time * ratio) ** 2, 2 / time, softness.timestep), round(duration / softness.timestep)
    )

    def mismatch(values):
        long = np.linalg.matrix_power(step_map(1e3 * values[0], 1e2 * values[1], timestep), round(duration / timestep))
        return (long - short)[0] * np.array([1.0, 100.0])

    from scipy import optimize  # Only now: it takes a fifth of a second.

    found = optimize.root(mismatch, np.array([1e-3 / (time * ratio) ** 2, 2e-2 / time]) * 0.6)
    assert found.success, found.message
    stiffness, damping = found.x * np.array([1e3, 1e2])
    return dataclasses.replace(
        softness, reference=(2 / damping, damping / 2 / np.sqrt(stiffness)), timestep=timestep, safe=False
    )


@dataclasses.dataclass(frozen=True, eq=False)
class ContactKind:
    """A pair of bodies, whose contact points share their physics.

    dofs: +-1 or 0 [nv], the joints that move the second body minus those that move the first.
    friction: coefficients of sliding and spinning.
    torsion: whether the contact resists spinning (MuJoCo's condim 4, otherwise 3).
    margin: distance (m) at which it begins to act.
    """

    dofs: np.ndarray
    friction: tuple[float, float]
    torsion: bool
    margin: float
    inverse_weight: float
    softness: Softness

    @property
    def row(self) -> tuple[Softness, float]:
        """What each row of the pyramid is made of."""
        sliding = self.friction[0]
        return self.softness, self.inverse_weight * (1 + sliding**2) * 2 * sliding**2


@flax.struct.dataclass
class Wrench:
    """The direction in which each constraint row acts: force and torque about the origin, vectors of arrays [R]."""

    force: Vector
    torque: Vector

    @classmethod
    def at(cls, lever: Vector, direction: Vector) -> "Wrench":
        """Forces of size 1 along these directions, at points that lie at `lever` from the origin (m)."""
        return cls(direction, lever.cross(direction))

    def __add__(self, other: "Wrench") -> "Wrench":
        return Wrench(self.force + other.force, self.torque + other.torque)

    def __mul__(self, factor) -> "Wrench":
        return Wrench(self.force * factor, self.torque * factor)

    def __getitem__(self, index) -> "Wrench":
        return Wrench(self.force[index], self.torque[index])

    def jacobian(self, axes: Axes) -> jax.Array:
        """The Jacobian [nv, R]: the velocity along each wrench for a unit velocity of each degree of freedom."""
        return axes.linear[:, None].dot(self.force) + axes.angular[:, None].dot(self.torque)


UNIT = Vector.of(np.eye(3, dtype=np.float32))


class Weld:
    """The weld of a point of the arm to the mocap body's pose: three rows in m, three in half radians."""

    def __init__(self, dofs: np.ndarray, softness: Softness, inverse_weight: tuple[float, float]):
        """dofs: 0 or 1 [nv], the joints that move the point; inverse_weight: of translation and of rotation."""
        self.dofs = np.repeat(dofs[:, None], 6, axis=1)
        self.kinds = [(softness, weight) for weight in inverse_weight for _ in range(3)]

    def wrench_and_violation(
        self, lever: Vector, quaternion: Quaternion, apart: Vector, target: Quaternion
    ) -> tuple[Wrench, jax.Array]:
        """Wrenches and violation [6] for a point at `lever` from the origin (m) and with this quaternion; apart: from
        it to the target (m)."""
        pull = Wrench.at(lever, -UNIT)  # Mocap minus arm; the mocap body has no joints.
        # Orientation error conj(q) q_target, and its derivative 1/2 conj(q) (-w) q_target for a turn of the arm by w.
        inverse = quaternion.conjugate()
        derivative = (inverse * Quaternion(np.zeros(3, np.float32), -UNIT) * target).vector * 0.5
        turn = Wrench(jax.tree.map(jnp.zeros_like, UNIT), Vector.of(derivative.array.T))
        return joined(pull, turn), jnp.concatenate([apart.array, (inverse * target).vector.array])


class Limits:
    """The limits of joints: one row for each joint, for the nearer end."""

    def __init__(self, joints: np.ndarray, spans: np.ndarray, kinds: list[tuple[Softness, float]], nv: int):
        """joints: their indices [L] into position and velocity; spans: lowest and highest position [L, 2]."""
        self.joints, self.low, self.high = joints, *np.float32(spans).T
        self.kinds, self.unit = kinds, np.eye(nv, dtype=np.float32)[:, joints]

    def jacobian_and_violation(self, position: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Jacobian [nv, L] and violation [L], negative beyond the limit, at this position [nq]."""
        above, below = position[self.joints] - self.low, self.high - position[self.joints]
        return self.unit * jnp.where(above < below, 1.0, -1.0)[None], jnp.minimum(above, below)


class FrictionPyramids:
    """The rows of contact points: normal +- friction x tangent for both tangents, and for the spin where the contact
    resists it."""

    def __init__(self, kinds: list[ContactKind]):
        """kinds: of each of n points, of which s resist spinning."""
        self.spinning = np.flatnonzero([kind.torsion for kind in kinds]).astype(np.int32)
        points = np.concatenate([np.tile(np.arange(len(kinds)), 4), np.tile(self.spinning, 2)])
        self.dofs = np.stack([kinds[point].dofs for point in points], axis=1)
        self.kinds = [kinds[point].row for point in points]
        self.margin = np.float32([kind.margin for kind in kinds])
        self.sliding, self.torsional = np.float32([kind.friction for kind in kinds]).T

    def wrench_and_violation(self, origin: Vector, contacts: Contacts) -> tuple[Wrench, jax.Array]:
        """Wrenches and violation [4 n + 2 s]."""
        contacts, slides = once((contacts, tangents(contacts.normal)))
        lever, spinning = contacts.position - origin, self.spinning
        push = Wrench.at(lever, contacts.normal)
        edges = [push + Wrench.at(lever, slide) * (side * self.sliding) for slide in slides for side in (1, -1)]
        pressed, axis = push[spinning], contacts.normal[spinning] * self.torsional[spinning]
        edges += [pressed.replace(torque=pressed.torque + axis), pressed.replace(torque=pressed.torque - axis)]
        violation = contacts.distance - self.margin
        return joined(*edges), jnp.concatenate([violation] * 4 + [violation[spinning]] * 2)
