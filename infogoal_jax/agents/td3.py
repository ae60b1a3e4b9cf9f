"""TD3 (Fujimoto et al. 2018): a deterministic actor, twin critics and target policy smoothing.

Both levels of HRAC use it: the high level in `agents/hrac.py`, and the low level while it is trained. As in HRAC's own
code the actor is updated as often as the critics.
"""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from infogoal_jax import networks


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


def explore(key: jax.Array, action: jax.Array, noise: jax.Array, random_share: jax.Array) -> jax.Array:
    """Add Gaussian noise of this standard deviation to actions [..., A]. With probability `random_share` an action is
    uniform in [-1, 1] instead."""
    noise_key, choose_key, random_key = jax.random.split(key, 3)
    noisy = jnp.clip(action + noise * jax.random.normal(noise_key, action.shape, jnp.float32), -1.0, 1.0)
    random = jax.random.uniform(random_key, action.shape, minval=-1.0, dtype=jnp.float32)
    return jnp.where(jax.random.uniform(choose_key, (*action.shape[:-1], 1), jnp.float32) < random_share, random, noisy)


def smoothed(key: jax.Array, action: jax.Array, noise: jax.Array, largest: float = 2.5) -> jax.Array:
    """Target policy smoothing (Eq. 14): actions [..., A] with noise of this standard deviation, clipped at `largest`
    standard deviations."""
    return jnp.clip(
        action + noise * jnp.clip(jax.random.normal(key, action.shape, jnp.float32), -largest, largest), -1.0, 1.0
    )


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


class Losses(NamedTuple):
    """critic: the loss of both critics; actor: minus the value of the actor's own actions [B, A], which may cost
    something beside it.

    metrics: mean temporal-difference error and value, scalars.
    """

    critic: jax.Array
    actor: jax.Array
    actions: jax.Array
    metrics: dict[str, jax.Array]


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
    expected = critic.apply(jax.lax.stop_gradient(params["critic"]), inputs, own)[0].mean()
    metrics = {"td_error": jnp.abs(values - target[None]).mean(), "value": values.mean()}
    return Losses(critic_loss(values, target, huber), -expected, own, metrics)
