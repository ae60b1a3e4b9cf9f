"""MuJoCo's constraint problem for one small robot, solved by Newton's method with a fixed number of steps.

The problem is MuJoCo's own (its documentation, Computation: primal problem, pyramidal cones): find the acceleration a
that minimises

    1/2 (a - a_free)' M (a - a_free)  +  1/2 sum over rows of D (J a - reference)^2, where a row counts if it is an
    equality or J a < reference.

`mjx.solve` finds the same minimum. This solver is for 7 to 18 degrees of freedom and about 100 rows, without a
convergence test, so that a batch runs in lock-step. On an NVIDIA GPU the same steps run in one kernel: a warp for each
robot, whose rows stay on the chip for all Newton steps. In XLA's own operations every product of a step goes through
memory, and the factorisation of a 15 x 15 matrix is either a library call for each robot or thousands of operations to
compile.

The kernel is written in Pallas for Triton, so sizes are powers of 2: extra degrees of freedom stay at rest, extra rows
have no stiffness. `solve_anywhere` is what it is tested against.
"""

import functools

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

SMALLEST = 16
"""Triton multiplies matrices of at least this size."""
ROWS_AT_ONCE = 32
"""Constraint rows whose part of the Jacobian is in registers at one time."""
PARTS = 8
"""Parts that the bracket of the best length along a direction is divided into once more."""
PRECISION = jax.lax.DotAlgorithmPreset.TF32_TF32_F32_X3
"""Of J' W J: factors in three parts on the tensor cores, about float32. The curvature decides how straight a step goes,
not where the minimum is."""
TRIAL_LENGTHS = np.array([0.0, 0.03, 0.1, 0.25, 0.5, 0.75, 0.95, 1.05, 1.5, 3.0], np.float32)
FINER = np.linspace(0.0, 1.0, PARTS + 1, dtype=np.float32)
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
    problem = (inertia, jnp.asarray(damping, jnp.float32), force, rows.jacobian, rows.stiffness, rows.reference, start)
    return jax.lax.platform_dependent(
        *problem,
        cuda=functools.partial(solve_on_gpu, lengths=TRIAL_LENGTHS, equalities=EQUALITIES, steps=steps),
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
        curvature = times(rows.jacobian * weight[None], rows.jacobian.T)
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
        moved = residual[None] + lengths[:, None] * change[None]
        return value + lengths * growth + times(jax.vmap(rows.weights)(moved) * moved, change)

    def bracket(lengths, values):
        """The neighbouring trial lengths between which the derivative turns positive, and its values there."""
        last = jnp.clip((jnp.cumprod(values < 0)).sum() - 1, 0, len(lengths) - 2)
        pick = jax.nn.one_hot(last, len(lengths) - 1, dtype=jnp.float32)
        return tuple((pick * part).sum() for part in (lengths[:-1], lengths[1:], values[:-1], values[1:]))

    lengths = jnp.asarray(TRIAL_LENGTHS)
    low, high, first, second = bracket(lengths, jnp.concatenate([slope[None], derivative(lengths[1:])]))
    lengths = low + (high - low) * FINER
    low, high, first, second = bracket(lengths, jnp.concatenate([first[None], derivative(lengths[1:-1]), second[None]]))
    return low + (high - low) * jnp.clip(-first / jnp.maximum(second - first, 1e-12), 0.0, 1.0)


def solve_on_gpu(
    inertia,
    damping,
    force,
    jacobian,
    stiffness,
    reference,
    start,
    lengths,
    equalities: int,
    steps: int,
    interpret: bool = False,
):
    """The solution, as `solve` returns it. jacobian [nv, R]; lengths [L] to try along a direction, the first 0;
    the first `equalities` rows count always.

    interpret: run as plain operations, to test it.
    """
    shape = jax.ShapeDtypeStruct(force.shape, jnp.float32)
    precision = jax.lax.Precision.HIGHEST if interpret else PRECISION
    kernel = functools.partial(newton, equalities=equalities, steps=steps, precision=precision)
    return pl.pallas_call(
        kernel,
        out_shape=(shape, shape),
        interpret=interpret,
        compiler_params=triton.CompilerParams(num_warps=1),
        name="newton",
    )(inertia, damping, force, jacobian, stiffness, reference, start, lengths)


def newton(
    inertia_ref,
    damping_ref,
    force_ref,
    jacobian_ref,
    stiffness_ref,
    reference_ref,
    start_ref,
    lengths_ref,
    acceleration_ref,
    smoothed_ref,
    *,
    equalities: int,
    steps: int,
    precision,
):
    """The Newton steps of one robot."""
    nv, num_rows = jacobian_ref.shape
    size = max(SMALLEST, pl.next_power_of_2(nv + 1))  # A column more than the matrix has, for the right-hand side.
    place = count_along((size,), 0)
    rows, columns = (count_along((size, size), axis) for axis in (0, 1))
    inertia = triton.load(inertia_ref.at[rows, columns], mask=(rows < nv) & (columns < nv), other=0.0)
    force, start, damping = (
        triton.load(ref.at[place], mask=place < nv, other=0.0) for ref in (force_ref, start_ref, damping_ref)
    )

    firsts = range(0, num_rows, ROWS_AT_ONCE)
    widths = [max(SMALLEST, pl.next_power_of_2(min(ROWS_AT_ONCE, num_rows - first))) for first in firsts]
    numbers = [first + count_along((width,), 0) for first, width in zip(firsts, widths, strict=True)]
    stiffness, reference = (
        [triton.load(ref.at[row], mask=row < num_rows, other=0.0) for row in numbers]
        for ref in (stiffness_ref, reference_ref)
    )
    always = [row < equalities for row in numbers]

    def jacobian(row):
        """The Jacobian's part for these rows: from the first cache, anew each time."""
        row, dof = (jnp.broadcast_to(index, (size, row.shape[0])) for index in (row[None], place[:, None]))
        return triton.load(jacobian_ref.at[dof, row], mask=(dof < nv) & (row < num_rows), other=0.0)

    def along(vector):
        """J vector, by parts."""
        return [(jacobian(row) * vector[:, None]).sum(0) for row in numbers]

    def weights(residual):
        return [
            jnp.where(must | (part < 0), rigid, 0.0)
            for must, part, rigid in zip(always, residual, stiffness, strict=True)
        ]

    def newton_step(_, carried):
        acceleration, residual = carried
        smooth = (inertia * acceleration[None]).sum(1) - force
        slope, curvature = smooth, inertia
        for row, weight, part in zip(numbers, weights(residual), residual, strict=True):
            factors = jacobian(row)
            weighted = factors * weight[None]
            slope = slope + (weighted * part[None]).sum(1)
            curvature = curvature + triton.dot(weighted, factors, trans_b=True, precision=precision)
        direction = -gauss_jordan_solve(curvature, slope, nv)
        change = along(direction)
        value, growth = (direction * smooth).sum(), (direction * (inertia * direction[None]).sum(1)).sum()

        along_change = [rigid * more for rigid, more in zip(stiffness, change, strict=True)]

        def derivatives(lengths):
            """The cost's derivative [L] at these lengths [L] along the direction."""
            values = value + lengths * growth
            for part, more, pull, must in zip(residual, change, along_change, always, strict=True):
                moved = part[None] + lengths[:, None] * more[None]
                values = values + jnp.where(must[None] | (moved < 0), moved * pull[None], 0.0).sum(1)
            return values

        low, high, _, _ = bracket(trials, derivatives(trials), lengths_ref.shape[0])
        finer = low + (high - low) * count_along(trials.shape, 0).astype(jnp.float32) / PARTS
        low, high, first, second = bracket(finer, derivatives(finer), PARTS + 1)
        length = low + (high - low) * jnp.clip(-first / jnp.maximum(second - first, 1e-12), 0.0, 1.0)
        return acceleration + length * direction, [
            part + length * more for part, more in zip(residual, change, strict=True)
        ]

    count = count_along((max(pl.next_power_of_2(lengths_ref.shape[0]), pl.next_power_of_2(PARTS + 1)),), 0)
    trials = triton.load(lengths_ref.at[count], mask=count < lengths_ref.shape[0], other=0.0)
    residual = [part - aim for part, aim in zip(along(start), reference, strict=True)]
    acceleration, residual = jax.lax.fori_loop(0, steps, newton_step, (start, residual))
    total = force
    for row, weight, part in zip(numbers, weights(residual), residual, strict=True):
        total = total - (jacobian(row) * (weight * part)[None]).sum(1)
    damped = inertia + jnp.where(rows == columns, damping[None], 0.0)
    triton.store(acceleration_ref.at[place], acceleration, mask=place < nv)
    triton.store(smoothed_ref.at[place], gauss_jordan_solve(damped, total, nv), mask=place < nv)


def count_along(shape: tuple[int, ...], axis: int) -> jax.Array:
    """0, 1, 2, ... along an axis, int32 of this shape."""
    return jax.lax.broadcasted_iota(jnp.int32, shape, axis)


def bracket(lengths: jax.Array, values: jax.Array, count: int) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """The neighbouring lengths, of the first `count`, between which the values turn positive, and the values there."""
    place = count_along(lengths.shape, 0)
    last = jnp.clip(jnp.where((values < 0) & (place < count), 1, 0).sum() - 1, 0, count - 2)
    return tuple(jnp.where(place == last + after, of, 0.0).sum() for of in (lengths, values) for after in (0, 1))


def gauss_jordan_solve(matrix: jax.Array, vector: jax.Array, size: int) -> jax.Array:
    """The solution x [n] of `matrix x = vector` for the leading part of this size, n > size, by Gauss-Jordan
    elimination without pivoting."""
    rows, columns = (count_along(matrix.shape, axis) for axis in (0, 1))
    place = count_along(vector.shape, 0)

    def eliminate(step, matrix):
        pivot_row = jnp.where(rows == step, matrix, 0.0).sum(0)
        column = jnp.where(columns == step, matrix, 0.0).sum(1)
        pivot = jnp.where(place == step, pivot_row, 0.0).sum()
        factor = jnp.where(place == step, pivot - 1.0, column) / pivot
        return matrix - factor[:, None] * pivot_row[None]

    solved = jax.lax.fori_loop(0, size, eliminate, jnp.where(columns == size, vector[:, None], matrix))
    return jnp.where(columns == size, solved, 0.0).sum(1)
