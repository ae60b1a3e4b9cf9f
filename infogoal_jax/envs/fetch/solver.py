"""MuJoCo's constraint problem for one small robot, solved by Newton's method with a fixed number of steps.

The problem is MuJoCo's own (its documentation, Computation: primal problem, pyramidal cones): find the acceleration a
that minimises

    1/2 (a - a_free)' M (a - a_free)  +  1/2 sum over rows of D (J a - reference)^2, where a row counts if it is an
    equality or J a < reference.

`mjx.solve` finds the same minimum. This solver is for 7 to 18 degrees of freedom and about 100 rows, without a
convergence test, so that a batch runs in lock-step. On an NVIDIA GPU the same steps run in a kernel that keeps a
robot's rows on the chip (newton_kernel.py).
"""

import functools

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.envs.fetch import newton_kernel

TRIAL_LENGTHS = np.array([0.0, 0.03, 0.1, 0.25, 0.5, 0.75, 0.95, 1.05, 1.5, 3.0], np.float32)
FINER = np.linspace(0.0, 1.0, newton_kernel.FINER + 1, dtype=np.float32)
EQUALITIES = 6
"""The first rows are the weld's: they count whatever their residual."""


@flax.struct.dataclass
class ConstraintRows:
    """Constraint rows: jacobian [nv, R] (transposed: long rows are multiplied twice as fast), stiffness D [R] (1 /
    regularisation), reference acceleration [R]."""

    jacobian: jax.Array
    stiffness: jax.Array
    reference: jax.Array

    def weights(self, residual: jax.Array) -> jax.Array:
        """The stiffness of the rows that count at this residual, 0 for the others, [R]."""
        return jnp.where((np.arange(len(residual)) < EQUALITIES) | (residual < 0), self.stiffness, 0.0)


def times(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Matrix [m, n] times vector [n] or matrix [n, k] in full float32, also where a GPU would round its factors to
    TF32."""
    return jnp.matmul(matrix, vector, precision=jax.lax.Precision.HIGHEST)


def positive_definite_solve(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """The solution x [n] of `matrix x = vector` for a positive definite matrix [n, n]."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix, lower=True), vector)


def solve(
    inertia: jax.Array, damping: np.ndarray, force: jax.Array, rows: ConstraintRows, start: jax.Array, steps: int
) -> tuple[jax.Array, jax.Array]:
    """The acceleration [nv] of least cost, and that of a step which takes damping implicitly: (M + damping)^-1 (force +
    constraint force), [nv].

    inertia: M [nv, nv]; damping: joint damping times timestep [nv]; force: all other generalised forces [nv], so that
    a_free = M^-1 force; start: acceleration to begin from [nv].
    """
    problem = (inertia, jnp.asarray(damping), force, rows.jacobian, rows.stiffness, rows.reference, start)
    return jax.lax.platform_dependent(
        *problem,
        cuda=functools.partial(newton_kernel.solve, lengths=TRIAL_LENGTHS, equalities=EQUALITIES, steps=steps),
        default=functools.partial(solve_anywhere, steps=steps),
    )


def solve_anywhere(
    inertia, damping, force, jacobian, stiffness, reference, start, steps: int
) -> tuple[jax.Array, jax.Array]:
    """`solve` in XLA's own operations: used on every device but NVIDIA GPUs, and the reference for the kernel."""
    rows = ConstraintRows(jacobian, stiffness, reference)

    def newton_step(_, carried):
        acceleration, residual = carried
        weight = rows.weights(residual)
        curvature = times(rows.jacobian * weight, rows.jacobian.T)
        pull = times(rows.jacobian, weight * residual)
        smooth = times(inertia, acceleration) - force
        direction = -positive_definite_solve(inertia + curvature, smooth + pull)
        change = times(rows.jacobian.T, direction)
        quadratic = ((direction * smooth).sum(), (direction * times(inertia, direction)).sum())
        length = line_search((direction * (smooth + pull)).sum(), quadratic, residual, change, rows)
        return acceleration + length * direction, residual + length * change

    # A loop, not written out: the program compiles in half the time, and runs a quarter faster on a CPU.
    acceleration, residual = jax.lax.fori_loop(
        0, steps, newton_step, (start, times(rows.jacobian.T, start) - rows.reference)
    )
    constraint_force = -times(rows.jacobian, rows.weights(residual) * residual)
    return acceleration, positive_definite_solve(inertia + jnp.diag(damping), force + constraint_force)


def line_search(
    slope: jax.Array,
    quadratic: tuple[jax.Array, jax.Array],
    residual: jax.Array,
    change: jax.Array,
    rows: ConstraintRows,
) -> jax.Array:
    """The step length along the direction: the root of the cost's derivative, which is continuous, piecewise linear and
    rising.

    slope: the derivative at length 0, negative; quadratic: its smooth part's value at 0 and growth; residual and
    change: [R] of the rows. The root is bracketed twice among trial lengths that are evaluated side by side, and
    interpolated in the last bracket.
    """
    value, growth = quadratic

    def derivative(lengths):
        moved = residual + lengths[:, None] * change
        return value + lengths * growth + times(jax.vmap(rows.weights)(moved) * moved, change)

    def bracket(lengths, values):
        """The neighbouring trial lengths between which the derivative turns positive, and its values there."""
        last = jnp.clip((jnp.cumprod(values < 0)).sum() - 1, 0, len(lengths) - 2)
        pick = jax.nn.one_hot(last, len(lengths) - 1)
        return tuple((pick * part).sum() for part in (lengths[:-1], lengths[1:], values[:-1], values[1:]))

    lengths = jnp.asarray(TRIAL_LENGTHS)
    low, high, first, second = bracket(lengths, jnp.concatenate([slope[None], derivative(lengths[1:])]))
    lengths = low + (high - low) * FINER
    low, high, first, second = bracket(lengths, jnp.concatenate([first[None], derivative(lengths[1:-1]), second[None]]))
    return low + (high - low) * jnp.clip(-first / jnp.maximum(second - first, 1e-12), 0.0, 1.0)
