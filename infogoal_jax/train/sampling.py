"""What one update learns from: transitions, some of them under other goals, with rewards, and goal pairs for the
learner."""

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import pairs as goal_pairs
from infogoal_jax import replay
from infogoal_jax.goals import is_goal, same, with_placeholders
from infogoal_jax.pairs import GoalPairs
from infogoal_jax.replay import Transitions
from infogoal_jax.train.costs import learns_from_costs, sample_costs
from infogoal_jax.train.dissimilar import sample_apart, sample_pairs_by_distance
from infogoal_jax.train.experience import Experience, external_reward, usable_goals
from infogoal_jax.train.exploring import steps_explored
from infogoal_jax.train.many_goals import draw_goals, draw_goals_to_learn, goals_to_learn
from infogoal_jax.train.parts import Setup
from infogoal_jax.train.relabelled import RelabelledBatch, relabel_for_learner, with_relabelled_goals


@flax.struct.dataclass
class Sample:
    """What one update learns from: indices and small vectors, so that those of a whole epoch are drawn at once, outside
    of the loop over updates."""

    transitions: Transitions
    """B of them."""
    external: jax.Array
    """float32 [B, n], the environment's reward for each step."""
    achieved: jax.Array
    """[B, n, K, *shape], the known goals that were achieved after each step, padded with "no goal"."""
    pairs: GoalPairs | None
    """Pairs of goals, as the learner asks for them; None without."""
    goals: jax.Array | None = None
    """[M, *shape], known goals, as many as the learner asks for."""
    first_seen: jax.Array | None = None
    """float32 [B, n], as in `Visited`; None unless the learner asks for it."""
    bonus: jax.Array | None = None
    """float32 [B, n], of each step; None without an explorer."""
    move: tuple | None = None
    """The first step of each, as (observation, action, next observation) [B]; None without an explorer."""
    relabelled: RelabelledBatch | None = None
    """The same steps as the learner's loss sees them, some under goals achieved later; None where it sees what the
    agent sees."""
    all_goals: jax.Array | None = None
    """int32 [G], the goals that the agent learns every transition from; None without, or for all of the task."""
    goal_weight: jax.Array | None = None
    """float32 [G], of each of these goals in the agent's loss, as in `AllGoals`; None without."""
    actor_goal: jax.Array | None = None
    """[B, *shape], the goals that the actor learns for; None: those of the transitions."""
    waypoints: tuple | None = None
    """(goal, goal on the way to the actor's, observation there) [B], as in `relabelling.Waypoints`; None without."""


def sample(setup: Setup, experience: Experience, key: jax.Array) -> Sample:
    """Draw what one update learns from: transitions, some of them under other goals, and goal pairs."""
    parts, _, env = setup
    relabelling = parts.relabelling
    transition_key, relabel_key, pair_key = jax.random.split(key, 3)
    buffer, num_steps, desired_goal = experience.buffer, parts.agent.num_steps, None
    candidates = parts.config.batch_size * (1 if relabelling is None else relabelling.candidates)
    row, step = replay.draw(transition_key, experience.decision_count, candidates, buffer.valid.shape[1])
    if env.recorded is not None:
        # Recorded episodes did not end where their goal was reached; what is drawn from them does.
        desired_goal = buffer.desired_goal[row, step]
    if relabelling is not None:
        row, step, desired_goal = with_relabelled_goals(setup, experience, relabel_key, row, step)
    ends = env.reached if env.ends_at_goal else None
    transitions = replay.transitions_at(buffer, row, step, num_steps, desired_goal, ends)
    drawn = Sample(transitions, external_reward(env, transitions), usable_goals(setup, transitions.records), pairs=None)
    if learns_from_costs(relabelling):
        costs_key = jax.random.fold_in(key, 6)
        drawn = drawn.replace(**sample_costs(setup, experience, costs_key, drawn.transitions, row, step))
    spec, goals_key = parts.learner.sample_spec, jax.random.fold_in(key, 3)
    if spec.num_pairs:
        drawn = drawn.replace(pairs=sample_pairs(setup, experience, pair_key))
    if spec.num_goals:
        drawn = drawn.replace(goals=draw_goals_to_learn(setup, experience, goals_key, spec.num_goals))
    if parts.agent.all_goals is not None:
        known, many_key = goals_to_learn(setup, experience), jax.random.fold_in(key, 5)
        collected = buffer.desired_goal[row, step]
        goals, weight = draw_goals(parts.agent.all_goals, known, drawn.achieved, collected, many_key)
        drawn = drawn.replace(all_goals=goals, goal_weight=weight)
    if spec.first_seen:
        ahead = jnp.arange(num_steps, dtype=jnp.int32)[None]
        led_to = jnp.minimum(step[:, None] + 1 + ahead, buffer.valid.shape[1])
        drawn = drawn.replace(first_seen=experience.first_seen[row[:, None], led_to])
    if spec.relabelling is not None:
        key_of_goals, given = jax.random.fold_in(key, 4), drawn.transitions.desired_goal
        relabelled = relabel_for_learner(setup, experience, key_of_goals, row, step, given, ends)
        drawn = drawn.replace(relabelled=relabelled)
    if parts.explorer is not None:
        drawn = drawn.replace(**steps_explored(experience.bonus, buffer, row, step, num_steps))
    return drawn


