"""GCIQL, goal-conditioned implicit Q-learning (Kostrikov et al. 2022, arXiv 2110.06169), in OGBench's definition (Park
et al. 2025, arXiv 2410.20092): V(s, g) is an expectile of Q(s, a, g) over the recorded actions, and what follows a
transition is worth V. The actor climbs Q near the recorded actions (`ddpg_bc`), or is a weighted regression on them
(`awr`).

Shapes: B transitions, F features of a state, d numbers of a goal code, A numbers of an action.
"""

import dataclasses
from typing import Annotated

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents import offline, td3
from infogoal_jax.agents.agent import Agent, AgentBatch


@dataclasses.dataclass(frozen=True)
class GCIQLConfig(offline.OfflineConfig):
    """Sizes and switches of GCIQL."""

    actor_loss: offline.ActorLoss = "ddpg_bc"
    """`ddpg_bc`: values of the actor's own actions, and how likely it finds the recorded ones; `awr`: weighted
    regression on these."""


@flax.struct.dataclass
class GCIQLHyperparameters(offline.ExpectileHyperparameters):
    """Float hyperparameters of GCIQL."""

    alpha: Annotated[float, offline.ALPHA] = 0.3
    """Of `ddpg_bc`: weight of the recorded actions, 0.003 to 1 in OGBench; of `awr`: how much more a better action
    counts, 10 there."""


def make(config: GCIQLConfig, env) -> Agent:
    actor, value = offline.make_actor(config, env.action_size), networks.GeluMLP(config.hidden, 1, config.layer_norm)
    critic = networks.TwinGeluMLP(config.hidden, 1, config.layer_norm)

    def init(key, features, code):
        keys, inputs = jax.random.split(key, 3), td3.joined(features, code)
        action = jnp.zeros(env.action_size, jnp.float32)
        return {
            "actor": actor.init(keys[0], inputs),
            "value": value.init(keys[1], inputs),
            "critic": critic.init(keys[2], td3.joined(inputs, action)),
        }, ()

    def of_actions(params, inputs, action):
        """Q1 and Q2 [2, B]."""
        return critic.apply(params["critic"], td3.joined(inputs, action))[..., 0]

    def of_states(params, inputs):
        """V [B]."""
        return value.apply(params["value"], inputs)[..., 0]

    def loss(params, target_params, batch: AgentBatch, state, hyper, key):
        """Expectile regression of V on Q (IQL, Eq. 5), of Q on r + discount V(s', g) (Eq. 6), and the actor's."""
        inputs, frozen = td3.joined(batch.features, batch.code), jax.lax.stop_gradient(params)
        seen = td3.joined(batch.first_target_features, batch.first_target_code)
        difference = jax.lax.stop_gradient(of_actions(target_params, seen, batch.action).min(0)) - of_states(
            params, inputs
        )
        value_loss = offline.expectile_loss(difference, difference, hyper.expectile).mean()
        target = batch.reward + batch.discount * of_states(frozen, td3.joined(batch.next_features, batch.next_code))
        values = of_actions(params, inputs, batch.action)
        critic_loss = jnp.square(values - jax.lax.stop_gradient(target)).mean(-1).sum()
        first, _ = offline.actor_inputs(batch)
        mean = actor.apply(params["actor"], first)
        log_pi = offline.log_density(mean, batch.action)
        if config.actor_loss == "awr":
            advantage = of_actions(frozen, first, batch.action).min(0) - of_states(frozen, first)
            actor_loss = offline.weighted_regression(log_pi, advantage, hyper.alpha)
        else:
            own = of_actions(frozen, first, jnp.clip(mean, -1.0, 1.0)).min(0)
            actor_loss = offline.near_data(own, log_pi, hyper.alpha)
        metrics = {"value_loss": value_loss, "critic_loss": critic_loss, "actor_loss": actor_loss}
        metrics |= td3.error_metrics(values, target) | {"log_density": log_pi.mean()}
        return value_loss + critic_loss + actor_loss, metrics

    def value_at(params, features, code, action_mask):
        return of_states(params, td3.joined(features, code))

    return offline.agent(init, offline.make_act(actor), value_at, loss)
