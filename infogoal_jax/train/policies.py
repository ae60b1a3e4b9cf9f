"""Policies: how parameters act on observations and goals, while collecting and when they are tested."""

import jax

from infogoal_jax.agents.agent import Exploration
from infogoal_jax.learners.learner import Encode, conditioned, encode_commanded, lookup
from infogoal_jax.train.encoding import encode_states, training_view
from infogoal_jax.train.evaluation import EVALUATION_SEED, corrupted_images, has_image_goals
from infogoal_jax.train.rollout import Policy


def policy(parts, params, exploration: Exploration, env, encode: Encode, use_mean=False) -> Policy:
    """The policy of these parameters. The goal is drawn anew from its code at every step (paper, Sec. IV), or its mean
    is used."""
    see = encode_states(parts, params, env, parts.config.num_envs * parts.config.rollout_steps)

    def act(observation, goal, key):
        sample_key, act_key = jax.random.split(key)
        features = see(observation)
        code = conditioned(parts.learner, params["goal"], encode(goal), features)
        code = code.mean if use_mean else code.sample(sample_key)
        return parts.agent.act(params["agent"], features, code, env.action_mask(observation), act_key, exploration)

    return act


def training_policy(parts, params, hyper, env, key) -> Policy:
    """The policy that collects: each goal under a background, where training corrupts goals, that stays for the
    epoch."""
    encode = encode_commanded(
        parts.learner,
        params["goal"],
        env.goals,
        parts.config.batch_size,
        training_view(parts, env, augmented=False),
        key,
    )
    return policy(parts, params, Exploration(hyper.epsilon, hyper.noise), env, encode)


def tested_policy(parts, params, hyper, env, encode: Encode, use_mean: bool = False) -> Policy:
    """The policy that is tested: greedy but for `test_epsilon`, on goals as `encode` sees them."""
    return policy(
        parts,
        params,
        Exploration(hyper.test_epsilon, 0.0),
        env,
        encode,
        use_mean=use_mean or parts.learner.mean_at_test,
    )


def test_policies(
    parts, params, hyper, env, num_starts: int, corruption: float | None = None, seed: int = EVALUATION_SEED
) -> dict[str, Policy]:
    """The policies that an evaluation compares, by the names of their metrics: code sampled or mean, goals as they are
    or corrupted.

    They act on the episodes of `evaluation.goal_starts` with this number of starts. corruption: weight, None for the
    configuration's.
    """
    learner = parts.learner
    views = {
        "": lookup(
            learner.encode(params["goal"], env.goals.inputs_of(env.goals.evaluated)), env.goals, env.goals.evaluated
        )
    }
    if has_image_goals(env):
        weight = parts.config.test_corruption if corruption is None else corruption
        codes = learner.encode(params["goal"], corrupted_images(env, num_starts, weight, seed))
        views["corrupted_"] = lambda goal: codes  # A background for each episode, the same for its whole length.
    return {
        f"{prefix}{{group}}_goal{suffix}": tested_policy(parts, params, hyper, env, encode, use_mean=bool(suffix))
        for suffix in ("", "_mean_code")
        for prefix, encode in views.items()
    }
