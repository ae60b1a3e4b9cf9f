"""Angles, as environments and networks need them: closed over a full turn. And orientations of an object: the angle
between two, and which of many are the same.

The object-manipulation task (paper, section V-A.3) is solved by orientation, not by the arm's joints, and different
joints may give one orientation.
"""

import jax
import jax.numpy as jnp
import numpy as np

TOLERANCE = 1e-3
"""Of orientations that are one, in radians."""


def wrapped(angles: jax.Array) -> jax.Array:
    """Angles [...] in [-pi, pi), radians."""
    return (angles + jnp.pi) % (2 * jnp.pi) - jnp.pi


def on_circles(angles: jax.Array) -> jax.Array:
    """Cosines and sines of angles [..., J], for networks: [..., 2 J]."""
    return jnp.concatenate([jnp.cos(angles), jnp.sin(angles)], axis=-1)


def quaternions(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternions [..., 4] (w first, sign free) of rotation matrices [..., 3, 3]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation.astype(np.float64)).as_quat(scalar_first=True).astype(np.float32)


def rotation_matrices(quaternion: jax.Array) -> jax.Array:
    """Rotation matrices, float32 [..., 9] row by row, of unit quaternions [..., 4] (w first). The distance of two grows
    with the angle between them."""
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    return jnp.stack(
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
            2 * (x * y + w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z - w * x),
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        ],
        axis=-1,
    )


def geodesic(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle of the turn from one orientation to another: [..., 3, 3] and [..., 3, 3] to float64 radians [...], 0 to pi;
    the two broadcast."""
    turn = np.swapaxes(np.asarray(first, np.float64), -1, -2) @ np.asarray(second, np.float64)
    twice_sine = np.stack(
        [turn[..., 2, 1] - turn[..., 1, 2], turn[..., 0, 2] - turn[..., 2, 0], turn[..., 1, 0] - turn[..., 0, 1]], -1
    )
    # The arc cosine of the trace alone would lose half of the digits near 0 and pi.
    return np.arctan2(np.linalg.norm(twice_sine, axis=-1), np.trace(turn, axis1=-2, axis2=-1) - 1)


def orientation_classes(rotation: np.ndarray) -> np.ndarray:
    """Class of each orientation: [K, 3, 3] to int32 [K], numbered by first appearance.

    Orientations less than half of `TOLERANCE` apart always share a class, and so do chains of them; more than
    1.5 of it apart, they share one only by a chain. SciPy is imported only now: it takes a quarter of a second.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree
    from scipy.spatial.transform import Rotation

    quaternion = Rotation.from_matrix(np.asarray(rotation, np.float64)).as_quat()
    reach = TOLERANCE / 2  # an angle is twice the distance of its quaternions
    # One of each crowd stands for all: an arm that stood still for a thousand frames would otherwise have half a
    # million pairs. What is in one cell is at most reach / 4 apart (the diagonal of four sides); across borders the
    # tree decides.
    _, representative, member = np.unique(
        np.round(quaternion / (reach / 8)).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    points = quaternion[representative]
    # q and -q are one orientation
    pairs = KDTree(np.concatenate([points, -points])).query_pairs(reach, output_type="ndarray") % len(points)
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    _, component = connected_components(graph, directed=False)
    _, first, group = np.unique(component[member.reshape(-1)], return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[group].astype(np.int32)
