"""Constraint rows of one Fetch robot: the weld to the mocap body, joint limits and contacts, as MuJoCo defines them.

Formulas: MuJoCo's documentation, Modeling: solver parameters, and Computation: constraint model. `mjx.make_constraint` builds the same rows for any
model; here the model is known, so that all rows are worked out side by side, and whatever is constant is an array made beforehand.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

from infogoal_jax.envs.fetch import solver
from infogoal_jax.envs.fetch.contacts import Contacts, tangents
from infogoal_jax.envs.fetch.multibody import Axes
from infogoal_jax.envs.fetch.vectors import Quaternion, Vector

UNIT, NOTHING = Vector.of(np.eye(3, dtype=np.float32)), Vector.of(np.zeros((1, 3), np.float32))


@dataclasses.dataclass(frozen=True, eq=False)
class Softness:
    """How a constraint gives way. reference: time constant (s) and damping ratio; impedance: MuJoCo's solimp (5 numbers, the last two 0.5 and 2);
    timestep in s; safe: whether the time constant is kept at two timesteps or more, as MuJoCo does."""

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

    def rows(self, jacobian: jax.Array, velocity: jax.Array, violation: jax.Array, measure: jax.Array, active: jax.Array) -> solver.ConstraintRows:
        """Rows of these kinds. jacobian [nv, R], velocity [nv], violation [R] (m or rad); measure [R]: what the impedance goes by; active: bool [R]."""
        impedance = self.impedance(measure)
        regularisation = jnp.maximum(self.inverse_weight * (1 - impedance) / impedance, 1e-15)
        reference = -self.damping * solver.times(jacobian.T, velocity) - self.stiffness * impedance * violation
        return solver.ConstraintRows(jacobian, jnp.where(active, 1 / regularisation, 0.0), reference)


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

    @property
    def row(self) -> tuple[Softness, float]:
        """What each row of the pyramid is made of."""
        sliding = self.friction[0]
        return self.softness, self.inverse_weight * (1 + sliding**2) * 2 * sliding**2


def work(axes: Axes, force: Vector, torque: Vector) -> jax.Array:
    """How fast forces and torques about the origin (vectors of arrays [R]) work along each degree of freedom: Jacobian [nv, R]."""
    return axes.linear[:, None].dot(force) + axes.angular[:, None].dot(torque)


class Weld:
    """The weld of a point of the arm to the mocap body's pose: three rows in m, three in half radians."""

    def __init__(self, dofs: np.ndarray, softness: Softness, inverse_weight: tuple[float, float]):
        """dofs: 0 or 1 [nv], the joints that move the point; inverse_weight: of translation and of rotation."""
        self.dofs = dofs[:, None]
        self.kinds = [(softness, weight) for weight in inverse_weight for _ in range(3)]

    def jacobian_and_violation(
        self, axes: Axes, lever: Vector, quaternion: Quaternion, apart: Vector, target: Quaternion
    ) -> tuple[jax.Array, jax.Array]:
        """Jacobian [nv, 6] and violation [6] for a point at `lever` from the origin (m) and with this quaternion; apart: from it to the target (m)."""
        # Mocap minus arm; the mocap body has no joints.
        linear = work(axes, -UNIT, -lever.cross(UNIT))
        # Orientation error conj(q) q_target, and its derivative 1/2 conj(q) (-w) q_target for a turn of the arm by w.
        inverse = quaternion.conjugate()
        error = inverse * target
        derivative = (inverse * Quaternion(np.zeros(3, np.float32), -UNIT) * target).vector * 0.5
        angular = work(axes, NOTHING, Vector.of(derivative.array.T))
        return jnp.concatenate([linear, angular], axis=1) * self.dofs, jnp.concatenate([apart.array, error.vector.array])


class Limits:
    """The limits of joints, a row for each, at whichever end is nearer."""

    def __init__(self, joints: list[int], spans: list[np.ndarray], kinds: list[tuple[Softness, float]], nv: int):
        """joints: their indices into position and velocity; spans: lowest and highest position [2] of each."""
        self.joints, self.low, self.high = np.array(joints), *np.float32(spans).T
        self.kinds, self.unit = kinds, np.eye(nv, dtype=np.float32)[:, joints]

    def jacobian_and_violation(self, position: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Jacobian [nv, L] and violation [L], negative beyond the limit, at this position [nq]."""
        above, below = position[self.joints] - self.low, self.high - position[self.joints]
        return self.unit * jnp.where(above < below, 1.0, -1.0), jnp.minimum(above, below)


class FrictionPyramids:
    """The rows of contact points: normal +- friction x tangent for both tangents, and for the spin where the contact resists it."""

    def __init__(self, kinds: list[ContactKind]):
        """kinds: of each point."""
        self.spinning = np.flatnonzero([kind.torsion for kind in kinds])
        self.dofs = np.stack([kind.dofs for kind in kinds], axis=1)
        self.margin = np.float32([kind.margin for kind in kinds])
        self.sliding, self.torsional = np.float32([kind.friction for kind in kinds]).T
        self.kinds = [kind.row for kind in kinds] * 4 + [kinds[point].row for point in self.spinning] * 2

    def jacobian_and_violation(self, axes: Axes, origin: Vector, contacts: Contacts) -> tuple[jax.Array, jax.Array]:
        """Jacobian [nv, 4 n + 2 s] and violation of n points, of which s resist spinning."""
        normal, lever, spinning = contacts.normal, contacts.position - origin, self.spinning
        push, *slides = (work(axes, direction, lever.cross(direction)) * self.dofs for direction in (normal, *tangents(normal)))
        edges = [push + side * self.sliding * slide for slide in slides for side in (1, -1)]
        spin = work(axes, NOTHING, normal[spinning]) * (self.dofs * self.torsional)[:, spinning]
        edges += [push[:, spinning] + spin, push[:, spinning] - spin]
        violation = contacts.distance - self.margin
        return jnp.concatenate(edges, axis=1), jnp.concatenate([violation] * 4 + [violation[spinning]] * 2)
