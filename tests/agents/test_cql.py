"""Conservative Q-learning: its term by hand, and what it is there for, values of moves that nobody recorded kept below
those that were."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import agents
from infogoal_jax.agents.agent import AgentBatch, Exploration
from infogoal_jax.agents.cql import CQLConfig, CQLHyperparameters, conservative_gap

BATCH, ACTIONS = 64, 4


class FourActions:
    """As much of an environment as an agent of discrete actions reads."""

    action_size = ACTIONS


def batch(mask) -> AgentBatch:
    """Random codes; only actions 0 and 1 were recorded, and every reward is 0."""
    keys = jax.random.split(jax.random.key(0), 4)
    features, code = jax.random.normal(keys[0], (BATCH, 6)), jax.random.normal(keys[1], (BATCH, 3))
    action = jax.random.randint(keys[2], (BATCH,), 0, 2)
    every = jnp.broadcast_to(mask, (BATCH, ACTIONS))
    return AgentBatch(
        observation=None,
        next_observation=None,
        features=features,
        code=code,
        action=action,
        next_features=features,
        next_code=code,
        target_features=features,
        target_code=code,
        reward=jnp.zeros(BATCH),
        discount=jnp.full(BATCH, 0.9),
        action_mask=every,
        next_action_mask=every,
    )


def test_gap_by_hand():
    """log sum exp over the moves that exist, less the value of the recorded one; 0 where only one move exists."""
    values = jnp.array([[1.0, 2.0, 50.0], [0.5, 7.0, 7.0]])
    mask = jnp.array([[True, True, False], [True, False, False]])
    gap = conservative_gap(values, mask, jnp.array([0, 0]))
    np.testing.assert_allclose(gap, [np.log(np.exp(1.0) + np.exp(2.0)) - 1.0, 0.0], rtol=1e-6)


def test_gap_is_never_negative():
    """The recorded move exists, so the sum is at least its own term."""
    values = 5 * jax.random.normal(jax.random.key(1), (500, ACTIONS))
    mask = jax.random.bernoulli(jax.random.key(2), 0.5, values.shape).at[:, 0].set(True)
    assert (conservative_gap(values, mask, jnp.zeros(500, jnp.int32)) >= 0).all()


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_values_of_unrecorded_moves_are_held_down(weight):
    """After training, the greedy move is a recorded one under the penalty; without it nothing keeps the others
    below."""
    agent = agents.registry.entry("cql").make(CQLConfig(hidden=(32,)), FourActions())
    data = batch(jnp.ones(ACTIONS, bool))
    params, state = agent.init(jax.random.key(3), data.features[0], data.code[0])
    hyper = CQLHyperparameters(conservative_weight=weight)

    @jax.jit
    def step(params, _):
        gradient, metrics = jax.grad(
            lambda own: agent.loss(own, params, data, state, hyper, jax.random.key(0)), has_aux=True
        )(params)
        return jax.tree.map(lambda leaf, slope: leaf - 0.1 * slope, params, gradient), metrics["conservative_gap"]

    params, gaps = jax.lax.scan(step, params, None, length=300)
    action = agent.act(params, data.features, data.code, data.action_mask, jax.random.key(1), Exploration(0.0, 0.0))
    recorded = float((action < 2).mean())
    if weight:
        assert recorded == 1.0 and gaps[-1] < 0.5 * gaps[0]
    else:
        assert recorded < 0.9
