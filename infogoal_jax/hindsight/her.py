"""Hindsight experience replay (Andrychowicz et al. 2017): a transition is given a goal that its own episode achieved later (strategy `future`)."""

import jax
import jax.numpy as jnp

from infogoal_jax.replay import Rows


def future_record(key: jax.Array, buffer: Rows, steps_left: jax.Array, row: jax.Array, step: jax.Array):
    """What was achieved at a step uniform among those after `step` in the same episode: records [B, ...].

    steps_left: int32 [R, T] of `replay.steps_left`; row, step: int32 [B], valid transitions.
    """
    ahead = jax.random.randint(key, row.shape, 1, jnp.maximum(steps_left[row, step], 1) + 1)
    return jax.tree.map(lambda leaf: leaf[row, step + ahead], buffer.record)


def relabel(key: jax.Array, goal: jax.Array, achieved_later: jax.Array, share: float) -> jax.Array:
    """Goals [B, ...] of which `share` are replaced by those achieved later [B, ...]."""
    chosen = jax.random.bernoulli(key, share, goal.shape[:1]).reshape(-1, *[1] * (goal.ndim - 1))
    return jnp.where(chosen, achieved_later, goal)
