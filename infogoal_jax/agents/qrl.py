"""QRL, quasimetric RL (Wang et al. 2023, arXiv 2304.01203), in OGBench's definition (arXiv 2410.20092):
the cost of the way from a state to a goal is a quasimetric d, which obeys the triangle inequality by its form. Learning
spreads states and goals apart as far as no recorded step gets longer than 1. The actor climbs -d after a step that a
model in the space of d predicts (`ddpg_bc`), or is a weighted regression on the recorded actions (`awr`).

In OGBench a goal is a whole state, embedded as states are (`--agent.goals states`). Here a goal is a code, embedded by
a network of its own; a state that achieves its goal has to lie at it, which is one more constraint.

Shapes: B transitions, F features of a state, d numbers of a goal code, A numbers of an action, Z of an embedding.
"""

import dataclasses
from typing import Annotated, Literal

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents import offline, td3
from infogoal_jax.agents.agent import Agent, AgentBatch
from infogoal_jax.errors import require
from infogoal_jax.field_types import Size
from infogoal_jax.hyperparameters import Number

GROUP = 8
"""Intervals of an embedding whose union is measured together."""
FAR, SPREAD = 500.0, 100.0
"""Distances beyond about this one are no longer driven apart, and over which range that sets in."""


@dataclasses.dataclass(frozen=True)
class QRLConfig(offline.OfflineConfig):
    """Sizes and switches of QRL."""

    size: Size = 512
    """Size Z of the embeddings, a multiple of 8."""
    goals: Literal["codes", "states"] = "codes"
    """`codes`: goals have a network of their own; `states`: features of states and codes of goals mean the same, and
    one network embeds both, as in OGBench."""
    actor_loss: offline.ActorLoss = "ddpg_bc"
    """As of GCIQL, with -d in the place of values."""

    def check(self, config) -> None:
        """Raise `UserError` for embeddings that cannot be cut into groups."""
        require(self.size % GROUP == 0, "agent.size", self.size, f"give a multiple of {GROUP} greater than 0")


def of_relabelling(config: QRLConfig) -> dict[str, float]:
    """Any goals, to be spread apart; and some that are achieved where goals are embedded by a network of their own.
    Where states and goals are embedded alike, the way to the goal that is achieved is 0 by its form."""
    return {"current_share": 0.0 if config.goals == "states" else 0.2, "future_share": 0.0}


@flax.struct.dataclass
class QRLHyperparameters:
    """Float hyperparameters of QRL."""

    alpha: Annotated[float, offline.ALPHA] = 0.003
    """Of `ddpg_bc`: weight of the recorded actions; of `awr`: how much more a better action counts."""
    margin: Annotated[float, Number("[0, inf)")] = 0.05
    """Squared excess over 1 that a recorded step may have (epsilon^2 of QRL, Eq. 5)."""


def union(first: jax.Array, second: jax.Array) -> jax.Array:
    """Lengths [..., Z / GROUP] of the unions of the intervals from `first` to `second` [..., Z], GROUP at a time; those
    that run backwards are empty (IQE, Wang & Isola 2022, arXiv 2211.15120, Eq. 7)."""
    low, high = (values.reshape(*values.shape[:-1], -1, GROUP) for values in (first, jnp.maximum(first, second)))
    order = jnp.argsort(low, axis=-1)
    low, high = (jnp.take_along_axis(values, order, axis=-1) for values in (low, high))
    covered = jax.lax.cummax(high, axis=high.ndim - 1)[..., :-1]
    begin = jnp.concatenate([low[..., :1], jnp.maximum(low[..., 1:], covered)], axis=-1)
    return jax.nn.relu(high - begin).sum(-1)


def distance(mixture: jax.Array, first: jax.Array, second: jax.Array) -> jax.Array:
    """d from embeddings [..., Z] to others, float32 [...]: the mean and the largest of the unions' lengths, weighed by
    sigmoid(mixture)."""
    lengths, weight = union(first, second), jax.nn.sigmoid(mixture)
    return weight * lengths.mean(-1) + (1.0 - weight) * lengths.max(-1)


