"""Rows that are looked up in a table, and values that are added up by row, to the same bits every time.

A CPU adds what a scatter brings to a row in the order of its indices. A GPU adds it in the order in which its threads
come, and a sum of floats depends on the order. There a product with the indices, one-hot, takes its place.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _rows(table: jax.Array, indices: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Rows of a table of this shape."""
    return table[indices]


def _rows_forwards(table: jax.Array, indices: jax.Array, shape: tuple[int, ...]) -> tuple[jax.Array, jax.Array]:
    return table[indices], indices


def _rows_backwards(shape: tuple[int, ...], indices: jax.Array, gradient: jax.Array) -> tuple[jax.Array, np.ndarray]:
    flat = gradient.reshape(indices.size, math.prod(shape[1:]))
    return add_rows(flat, indices.reshape(-1), shape[0]).reshape(shape), np.zeros(indices.shape, jax.dtypes.float0)


_rows.defvjp(_rows_forwards, _rows_backwards)


def take_rows(table: jax.Array, indices: jax.Array) -> jax.Array:
    """`table[indices]`: rows of the table [M, ...] at these indices, int32 [...], from -M to M - 1. `add_rows` makes
    the gradient for the table."""
    return _rows(table, indices, table.shape)


def add_rows(values: jax.Array, indices: jax.Array, num_rows: int) -> jax.Array:
    """The sum of the values [N, D] of each index, int32 [N], to [num_rows, D]."""
    return jax.lax.platform_dependent(
        values, indices, cuda=functools.partial(by_product, num_rows), default=functools.partial(by_scatter, num_rows)
    )


def by_scatter(num_rows: int, values: jax.Array, indices: jax.Array) -> jax.Array:
    """The sums of `add_rows`, in the order of the indices on a CPU."""
    return jnp.zeros((num_rows, values.shape[1]), values.dtype).at[indices].add(values)


def by_product(num_rows: int, values: jax.Array, indices: jax.Array) -> jax.Array:
    """The sums of `add_rows`, in an order that does not change on a GPU."""
    chosen = jax.nn.one_hot(jnp.where(indices < 0, indices + num_rows, indices), num_rows, dtype=values.dtype)
    return jnp.einsum("nm,nd->md", chosen, values, precision=jax.lax.Precision.HIGHEST)
