"""Transitions under other goals than those that were desired, where a relabelling gives them some."""

from collections.abc import Callable

import flax.struct
import jax

from infogoal_jax import replay
from infogoal_jax.goals import select
from infogoal_jax.relabelling.relabelling import Relabelling
from infogoal_jax.train.experience import Experience, external_reward
from infogoal_jax.train.parts import Setup

CHOICES_AT_ONCE = 10  # A matrix of 512 candidates by 512 for each, 1 MiB.


@flax.struct.dataclass
class RelabelledBatch:
    """Steps of a `Sample` under goals of which some were achieved later: as much of such transitions, and of their
    rewards, as changes.

    desired_goal: [B, *shape].
    next_observation: [B, ...].
    mask, external: float32 [B, n].
    terminated: bool [B].
    """

    desired_goal: jax.Array
    next_observation: jax.Array
    mask: jax.Array
    terminated: jax.Array
    external: jax.Array


def with_relabelled_goals(
    setup: Setup, experience: Experience, key: jax.Array, row: jax.Array, step: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The transitions that are learned from, among those that start at these rows and steps [B], and the goals that
    they are given."""
    relabelling, (relabel_key, choose_key) = setup.parts.relabelling, jax.random.split(key)
    collected_goal = experience.buffer.desired_goal[row, step]
    desired_goal = relabelling.relabel(relabel_key, experience.relabelling, row, step, collected_goal)
    if relabelling.skip_reached:
        before = jax.tree.map(lambda leaf: leaf[row, step], experience.buffer.record)
        desired_goal = select(setup.env.reached(before, desired_goal), collected_goal, desired_goal)
    if relabelling.choose is None:
        return row, step, desired_goal
    kept = relabelling.choose(choose_key, experience.relabelling, row, step, desired_goal)
    return row[kept], step[kept], desired_goal[kept]


def relabel_for_learner(
    setup: Setup,
    experience: Experience,
    key: jax.Array,
    row: jax.Array,
    step: jax.Array,
    desired_goal: jax.Array,
    ends: Callable | None,
) -> RelabelledBatch:
    """The transitions that start at these rows and steps [B] under the goals of the learner's own relabelling. ends: as
    `replay.transitions_at` takes it."""
    relabelling, num_steps = setup.parts.learner.sample_spec.relabelling, setup.parts.agent.num_steps
    relabelled_goal = relabelling.relabel(key, experience.learner_relabelling, row, step, desired_goal)
    found = replay.transitions_at(experience.buffer, row, step, num_steps, relabelled_goal, ends)
    return RelabelledBatch(
        found.desired_goal, found.next_observation, found.mask, found.terminated, external_reward(setup.env, found)
    )


def draws_at_once(relabelling: Relabelling | None, count: int) -> int:
    """How many updates' samples are drawn side by side: all of them, but for a relabelling that compares candidates,
    whose tables take memory."""
    return count if relabelling is None or relabelling.choose is None else min(count, CHOICES_AT_ONCE)
