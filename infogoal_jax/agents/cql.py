"""Conservative Q-learning for discrete actions (Kumar et al. 2020): DQN on recorded transitions with a penalty on
actions that were not taken."""

import dataclasses
from typing import Annotated

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax.agents import dqn, value_heads
from infogoal_jax.agents.agent import Agent
from infogoal_jax.hyperparameters import Number, Search


@dataclasses.dataclass(frozen=True)
class CQLConfig(dqn.DQNConfig):
    """Sizes and switches of CQL: those of DQN."""

    num_steps: int = 1
    """Steps of the n-step return. More than 1 would learn the value of the recorded behaviour."""


@flax.struct.dataclass
class CQLHyperparameters:
    """Float hyperparameters of CQL."""

    conservative_weight: Annotated[float, Number("[0, inf)", Search(0.003, 3.0, "log"))] = 1.0
    """Weight of the penalty on the values of actions that were not recorded."""


def conservative_gap(values: jax.Array, action_mask: jax.Array, actions: jax.Array) -> jax.Array:
    """log sum_a exp Q(s, g, a) - Q(s, g, a of the data) over the legal actions, float32 [B], at least 0 (CQL(H), Eq.
    4).

    values: float32 [B, A]; action_mask: bool [B, A]; actions: int32 [B].
    """
    return jax.nn.logsumexp(jnp.where(action_mask, values, -jnp.inf), axis=-1) - value_heads.of_actions(values, actions)


def make(config: CQLConfig, env) -> Agent:
    def regulariser(values, batch, hyper):
        gap = conservative_gap(values, batch.action_mask, batch.action).mean()
        return hyper.conservative_weight * gap, {"conservative_gap": gap}

    return dqn.value_agent(config, env, regulariser)
