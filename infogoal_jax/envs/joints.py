"""Target states of an arm that turns an object by single joint steps: the joints' angles (methods: "subgoal = 3 angles")."""

import dataclasses

import jax
import jax.numpy as jnp

from infogoal_jax.angles import on_circles, wrapped
from infogoal_jax.envs.cells import Cells


@dataclasses.dataclass(frozen=True)
class JointSpace:
    """Target states of J joints, all in radians."""

    size: int
    components = 1

    def of(self, observation) -> jax.Array:
        """The state [..., J] that an observation shows: its joints."""
        return observation.joints

    def from_subgoal(self, observation, subgoal: jax.Array, scale: float) -> jax.Array:
        """The target state [..., J] that a subgoal [..., J] in [-1, 1] means: every joint turned by up to `scale`."""
        return wrapped(observation.joints + scale * jnp.clip(subgoal, -1.0, 1.0))

    def parts(self, states: jax.Array) -> jax.Array:
        """The parts of target states that are remembered apart: the one there is, [1, ..., J]."""
        return states[None]

    def network_input(self, part: jax.Array, scale: float) -> jax.Array:
        """A part as a network sees it: on circles, so that a full turn ends where it began."""
        return on_circles(part)

    def cells(self, side: float) -> Cells:
        """Cells of about this side over all angles."""
        return Cells.over_angles(self.size, side)
