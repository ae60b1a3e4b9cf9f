"""TD3 (Fujimoto et al. 2018) for actions that are vectors: a deterministic actor, twin critics and target policy
smoothing.

Actor and critics see the same features and codes, which the critics' loss alone trains. As in HRAC's own code the actor
is updated as often as the critics. The high level of HRAC (`agents/hrac.py`) learns by the same functions.

Shapes: B transitions, F features of a state, d numbers of a goal code, A numbers of an action, G goals.
"""

import dataclasses
from typing import Annotated, Any, Literal, NamedTuple

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents import value_heads
from infogoal_jax.agents.agent import Agent, AgentBatch, AgentTraits, OfSteps, in_bounds
from infogoal_jax.agents.all_goals import OfAllGoals
from infogoal_jax.errors import require
from infogoal_jax.field_types import Size, Sizes
from infogoal_jax.hyperparameters import Number, Search


@dataclasses.dataclass(frozen=True)
class TD3Config(OfAllGoals, OfSteps):
    """Sizes and switches of TD3."""

    hidden: Sizes = (256, 256)
    """Widths of the layers of actor and critics."""
    num_steps: int = 1
    """Steps of the n-step return."""
    huber: bool = True
    """Huber loss with threshold 1 instead of the squared error."""
    critic: Literal["concatenated", "product"] = "concatenated"
    """How values depend on the goal: `concatenated`: one network of features, code and action; `product`: the all-goals
    head (docs/research/all_goals.md)."""
    critic_size: Size = 128
    """Size of the vectors whose product is a value, for `product` alone."""
    layer_norm: bool = False
    """Normalise what each ReLU of the critics gets."""
    bounded: bool = False
    """Keep targets between 0 and the largest value, and values of `product` by a sigmoid. Not for rewards other than 1
    at the goal."""
    behaviour: bool = False
    """Keep the actor near the actions of the data, for recorded episodes (TD3+BC, Fujimoto & Gu 2021)."""

    def check(self, config) -> None:
        """Raise `UserError` for returns of no step or too many, for shares of goals that are more than all, and for
        critics that value one goal at a time."""
        super().check(config)
        self.check_all_goals()
        check_critic(self)


def check_critic(config: Any) -> None:
    """Raise `UserError` for a configuration of TD3 or HRAC that learns from all goals at once by critics that value one
    goal at a time."""
    fits = config.critic == "product" or not config.all_goals
    require(fits, "agent.critic", config.critic, "values one goal at a time, and agent.all_goals all; give product")


@flax.struct.dataclass
class TD3Hyperparameters:
    """Float hyperparameters of TD3."""

    target_noise: Annotated[float, Number("[0, inf)", Search(0.05, 0.5, "linear", always=False))] = 0.2
    """Standard deviation of target policy smoothing; TD3's own."""
    action_cost: Annotated[float, Number("[0, inf)", Search(0.001, 1.0, "log", always=False))] = 0.02
    """Weight of the mean squared action in the actor's loss. HER's own code has 1 beside returns of -1 a step, which
    with its discount of 0.98 are 50 times as large as values between 0 and 1."""
    behaviour_alpha: Annotated[float, Number("(0, inf)", Search(0.25, 25.0, "log", always=False))] = 2.5
    """With `behaviour`: the weight of values, in units of their mean size, beside the squared distance from the data's
    actions; TD3+BC's own."""


class Actor(nn.Module):
    """pi(x): inputs [..., D] to actions [..., size] in [-1, 1]."""

    hidden: tuple[int, ...]
    size: int

    @nn.compact
    def __call__(self, inputs):
        return jnp.tanh(networks.MLP(self.hidden, self.size)(inputs))


TwinMLP = nn.vmap(networks.MLP, variable_axes={"params": 0}, split_rngs={"params": True}, in_axes=None, axis_size=2)
"""Two networks with the same inputs [..., D], their outputs stacked: [2, ..., out]."""


