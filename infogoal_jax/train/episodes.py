"""Whole episodes of a policy, each to its end: what evaluations are made of."""

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax import checks
from infogoal_jax.envs.environment import failed_in
from infogoal_jax.train.contracts import check_is_environment, check_simulated, checked_policy
from infogoal_jax.train.rollout import Policy, chosen


@flax.struct.dataclass
class Episodes:
    """E finished episodes."""

    steps: jax.Array
    """int32 [E], steps taken until the end."""
    success: jax.Array
    """bool [E], whether the goal was reached; where reaching it ends no episode: at the end, without a failure."""
    first_reached: jax.Array
    """int32 [E], steps after which the goal was first reached; episode_length + 1 where it never was."""
    observations: jax.Array
    """[E, T + 1, ...], stored observations; after the end of an episode the last one is repeated."""


def rollout(env, policy: Policy, goal: jax.Array | int, key: jax.Array) -> Episodes:
    """One episode for a desired goal, a value of `env.goals` or its name, from a start drawn from the key; without the
    axis of episodes. Compile it with `jax.jit`. Raises `UserError` for a goal that the task does not have."""
    check_is_environment(env, "give an environment, and the policy after it")
    check_simulated(env, "env", type(env).__name__)
    policy = checked_policy(env, policy)
    start_key, act_key = jax.random.split(checks.key(key))
    starts = jax.vmap(env.reset_to)(start_key[None], env.goals.checked(goal, "goal", axes=0)[None])
    return jax.tree.map(lambda leaf: leaf[0], run_episodes(env, starts, policy, act_key))


def run_episodes(env, starts, policy: Policy, key: jax.Array) -> Episodes:
    """One episode from each of the E start states, to its end. The key is shared by all: nothing is drawn from
    seeds."""

    def step(states, step_key):
        finished = states.terminated | states.truncated
        stepped = jax.vmap(env.step)(states, policy(env.observe(states), states.desired_goal, step_key))
        following = chosen(finished, states, stepped)
        at_goal = () if env.ends_at_goal else env.reached(env.achieved(following), following.desired_goal)
        return following, (env.observe(following), at_goal)

    states, (observations, at_goal) = jax.lax.scan(step, starts, jax.random.split(key, env.episode_length))
    observations = jax.tree.map(
        lambda first, rest: jnp.moveaxis(jnp.concatenate([first[None], rest]), 0, 1), env.observe(starts), observations
    )
    if env.ends_at_goal:
        success, found, first = states.terminated, states.terminated, states.time
    else:
        success = at_goal[-1] & ~failed_in(env, states)
        found, first = at_goal.any(0), at_goal.argmax(0).astype(jnp.int32) + 1
    return Episodes(states.time, success, jnp.where(found, first, env.episode_length + 1), observations)
