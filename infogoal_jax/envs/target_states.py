"""Target states of an arm with discrete joint moves, the angles of its joints; and grids of cells over target states
(positions or angles), over which HRAC's adjacency matrix is made."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.angles import on_circles, wrapped


@dataclasses.dataclass(frozen=True)
class Cells:
    """A grid of cells, in m or radians."""

    low: np.ndarray
    """[D], lower corner."""
    side: float
    """Side of a cell."""
    shape: tuple[int, ...]
    """Number of cells along each axis."""
    periodic: bool = False
    """Whether the grid is periodic, as angles are."""

    @classmethod
    def over(cls, bounds: np.ndarray, side: float) -> "Cells":
        """Make a grid over the space between the corners [2, D], with at least one more cell on every side.

        A cell is centred on the lower corner, so that an object at rest there lies in the middle of a cell and not on
        the border of two.
        """
        counts = np.round((bounds[1] - bounds[0]) / side).astype(int) + 3
        return cls(bounds[0] - 1.5 * side, side, tuple(int(count) for count in counts))

    @classmethod
    def over_angles(cls, axes: int, side: float) -> "Cells":
        """Make a periodic grid over full turns about so many axes, with cells of about this side (radians)."""
        count = max(1, round(2 * np.pi / side))
        return cls(np.full(axes, -np.pi / count), 2 * np.pi / count, (count,) * axes, periodic=True)

    @property
    def count(self) -> int:
        """Number of cells."""
        return int(np.prod(self.shape))

    def of(self, position: jax.Array) -> jax.Array:
        """The cell of each position [..., D], int32 [...]; -1 outside the grid."""
        place = jnp.floor((position - self.low) / self.side).astype(jnp.int32)
        shape = jnp.array(self.shape)
        place = place % shape if self.periodic else place
        inside = ((place >= 0) & (place < shape)).all(-1)
        return jnp.where(inside, flattened(place, self.shape), -1)


def flattened(place: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """The numbers of cells, int32 [...], that stand at these places int32 [..., D] of a grid, counted along its last
    axis first."""
    steps = np.cumprod([1, *shape[:0:-1]])[::-1].astype(np.int32)
    return (place * steps).sum(-1)


@dataclasses.dataclass(frozen=True)
class JointSpace:
    """Target states of J = `size` joints, in radians."""

    size: int
    components = 1

    def of(self, observation) -> jax.Array:
        """The joints [..., J] of an observation."""
        return observation.joints

    def from_subgoal(self, observation, subgoal: jax.Array, scale: float) -> jax.Array:
        """The target state [..., J] of a subgoal [..., J] in [-1, 1]: each joint turns by up to `scale` radians."""
        return wrapped(observation.joints + scale * jnp.clip(subgoal, -1.0, 1.0))

    def parts(self, states: jax.Array) -> jax.Array:
        """The components of target states with adjacency matrices of their own: one, [1, ..., J]."""
        return states[None]

    def network_input(self, part: jax.Array, scale: float) -> jax.Array:
        """A component as a network sees it: sines and cosines, so that a full turn ends where it began."""
        return on_circles(part)

    def cells(self, side: float) -> Cells:
        """Cells of about this side (radians) over all angles."""
        return Cells.over_angles(self.size, side)