class TwinCritic(nn.Module):
    """Q1 and Q2 of inputs [..., D] and actions [..., A], stacked: [2, ...]."""

    hidden: tuple[int, ...]
    layer_norm: bool = False

    @nn.compact
    def __call__(self, inputs, action):
        together = jnp.concatenate([inputs, action], axis=-1)
        return TwinMLP(self.hidden, 1, self.layer_norm)(together)[..., 0]


class TwinProductCritic(nn.Module):
    """Q1 and Q2 as products f(features, action) . h(code), so that one action is valued under all goals at once."""

    hidden: tuple[int, ...]
    size: int
    layer_norm: bool = False
    bounded: bool = False
    """Keep values between 0 and 1 by a sigmoid."""

    def setup(self):
        self.states = TwinMLP(self.hidden, self.size, self.layer_norm)
        self.goals = TwinMLP(self.hidden[-1:], self.size, self.layer_norm)

    def __call__(self, features, action, code):
        """Features [..., F] and action [..., A], each under its own goal [..., d]: [2, ...]."""
        return self.product("n...d,n...d->n...", features, action, code)

    def of_all(self, features, action, codes):
        """One action [B, A] in each state, under all goals [G, d]: [2, B, G]."""
        return self.product("nbd,ngd->nbg", features, action, codes)

    def of_each(self, features, actions, codes):
        """In each state an action of its own for each goal, [B, G, A], under that goal [G, d]: [2, B, G]."""
        several = jnp.broadcast_to(features[:, None], (*actions.shape[:-1], features.shape[-1]))
        return self.product("nbgd,ngd->nbg", several, actions, codes)

    def product(self, axes, features, action, codes):
        """The products over these axes."""
        states = self.states(jnp.concatenate([features, action], axis=-1)) / self.size**0.5
        values = jnp.einsum(axes, states, self.goals(codes))
        return jax.nn.sigmoid(values) if self.bounded else values


class OfInputs(NamedTuple):
    """A product critic that takes features and code as one vector, as `TwinCritic` does."""

    critic: TwinProductCritic
    num_features: int

    def apply(self, params: dict, inputs: jax.Array, action: jax.Array) -> jax.Array:
        """Q1 and Q2 [2, B] of inputs [B, F + d] and actions [B, A]."""
        features, code = jnp.split(inputs, [self.num_features], axis=-1)
        return self.critic.apply(params, features, action, code)


Critic = TwinCritic | TwinProductCritic


def make_critic(config: TD3Config) -> Critic:
    """The critics of a configuration with the fields `hidden`, `critic`, `critic_size`, `layer_norm` and `bounded`."""
    if config.critic == "product":
        return TwinProductCritic(config.hidden, config.critic_size, config.layer_norm, config.bounded)
    return TwinCritic(config.hidden, config.layer_norm)


def init_networks(keys: jax.Array, actor: Actor, critic: Critic, features: jax.Array, code: jax.Array) -> dict:
    """Parameters {"actor", "critic"} for features [F] and a code [d]: by two keys."""
    inputs, action = joined(features, code), jnp.zeros(actor.size, jnp.float32)
    seen = (features, action, code) if isinstance(critic, TwinProductCritic) else (inputs, action)
    return {"actor": actor.init(keys[0], inputs), "critic": critic.init(keys[1], *seen)}


def joined(features: jax.Array, code: jax.Array) -> jax.Array:
    """Features [..., F] and codes [..., d] as one vector, [..., F + d]."""
    return jnp.concatenate([features, code], axis=-1)


def of_inputs(critic: Critic, features: jax.Array) -> TwinCritic | OfInputs:
    """The critics as functions of `joined` features [..., F] and codes."""
    return OfInputs(critic, features.shape[-1]) if isinstance(critic, TwinProductCritic) else critic


def lower_value(actor: Actor, critic: Critic, params: dict, features: jax.Array, code: jax.Array) -> jax.Array:
    """The lower of both critics' values of the actor's action, float32 [B]."""
    inputs = joined(features, code)
    return of_inputs(critic, features).apply(params["critic"], inputs, actor.apply(params["actor"], inputs)).min(0)


