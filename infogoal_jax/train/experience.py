"""What an epoch learns from: the trajectories that it collects, what is learned from them without a gradient, and what
its updates sample from, with the tables of relabelling and exploration."""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import pairs, replay
from infogoal_jax.agents import traits_of
from infogoal_jax.envs.environment import Environment
from infogoal_jax.goals import is_goal, no_goals_like, select
from infogoal_jax.learners.encoding import encode_all
from infogoal_jax.learners.learner import GoalCode, NewSteps
from infogoal_jax.relabelling.her import first_seen
from infogoal_jax.relabelling.relabelling import Achievements
from infogoal_jax.replay import Trajectories, Transitions
from infogoal_jax.train.exploring import explore
from infogoal_jax.train.parts import COLLECT, CORRUPT, Setup, TrainState, numbered
from infogoal_jax.train.relabelling_context import relabelling_context
from infogoal_jax.train.rollout import collect, training_policy


@flax.struct.dataclass
class Experience:
    """What an epoch's updates sample from; fixed while they run."""

    buffer: Trajectories
    """The replay buffer, or the recorded trajectories."""
    decision_count: jax.Array
    """int32 [R * T], running count of the agent's decisions, which turns draws into binary searches; of an agent that
    learns from achieved goals (`AgentTraits`), those that lead to one."""
    achieved: jax.Array
    """bool [R, T + 1], steps that achieve a known goal."""
    achieved_count: jax.Array
    """int32 [R * (T + 1)], running count of these."""
    known: pairs.KnownGoals | pairs.AchievedGoals
    """Goals that may be drawn, for the learner's loss and by relabelling."""
    dissimilarity: jax.Array | None
    """bool [N, N], as in `TrainState`."""
    codes: GoalCode | None
    """Of all goals of a set by the epoch's first parameters, for the intrinsic reward, where there are too many goals
    to encode in every update; else None."""
    goal_params: Any = None
    """The learner's parameters at the beginning of the epoch, where it classifies goals; else None."""
    relabelling: Any = None
    """The table that the relabelling made for the epoch; None without."""
    learner_relabelling: Any = None
    """The table of the learner's own relabelling; None without."""
    bonus: jax.Array | None = None
    """float32 [K, A], the explorer's bonus of each observation and action; None without an explorer."""
    episode: jax.Array | None = None
    """int32 [R, T + 1], number of the episode that each observation belongs to; None for finite goals."""
    first_seen: jax.Array | None = None
    """float32 [R, T + 1], known goals that each step was the first of its episode to achieve; None unless the learner
    asks for them."""


def collect_epoch(setup: Setup, state: TrainState, number: jax.Array) -> tuple[TrainState, dict]:
    """Collect the rows of an epoch into the buffer."""
    env = setup.env
    collect_key = numbered(state.key, COLLECT, number)
    corruption_key = numbered(state.key, CORRUPT, number)
    acting = training_policy(setup, state.params, corruption_key)
    env_states, rows = collect(env, state.env_states, acting, collect_key, setup.config.rollout_steps)
    state = update_statistics(
        setup, state.replace(env_states=env_states, buffer=replay.add(state.buffer, rows, number)), rows
    )
    terminated, truncated = (ends.sum(dtype=jnp.int32) for ends in (rows.terminated, rows.truncated))
    ended, reached = jnp.maximum(terminated + truncated, 1), terminated
    if not env.ends_at_goal:
        reached = ended_at_goal(env, rows).sum(dtype=jnp.int32)
    counts = {}
    if not env.goals.finite:  # A step that diverged is marked invalid, and ends its episode.
        counts["collect/diverged"] = (~rows.valid & rows.truncated).sum(dtype=jnp.int32)
    return state, counts | {
        "collect/success_rate": reached.astype(jnp.float32) / ended.astype(jnp.float32),
        "collect/nothing_achieved": (~is_goal(env.goals_of(rows.record))).all(-1).mean(dtype=jnp.float32),
        "collect/valid": rows.valid.mean(dtype=jnp.float32),
        **({} if state.seen is None else {"collect/goals_seen": state.seen.sum(dtype=jnp.int32)}),
    }


def ended_at_goal(env: Environment, rows: Trajectories) -> jax.Array:
    """Whether an episode that no goal ends was at its goal when its time was up, without a failure, bool [R, T].
    A step that diverged is not valid."""
    led_to = jax.tree.map(lambda leaf: leaf[:, 1:], rows.record)
    at_goal = rows.truncated & rows.valid & env.reached(led_to, rows.desired_goal)
    return at_goal if rows.failed is None else at_goal & ~rows.failed


def update_statistics(setup: Setup, state: TrainState, rows: Trajectories) -> TrainState:
    """The state that has seen these rows: goals achieved, pairs that are no longer dissimilar, and what the agent makes
    of them."""
    parts, _, env = setup
    learner, achieved = parts.learner, achieved_goals(env, rows)
    state = state.replace(
        agent=parts.agent.observe(state.agent, rows),
        env_steps=state.env_steps + rows.valid.sum(dtype=jnp.int32),
        learner=learner.observe(
            state.learner, NewSteps(rows.desired_goal, achieved[:, 1:], env.cell_of(rows.record)[:, 1:], rows.valid)
        ),
    )
    if env.goals.finite:
        seen = jnp.where(achieved < 0, env.goals.num_goals, achieved)
        state = state.replace(seen=state.seen.at[seen].set(True, mode="drop"))
    spec = learner.sample_spec
    if not spec.num_pairs or state.dissimilarity is None or spec.radius is not None:
        return state
    similar = usable_goals(setup, achieved_goals(env, rows))
    similar = similar if env.goals.finite else env.goals.cell_of(similar)
    return state.replace(dissimilarity=pairs.remove_similar(state.dissimilarity, similar, rows.episode(), spec.window))


