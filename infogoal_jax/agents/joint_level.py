"""The low level of HRAC for an arm that is moved by single joint steps: a DQN over the moves that drives the joints to a target state, frozen."""

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents import dqn
from infogoal_jax.angles import on_circles, wrapped


@flax.struct.dataclass
class JointLevel:
    """A policy over target states of joints: act(observation, target [..., J]) -> move int32 [...]. A pytree of its parameters."""

    params: dict
    hidden: tuple[int, ...] = flax.struct.field(pytree_node=False)
    num_moves: int = flax.struct.field(pytree_node=False)

    def act(self, observation, target: jax.Array) -> jax.Array:
        """The move that leads from these joints towards the target state."""
        values = values_of(self.params, self.hidden, self.num_moves, observation.joints, target)
        return dqn.greedy(values, jnp.ones(values.shape, bool)).astype(jnp.int32)


def values_of(params: dict, hidden: tuple[int, ...], num_moves: int, joints: jax.Array, target: jax.Array) -> jax.Array:
    """Q(joints [..., J], target [..., J], .) of all moves, [..., A]."""
    return networks.MLP(hidden, num_moves).apply(params, network_input(joints, target))


def network_input(joints: jax.Array, target: jax.Array) -> jax.Array:
    """What the network sees, [..., 4 J]: the joints on circles, how far each is from its target in half turns, and how far it is at all."""
    left = wrapped(target - joints) / jnp.pi
    return jnp.concatenate([on_circles(joints), left, jnp.abs(left)], axis=-1)
