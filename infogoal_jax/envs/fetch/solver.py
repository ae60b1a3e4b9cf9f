"""MuJoCo's constraint problem for one small robot, solved by Newton's method with a fixed number of steps.

The problem is MuJoCo's own (its documentation, Computation: primal problem, pyramidal cones): find the acceleration a that minimises

    1/2 (a - a_free)' M (a - a_free)  +  1/2 sum over rows of D (J a - reference)^2, where a row counts if it is an equality or J a < reference.

`mjx.solve` finds the same minimum. This solver is for 7 to 18 degrees of freedom and about 100 rows: no convergence test, so that a batch runs in
lock-step, and a Cholesky factorisation written out, because a library call for each of thousands of 15 x 15 matrices costs more than the arithmetic.
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

TRIAL_LENGTHS = np.array([0.0, 0.03, 0.1, 0.25, 0.5, 0.75, 0.95, 1.05, 1.5, 3.0], np.float32)
FINER = np.linspace(0.0, 1.0, 9, dtype=np.float32)


@flax.struct.dataclass
class Rows:
    """Constraint rows: jacobian [R, nv], stiffness D [R] (1 / regularisation), reference acceleration [R], equality bool [R]."""

    jacobian: jax.Array
    stiffness: jax.Array
    reference: jax.Array
    equality: jax.Array


def cholesky(matrix: jax.Array) -> list[list[jax.Array]]:
    """The lower factor of a positive definite [n, n] as rows of scalars, its diagonal inverted."""
    size = matrix.shape[0]
    lower = [[None] * size for _ in range(size)]
    for column in range(size):
        for row in range(column, size):
            value = matrix[row, column]
            for inner in range(column):
                value = value - lower[row][inner] * lower[column][inner]
            lower[row][column] = jax.lax.rsqrt(jnp.maximum(value, 1e-12)) if row == column else value * lower[column][column]
    return lower


def cholesky_solve(lower: list[list[jax.Array]], vector: jax.Array) -> jax.Array:
    """The solution [n] of `L L' x = vector` for a factor of `cholesky`."""
    size = len(lower)
    forward = []
    for row in range(size):
        value = vector[row]
        for inner in range(row):
            value = value - lower[row][inner] * forward[inner]
        forward.append(value * lower[row][row])
    solution = [None] * size
    for row in reversed(range(size)):
        value = forward[row]
        for inner in range(row + 1, size):
            value = value - lower[inner][row] * solution[inner]
        solution[row] = value * lower[row][row]
    return jnp.stack(solution)


def times(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Matrix [m, n] times vector [n] in full float32, also where a GPU would round its factors to TF32."""
    return jnp.matmul(matrix, vector, precision=jax.lax.Precision.HIGHEST)


def solve(inertia: jax.Array, force: jax.Array, rows: Rows, start: jax.Array, steps: int) -> tuple[jax.Array, jax.Array]:
    """The acceleration [nv] of least cost and the constraint force [nv] there.

    inertia: M [nv, nv]; force: all other generalised forces [nv], so that a_free = M^-1 force; start: acceleration to begin from [nv].
    """
    size = inertia.shape[0]

    def weights(residual):
        return jnp.where(rows.equality | (residual < 0), rows.stiffness, 0.0)

    def weighted_products(residual):
        """J' W J [nv, nv] and J' W residual [nv] over the rows that count, as one matrix product."""
        columns = jnp.concatenate([rows.jacobian, residual[:, None]], axis=1)
        products = jnp.matmul((rows.jacobian * weights(residual)[:, None]).T, columns, precision=jax.lax.Precision.HIGHEST)
        return products[:, :size], products[:, size]

    def newton_step(_, carried):
        acceleration, residual = carried
        curvature, pull = weighted_products(residual)
        smooth = times(inertia, acceleration) - force
        direction = -cholesky_solve(cholesky(inertia + curvature), smooth + pull)
        change = times(rows.jacobian, direction)
        quadratic = ((direction * smooth).sum(), (direction * times(inertia, direction)).sum())
        length = line_search((direction * (smooth + pull)).sum(), quadratic, residual, change, rows)
        return acceleration + length * direction, residual + length * change

    # A loop, not written out: the program compiles in half the time, and runs a quarter faster on a CPU.
    acceleration, residual = jax.lax.fori_loop(0, steps, newton_step, (start, times(rows.jacobian, start) - rows.reference))
    return acceleration, -times(rows.jacobian.T, weights(residual) * residual)


def line_search(slope: jax.Array, quadratic: tuple[jax.Array, jax.Array], residual: jax.Array, change: jax.Array, rows: Rows) -> jax.Array:
    """How far to go along the direction: the root of the cost's derivative, which is continuous, piecewise linear and rising.

    slope: the derivative at length 0, negative; quadratic: its smooth part's value at 0 and growth; residual and change: [R] of the rows. The root
    is bracketed twice among trial lengths that are evaluated side by side, and interpolated in the last bracket.
    """
    along_change = rows.stiffness * change
    value, growth = quadratic

    def derivative(lengths):
        along = residual + lengths[:, None] * change
        return value + lengths * growth + jnp.where(rows.equality | (along < 0), along_change * along, 0.0).sum(-1)

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