def first_dissimilarity(setup: Setup) -> jax.Array | None:
    """G_neg before any experience: of the goals of a set, or of the cells of a continuous space where the learner asks
    for them. Where the learner has a radius, experience does not change it."""
    goals, radius = setup.env.goals, setup.parts.learner.sample_spec.radius
    if radius is not None:
        return pairs.dissimilarity_by_distance(setup.env.goal_positions, radius)
    if goals.finite:
        return pairs.initial_dissimilarity(goals.num_goals)
    by_cells = setup.parts.learner.sample_spec.dissimilar_by == "cells"
    return pairs.initial_dissimilarity(goals.num_cells) if by_cells else None


def achieved_goals(env: Environment, rows: Trajectories) -> jax.Array:
    """Goals achieved at each place of these rows, [R, T + 1, K, *shape], padded with "no goal"; none at empty
    places."""
    goals = env.goals_of(rows.record)
    return goals if rows.there is None else select(rows.there[..., None], goals, no_goals_like(goals))


def usable_goals(setup: Setup, goals: jax.Array) -> jax.Array:
    """Those of these achieved goals that may be anchors and positives, and that transitions may be relabelled with:
    [..., K, *shape], padded with "no goal"."""
    usable = is_goal(goals) & setup.env.goals.usable(goals, setup.config.known_goals)
    return select(usable, goals, no_goals_like(goals))


def leading_to_goals(decisions: jax.Array, achieved_count: jax.Array, steps_left: jax.Array) -> jax.Array:
    """Those of the decisions bool [R, T] after which their episode achieves a known goal; all of them while there is
    none.

    achieved_count: int32 [R * (T + 1)], running count of the places that achieve one. steps_left: int32 [R, T].
    """
    count = achieved_count.reshape(decisions.shape[0], -1)
    here = jnp.arange(decisions.shape[1], dtype=jnp.int32)[None]
    leading = decisions & (jnp.take_along_axis(count, here + steps_left, axis=1) > count[:, :-1])
    return jnp.where(leading.any(), leading, decisions)


def external_reward(env: Environment, transitions: Transitions) -> jax.Array:
    """The environment's reward for each step, float32 [B, n] (Eq. 5): 1 for reaching the desired goal."""
    return env.reached(transitions.records, transitions.desired_goal[:, None]).astype(jnp.float32)


def make_experience(setup: Setup, state: TrainState, number: jax.Array) -> tuple[Experience, TrainState]:
    """What the updates of an epoch draw from, and the state with what the explorer made of it."""
    parts, _, env = setup
    offline = env.recorded is not None
    buffer = env.recorded if offline else state.buffer
    written = jnp.arange(buffer.valid.shape[0], dtype=jnp.int32) < (
        buffer.valid.shape[0] if offline else (number + 1) * parts.config.num_envs
    )
    goals = usable_goals(setup, achieved_goals(env, buffer))
    achieved = is_goal(goals).any(-1) & written[:, None]
    achieved_count = replay.running_count(achieved)
    known, codes = pairs.AchievedGoals(goals, achieved_count), None
    if env.goals.finite:
        usable = env.goals.usable_mask(parts.config.known_goals)
        known = pairs.KnownGoals(usable if parts.config.known_goals == "all" else usable & state.seen)
        if env.goals.num_goals > parts.config.batch_size:
            codes = encode_all(parts.learner, state.params["goal"], env.goals)
    bonus = table = learner_table = None
    learner_relabelling = parts.learner.sample_spec.relabelling
    if parts.relabelling is not None or learner_relabelling is not None:
        achievements = Achievements(goals, achieved_count, replay.steps_left(buffer.valid), known)
        context = relabelling_context(setup, state, number, buffer, written, achievements, codes)
        table = None if parts.relabelling is None else parts.relabelling.prepare(context)
        learner_table = None if learner_relabelling is None else learner_relabelling.prepare(context)
    if parts.explorer is not None:
        bonus, state = explore(setup, state, buffer, written)
    decisions = buffer.valid & buffer.decided
    if traits_of(parts.config.agent).achieved_goals:
        decisions = leading_to_goals(decisions, achieved_count, replay.steps_left(buffer.valid))
    return Experience(
        buffer=buffer,
        decision_count=replay.running_count(decisions),
        achieved=achieved,
        achieved_count=achieved_count,
        known=known,
        dissimilarity=state.dissimilarity,
        goal_params=None if parts.learner.similar is None else state.params["goal"],
        codes=codes,
        relabelling=table,
        learner_relabelling=learner_table,
        bonus=bonus,
        episode=None if env.goals.finite else buffer.episode(),
        first_seen=first_seen(goals, buffer, env.goals.num_goals) if parts.learner.sample_spec.first_seen else None,
    ), state
