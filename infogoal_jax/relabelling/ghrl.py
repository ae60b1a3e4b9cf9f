"""GHRL, generalized hindsight (Li, Pinto, Abbeel 2020), by approximate inverse reinforcement learning.

In the original, `choice = "best"`, an episode gets the goal that it demonstrates best: not the goal that it reached
first, but the goal that it reached sooner than most other episodes. The agent learns from its own goal and from this
one. InfoGoal's authors compare with something simpler under this name, which reaches more validation goals here
(docs/research/trials.md): any goal of the episode, at its first occurrence.
"""

import dataclasses
import functools
from typing import Literal

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import replay
from infogoal_jax.errors import require
from infogoal_jax.field_types import Share
from infogoal_jax.pairs import KnownGoals
from infogoal_jax.relabelling import her
from infogoal_jax.relabelling.relabelling import Context, Relabelling, check_room

VALUES_AT_ONCE = 256  # Episodes whose first observations and goals are encoded together; they may be images.


@dataclasses.dataclass(frozen=True)
class GHRLConfig:
    """Shares of the transitions that get another goal, and which goals are accepted."""

    share: Share = 0.5
    """Share that gets a goal of its episode, if that comes later. With 0.5, original and relabelled ones count equally,
    as in the code of GHRL's authors."""
    random_share: Share = 0.0
    """Share that gets any known goal, as in HER. These are mostly failures, which offline learning sees nowhere
    else."""
    choice: Literal["first_occurrence", "best"] = "first_occurrence"
    """`first_occurrence`: any goal that the episode achieved, each equally likely, at its first occurrence [A]; `best`:
    the goal that it demonstrates best, as in the original."""
    filter: Literal["none", "advantage"] = "none"
    """`advantage` accepts a goal only if the episode's return for it is no less than the policy's value at its
    start; with choice `best` alone."""

    def check(self, config) -> None:
        """Raise `UserError` for what does not go together."""
        check_room("random_share", self.random_share, "share", self.share)
        require(
            self.choice == "best" or self.filter == "none",
            "relabelling.filter",
            self.filter,
            "goes with relabelling.choice = best alone: give that too, or relabelling.filter = none",
        )


@flax.struct.dataclass
class Table:
    """What the draws of an epoch need."""

    goal: jax.Array
    """int32 [R, T + 1], best goal of the episode of each step."""
    hit: jax.Array
    """int32 [R, T + 1], step at which the episode first reached it; -1 without such a goal."""
    known: KnownGoals
    """Goals that may be drawn at random."""


