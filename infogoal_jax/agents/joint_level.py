"""The low level of HRAC for an arm with discrete joint moves: a frozen DQN that drives the joints to a target state."""

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents import dqn
from infogoal_jax.angles import on_circles, wrapped


@flax.struct.dataclass
class JointLevel:
    """A policy that reaches target states of joints. A pytree."""

    params: dict
    hidden: tuple[int, ...] = flax.struct.field(pytree_node=False)
    num_moves: int = flax.struct.field(pytree_node=False)

    def act(self, observation, target: jax.Array) -> jax.Array:
        """The move int32 [...] from the joints of the observation towards the target state [..., J], in radians."""
        values = values_of(self.params, self.hidden, self.num_moves, observation.joints, target)
        return dqn.greedy(values, jnp.ones(values.shape, bool)).astype(jnp.int32)


def values_of(params: dict, hidden: tuple[int, ...], num_moves: int, joints: jax.Array, target: jax.Array) -> jax.Array:
    """Q(joints [..., J], target [..., J], .) of all moves, [..., A]. Angles in radians."""
    return networks.MLP(hidden, num_moves).apply(params, network_input(joints, target))


def network_input(joints: jax.Array, target: jax.Array) -> jax.Array:
    """Input of the network, [..., 4 J]: sines and cosines of the joints, and the signed and absolute differences to the
    target in half turns."""
    left = wrapped(target - joints) / jnp.pi
    return jnp.concatenate([on_circles(joints), left, jnp.abs(left)], axis=-1)
