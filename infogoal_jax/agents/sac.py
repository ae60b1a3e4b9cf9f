"""SAC (Haarnoja et al. 2018b, arXiv 1812.05905) for actions that are vectors: a stochastic actor, twin critics, and a
temperature that keeps the actor's entropy near a target.

The actor draws u from a normal distribution and acts by a = tanh(u). All losses are summed, so that each stops the
gradient into what another one trains: the critics' loss trains critics and encoders, the actor's the actor, and the
temperature's the temperature.

Shapes: B transitions, F features of a state, d numbers of a goal code, A numbers of an action.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Annotated, NamedTuple

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents import td3
from infogoal_jax.agents.agent import Agent, AgentBatch, AgentTraits, Exploration, OfSteps, in_bounds
from infogoal_jax.field_types import Sizes
from infogoal_jax.hyperparameters import Number, Search

LOG_STDS = (-5.0, 2.0)
"""Bounds of the logarithm of the actor's standard deviations."""
TARGET_ENTROPY = Number("(-inf, 0.69]", Search(-2.0, 0.0, "linear", always=False))
"""A number that is uniform in [-1, 1] has log 2 = 0.693, the most that there is."""
TEMPERATURE = Number("(0, inf)", Search(1e-3, 1.0, "log", always=False))


@dataclasses.dataclass(frozen=True)
class SACConfig(OfSteps):
    """Sizes and switches of SAC."""

    hidden: Sizes = (256, 256)
    """Widths of the layers of actor and critics."""
    num_steps: int = 1
    """Steps of the n-step return, without the entropy of those between the first and the last."""
    huber: bool = True
    """Huber loss with threshold 1 instead of the squared error."""
    layer_norm: bool = False
    """Normalise what each ReLU of the critics gets."""
    bounded: bool = False
    """Keep targets between 0 and the largest value, without a worth of entropy: the actor's loss alone has it. Not for
    rewards other than 1 at the goal."""


@flax.struct.dataclass
class SACHyperparameters:
    """Float hyperparameters of SAC."""

    target_entropy: Annotated[float, TARGET_ENTROPY] = -1.0
    """Entropy of each number of an action, in nats, that the temperature is led to; SAC's own."""
    initial_temperature: Annotated[float, TEMPERATURE] = 0.02
    """Temperature at the start. SAC's own code has 1; of values between 0 and 1 that would be most."""


class Actor(nn.Module):
    """Inputs [..., D] to the mean and the logarithm of the standard deviation of u, [..., size] each."""

    hidden: tuple[int, ...]
    size: int

    @nn.compact
    def __call__(self, inputs):
        mean, raw = jnp.split(networks.MLP(self.hidden, 2 * self.size)(inputs), 2, axis=-1)
        low, high = LOG_STDS
        return mean, low + (high - low) * (jnp.tanh(raw) + 1.0) / 2.0


