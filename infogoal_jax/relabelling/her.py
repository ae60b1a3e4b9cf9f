"""HER, hindsight experience replay (Andrychowicz et al. 2017): a transition gets a goal that its episode achieved
later.

`future` is the paper's strategy: draw a later step, then a goal achieved there. `prefix` is the strategy of InfoGoal's
authors for graphs: draw one of the goals that the episode achieved, each equally likely however long it stayed in view,
then one of its occurrences. The transitions before that occurrence get the goal.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import pairs, replay
from infogoal_jax.errors import require
from infogoal_jax.field_types import Share
from infogoal_jax.goals import axes_of, is_goal, no_goals_like, select
from infogoal_jax.relabelling.relabelling import Achievements, Context, Relabelling, check_room
from infogoal_jax.replay import Trajectories


@dataclasses.dataclass(frozen=True)
class HERConfig:
    """Shares of the transitions that get another goal."""

    future_share: Share = 0.8
    """Share that gets a goal achieved later in the same episode (four of five, as in the paper on HER)."""
    random_share: Share = 0.0
    """Share that gets any known goal. These are mostly failures, which offline learning sees nowhere else."""
    strategy: Literal["future", "soon", "prefix"] = "future"
    """`future`: every later step that achieves a goal is equally likely; `soon`: each is less likely by the discount
    than the one before it, as contrastive RL asks; `prefix`: every goal that the episode achieved is equally likely
    [A], for finite goals."""
    skip_reached: bool = False
    """Leave a transition the goal of its episode where the drawn one is reached before it already, as an object's place
    is until it is moved: no action is needed for such a goal (filtered HER, Manela and Biess 2019)."""

    def check(self, config) -> None:
        """Raise `UserError` for shares that are more than all."""
        check_room("random_share", self.random_share, "future_share", self.future_share)


@flax.struct.dataclass
class Occurrences:
    """What each row achieved: W = (T + 1) K entries sorted by episode, goal and step. The entries of an episode stay at
    its places in the row."""

    goal: jax.Array
    """int32 [R, W], N for none."""
    step: jax.Array
    """int32 [R, W]."""
    size: jax.Array
    """int32 [R, W]: at the first occurrence of a goal in an episode, the number of its occurrences there; 0
    elsewhere."""
    start: jax.Array
    """int32 [R, T + 1], first step of the episode of each step."""


@flax.struct.dataclass
class Prefixes:
    """What the strategy `prefix` draws from."""

    occurrences: Occurrences
    """What was achieved where."""
    count: jax.Array
    """int32 [R * W], running count of the first occurrences."""
    steps_left: jax.Array
    """int32 [R, T], as in `Achievements`."""
    known: pairs.KnownGoals
    """As in `Achievements`."""


def draw_rank(key: jax.Array, before: jax.Array, until: jax.Array) -> jax.Array:
    """A rank from `before` to below `until`, uniformly, int32 [B]."""
    return jax.random.randint(key, before.shape, before, jnp.maximum(until, before + 1), jnp.int32)


def soon(discount: jax.Array) -> Callable[[jax.Array, jax.Array, jax.Array], jax.Array]:
    """A rank as `draw_rank`, but each one further on is `discount` times as likely (a geometric distribution, cut
    off)."""

    def draw(key, before, until):
        left = jnp.maximum(until - before, 1)
        within = 1.0 - discount ** left.astype(jnp.float32)
        drawn = jax.random.uniform(key, before.shape, jnp.float32)
        ahead = jnp.floor(jnp.log1p(-drawn * within) / jnp.log(discount)).astype(jnp.int32)
        return before + jnp.clip(ahead, 0, left - 1)

    return draw


def future_goal(
    key: jax.Array, achievements: Achievements, row: jax.Array, step: jax.Array, choose: Callable = draw_rank
) -> jax.Array:
    """Draw a goal achieved after `step` in the same episode, [B, *shape]; "no goal" where there is none.

    The later step is drawn by `choose` among those that achieve a goal, the goal uniformly among those achieved there.
    """
    choose_step, choose_goal = jax.random.split(key)
    place, found = future_place(choose_step, achievements, row, step, choose)
    goals = pairs.choose_goal(choose_goal, achievements.goals.reshape(-1, *achievements.goals.shape[2:])[place])
    return select(found, goals, no_goals_like(goals))


def future_place(
    key: jax.Array, achievements: Achievements, row: jax.Array, step: jax.Array, choose: Callable
) -> tuple[jax.Array, jax.Array]:
    """Draw by `choose` a step after `step` of the same episode that achieves a goal: its place among all steps of all
    rows, int32 [B], and whether there is one, bool [B]."""
    here = row * achievements.goals.shape[1] + step
    before, until = achievements.count[here], achievements.count[here + achievements.steps_left[row, step]]
    rank = choose(key, before, until)
    place = jnp.minimum(jnp.searchsorted(achievements.count, rank, side="right"), achievements.count.shape[0] - 1)
    return place, until > before


@flax.struct.dataclass
class Soon:
    """What the strategy `soon` draws from."""

    achievements: Achievements
    """What was achieved where."""
    discount: jax.Array
    """float32 [], discount of one step."""

    @property
    def known(self) -> pairs.KnownGoals | pairs.AchievedGoals:
        """Goals that may be drawn at random."""
        return self.achievements.known

    def goal(self, key: jax.Array, row: jax.Array, step: jax.Array) -> jax.Array:
        """As `future_goal`."""
        return future_goal(key, self.achievements, row, step, soon(self.discount))


def episode_starts(rows: Trajectories) -> jax.Array:
    """The first step of the episode that each observation belongs to, int32 [R, T + 1]."""
    begins = jnp.pad(~rows.valid, ((0, 0), (1, 0)), constant_values=True)
    steps = jnp.arange(begins.shape[1], dtype=jnp.int32)[None]
    return jax.lax.cummax(jnp.where(begins, steps, 0), axis=1)


def occurrences(goals: jax.Array, rows: Trajectories, num_goals: int) -> Occurrences:
    """Where each episode of these rows achieved each goal. goals: int32 [R, T + 1, K], padded with -1."""
    length, several = goals.shape[1:]
    require(
        length**2 * (num_goals + 1) < 2**31,
        "rollout_steps",
        length - 1,
        f"with {num_goals} goals too long: what a row achieved could not be numbered in 32 bits; give less",
    )
    name = rows.episode()[..., None] * (num_goals + 1) + jnp.where(goals < 0, num_goals, goals)
    # One number sorts faster than two.
    steps = jnp.arange(length, dtype=jnp.int32)[None, :, None]
    ordered = jnp.sort((name * length + steps).reshape(-1, length * several), axis=1)
    name, step = ordered // length, ordered % length
    place, goal = jnp.arange(length * several, dtype=jnp.int32)[None], name % (num_goals + 1)
    first = jnp.pad(name[:, 1:] != name[:, :-1], ((0, 0), (1, 0)), constant_values=True)
    following = jnp.pad(
        jnp.where(first, place, length * several)[:, 1:], ((0, 0), (0, 1)), constant_values=length * several
    )
    size = jnp.where(first & (goal < num_goals), jax.lax.cummin(following, axis=1, reverse=True) - place, 0)
    return Occurrences(goal, step, size, episode_starts(rows))


def first_seen(goals: jax.Array, rows: Trajectories, num_goals: int) -> jax.Array:
    """How many goals each step was the first of its episode to achieve, float32 [R, T + 1]. goals: int32 [R, T + 1, K],
    padded with -1."""
    seen = occurrences(goals, rows, num_goals)
    row = jnp.arange(goals.shape[0], dtype=jnp.int32)[:, None]
    return jnp.zeros(goals.shape[:2], jnp.float32).at[row, seen.step].add((seen.size > 0).astype(jnp.float32))


def prefix_goal(
    key: jax.Array, table: Prefixes, row: jax.Array, step: jax.Array, first_occurrence: bool = False
) -> jax.Array:
    """Draw a goal that the episode achieved, each equally likely, and one of its occurrences, or take the first: int32
    [B]; -1 if it does not lie after `step`."""
    choose_goal, choose_occurrence = jax.random.split(key)
    seen, (length, width) = table.occurrences, (table.occurrences.start.shape[1], table.occurrences.goal.shape[1])
    several = width // length
    begin = row * width + seen.start[row, step] * several
    end = row * width + (step + table.steps_left[row, step] + 1) * several
    before, until = jnp.where(begin > 0, table.count[begin - 1], 0), table.count[end - 1]
    rank = jax.random.randint(choose_goal, row.shape, before, jnp.maximum(until, before + 1), jnp.int32)
    first = jnp.minimum(jnp.searchsorted(table.count, rank, side="right"), table.count.shape[0] - 1)
    size = jnp.maximum(seen.size.reshape(-1)[first], 1)
    place = first if first_occurrence else first + jax.random.randint(choose_occurrence, row.shape, 0, size, jnp.int32)
    return jnp.where((until > before) & (seen.step.reshape(-1)[place] > step), seen.goal.reshape(-1)[place], -1)


def prefixes(context: Context) -> Prefixes:
    """The table of an epoch for the strategy `prefix`."""
    achieved = context.achievements
    seen = occurrences(achieved.goals, context.rows, achieved.known.mask.shape[0])
    return Prefixes(seen, replay.running_count(seen.size > 0), achieved.steps_left, achieved.known)


def any_known(key: jax.Array, known: pairs.KnownGoals | pairs.AchievedGoals, goal: jax.Array) -> jax.Array:
    """Any known goal in place of each of these [B, *shape]; these themselves while no goal is known."""
    return jnp.where(known.any(), known.draw(key, axes_of(goal)), goal)


def relabel_shares(later_goal: Callable, share: float, random_share: float) -> Callable:
    """The `relabel` of a `Relabelling`: a share of the transitions gets what `later_goal` draws, if anything, and a
    share any known goal. later_goal: (key, table, row, step) -> [B, *shape], "no goal" for none."""

    def relabel_goals(key, table, row, step, desired_goal):
        later_key, random_key, choose_key = jax.random.split(key, 3)
        later = later_goal(later_key, table, row, step)
        anything = any_known(random_key, table.known, desired_goal)
        drawn = jax.random.uniform(choose_key, row.shape, jnp.float32)
        desired_goal = select((drawn < share) & is_goal(later), later, desired_goal)
        return select(drawn >= 1.0 - random_share, anything, desired_goal)

    return relabel_goals


def make(config: HERConfig) -> Relabelling:
    prepare, later_goal = {
        "future": (lambda context: context.achievements, future_goal),
        "soon": (
            lambda context: Soon(context.achievements, context.discount),
            lambda key, table, row, step: table.goal(key, row, step),
        ),
        "prefix": (prefixes, prefix_goal),
    }[config.strategy]
    relabel_goals = relabel_shares(later_goal, config.future_share, config.random_share)
    return Relabelling(prepare, relabel_goals, skip_reached=config.skip_reached)
