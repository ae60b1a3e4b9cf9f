"""Hindsight experience replay (Andrychowicz et al. 2017): a transition is given a goal that its own episode achieved later (strategy `future`)."""

import dataclasses

import jax
import jax.numpy as jnp

from infogoal_jax import pairs
from infogoal_jax.errors import require
from infogoal_jax.hindsight.relabelling import Achievements, Hindsight
from infogoal_jax.replay import Rows


@dataclasses.dataclass(frozen=True)
class HERConfig:
    """Shares of the transitions that are given another goal."""

    future_share: float = 0.8
    """Share that is given a goal achieved later in the same episode (four of five, as in the paper on HER)."""
    random_share: float = 0.0
    """Share that is given any known goal: mostly failures, which offline learning sees nowhere else."""

    def check(self, config) -> None:
        """Raise `UserError` for values out of range."""
        for name in ("future_share", "random_share"):
            require(0 <= getattr(self, name) <= 1, f"hindsight.{name}", getattr(self, name), "give a share from 0 to 1")
        require(self.future_share + self.random_share <= 1, "hindsight.random_share", self.random_share,
                f"must leave room for future_share = {self.future_share}: together at most 1")


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


def future_goal(key: jax.Array, achievements: Achievements, row: jax.Array, step: jax.Array) -> jax.Array:
    """A goal achieved after `step` in the same episode, int32 [B]; -1 where none was.

    The step is uniform among those at which something was achieved, the goal among those achieved there.
    """
    choose_step, choose_goal = jax.random.split(key)
    width = achievements.goals.shape[1]
    here = row * width + step
    before, until = achievements.count[here], achievements.count[here + achievements.steps_left[row, step]]
    rank = jax.random.randint(choose_step, row.shape, before, jnp.maximum(until, before + 1))
    place = jnp.minimum(jnp.searchsorted(achievements.count, rank, side="right"), achievements.count.shape[0] - 1)
    goals = achievements.goals.reshape(-1, achievements.goals.shape[-1])[place]
    return jnp.where(until > before, pairs.choose_goal(choose_goal, goals), -1)


def make(config: HERConfig) -> Hindsight:
    """HER for goals that are indices."""

    def relabel_goals(key, achievements, row, step, goal):
        future_key, random_key, choose_key = jax.random.split(key, 3)
        later = future_goal(future_key, achievements, row, step)
        anything = pairs.choose_from_mask(random_key, achievements.known, goal.shape)
        share = jax.random.uniform(choose_key, goal.shape)
        goal = jnp.where((share < config.future_share) & (later >= 0), later, goal)
        return jnp.where(share >= 1.0 - config.random_share, anything, goal)

    return Hindsight(lambda context: context.achievements, relabel_goals)