def log_probability(u: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """The logarithm of the density of a = tanh(u), u ~ N(mean, exp(log_std)^2), float32 [...]; arguments [..., A].

    log N(u) - sum log(1 - tanh(u)^2) (Eq. 21 of Appendix C), in a form that large u leave finite.
    """
    normal = -0.5 * jnp.square((u - mean) / jnp.exp(log_std)) - log_std - 0.5 * math.log(2.0 * math.pi)
    return (normal - 2.0 * (math.log(2.0) - u - jax.nn.softplus(-2.0 * u))).sum(-1)


def draw(key: jax.Array, mean: jax.Array, log_std: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Actions [..., A] of the policy and the logarithms of their densities [...], with the gradient of both."""
    u = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape, jnp.float32)
    return jnp.tanh(u), log_probability(u, mean, log_std)


def choose(actor: Actor, params: dict, inputs: jax.Array, key: jax.Array, exploration: Exploration) -> jax.Array:
    """An action [..., A] of the policy, as it is drawn; without noise tanh(mean). With probability epsilon an action is
    uniform in [-1, 1] instead.

    How much the policy varies is learned: of `exploration.noise` it only counts whether it is 0.
    """
    draw_key, random_key = jax.random.split(key)
    mean, log_std = actor.apply(params["actor"], inputs)
    drawn, _ = draw(draw_key, mean, log_std)
    action = jnp.where(exploration.noise > 0, drawn, jnp.tanh(mean))
    return td3.explore(random_key, action, 0.0, exploration.epsilon)


def temperature(params: dict, hyper) -> jax.Array:
    """alpha, scalar."""
    return hyper.initial_temperature * jnp.exp(params["log_temperature"])


class ActorLosses(NamedTuple):
    """loss: of the actor and the temperature together, scalar; metrics: scalars by name."""

    loss: jax.Array
    metrics: dict[str, jax.Array]


def actor_losses(actor: Actor, params: dict, inputs: jax.Array, value: Callable, hyper, key: jax.Array) -> ActorLosses:
    """The actor's loss, E[alpha log pi(a | s) - Q(s, a)] (Eq. 7), and the temperature's, E[-alpha (log pi(a | s) + H)]
    (Eq. 18) with the target entropy H.

    inputs: [B, D], without gradient; value(action [B, A]) -> float32 [B] with a gradient for the action alone.
    """
    action, log_pi = draw(key, *actor.apply(params["actor"], inputs))
    alpha, target = temperature(params, hyper), hyper.target_entropy * actor.size
    actor_loss = (jax.lax.stop_gradient(alpha) * log_pi - value(action)).mean()
    temperature_loss = -alpha * jax.lax.stop_gradient(log_pi + target).mean()
    metrics = {"actor_loss": actor_loss, "entropy": -log_pi.mean(), "temperature": alpha}
    return ActorLosses(actor_loss + temperature_loss, metrics)


def soft_target(
    actor: Actor, critic: td3.TwinCritic, params: dict, target_params: dict, batch: AgentBatch, alpha, key: jax.Array
) -> jax.Array:
    """r + discount (min_i Q_i(s', a') - alpha log pi(a' | s')), float32 [B]: the trained actor draws a', the target
    critics value it (Eq. 5). alpha: scalar; 0 counts no entropy.
    """
    arrived = td3.joined(batch.next_features, batch.next_code)
    action, log_pi = draw(key, *actor.apply(params["actor"], arrived))
    seen = td3.joined(batch.target_features, batch.target_code)
    following = critic.apply(target_params["critic"], seen, action).min(0) - alpha * log_pi
    return jax.lax.stop_gradient(batch.reward + batch.discount * following)


def traits(config: SACConfig) -> AgentTraits:
    """Its actions are vectors."""
    return AgentTraits("vectors")


def make(config: SACConfig, env) -> Agent:
    actor, critic = Actor(config.hidden, env.action_size), td3.TwinCritic(config.hidden, config.layer_norm)

    def init(key, features, code):
        params = td3.init_networks(jax.random.split(key), actor, critic, features, code)
        return params | {"log_temperature": jnp.zeros((), jnp.float32)}, ()

    def act(params, features, code, action_mask, key, exploration):
        """An action that the policy draws; the greedy one is tanh(mean)."""
        return choose(actor, params, td3.joined(features, code), key, exploration)

    def value(params, features, code, action_mask):
        """The lower of both critics' values of tanh(mean)."""
        inputs = td3.joined(features, code)
        mean, _ = actor.apply(params["actor"], inputs)
        return critic.apply(params["critic"], inputs, jnp.tanh(mean)).min(0)

    def loss(params, target_params, batch: AgentBatch, state, hyper, key):
        """The sum of the losses of critics, actor and temperature."""
        target_key, actor_key = jax.random.split(key)
        alpha = 0.0 if config.bounded else temperature(params, hyper)
        target = soft_target(actor, critic, params, target_params, batch, alpha, target_key)
        target = in_bounds(target, batch) if config.bounded else target
        inputs = td3.joined(batch.features, batch.code)
        values = critic.apply(params["critic"], inputs, batch.action)
        inputs, frozen = jax.lax.stop_gradient((inputs, params["critic"]))
        learned = actor_losses(
            actor, params, inputs, lambda action: critic.apply(frozen, inputs, action).min(0), hyper, actor_key
        )
        metrics = td3.error_metrics(values, target) | learned.metrics
        return td3.critic_loss(values, target, config.huber) + learned.loss, metrics

    return Agent(init, act, value, loss, config.num_steps)