def make(config: QRLConfig, env) -> Agent:
    actor = offline.make_actor(config, env.action_size)
    embed, dynamics = (networks.GeluMLP(config.hidden, config.size, config.layer_norm) for _ in range(2))
    shared = config.goals == "states"

    def init(key, features, code):
        keys, embedded = jax.random.split(key, 4), jnp.zeros(config.size, jnp.float32)
        with_action = td3.joined(embedded, jnp.zeros(env.action_size, jnp.float32))
        params = {
            "actor": actor.init(keys[0], td3.joined(features, code)),
            "value": embed.init(keys[1], features),
            "dynamics": dynamics.init(keys[2], with_action),
            "mixture": jnp.zeros((), jnp.float32),
            "log_lambda": jnp.zeros((), jnp.float32),
        }
        return params | ({} if shared else {"goals": embed.init(keys[3], code)}), ()

    def at(params, features):
        """Embeddings of states [B, Z]."""
        return embed.apply(params["value"], features)

    def of_goals(params, code):
        """Embeddings of goals [B, Z]."""
        return embed.apply(params["value" if shared else "goals"], code)

    def after(params, embedded, action):
        """Embeddings [B, Z] of the states that the model predicts after these actions."""
        return embedded + dynamics.apply(params["dynamics"], td3.joined(embedded, action))

    def value(params, features, code, action_mask=None):
        """-d [B]."""
        return -distance(params["mixture"], at(params, features), of_goals(params, code))

    def spread_loss(params, batch, hyper):
        """Far goals, under the constraint of the recorded steps, whose multiplier is lambda (QRL, Eqs. 5 and 10)."""
        here, there = at(params, batch.features), at(params, batch.next_features)
        far, step = -value(params, batch.features, batch.code), distance(params["mixture"], here, there)
        weight = jnp.exp(params["log_lambda"])
        wanted = SPREAD * jax.nn.softplus((FAR - far) / SPREAD)
        too_long = jnp.square(jax.nn.relu(step - 1.0)).mean()
        if not shared:
            at_goal = batch.at_goal.astype(jnp.float32)
            wanted = wanted * (1.0 - at_goal)
            too_long += (at_goal * jnp.square(far)).mean()
        loss = wanted.mean() + too_long * jax.lax.stop_gradient(weight)
        loss += weight * (hyper.margin - jax.lax.stop_gradient(too_long))
        return loss, {"distance_loss": loss, "step": step.mean(), "distance": far.mean(), "lambda": weight}

    def dynamics_loss(params, batch):
        """How far predicted states are from those that followed, there and back."""
        following = at(params, batch.next_features)
        predicted = after(params, at(params, batch.features), batch.action)
        there, back = (distance(params["mixture"], *ends) for ends in ((following, predicted), (predicted, following)))
        return (there + back).mean() / 2.0

    def actor_loss(params, batch, hyper):
        """As of GCIQL; the value of an action is -d of the state that it leads to."""
        (first, _), frozen = offline.actor_inputs(batch), jax.lax.stop_gradient(params)
        features, following = jax.lax.stop_gradient((batch.features, batch.next_features))
        mean = actor.apply(params["actor"], first)
        log_pi = offline.log_density(mean, batch.action)
        if config.actor_loss == "awr":
            advantage = value(frozen, following, batch.actor.next_code) - value(frozen, features, batch.actor.code)
            return offline.weighted_regression(log_pi, advantage, hyper.alpha), log_pi
        predicted = after(frozen, at(frozen, features), jnp.clip(mean, -1.0, 1.0))
        own = -distance(frozen["mixture"], predicted, of_goals(frozen, batch.actor.code))
        return offline.near_data(own, log_pi, hyper.alpha), log_pi

    def loss(params, target_params, batch: AgentBatch, state, hyper, key):
        """The sum of the losses of d, the model and the actor."""
        value_loss, metrics = spread_loss(params, batch, hyper)
        of_actor, log_pi = actor_loss(params, batch, hyper)
        of_model = dynamics_loss(params, batch) if config.actor_loss == "ddpg_bc" else 0.0
        metrics |= {"actor_loss": of_actor, "dynamics_loss": of_model, "log_density": log_pi.mean()}
        return value_loss + of_model + of_actor, metrics

    return offline.agent(init, offline.make_act(actor), value, loss)