def explore(key: jax.Array, action: jax.Array, noise: jax.Array, random_probability: jax.Array) -> jax.Array:
    """Add Gaussian noise of this standard deviation to actions [..., A]. With probability `random_probability` an
    action is uniform in [-1, 1] instead."""
    noise_key, choose_key, random_key = jax.random.split(key, 3)
    noisy = jnp.clip(action + noise * jax.random.normal(noise_key, action.shape, jnp.float32), -1.0, 1.0)
    random = jax.random.uniform(random_key, action.shape, minval=-1.0, dtype=jnp.float32)
    return jnp.where(
        jax.random.uniform(choose_key, (*action.shape[:-1], 1), jnp.float32) < random_probability, random, noisy
    )


def smoothed(key: jax.Array, action: jax.Array, noise: jax.Array) -> jax.Array:
    """Target policy smoothing (Eq. 14): actions [..., A] with noise of this standard deviation, clipped at 2.5
    standard deviations."""
    return jnp.clip(action + noise * jnp.clip(jax.random.normal(key, action.shape, jnp.float32), -2.5, 2.5), -1.0, 1.0)


def next_value(
    key: jax.Array, actor: Actor, critic: TwinCritic, target_params: dict, inputs: jax.Array, noise: jax.Array
) -> jax.Array:
    """What follows a transition, float32 [B]: the smaller of both target critics' values of the target actor's action,
    with noise (Eq. 10, 14).

    inputs: [B, D] after the transition.
    """
    action = smoothed(key, actor.apply(target_params["actor"], inputs), noise)
    return critic.apply(target_params["critic"], inputs, action).min(0)


def critic_loss(values: jax.Array, target: jax.Array, huber: bool) -> jax.Array:
    """Temporal-difference error of both critics [2, B] against one target [B] (clipped double Q-learning, Eq. 10)."""
    target = jnp.broadcast_to(jax.lax.stop_gradient(target), values.shape)
    error = networks.squared_or_huber(values, target, huber)
    return error.mean(1).sum()


def error_metrics(values: jax.Array, target: jax.Array) -> dict[str, jax.Array]:
    """Mean temporal-difference error of both critics [2, B], and their mean value."""
    return {"td_error": jnp.abs(values - target[None]).mean(), "value": values.mean()}


class Losses(NamedTuple):
    """The losses of an actor and its critics.

    critic: of both critics.
    actor: minus the value of the actor's own actions, and what these cost beside it.
    actions: the actor's own, float32 [B, A].
    metrics: mean temporal-difference error and value, scalars.
    values: of those actions, float32 [B].
    """

    critic: jax.Array
    actor: jax.Array
    actions: jax.Array
    metrics: dict[str, jax.Array]
    values: jax.Array


def losses(
    actor: Actor,
    critic: TwinCritic | OfInputs,
    params: dict,
    inputs: jax.Array,
    action: jax.Array,
    target: jax.Array,
    huber: bool,
) -> Losses:
    """The losses of `params` {"actor", "critic", ...} for transitions that start at inputs [B, D] by action [B, A] and
    are worth target [B].

    The actor's loss has no gradient for the critics, nor for what the inputs were made by.
    """
    values = critic.apply(params["critic"], inputs, action)
    inputs = jax.lax.stop_gradient(inputs)
    own = actor.apply(params["actor"], inputs)
    expected = critic.apply(jax.lax.stop_gradient(params["critic"]), inputs, own)[0]
    metrics = error_metrics(values, target)
    return Losses(critic_loss(values, target, huber), -expected.mean(), own, metrics, expected)


def near_behaviour(losses: Losses, action: jax.Array, alpha: jax.Array) -> Losses:
    """The losses with an actor that stays near the actions [B, A] of the data: -lambda Q + mean (pi - a)^2, lambda =
    alpha / mean |Q| (Eqs. 3 and 4 of TD3+BC)."""
    size = jnp.abs(jax.lax.stop_gradient(losses.values)).mean()
    weight = alpha / jnp.maximum(size, 1e-6)
    return losses._replace(actor=weight * losses.actor + jnp.square(losses.actions - action).mean())


