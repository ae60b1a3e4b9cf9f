"""What learners share, so that methods differ in nothing else: the configuration of the goal encoder, and measures of
its codes: information about the goal, and how well goals are told apart."""

import dataclasses

import jax
import jax.numpy as jnp

from infogoal_jax.errors import require
from infogoal_jax.field_types import Size, Sizes
from infogoal_jax.learners.learner import GoalCode


@dataclasses.dataclass(frozen=True)
class GoalEncoderConfig:
    """Sizes of the goal encoder."""

    latent_size: Size = 32
    """Size d of the goal code [A]."""
    hidden: Sizes = (128, 128, 128)
    """Widths of the goal encoder's layers [A]. A decoder has them in reverse order."""
    standardise_images: bool = False
    """Give every goal image the same mean and contrast before it is encoded. This makes codes robust to corruption
    (docs/reference/fetch.md)."""


def check_window(learner, config) -> None:
    """Raise `UserError` for a window to pair goals within that is longer than an episode."""
    require(
        0 <= learner.window <= config.env.episode_length,
        "learner.window",
        learner.window,
        f"must lie between 0 and the episode length, {config.env.episode_length}",
    )


def log_score(first: jax.Array, second: jax.Array) -> jax.Array:
    """log f(z, z') of codes [..., d]: minus the mean absolute difference (the authors' score, without parameters)."""
    return -jnp.abs(first - second).mean(-1)


def contrastive_bound(positive: jax.Array, negative: jax.Array) -> jax.Array:
    """log f+ / (f+ + sum f-), the term of Theorem 3, for log scores [B] and [B, K]. Plus log(K + 1) it is the InfoNCE
    bound on mutual information."""
    return positive - jax.nn.logsumexp(jnp.concatenate([positive[..., None], negative], axis=-1), axis=-1)


def kl_to_standard_normal(code: GoalCode) -> jax.Array:
    """KL(N(mean, std^2) || N(0, I)) in nats, summed over the last axis (Eq. 11)."""
    return 0.5 * (code.mean**2 + code.std**2 - 1.0 - 2.0 * jnp.log(code.std)).sum(-1)


def warmed_up(updates: jax.Array, warm_up: int) -> jax.Array:
    """Weight of a KL after this many updates, a scalar: it rises linearly from 0 to 1 over the first `warm_up`
    updates."""
    return jnp.minimum(1.0, (updates + 1) / max(1, warm_up))


def weighted_mean(values: jax.Array, weights: jax.Array) -> jax.Array:
    """Weighted mean; 0 if all weights are 0."""
    values, weights = values.astype(jnp.float32), weights.astype(jnp.float32)
    return (values * weights).sum() / jnp.maximum(weights.sum(), 1.0)
