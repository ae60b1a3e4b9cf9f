"""Collecting the trajectories of an epoch, and what is learned from them without a gradient."""

import jax.numpy as jnp

from infogoal_jax import pairs, replay
from infogoal_jax.learners.learner import NewSteps
from infogoal_jax.replay import Trajectories
from infogoal_jax.train.experience import usable_goals, usable_mask
from infogoal_jax.train.policies import training_policy
from infogoal_jax.train.rollout import collect
from infogoal_jax.train.state import COLLECT, CORRUPT, TrainState, numbered


def collect_epoch(parts, state: TrainState, number, hyper, env) -> tuple[TrainState, dict]:
    """Collect the rows of an epoch into the buffer."""
    collect_key = numbered(state.key, COLLECT, number)
    corruption_key = numbered(state.key, CORRUPT, number)
    acting = training_policy(parts, state.params, hyper, env, corruption_key)
    env_states, rows = collect(env, state.env_states, acting, collect_key, parts.config.rollout_steps)
    state = update_statistics(
        parts, state.replace(env_states=env_states, buffer=replay.add(state.buffer, rows, number)), rows, env
    )
    ended = jnp.maximum(rows.terminated.sum() + rows.truncated.sum(), 1)
    return state, {
        "collect/success_rate": rows.terminated.sum() / ended,
        "collect/nothing_achieved": (env.goals_of(rows.record) < 0).all(-1).mean(),
        "collect/valid": rows.valid.mean(),
        "collect/goals_seen": state.seen.sum(),
    }


def update_statistics(parts, state: TrainState, rows: Trajectories, env) -> TrainState:
    """The state that has seen these rows: goals achieved, pairs that are no longer dissimilar, and what the agent makes
    of them."""
    learner, achieved = parts.learner, env.goals_of(rows.record)
    state = state.replace(
        agent=parts.agent.observe(state.agent, rows),
        env_steps=state.env_steps + rows.valid.sum(),
        learner=learner.observe(
            state.learner, NewSteps(rows.goal, achieved[:, 1:], env.cell_of(rows.record)[:, 1:], rows.valid)
        ),
        seen=state.seen.at[jnp.where(achieved < 0, env.goals.num_goals, achieved)].set(True, mode="drop"),
    )
    if not learner.sample_spec.num_pairs:
        return state
    similar = usable_goals(env, rows.record, usable_mask(parts.config, env))
    return state.replace(
        dissimilarity=pairs.remove_similar(state.dissimilarity, similar, rows.episode(), learner.sample_spec.window)
    )
