"""Policies: how parameters act on observations and goals; and the batched environment inside a scan under a policy that
is fixed for its length, to collect experience."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from infogoal_jax.agents.agent import Exploration
from infogoal_jax.learners.encoding import GoalEncoding
from infogoal_jax.learners.learner import Encode, GoalCode, conditioned
from infogoal_jax.replay import Trajectories
from infogoal_jax.train.parts import Setup, encode_states, sees_means, tests_on_means, training_view

Policy = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]
"""Stored observations [E, ...], goals [E, *shape] and a key to actions: int32 [E], or vectors [E, A]. A trained policy
also takes the codes `GoalCode` [E] of goals, in place of the goals."""


def policy(
    setup: Setup, params: dict, exploration: Exploration, encode: Encode, use_mean: bool | jax.Array = False
) -> Policy:
    """The policy of these parameters. The goal is drawn anew from its code at every step (paper, Sec. V-F), or its mean
    is used: in all episodes or, bool [E], in some."""
    parts, _, env = setup
    see = encode_states(setup, params, parts.config.num_envs * parts.config.rollout_steps)

    def act(observation, desired_goal, key):
        sample_key, act_key = jax.random.split(key)
        features = see(observation)
        code = conditioned(parts.learner, params["goal"], encode(desired_goal), features)
        code = jnp.where(jnp.expand_dims(use_mean, -1), code.mean, code.sample(sample_key))
        return parts.agent.act(params["agent"], features, code, env.action_mask(observation), act_key, exploration)

    return act


def training_policy(setup: Setup, params: dict, key: jax.Array) -> Policy:
    """The policy that collects: each goal under a background, where training corrupts goals, that stays for the
    epoch."""
    parts, hyper, env = setup
    view = training_view(setup, augmented=False)
    encode = GoalEncoding(
        parts.learner, params["goal"], env.goals, parts.config.batch_size, view, key
    ).of_desired_goals()
    return policy(setup, params, Exploration(hyper.epsilon, hyper.noise), encode, sees_means(parts))


def trained_policy(setup: Setup, params: dict, use_mean: bool | jax.Array = False) -> Policy:
    """The policy that training is for: greedy but for `test_epsilon`. It takes goals [E, *shape], or their codes
    `GoalCode` [E], which may be those of other inputs. use_mean: of the code, not a sample."""
    parts, hyper, env = setup

    def encode(goal: jax.Array | GoalCode) -> GoalCode:
        return goal if isinstance(goal, GoalCode) else encode_index(goal)

    encode_index = GoalEncoding(parts.learner, params["goal"], env.goals, parts.config.batch_size).of_any()
    exploration = Exploration(hyper.test_epsilon, 0.0)
    return policy(setup, params, exploration, encode, use_mean | tests_on_means(parts))


def collect(env, env_states, policy: Policy, key: jax.Array, num_steps: int):
    """`num_steps` steps of E environments.

    A finished one is reset by its next step, which is marked invalid, as a step that diverged is.

    Returns the environments' states [E] and the rows [E, num_steps] that they went through.
    """
    num_envs = env_states.terminated.shape[0]

    def step(states, step_key):
        act_key, reset_key = jax.random.split(step_key)
        finished = states.terminated | states.truncated
        actions = policy(env.observe(states), states.desired_goal, act_key)
        stepped = jax.vmap(env.step)(states, actions)
        following = restarted(env, finished, stepped, jax.random.split(reset_key, num_envs))
        return following, kept_of_step(env, states, actions, finished, stepped)

    env_states, outcomes = jax.lax.scan(step, env_states, jax.random.split(key, num_steps))
    last = {"observation": env.observe(env_states), "record": env.achieved(env_states)}
    rows = {name: jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), value) for name, value in outcomes.items()}
    for name, final in last.items():
        rows[name] = jax.tree.map(lambda leaf, end: jnp.concatenate([leaf, end[:, None]], axis=1), rows[name], final)
    return env_states, Trajectories(**rows)


def kept_of_step(env, states, actions: jax.Array, finished: jax.Array, stepped) -> dict[str, Any]:
    """What `Trajectories` have of one step of E environments: from `states` to `stepped`, and whether each was
    `finished` before it, bool [E]."""
    kept = {
        "observation": env.observe(states),
        "record": env.achieved(states),
        "action": actions,
        "desired_goal": states.desired_goal,
        "valid": ~finished & ~stepped.diverged,
        "terminated": ~finished & stepped.terminated,
        "truncated": ~finished & stepped.truncated,
        "decided": env.decides(states),
    }
    return kept | ({"failed": ~finished & env.failed(stepped)} if env.can_fail else {})


def restarted(env, finished: jax.Array, states, keys: jax.Array):
    """The states [E], with new episodes where finished, bool [E]; keys [E].

    Where a reset is costly it is computed only if an episode has ended: as a loop of one round or none, which stays one
    under `jax.vmap` over seeds, where both branches of a `jax.lax.cond` would be computed.
    """

    def restart(states):
        return chosen(finished, jax.vmap(env.reset)(keys), states)

    if not env.costly_reset:
        return restart(states)
    left = (finished.any(), states)
    return jax.lax.while_loop(lambda left: left[0], lambda left: (jnp.zeros((), bool), restart(left[1])), left)[1]


def rows_shape(env, env_states, policy: Policy, num_steps: int) -> Trajectories:
    """The shapes of the rows that `collect` returns, without tracing the environment's step."""

    def row(states):
        actions = policy(env.observe(states), states.desired_goal, jax.random.key(0))
        steps = kept_of_step(env, states, actions, states.terminated, states)
        ends = {"observation": env.observe(states), "record": env.achieved(states)}
        steps = jax.tree.map(lambda leaf: repeated(leaf, num_steps), steps)
        ends = jax.tree.map(lambda leaf: repeated(leaf, num_steps + 1), ends)
        return Trajectories(**steps | ends)

    def repeated(leaf, times):
        return jnp.broadcast_to(leaf[:, None], (leaf.shape[0], times, *leaf.shape[1:]))

    return jax.eval_shape(row, env_states)


def chosen(mask: jax.Array, first, second):
    """The first tree's leaves [E, ...] where the mask [E] holds, else the second's."""

    def select(one, other):
        return jax.lax.select(jax.lax.broadcast_in_dim(mask, one.shape, (0,)), one, other)

    return jax.tree.map(select, first, second)
