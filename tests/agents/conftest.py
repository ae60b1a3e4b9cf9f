"""HRAC's high level on the points: its training program, parameters, and rows of episodes under subgoals."""

import hand_made_points
import jax
import jax.numpy as jnp
import pytest

from infogoal_jax import make_train
from infogoal_jax.agents.hrac import HRACConfig
from infogoal_jax.train.rollout import collect


@pytest.fixture(scope="module")
def train():
    agent = HRACConfig(interval=hand_made_points.LONG_INTERVAL, hidden=(32,), adjacency_hidden=(32,))
    return make_train(
        hand_made_points.config(agent=agent), hand_made_points.steered(interval=hand_made_points.LONG_INTERVAL)
    )


@pytest.fixture(scope="module")
def params(train):
    return hand_made_points.random_params(train)


@pytest.fixture(scope="module")
def rows(train):
    """24 rows of 40 steps from fresh episodes, under subgoals that lead to the goal in half of the episodes and astray
    in the others."""
    env = train.env

    def policy(observation, goal, key):
        ahead = (env.unwrapped.positions[goal] - observation[:, :3]) / env.subgoal_scale
        astray = jax.random.uniform(key, ahead.shape, minval=-1.0)
        return jnp.clip(jnp.where((jnp.arange(24) % 2 == 0)[:, None], ahead, astray), -1.0, 1.0)

    def run(key):
        return collect(env, jax.vmap(env.reset)(jax.random.split(key, 24)), policy, key, 40)[1]

    return jax.jit(run)(jax.random.key(0))
