"""The low levels of HRAC, trained beforehand and frozen: an actor that drives the robot to a target state (paper, Sec.
V-C), and a DQN that drives an arm there by discrete moves of its joints."""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents import dqn, td3
from infogoal_jax.angles import on_circles, wrapped

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


@flax.struct.dataclass
class JointLevel:
    """A policy that reaches target states of joints. A pytree."""

    params: dict
    hidden: tuple[int, ...] = flax.struct.field(pytree_node=False)
    num_moves: int = flax.struct.field(pytree_node=False)

    def act(self, observation, target: jax.Array) -> jax.Array:
        """The move int32 [...] from the joints of the observation towards the target state [..., J], in radians."""
        values = joint_values(self.params, self.hidden, self.num_moves, observation.joints, target)
        return dqn.greedy(values, jnp.ones(values.shape, bool)).astype(jnp.int32)


def joint_values(
    params: dict, hidden: tuple[int, ...], num_moves: int, joints: jax.Array, target: jax.Array
) -> jax.Array:
    """Q(joints [..., J], target [..., J], .) of all moves, [..., A]. Angles in radians."""
    return networks.MLP(hidden, num_moves).apply(params, joint_input(joints, target))


def joint_input(joints: jax.Array, target: jax.Array) -> jax.Array:
    """Input of the network, [..., 4 J]: sines and cosines of the joints, and the signed and absolute differences to the
    target in half turns."""
    left = wrapped(target - joints) / jnp.pi
    return jnp.concatenate([on_circles(joints), left, jnp.abs(left)], axis=-1)
