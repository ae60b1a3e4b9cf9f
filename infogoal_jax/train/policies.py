"""Policies: how parameters act on observations and goals, while collecting and when they are evaluated."""

import jax
import jax.numpy as jnp

from infogoal_jax.agents.agent import Exploration
from infogoal_jax.learners.learner import Encode, GoalCode, GoalEncoding, conditioned
from infogoal_jax.train.encoding import encode_states, training_view
from infogoal_jax.train.rollout import Policy


def policy(parts, params, exploration: Exploration, env, encode: Encode, use_mean: bool | jax.Array = False) -> Policy:
    """The policy of these parameters. The goal is drawn anew from its code at every step (paper, Sec. IV), or its mean
    is used: in all episodes or, bool [E], in some."""
    see = encode_states(parts, params, env, parts.config.num_envs * parts.config.rollout_steps)

    def act(observation, goal, key):
        sample_key, act_key = jax.random.split(key)
        features = see(observation)
        code = conditioned(parts.learner, params["goal"], encode(goal), features)
        code = jnp.where(jnp.expand_dims(use_mean, -1), code.mean, code.sample(sample_key))
        return parts.agent.act(params["agent"], features, code, env.action_mask(observation), act_key, exploration)

    return act


def training_policy(parts, params, hyper, env, key) -> Policy:
    """The policy that collects: each goal under a background, where training corrupts goals, that stays for the
    epoch."""
    view = training_view(parts, env, augmented=False)
    encode = GoalEncoding(
        parts.learner, params["goal"], env.goals, parts.config.batch_size, view, key
    ).of_training_goals()
    return policy(parts, params, Exploration(hyper.epsilon, hyper.noise), env, encode)


def trained_policy(parts, params, hyper, env, use_mean: bool | jax.Array = False) -> Policy:
    """The policy that training is for: greedy but for `test_epsilon`. It takes goals int32 [E], or their codes
    `GoalCode` [E], which may be those of other inputs. use_mean: of the code, not a sample."""

    def encode(goal: jax.Array | GoalCode) -> GoalCode:
        return goal if isinstance(goal, GoalCode) else encode_index(goal)

    encode_index = GoalEncoding(parts.learner, params["goal"], env.goals, parts.config.batch_size).of_any()
    exploration = Exploration(hyper.test_epsilon, 0.0)
    return policy(parts, params, exploration, env, encode, use_mean | parts.learner.mean_at_test)
