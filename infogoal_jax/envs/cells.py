"""A grid of cells over positions or angles, by which it is remembered which target states were seen close together."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np


@dataclasses.dataclass(frozen=True)
class Cells:
    """A grid of cells. low: corner [D]; side: of a cell; shape: cells along each axis; periodic: whether it closes in on itself, as angles do."""

    low: np.ndarray
    side: float
    shape: tuple[int, ...]
    periodic: bool = False

    @classmethod
    def over(cls, bounds: np.ndarray, side: float) -> "Cells":
        """The grid over the space between these corners [2, D], and at least one cell around it.

        Its cells are centred on the corner of that space: what rests there lies in the middle of a cell, not where the last bit decides between two.
        """
        counts = np.round((bounds[1] - bounds[0]) / side).astype(int) + 3
        return cls(bounds[0] - 1.5 * side, side, tuple(int(count) for count in counts))

    @classmethod
    def over_angles(cls, axes: int, side: float) -> "Cells":
        """The grid over full turns about so many axes, of cells of about this side (radians)."""
        count = max(1, round(2 * np.pi / side))
        return cls(np.full(axes, -np.pi / count), 2 * np.pi / count, (count,) * axes, periodic=True)

    @property
    def count(self) -> int:
        """Number of cells."""
        return int(np.prod(self.shape))

    def of(self, position: jax.Array) -> jax.Array:
        """The cell of each position [..., D], int32 [...]; -1 outside of the grid."""
        place = jnp.floor((position - self.low) / self.side).astype(jnp.int32)
        shape = jnp.array(self.shape)
        place = place % shape if self.periodic else place
        inside = ((place >= 0) & (place < shape)).all(-1)
        flat = jnp.zeros(place.shape[:-1], jnp.int32)
        for axis, count in enumerate(self.shape):
            flat = flat * count + place[..., axis]
        return jnp.where(inside, flat, -1)