def sample_pairs(setup: Setup, experience: Experience, key: jax.Array) -> GoalPairs:
    """Goal pairs for the contrastive bound, as the learner's `SampleSpec` asks (Algorithm 1, lines 16 to 20)."""
    parts, _, env = setup
    if parts.learner.sample_spec.radius is not None:
        return sample_pairs_by_distance(setup, experience, key)
    spec, buffer, count = parts.learner.sample_spec, experience.buffer, experience.achieved_count
    keys, shape = (
        jax.random.split(key, 5),
        (parts.learner.sample_spec.num_pairs, parts.learner.sample_spec.num_negatives),
    )
    row, first, second = replay.sample_within_window(
        keys[0], buffer, experience.achieved, count, spec.num_pairs, spec.window
    )
    records = jax.tree.map(lambda leaf: jnp.stack([leaf[row, first], leaf[row, second]]), buffer.record)
    anchor, positive = jax.vmap(goal_pairs.choose_goal)(keys[1:3], usable_goals(setup, records))
    # Else the draw has nothing to choose from, and returned a row not written yet.
    any_achieved = count[-1] > 0
    positive_weight = (is_goal(anchor) & is_goal(positive) & any_achieved).astype(jnp.float32)
    anchor, positive = with_placeholders(anchor), with_placeholders(positive)
    place = row[:, None], first[:, None]
    contrast = jnp.broadcast_to(anchor[:, None], (*shape, *anchor.shape[1:]))
    if not spec.anchored and env.goals.finite:
        contrast = experience.known.draw(keys[3], shape)
    elif not spec.anchored:
        place_key, goal_key = jax.random.split(keys[3])
        place = replay.draw(place_key, count, shape, buffer.valid.shape[1] + 1)
        contrast = with_placeholders(goal_pairs.choose_goal(goal_key, experience.known.goals[place]))
    if not spec.dissimilar:
        # Any known goal, similar ones too; only where it is the very goal that it would be compared with, it is none.
        negative = experience.known.draw(keys[4], shape)
        known = experience.known.mask[negative] if env.goals.finite else any_achieved & is_goal(negative)
        negative_weight = (known & ~same(negative, contrast)).astype(jnp.float32)
    elif env.goals.finite:
        negative, negative_weight = goal_pairs.sample_negatives(
            keys[4], experience.dissimilarity, experience.known.mask, contrast
        )
    else:
        negative, negative_weight = sample_apart(setup, experience, keys[4], place, contrast)
    other = None
    if spec.dissimilar_by == "classifier":
        other = with_placeholders(experience.known.draw(jax.random.fold_in(key, 5), (spec.num_pairs,)))
    return GoalPairs(anchor, positive, contrast, with_placeholders(negative), positive_weight, negative_weight, other)
