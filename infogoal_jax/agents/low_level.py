"""The low level of HRAC: a frozen actor, trained beforehand, that drives the robot to a target state (paper, Sec.
V-C)."""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax.agents import td3

DISTANCE_SCALE = 0.1
"""Unit, in m, of the differences between target and present state that the networks see."""
SMALLEST_STD = 0.01
"""Least standard deviation that observations are divided by: some components hardly move."""
LARGEST_INPUT = 5.0
"""Normalised observations are clipped to plus and minus this, as in HER's own code."""


@dataclasses.dataclass(frozen=True)
class LowLevelConfig:
    """Sizes of the networks."""

    hidden: tuple[int, ...] = (256, 256, 256)
    """Widths of the layers of actor and critics."""


@flax.struct.dataclass
class LowLevel:
    """A frozen policy that reaches target states. A pytree."""

    actor: dict
    """Parameters of the network."""
    mean: jax.Array
    """float32 [D], subtracted from observations."""
    std: jax.Array
    """float32 [D] that observations are divided by."""
    hidden: tuple[int, ...] = flax.struct.field(pytree_node=False)
    action_size: int = flax.struct.field(pytree_node=False)

    def act(self, observation: jax.Array, target: jax.Array) -> jax.Array:
        """The action [..., A] in [-1, 1] from this observation [..., D] towards the target state [..., S]."""
        return td3.Actor(self.hidden, self.action_size).apply(
            self.actor, network_input(observation, target, self.mean, self.std)
        )


def network_input(observation: jax.Array, target: jax.Array, mean: jax.Array, std: jax.Array) -> jax.Array:
    """Input of actor and critics, [..., D + S]: the normalised observation and the difference to the target state.

    The S numbers of a target state are the first S numbers of the observation.
    """
    normal = jnp.clip((observation - mean) / std, -LARGEST_INPUT, LARGEST_INPUT)
    return jnp.concatenate([normal, (target - observation[..., : target.shape[-1]]) / DISTANCE_SCALE], axis=-1)