def learn(
    actor: Actor,
    critic: Critic,
    params: dict,
    target_params: dict,
    batch: AgentBatch,
    noise: jax.Array,
    key: jax.Array,
    huber: bool,
    bounded: bool,
) -> Losses:
    """The losses for a batch, under all goals at once where it has them: then the critics learn from all of them, and
    the actor from the batch's own.

    noise: standard deviation of target policy smoothing; bounded: keep targets `in_bounds`.
    """
    inputs = joined(batch.features, batch.code)
    target_inputs, both = joined(batch.target_features, batch.target_code), of_inputs(critic, batch.features)
    following = next_value(key, actor, both, target_params, target_inputs, noise)
    target = batch.reward + batch.discount * following
    target = in_bounds(target, batch) if bounded else target
    found = losses(actor, both, params, inputs, batch.action, target, huber)
    if batch.all_goals is None:
        return found
    loss, metrics = loss_of_all(actor, critic, params, target_params, batch, noise, jax.random.fold_in(key, 1), huber)
    return found._replace(critic=loss, metrics=metrics)


def loss_of_all(
    actor: Actor,
    critic: TwinProductCritic,
    params: dict,
    target_params: dict,
    batch: AgentBatch,
    noise: jax.Array,
    key: jax.Array,
    huber: bool,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The loss of the critics under the goals `batch.all_goals`: (loss, metrics).

    One action is learned from under all goals in one product. What follows is another action for each goal, so that
    actor and critics are applied B * G times. noise: standard deviation of target policy smoothing.
    """
    goals, shape = batch.all_goals, batch.all_goals.reward.shape
    states = jnp.broadcast_to(batch.target_features[:, None], (*shape, batch.target_features.shape[-1]))
    codes = jnp.broadcast_to(goals.target_code, (*shape, goals.target_code.shape[-1]))
    action = smoothed(key, actor.apply(target_params["actor"], joined(states, codes)), noise)
    following = critic.apply(
        target_params["critic"], batch.target_features, action, goals.target_code, method="of_each"
    )
    target = jax.lax.stop_gradient(goals.reward + goals.discount * following.min(0))
    values = critic.apply(params["critic"], batch.features, batch.action, goals.code, method="of_all")
    loss, metrics = jax.vmap(lambda twin: value_heads.td_loss_of_all(twin, target, goals.weight, huber))(values)
    return loss.sum(), jax.tree.map(jnp.mean, metrics)


def traits(config: TD3Config) -> AgentTraits:
    """Its actions are vectors."""
    return AgentTraits("vectors", all_goals=config.all_goals, sigmoid=config.critic == "product" and config.bounded)


def make(config: TD3Config, env) -> Agent:
    actor, critic = Actor(config.hidden, env.action_size), make_critic(config)

    def init(key, features, code):
        return init_networks(jax.random.split(key), actor, critic, features, code), ()

    def act(params, features, code, action_mask, key, exploration):
        """The actor's action with noise, or a random action."""
        best = actor.apply(params["actor"], joined(features, code))
        return explore(key, best, exploration.noise, exploration.epsilon)

    def value(params, features, code, action_mask):
        """The lower of both critics' values of the actor's action."""
        return lower_value(actor, critic, params, features, code)

    def loss(params, target_params, batch: AgentBatch, state, hyper, key):
        """Temporal-difference error of the critics, and the actor's: minus what its actions are worth, and their
        cost."""
        learned = learn(
            actor, critic, params, target_params, batch, hyper.target_noise, key, config.huber, config.bounded
        )
        if config.behaviour:
            learned = near_behaviour(learned, batch.action, hyper.behaviour_alpha)
        cost = jnp.square(learned.actions).mean()
        metrics = learned.metrics | {"action_size": jnp.abs(learned.actions).mean()}
        return learned.critic + learned.actor + hyper.action_cost * cost, metrics

    return Agent(init, act, value, loss, config.num_steps, config.goals_at_once())
