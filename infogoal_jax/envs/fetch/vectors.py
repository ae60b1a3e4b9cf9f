"""Vectors, rotations and quaternions by their components, each an array over bodies, contacts or points.

Every operation is one on whole arrays, without an axis of length 3 or 4: XLA compiles and runs these several times
faster than products and sums along so short an axis, on a CPU as on a GPU, and nothing is rounded to TF32.
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.shapes import aligned


def multiplied(first, second):
    """The product of two arrays, one of which may lack leading axes of the other."""
    first, second = aligned(first, second)
    return first * second


@flax.struct.dataclass
class Vector:
    """Vectors in space by their components, arrays of one shape."""

    x: jax.Array
    y: jax.Array
    z: jax.Array

    @classmethod
    def of(cls, array) -> "Vector":
        """The vectors in an array [..., 3]."""
        return cls(array[..., 0], array[..., 1], array[..., 2])

    @property
    def array(self) -> jax.Array:
        """The vectors as an array [..., 3]."""
        return jnp.stack([self.x, self.y, self.z], axis=-1)

    def __add__(self, other: "Vector") -> "Vector":
        return Vector(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: "Vector") -> "Vector":
        return Vector(self.x - other.x, self.y - other.y, self.z - other.z)

    def __neg__(self) -> "Vector":
        return Vector(-self.x, -self.y, -self.z)

    def __mul__(self, factor) -> "Vector":
        return Vector(*(multiplied(part, factor) for part in (self.x, self.y, self.z)))

    def __getitem__(self, index) -> "Vector":
        return Vector(*(entries(part, index) for part in (self.x, self.y, self.z)))

    def dot(self, other: "Vector") -> jax.Array:
        """Inner products."""
        return multiplied(self.x, other.x) + multiplied(self.y, other.y) + multiplied(self.z, other.z)

    def cross(self, other: "Vector") -> "Vector":
        """Vector products."""
        return Vector(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    def norm(self) -> jax.Array:
        """Lengths."""
        return jnp.sqrt(self.dot(self))


@flax.struct.dataclass
class Rotation:
    """Rotations by the columns of their matrices, the axes of a body."""

    x: Vector
    y: Vector
    z: Vector

    @classmethod
    def of(cls, array) -> "Rotation":
        """The rotations in an array of matrices [..., 3, 3]."""
        return cls(*(Vector.of(array[..., column]) for column in range(3)))

    @property
    def array(self) -> jax.Array:
        """The rotations as matrices [..., 3, 3]."""
        return jnp.stack([self.x.array, self.y.array, self.z.array], axis=-1)

    def __getitem__(self, index) -> "Rotation":
        return Rotation(self.x[index], self.y[index], self.z[index])

    def __matmul__(self, vector: Vector) -> Vector:
        """Vectors of the body's axes as vectors of the world."""
        return self.x * vector.x + self.y * vector.y + self.z * vector.z

    def inverse(self, vector: Vector) -> Vector:
        """Vectors of the world as vectors of the body's axes."""
        return Vector(self.x.dot(vector), self.y.dot(vector), self.z.dot(vector))


@flax.struct.dataclass
class Quaternion:
    """Quaternions: scalar w and vector."""

    w: jax.Array
    vector: Vector

    @classmethod
    def of(cls, array) -> "Quaternion":
        """The quaternions in an array [..., 4] (w, x, y, z)."""
        return cls(array[..., 0], Vector.of(array[..., 1:]))

    @property
    def array(self) -> jax.Array:
        """The quaternions as an array [..., 4]."""
        return jnp.stack([self.w, self.vector.x, self.vector.y, self.vector.z], axis=-1)

    def __getitem__(self, index) -> "Quaternion":
        return Quaternion(entries(self.w, index), self.vector[index])

    def __mul__(self, other: "Quaternion") -> "Quaternion":
        """Hamilton's product."""
        straight = other.vector * self.w + self.vector * other.w
        return Quaternion(self.w * other.w - self.vector.dot(other.vector), straight + self.vector.cross(other.vector))

    def conjugate(self) -> "Quaternion":
        """The quaternions of the inverse rotations."""
        return Quaternion(self.w, -self.vector)

    def rotation(self) -> Rotation:
        """The rotations of quaternions of length 1."""
        double = self.vector * 2.0
        x, y, z = self.vector.x, self.vector.y, self.vector.z
        xx, xy, xz, yy, yz, zz = x * double.x, x * double.y, x * double.z, y * double.y, y * double.z, z * double.z
        wx, wy, wz = self.w * double.x, self.w * double.y, self.w * double.z
        return Rotation(
            Vector(1 - yy - zz, xy + wz, xz - wy),
            Vector(xy - wz, 1 - xx - zz, yz + wx),
            Vector(xz + wy, yz - wx, 1 - xx - yy),
        )


def entries(array: jax.Array, index) -> jax.Array:
    """The entries of an array at an index, a slice or constant indices [m]; none is negative, so that the program need
    not ask."""
    if isinstance(index, np.ndarray) and isinstance(array, jax.Array):
        return array.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)
    return array[index]


def joined(*parts):
    """Concatenate vectors, rotations, quaternions or arrays [n, ...]."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def vectors(array: np.ndarray) -> Vector:
    """Constant vectors [n, 3]."""
    return Vector.of(np.float32(array))


once = jax.lax.optimization_barrier
"""What goes through here is computed once. XLA's CPU fusions would compute it anew for every number that it is needed
for."""
