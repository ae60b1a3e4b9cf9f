"""The low level of HRAC: an actor that drives the robot to a target state (paper, Sec. V-C), trained beforehand and frozen."""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax.agents import td3

DISTANCE_SCALE = 0.1
"""Differences between target and present state enter the networks in units of this, in m."""
SMALLEST_STD = 0.01
"""Observations are divided by at least this: some components hardly move."""
LARGEST_INPUT = 5.0
"""Normalised observations are clipped here, as in hindsight experience replay's own code."""


@dataclasses.dataclass(frozen=True)
class LowLevelConfig:
    """Sizes of the networks."""

    hidden: tuple[int, ...] = (256, 256, 256)
    """Widths of the layers of actor and critics."""


@flax.struct.dataclass
class LowLevel:
    """A frozen policy over target states: act(observation [..., D], target [..., S]) -> action [..., 4]. A pytree of its parameters.

    actor: parameters of the network; mean, std: float32 [D] that observations are normalised with.
    """

    actor: dict
    mean: jax.Array
    std: jax.Array
    hidden: tuple[int, ...] = flax.struct.field(pytree_node=False)
    action_size: int = flax.struct.field(pytree_node=False)

    def act(self, observation: jax.Array, target: jax.Array) -> jax.Array:
        """The action [..., A] in [-1, 1] that leads from this observation towards the target state."""
        return td3.Actor(self.hidden, self.action_size).apply(self.actor, network_input(observation, target, self.mean, self.std))


def network_input(observation: jax.Array, target: jax.Array, mean: jax.Array, std: jax.Array) -> jax.Array:
    """What actor and critics see, [..., D + S]: the observation normalised, and how far each component of the target state is.

    A target state of S numbers is about the first S numbers of the observation.
    """
    normal = jnp.clip((observation - mean) / std, -LARGEST_INPUT, LARGEST_INPUT)
    return jnp.concatenate([normal, (target - observation[..., : target.shape[-1]]) / DISTANCE_SCALE], axis=-1)
