"""Goals as OGBench samples them (Park et al. 2025, arXiv 2410.20092, `GCDataset`): those that values are learned for
are a mixture of the goal that is achieved now, one that the episode achieves later, and any; the actor has goals of
its own. Every step costs 1 until the goal.

Four things differ from its code. A goal of a task that can be acted in is achieved within its radius, there by the
very state alone. A later step is drawn uniformly; there the first and the last are half as likely. What the last
observation of an episode achieves is a goal too, which it is never there. Current and later steps that achieve nothing
known keep their goal, and are no subgoals.
"""

import dataclasses

import jax
import jax.numpy as jnp

from infogoal_jax import pairs
from infogoal_jax.errors import require
from infogoal_jax.field_types import Count, Share
from infogoal_jax.goals import is_goal, select
from infogoal_jax.relabelling.her import Soon, any_known, draw_rank, future_goal, future_place
from infogoal_jax.relabelling.relabelling import Context, Relabelling, Waypoints, check_room


@dataclasses.dataclass(frozen=True)
class MixedConfig:
    """Shares of the goals, OGBench's own for GCIVL, GCIQL and HIQL."""

    current_share: Share = 0.2
    """Share of the goals of values that are achieved now already."""
    future_share: Share = 0.5
    """Share of them that the episode achieves later; the rest is any known goal."""
    geometric: bool = True
    """Whether each later step is less likely by the discount than the one before it, what lies beyond the end of the
    episode counting as its last; else all are equally likely."""
    actor_future_share: Share = 1.0
    """Share of the actor's goals that the episode achieves later; the rest is any known goal. OGBench has 0.5 for its
    datasets that have to be stitched."""
    actor_geometric: bool = False
    """As `geometric`, of the actor's goals."""
    subgoal_steps: Count = 0
    """Steps after which a state is a subgoal, for agent hiql; 0: none."""

    def check(self, config) -> None:
        """Raise `UserError` for shares that are more than all, and for returns of several steps."""
        check_room("future_share", self.future_share, "current_share", self.current_share)
        steps = getattr(config.agent, "num_steps", 1)
        require(steps == 1, "agent.num_steps", steps, "relabelling mixed counts the cost of one step; give 1")


def until_the_end(discount: jax.Array):
    """A rank as `her.draw_rank`, by a geometric distribution whose tail counts as the last rank."""

    def draw(key, before, until):
        drawn = jax.random.uniform(key, before.shape, jnp.float32)
        ahead = jnp.floor(jnp.log1p(-drawn) / jnp.log(discount)).astype(jnp.int32)
        return before + jnp.clip(ahead, 0, jnp.maximum(until - before, 1) - 1)

    return draw


def later(table: Soon, geometric: bool):
    """What chooses a later step, see `her.future_goal`."""
    return until_the_end(table.discount) if geometric else draw_rank


def make(config: MixedConfig) -> Relabelling:
    """The mixture of this configuration."""

    def mixture(key, table, row, step, desired_goal, current: float, future: float, geometric: bool):
        keys = jax.random.split(key, 4)
        achieved = table.achievements
        ahead = future_goal(keys[0], achieved, row, step, later(table, geometric))
        now = pairs.choose_goal(keys[1], achieved.goals[row, step])
        drawn = jax.random.uniform(keys[3], row.shape, jnp.float32)
        anything = any_known(keys[2], achieved.known, desired_goal)
        of_episode = select(drawn < current, now, ahead)
        of_episode = select(is_goal(of_episode), of_episode, desired_goal)
        return select(drawn < current + future, of_episode, anything)

    def relabel(key, table, row, step, desired_goal):
        return mixture(key, table, row, step, desired_goal, config.current_share, config.future_share, config.geometric)

    def actor_goal(key, table, row, step, desired_goal):
        future, geometric = config.actor_future_share, config.actor_geometric
        return mixture(key, table, row, step, desired_goal, 0.0, future, geometric), None

    def actor_goal_with_waypoints(key, table, row, step, desired_goal):
        keys, achieved = jax.random.split(key, 6), table.achievements
        place, found = future_place(keys[0], achieved, row, step, later(table, config.actor_geometric))
        from_episode = found & (jax.random.uniform(keys[1], row.shape, jnp.float32) < config.actor_future_share)
        end, ahead = step + achieved.steps_left[row, step], step + config.subgoal_steps
        of_goal = jnp.where(from_episode, place - row * achieved.goals.shape[1], end)

        def achieved_at(key, step):
            return pairs.choose_goal(key, achieved.goals[row, step])

        anything = any_known(keys[2], achieved.known, desired_goal)
        low_step, high_step = jnp.minimum(ahead, end), jnp.minimum(ahead, of_goal)
        of_actor = select(from_episode, achieved_at(keys[3], of_goal), anything)
        return of_actor, Waypoints(achieved_at(keys[4], low_step), high_step, achieved_at(keys[5], high_step))

    def prepare(context: Context) -> Soon:
        return Soon(context.achievements, context.discount)

    return Relabelling(prepare, relabel, costs=actor_goal_with_waypoints if config.subgoal_steps else actor_goal)
