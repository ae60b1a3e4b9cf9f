"""What one update learns from: transitions, some of them under other goals, with rewards, and goal pairs for the
learner."""

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import pairs as goal_pairs
from infogoal_jax import replay
from infogoal_jax.goals import is_goal, same, select, with_placeholders
from infogoal_jax.keys import draw_chance
from infogoal_jax.pairs import GoalPairs
from infogoal_jax.relabelling.relabelling import Relabelling
from infogoal_jax.replay import Transitions
from infogoal_jax.train.costs import costs_of, learns_from_costs
from infogoal_jax.train.dissimilar import sample_apart, sample_pairs_by_distance
from infogoal_jax.train.experience import Experience, usable_goals
from infogoal_jax.train.many_goals import draw_goals
from infogoal_jax.train.parts import Setup, spec_of

CHOICES_AT_ONCE = 10  # A matrix of 512 candidates by 512 for each, 1 MiB.


@flax.struct.dataclass
class RelabelledBatch:
    """Steps of a `Sample` under goals of which some were achieved later: as much of such transitions, and of their
    rewards, as changes.

    goal: [B, *shape]; next_observation: [B, ...]; mask, external: float32 [B, n]; terminated: bool [B].
    """

    goal: jax.Array
    next_observation: jax.Array
    mask: jax.Array
    terminated: jax.Array
    external: jax.Array


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
    goal_share: jax.Array | None = None
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
    buffer, num_steps, goal = experience.buffer, parts.agent.num_steps, None
    candidates = parts.config.batch_size * (1 if relabelling is None else relabelling.candidates)
    row, step = replay.draw(transition_key, experience.decision_count, candidates, buffer.valid.shape[1])
    if env.recorded is not None:
        # Recorded episodes did not end where their goal was reached; what is drawn from them does.
        goal = buffer.goal[row, step]
    if relabelling is not None:
        row, step, goal = with_relabelled_goals(setup, experience, relabel_key, row, step)
    ends = env.reached if env.ends_at_goal else None
    drawn = with_rewards(setup, replay.transitions_at(buffer, row, step, num_steps, goal, ends))
    if learns_from_costs(relabelling):
        costs_key = jax.random.fold_in(key, 6)
        drawn = drawn.replace(**costs_of(setup, experience, costs_key, drawn.transitions, row, step))
    spec, goals_key = parts.learner.sample_spec, jax.random.fold_in(key, 3)
    if spec.num_pairs:
        drawn = drawn.replace(pairs=sample_pairs(setup, experience, pair_key))
    if spec.num_goals:
        drawn = drawn.replace(goals=draw_goals_to_learn(setup, experience, goals_key, spec.num_goals))
    if spec_of(parts) is not None:
        known, many_key = goals_to_learn(setup, experience), jax.random.fold_in(key, 5)
        goals, share = draw_goals(spec_of(parts), known, drawn.achieved, buffer.goal[row, step], many_key)
        drawn = drawn.replace(all_goals=goals, goal_share=share)
    if spec.first_seen:
        ahead = jnp.arange(num_steps, dtype=jnp.int32)[None]
        led_to = jnp.minimum(step[:, None] + 1 + ahead, buffer.valid.shape[1])
        drawn = drawn.replace(first_seen=experience.first_seen[row[:, None], led_to])
    if spec.relabelling is not None:
        other = spec.relabelling.relabel(
            jax.random.fold_in(key, 4), experience.learner_relabelling, row, step, drawn.transitions.goal
        )
        relabelled = with_rewards(setup, replay.transitions_at(buffer, row, step, num_steps, other, ends))
        kept = {
            name: getattr(relabelled.transitions, name) for name in ("goal", "next_observation", "mask", "terminated")
        }
        drawn = drawn.replace(relabelled=RelabelledBatch(**kept, external=relabelled.external))
    if parts.explorer is not None:
        ahead = jnp.arange(num_steps, dtype=jnp.int32)[None]
        taken = jnp.minimum(step[:, None] + ahead, buffer.valid.shape[1] - 1)
        place = row[:, None], taken
        bonus = experience.bonus[buffer.observation[place], buffer.action[place]]
        drawn = drawn.replace(
            bonus=bonus,
            move=(buffer.observation[row, step], buffer.action[row, step], buffer.observation[row, step + 1]),
        )
    return drawn


def goals_to_learn(setup: Setup, experience: Experience) -> jax.Array:
    """Goals of a finite set that something may be learned of: known ones, and those that are desired from the start;
    bool [N]."""
    return experience.known.mask | setup.env.goals.desired_mask


def draw_goals_to_learn(setup: Setup, experience: Experience, key: jax.Array, num: int) -> jax.Array:
    """Goals [num, *shape] that something may be learned of: known ones and training goals. In a continuous space half
    of them are of each kind."""
    if setup.env.goals.finite:
        return goal_pairs.choose_from_mask(key, goals_to_learn(setup, experience), (num,))
    known_key, desired_key, choose_key = jax.random.split(key, 3)
    desired_goal = jax.vmap(setup.env.goals.draw)(jax.random.split(desired_key, num))
    take_known = draw_chance(choose_key, 0.5, (num,)) & experience.known.any()
    return select(take_known, experience.known.draw(known_key, (num,)), desired_goal)


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


def with_relabelled_goals(
    setup: Setup, experience: Experience, key: jax.Array, row: jax.Array, step: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The transitions that are learned from, among those that start at these rows and steps [B], and the goals that
    they are given."""
    relabelling, (relabel_key, choose_key) = setup.parts.relabelling, jax.random.split(key)
    desired_goal = experience.buffer.goal[row, step]
    goal = relabelling.relabel(relabel_key, experience.relabelling, row, step, desired_goal)
    if relabelling.skip_reached:
        before = jax.tree.map(lambda leaf: leaf[row, step], experience.buffer.record)
        goal = select(setup.env.reached(before, goal), desired_goal, goal)
    if relabelling.choose is None:
        return row, step, goal
    kept = relabelling.choose(choose_key, experience.relabelling, row, step, goal)
    return row[kept], step[kept], goal[kept]


def with_rewards(setup: Setup, transitions: Transitions) -> Sample:
    """The transitions with their rewards (Eq. 5: 1 for reaching the goal) and with what was achieved."""
    external = setup.env.reached(transitions.records, transitions.goal[:, None]).astype(jnp.float32)
    return Sample(transitions, external, usable_goals(setup, transitions.records), pairs=None)


def draws_at_once(relabelling: Relabelling | None, count: int) -> int:
    """How many updates' samples are drawn side by side: all of them, but for a relabelling that compares candidates,
    whose tables take memory."""
    return count if relabelling is None or relabelling.choose is None else min(count, CHOICES_AT_ONCE)
