"""Rows of tables, and what is added up by row."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax.rows import add_rows, by_product, by_scatter, take_rows

TABLE = jnp.asarray(np.random.default_rng(0).normal(size=(5, 2, 3)), jnp.float32)
INDICES = jnp.array([[0, 4, 4], [-1, 2, 4]], jnp.int32)


def test_rows_are_what_indexing_gives_and_so_is_their_gradient():
    """To the bit on a CPU; also for seeds that each have a table, or indices, of their own."""
    weights = jnp.sin(jnp.arange(36.0)).reshape(2, 3, 2, 3)

    def of(take):
        value_and_gradient = jax.value_and_grad(lambda table, indices: (weights * take(table, indices)).sum())
        each = jax.vmap(value_and_gradient)(jnp.stack([TABLE, 2 * TABLE]), jnp.stack([INDICES, INDICES[::-1]]))
        return value_and_gradient(TABLE, INDICES), each

    jax.tree.map(np.testing.assert_array_equal, of(take_rows), of(lambda table, indices: table[indices]))


@pytest.mark.parametrize("add", [by_scatter, by_product])
def test_values_of_a_row_are_added_up(add):
    """The product, which a GPU computes, as well; a negative index counts from the end."""
    values = jnp.array([[1.0, 10.0], [2.0, 20.0], [4.0, 40.0], [8.0, 80.0]])
    sums = add(3, values, jnp.array([0, 2, 0, -1], jnp.int32))
    np.testing.assert_array_equal(sums, [[5.0, 50.0], [0.0, 0.0], [10.0, 100.0]])


def test_a_cpu_adds_in_the_order_of_the_indices():
    values = jnp.array([[1e8], [1.0], [-1e8]])
    assert add_rows(values, jnp.zeros(3, jnp.int32), 1) == jnp.float32(1e8) + jnp.float32(1.0) - jnp.float32(1e8)
