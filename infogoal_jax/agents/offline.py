"""What the offline agents of OGBench (Park et al. 2025, arXiv 2410.20092) share: an actor that is drawn towards the
actions of the data, and expectile regression. `gcivl.py`, `gciql.py`, `qrl.py`, `hiql.py` and
`offline_crl.py` are the agents.

They learn from costs: -1 a step until the goal (`relabelling/mixed.py`). Actor and values have networks of their own;
the actor's loss trains nothing but the actor. Their code mixes the target networks from the parameters before an
update, the program here from those after it.

Shapes: B transitions, F features of a state, d numbers of a goal code, A numbers of an action.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Annotated, Any, Literal

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents import td3
from infogoal_jax.agents.agent import Agent, AgentBatch, AgentTraits
from infogoal_jax.field_types import Sizes
from infogoal_jax.hyperparameters import Number, Search
from infogoal_jax.registry import Entry

EXPECTILE = Number("(0, 1)", Search(0.6, 0.95, "linear", always=False))
ALPHA = Number("[0, inf)", Search(1e-3, 10.0, "log", always=False))
LARGEST_WEIGHT = 100.0
"""Of an action in the regression on actions."""
ActorLoss = Literal["ddpg_bc", "awr"]


@dataclasses.dataclass(frozen=True)
class OfflineConfig:
    """Sizes of an offline agent, OGBench's own."""

    hidden: Sizes = (512, 512, 512)
    """Widths of the layers of actor and values."""
    layer_norm: bool = True
    """Normalise what each layer of the values puts out."""


@flax.struct.dataclass
class ExpectileHyperparameters:
    """Float hyperparameters of implicit Q-learning."""

    expectile: Annotated[float, EXPECTILE] = 0.9
    """Expectile of the values: above 0.5, what turned out well counts more."""


def traits(config: OfflineConfig) -> AgentTraits:
    """Its actions are vectors; it learns from costs."""
    return AgentTraits("vectors", costs=True)


def agent(init: Callable, act: Callable, value: Callable, loss: Callable) -> Agent:
    """The agent of these functions (`Agent`), which learns from single steps and keeps nothing besides its
    parameters."""
    return Agent(init, act, value, loss)


def entry(
    config: type,
    make: Callable,
    hyper: type,
    of_relabelling: Mapping | Callable = MappingProxyType({}),
    declared: Callable[[Any], AgentTraits] = traits,
) -> Entry:
    """What the registry of agents holds of an offline one."""
    return Entry(config, make, hyper, declared, of_relabelling=of_relabelling, relabelling="mixed")


def make_actor(config: OfflineConfig, size: int) -> networks.GeluMLP:
    """The mean of a normal distribution of actions [..., size], whose standard deviation is 1."""
    return networks.GeluMLP(config.hidden, size, last_scale=1e-2)


def make_act(actor: networks.GeluMLP) -> Callable:
    """The `act` of an agent with this actor: its mean, clipped, with noise, or a random action."""

    def act(params, features, code, action_mask, key, exploration):
        best = jnp.clip(actor.apply(params["actor"], td3.joined(features, code)), -1.0, 1.0)
        return td3.explore(key, best, exploration.noise, exploration.epsilon)

    return act


def log_density(mean: jax.Array, action: jax.Array) -> jax.Array:
    """log N(action; mean, I), float32 [B]; arguments [B, A]."""
    return -0.5 * jnp.square(action - mean).sum(-1) - 0.5 * mean.shape[-1] * math.log(2.0 * math.pi)


def expectile_loss(advantage: jax.Array, difference: jax.Array, expectile: jax.Array) -> jax.Array:
    """|expectile - 1(advantage < 0)| difference^2 (IQL, Kostrikov et al. 2022, Eq. 5)."""
    return jnp.where(advantage >= 0, expectile, 1.0 - expectile) * jnp.square(difference)


def weighted_regression(
    log_pi: jax.Array, advantage: jax.Array, alpha: jax.Array, counts: jax.Array | None = None
) -> jax.Array:
    """-E[min(exp(alpha advantage), 100) log pi(a | s, g)] (AWR, Peng et al. 2019; IQL, Eq. 7).

    counts: float32 [B], 1 for the transitions that are learned from, else 0; None: all are.
    """
    gain = jnp.minimum(jnp.exp(alpha * advantage), LARGEST_WEIGHT) * log_pi
    return -gain.mean() if counts is None else -(gain * counts).sum() / jnp.maximum(counts.sum(), 1.0)


def near_data(value: jax.Array, log_pi: jax.Array, alpha: jax.Array) -> jax.Array:
    """-E[Q(s, pi(s, g), g)] / mean |Q| - alpha E[log pi(a | s, g)] (DDPG+BC, Fujimoto & Gu 2021)."""
    return -value.mean() / jax.lax.stop_gradient(jnp.abs(value).mean() + 1e-6) - alpha * log_pi.mean()


def actor_inputs(batch: AgentBatch) -> tuple[jax.Array, jax.Array]:
    """Features and the actor's goals of the first and of the last state, [B, F + d] each, without gradient."""
    first, last = td3.joined(batch.features, batch.actor.code), td3.joined(batch.next_features, batch.actor.next_code)
    return jax.lax.stop_gradient((first, last))


def implicit_values(
    values: Callable, params: dict, target_params: dict, batch: AgentBatch, expectile: jax.Array
) -> tuple[jax.Array, dict]:
    """The loss of twin values of transitions alone, and metrics (OGBench, Eq. 4: IQL without Q).

    values: (params, features [B, F], code [B, d]) -> [2, B]. The weight of a difference depends on the mean of the
    target networks' values before the transition, not on what learns.
    """
    following = values(target_params, batch.target_features, batch.target_code)
    before = values(target_params, batch.first_target_features, batch.first_target_code).mean(0)
    learned = values(params, batch.features, batch.code)
    target = jax.lax.stop_gradient(batch.reward + batch.discount * following)
    advantage = jax.lax.stop_gradient(target.min(0) - before)
    loss = expectile_loss(advantage, target - learned, expectile).mean(-1).sum()
    return loss, {"value_loss": loss, "value": learned.mean()}