def best_goals(context: Context) -> Table:
    """The goal that each episode demonstrates best. As in the authors' code episodes are ranked by their returns for
    each goal, and an episode gets the goal in which it ranks highest, of equal ranks that of the largest return. Two
    things differ.

    - Only goals that the episode reached can be chosen. With sparse rewards the authors' code may choose a goal that
      was never reached, by the order of zeros.
    - Equal returns have equal ranks: the number of episodes with a smaller return. Order then does not matter, and
      counting hits by goal and delay replaces sorting.

    All stored episodes are compared; the authors stop at 500 trajectories, because they compute each reward. A goal
    that held at the start of the episode does not count, because no transition led there. The end of a row cuts its
    last episode in two.
    """
    rows, achieved = context.rows, context.achievements
    num_rows, length, several = achieved.goals.shape
    num_goals = achieved.known.mask.shape[0]
    led_to = jnp.pad(rows.valid & context.written[:, None], ((0, 0), (1, 0)))  # States that a transition led to.
    begin = her.episode_starts(rows)
    at_start = jax.tree.map(
        lambda leaf: leaf[jnp.arange(num_rows, dtype=jnp.int32)[:, None], begin][:, :, None], rows.record
    )
    again = context.reached(at_start, jnp.maximum(achieved.goals, 0))
    seen = her.occurrences(jnp.where(led_to[..., None] & ~again, achieved.goals, -1), rows, num_goals)
    first, start = seen.size > 0, jnp.repeat(begin, several, axis=1)
    delay = jnp.where(first, seen.step - start, 0)  # Transitions until the goal was reached, from 1.
    hits = (
        jnp.zeros((num_goals, length), jnp.int32).at[jnp.where(first, seen.goal, num_goals), delay].add(1, mode="drop")
    )
    num_episodes = (led_to[:, 1:] & ~led_to[:, :-1]).sum(dtype=jnp.int32)
    # Episodes that were slower, or never got there.
    rank = num_episodes - jnp.cumsum(hits, axis=1, dtype=jnp.int32)[jnp.minimum(seen.goal, num_goals - 1), delay]

    # Among equal ranks the larger return, which is the shorter delay.
    score = jnp.where(first, rank * length - delay, -length)
    number = jnp.arange(num_rows, dtype=jnp.int32)[:, None] * length + begin

    def over_episodes(reduce, values):
        """Reduce values [R, (T + 1) K], K for each step, over each episode, and repeat the result at every place of the
        episode."""
        episode = jnp.repeat(number, values.shape[1] // length, axis=1).reshape(-1)
        return reduce(values.reshape(-1), episode, num_rows * length, indices_are_sorted=True)[episode].reshape(
            values.shape
        )

    best = first & (score == over_episodes(jax.ops.segment_max, score))
    goal = over_episodes(jax.ops.segment_min, jnp.where(best, seen.goal, num_goals))  # Then the first goal.
    goal = goal[:, ::several]  # An episode has all places of its steps, in order.
    at_goal = context.reached(rows.record, jnp.minimum(goal, num_goals - 1)) & led_to & (goal < num_goals)
    hit = over_episodes(jax.ops.segment_min, jnp.where(at_goal, jnp.arange(length, dtype=jnp.int32), length))
    found = hit < length  # The environment may call a goal reached before the record is nearest to it.
    return Table(jnp.where(found, goal, -1), jnp.where(found, hit, -1), achieved.known)


def accepted(context: Context, table: Table) -> jax.Array:
    """Whether an episode's return for its best goal is at least the value of the policy at its start: bool [R, T + 1],
    true at starts only."""
    shape = table.hit.shape
    starts = her.episode_starts(context.rows) == jnp.arange(shape[1], dtype=jnp.int32)
    count = replay.running_count(starts & (table.hit >= 0))

    def some(number, passed):
        rank = number * VALUES_AT_ONCE + jnp.arange(VALUES_AT_ONCE, dtype=jnp.int32)
        # Beyond the end for ranks that do not exist: dropped below.
        place = jnp.searchsorted(count, rank, side="right")
        row, step = jnp.unravel_index(jnp.minimum(place, count.shape[0] - 1), shape)
        value = context.value(
            jax.tree.map(lambda leaf: leaf[row, step], context.rows.observation), jnp.maximum(table.goal[row, step], 0)
        )
        return passed.at[place].set(context.discount ** (table.hit[row, step] - step - 1) >= value, mode="drop")

    chunks = (count[-1] + VALUES_AT_ONCE - 1) // VALUES_AT_ONCE
    return jax.lax.fori_loop(0, chunks, some, jnp.zeros(count.shape[0], bool)).reshape(shape)


def make(config: GHRLConfig) -> Relabelling:
    """GHRL for goals that are indices. Transitions after the episode first reached the goal keep their own: reaching a
    goal ends an episode."""
    if config.choice == "first_occurrence":
        first_goal = functools.partial(her.prefix_goal, first_occurrence=True)
        return Relabelling(her.prefixes, her.relabel_shares(first_goal, config.share, config.random_share))

    def prepare(context):
        table = best_goals(context)
        if config.filter == "none":
            return table
        start = her.episode_starts(context.rows)
        return table.replace(hit=jnp.where(jnp.take_along_axis(accepted(context, table), start, axis=1), table.hit, -1))

    def relabel(key, table, row, step, desired_goal):
        random_key, choose_key = jax.random.split(key)
        anything = her.any_known(random_key, table.known, desired_goal)
        drawn = jax.random.uniform(choose_key, desired_goal.shape, jnp.float32)
        is_hit = (drawn < config.share) & (step < table.hit[row, step])
        desired_goal = jnp.where(is_hit, table.goal[row, step], desired_goal)
        return jnp.where(drawn >= 1.0 - config.random_share, anything, desired_goal)

    return Relabelling(prepare, relabel)
