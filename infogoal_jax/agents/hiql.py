"""HIQL, hierarchical implicit Q-learning (Park et al. 2023, arXiv 2307.11949), in OGBench's definition (arXiv
2410.20092): values as GCIVL's, of a representation phi(s, g) of the goal. A high level says phi of the state that
should be reached some steps from now on the way to the goal, a low level acts towards it. Both are weighted regressions
on the recordings.

Shapes: B transitions, F features of a state, d numbers of a goal code, A numbers of an action, P of phi.
"""

import dataclasses
from typing import Annotated

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents import offline, td3
from infogoal_jax.agents.agent import Agent, AgentBatch
from infogoal_jax.errors import require
from infogoal_jax.field_types import Size

OF_RELABELLING = {"subgoal_steps": 25}
"""Each transition carries a state that its episode reaches so many steps later."""


@dataclasses.dataclass(frozen=True)
class HIQLConfig(offline.OfflineConfig):
    """Sizes of HIQL."""

    size: Size = 10
    """Size P of phi, whose length is the root of P."""

    def check(self, config) -> None:
        """Raise `UserError` for transitions without a subgoal."""
        steps = getattr(config.relabelling, "subgoal_steps", None)
        require(
            steps != 0, "relabelling.subgoal_steps", steps, "agent hiql learns subgoals; give 1 or more, such as 25"
        )


@flax.struct.dataclass
class HIQLHyperparameters(offline.ExpectileHyperparameters):
    """Float hyperparameters of HIQL."""

    expectile: Annotated[float, offline.EXPECTILE] = 0.7
    """Expectile of the values."""
    low_alpha: Annotated[float, offline.ALPHA] = 3.0
    """How much more an action counts that came nearer to the subgoal."""
    high_alpha: Annotated[float, offline.ALPHA] = 3.0
    """How much more a subgoal counts that came nearer to the goal."""


def of_length(vectors: jax.Array) -> jax.Array:
    """Vectors [..., P] with the length of the root of P; those without a direction stay 0."""
    square = jnp.square(vectors).sum(-1, keepdims=True)
    return vectors * jax.lax.rsqrt(jnp.where(square > 0, square, 1.0)) * vectors.shape[-1] ** 0.5


def make(config: HIQLConfig, env) -> Agent:
    low, high = offline.make_actor(config, env.action_size), offline.make_actor(config, config.size)
    head = networks.TwinGeluMLP(config.hidden, 1, config.layer_norm)
    goals = networks.GeluMLP(config.hidden, config.size, config.layer_norm)

    def init(key, features, code):
        keys, inputs = jax.random.split(key, 4), td3.joined(features, code)
        seen = td3.joined(features, jnp.zeros(config.size, jnp.float32))
        return {
            "goals": goals.init(keys[0], inputs),
            "value": head.init(keys[1], seen),
            "low": low.init(keys[2], seen),
            "high": high.init(keys[3], inputs),
        }, ()

    def phi(params, features, code):
        """phi(s, g) [B, P]."""
        return of_length(goals.apply(params["goals"], td3.joined(features, code)))

    def both(params, features, code):
        """V1 and V2 [2, B]."""
        return head.apply(params["value"], td3.joined(features, phi(params, features, code)))[..., 0]

    def value(params, features, code, action_mask=None):
        """The mean of both values, float32 [B]."""
        return both(params, features, code).mean(0)

    def act(params, features, code, action_mask, key, exploration):
        """The low level's action towards the subgoal that the high level says."""
        subgoal = of_length(high.apply(params["high"], td3.joined(features, code)))
        best = jnp.clip(low.apply(params["low"], td3.joined(features, subgoal)), -1.0, 1.0)
        return td3.explore(key, best, exploration.noise, exploration.epsilon)

    def loss(params, target_params, batch: AgentBatch, state, hyper, key):
        """Of values, and of both levels with the advantages V(s', w) - V(s, w) of the subgoal w that is reached and
        V(w, g) - V(s, g) (HIQL, Eqs. 6 and 7)."""
        frozen = jax.lax.stop_gradient(params)
        targets = target_params | {"goals": frozen["goals"]}  # phi has no target network.
        of_values, metrics = offline.implicit_values(both, params, targets, batch, hyper.expectile)
        features, following, way, goal = jax.lax.stop_gradient(
            (batch.features, batch.next_features, batch.waypoints, batch.actor)
        )
        nearer = value(frozen, following, way.next_low_code) - value(frozen, features, way.low_code)
        towards = low.apply(params["low"], td3.joined(features, phi(frozen, features, way.low_code)))
        taken = offline.log_density(towards, batch.action)
        low_loss = offline.weighted_regression(taken, nearer, hyper.low_alpha, way.low_weight)
        ahead = value(frozen, way.features, way.code_there) - value(frozen, features, goal.code)
        said = high.apply(params["high"], td3.joined(features, goal.code))
        reached = phi(frozen, features, way.code)
        likely = offline.log_density(said, reached)
        high_loss = offline.weighted_regression(likely, ahead, hyper.high_alpha, way.weight)
        metrics |= {"low_loss": low_loss, "high_loss": high_loss, "subgoal_error": jnp.square(said - reached).mean()}
        return of_values + low_loss + high_loss, metrics

    return offline.agent(init, act, value, loss)
