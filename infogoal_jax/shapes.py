"""Shapes written out: what NumPy would do without being asked."""

from typing import Any

import jax
import numpy as np


def aligned(*arrays: Any) -> list[Any]:
    """Arrays with as many axes as the one that has most: leading axes of 1 are put where they lack, as broadcasting
    does by itself unless `jax_numpy_rank_promotion` forbids it. Scalars stay as they are."""
    rank = max(np.ndim(array) for array in arrays)
    return [with_rank(array, rank) for array in arrays]


def with_rank(array: Any, rank: int) -> Any:
    """The array with leading axes of 1 up to this number of axes; a scalar as it is."""
    lacking = rank - np.ndim(array)
    if np.ndim(array) == 0 or lacking <= 0:
        return array
    if isinstance(array, np.ndarray):
        return array.reshape((1,) * lacking + array.shape)
    return jax.lax.broadcast_to_rank(array, rank)
