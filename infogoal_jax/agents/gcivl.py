"""GCIVL, goal-conditioned implicit V-learning, in OGBench's definition (Park et al. 2025, arXiv 2410.20092): values of
states alone, by expectile regression on the recorded transitions, and an actor by weighted regression on their actions.

Shapes: B transitions, F features of a state, d numbers of a goal code, A numbers of an action.
"""

import dataclasses
from typing import Annotated

import flax.struct
import jax

from infogoal_jax import networks
from infogoal_jax.agents import offline, td3
from infogoal_jax.agents.agent import Agent, AgentBatch


@dataclasses.dataclass(frozen=True)
class GCIVLConfig(offline.OfflineConfig):
    """Sizes of GCIVL."""


@flax.struct.dataclass
class GCIVLHyperparameters(offline.ExpectileHyperparameters):
    """Float hyperparameters of GCIVL."""

    alpha: Annotated[float, offline.ALPHA] = 10.0
    """How much more an action counts in the regression that led to a better state; 0: all alike."""


def make(config: GCIVLConfig, env) -> Agent:
    actor, value = (
        offline.make_actor(config, env.action_size),
        networks.TwinGeluMLP(config.hidden, 1, config.layer_norm),
    )

    def init(key, features, code):
        keys, inputs = jax.random.split(key), td3.joined(features, code)
        return {"actor": actor.init(keys[0], inputs), "value": value.init(keys[1], inputs)}, ()

    def both(params, features, code):
        """V1 and V2 [2, B]."""
        return value.apply(params["value"], td3.joined(features, code))[..., 0]

    def values(params, inputs):
        """The mean of both values, float32 [B]."""
        return value.apply(params["value"], inputs)[..., 0].mean(0)

    def loss(params, target_params, batch: AgentBatch, state, hyper, key):
        """Expectile regression of the values, and the actor's with the advantage V(s', g) - V(s, g)."""
        value_loss, metrics = offline.implicit_values(both, params, target_params, batch, hyper.expectile)
        (first, last), frozen = offline.actor_inputs(batch), jax.lax.stop_gradient(params)
        advantage = values(frozen, last) - values(frozen, first)
        log_pi = offline.log_density(actor.apply(params["actor"], first), batch.action)
        actor_loss = offline.weighted_regression(log_pi, advantage, hyper.alpha)
        metrics |= {"actor_loss": actor_loss, "advantage": advantage.mean(), "log_density": log_pi.mean()}
        return value_loss + actor_loss, metrics

    def value_at(params, features, code, action_mask):
        return values(params, td3.joined(features, code))

    return offline.agent(init, offline.make_act(actor), value_at, loss)
