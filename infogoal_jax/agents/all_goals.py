"""Learning from every transition under all goals at once (LEO: Matthews et al. 2026, arXiv 2605.23551; before it
Kaelbling 1993).

Each goal g has a reward of its own, 1 where the transition achieves g, and ends for g alone. One network values all
goals in one pass, so that a transition costs hardly more than under the desired goal.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax

from infogoal_jax.agents import td3
from infogoal_jax.agents.agent import AgentBatch
from infogoal_jax.agents.value_heads import ValueHead


def returns_of_all(hit: jax.Array, mask: jax.Array, discount: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Discounted reward of each transition under each goal, and the discount of what follows it: float32 [B, G] each.

    hit: bool [B, n, G], goals achieved after each step; mask: float32 [B, n], 1 for a step that was taken. The first
    hit of a goal is worth 1 and ends the transition for that goal.
    """
    hit = hit & (mask > 0)[..., None]
    first = hit & (jnp.cumsum(hit, axis=1) == 1)
    powers = discount ** jnp.arange(mask.shape[1])
    reward = jnp.einsum("bng,n->bg", first.astype(jnp.float32), powers)
    return reward, (discount ** mask.sum(1))[:, None] * ~hit.any(1)


def target_of_all(
    reward: jax.Array, discount: jax.Array, next_values: jax.Array, next_action_mask: jax.Array
) -> jax.Array:
    """r_g + discount_g max_a' Q(s', a', g), float32 [B, G], without gradient.

    reward, discount: float32 [B, G]; next_values: float32 [B, A, G]; next_action_mask: bool [B, A].
    """
    best = jnp.where(next_action_mask[..., None], next_values, -jnp.inf).max(1)
    return jax.lax.stop_gradient(reward + discount * best)


def mean_over_goals(values: jax.Array, weight: jax.Array) -> jax.Array:
    """The mean of values [..., G] over all axes; goals count by their weight [G]."""
    share = weight / jnp.maximum(weight.sum(), 1.0)
    return (values * share).sum(-1).mean()


def td_loss_of_all(
    predicted: jax.Array, target: jax.Array, weight: jax.Array, huber: bool
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Temporal-difference error of values [B, G] against their targets [B, G], over goals of weight above 0 alone:
    (loss, metrics). Without `huber` it is LEO's half of the mean square."""
    error = optax.huber_loss(predicted, target) if huber else optax.l2_loss(predicted, target)
    metrics = {
        "td_error": mean_over_goals(jnp.abs(predicted - target), weight),
        "value": mean_over_goals(predicted, weight),
    }
    return mean_over_goals(error, weight), metrics


def value_loss(
    head: ValueHead, huber: bool, regulariser: Callable | None, params, target_params, batch: AgentBatch, hyper
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The loss of action values under the goals `batch.all_goals`: (loss, metrics). The target network chooses and
    values what follows, as one product [B, A, G].

    regulariser(values float32 [B, A], batch, hyper) -> (loss, metrics) of one goal, or None; it counts for each goal.
    """
    goals = batch.all_goals
    following = head.values_of_all(target_params, batch.target_features, goals.target_code)
    target = target_of_all(goals.reward, goals.discount, following, batch.next_action_mask)
    if regulariser is None:
        predicted = head.taken_of_all(params, batch.features, batch.action, goals.code)
        return td_loss_of_all(predicted, target, goals.weight, huber)
    values = head.values_of_all(params, batch.features, goals.code)
    predicted = jnp.take_along_axis(values, batch.action[:, None, None], axis=1)[:, 0]
    error, metrics = td_loss_of_all(predicted, target, goals.weight, huber)
    extra, own_metrics = jax.vmap(lambda under_one: regulariser(under_one, batch, hyper), in_axes=-1)(values)
    own_metrics = {name: mean_over_goals(value, goals.weight) for name, value in own_metrics.items()}
    return error + mean_over_goals(extra, goals.weight), metrics | own_metrics


def critic_loss(
    actor: td3.Actor, critic: td3.TwinProductCritic, params, target_params, batch: AgentBatch, noise, key: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The loss of TD3's critics under the goals `batch.all_goals`: (loss, metrics).

    One action is learned from under all goals in one product. What follows is another action for each goal, so that
    actor and critics are applied B * G times. noise: standard deviation of target policy smoothing.
    """
    goals, shape = batch.all_goals, batch.all_goals.reward.shape
    states = jnp.broadcast_to(batch.target_features[:, None], (*shape, batch.target_features.shape[-1]))
    codes = jnp.broadcast_to(goals.target_code, (*shape, goals.target_code.shape[-1]))
    own = actor.apply(target_params["actor"], jnp.concatenate([states, codes], axis=-1))
    following = critic.apply(
        target_params["critic"],
        batch.target_features,
        td3.smoothed(key, own, noise),
        goals.target_code,
        method="of_each",
    )
    target = jax.lax.stop_gradient(goals.reward + goals.discount * following.min(0))
    values = critic.apply(params["critic"], batch.features, batch.action, goals.code, method="of_all")
    loss, metrics = jax.vmap(lambda twin: td_loss_of_all(twin, target, goals.weight, huber=True))(values)
    return loss.sum(), jax.tree.map(jnp.mean, metrics)
