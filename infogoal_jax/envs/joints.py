"""Target states of an arm with discrete joint moves: the angles of its joints."""

import dataclasses

import jax
import jax.numpy as jnp

from infogoal_jax.angles import on_circles, wrapped
from infogoal_jax.envs.cells import Cells


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
