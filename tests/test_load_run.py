"""The way back in: a run's folder gives its environment and its policies, and an episode in five lines."""

import jax
import numpy as np
import pytest

from infogoal_jax import load_run, rollout
from infogoal_jax.errors import UserError


def test_a_run_gives_its_policy_and_an_episode(reach_run):
    """The same key gives the same episode; seeds of the run act differently."""
    run = load_run(reach_run.folder)
    goal = int(np.asarray(run.env.goals.evaluated)[-1])
    play = jax.jit(lambda env, key: [rollout(env, run.policy(seed), goal, key) for seed in run.seeds])
    first, second = play(run.env, jax.random.key(0))
    assert first.observations.shape == (run.env.episode_length + 1, 10) and 0 < first.steps <= run.env.episode_length
    np.testing.assert_array_equal(first.observations, play(run.env, jax.random.key(0))[0].observations)
    assert not np.array_equal(first.observations, second.observations)


def test_a_seed_that_was_not_trained_is_named(reach_run):
    with pytest.raises(UserError, match="seed = 7: the run has the seeds 0, 1"):
        load_run(str(reach_run.folder)).policy(seed=7)
