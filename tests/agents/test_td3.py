"""TD3 as an agent: its losses by hand, targets that stay within what rewards can be worth, and a line on which it
learns."""

import jax
import numpy as np
import pytest
from vector_agents import GREEDY, A, B, agent_of, joined, mlp, random_batch, started, success_on_the_line, twin, varied

from infogoal_jax.agents import td3
from infogoal_jax.agents.agent import Exploration


@pytest.mark.parametrize(
    ("bounded", "largest"),
    [*(pytest.param(bounded, None, marks=pytest.mark.long) for bounded in (False, True)), (True, 1.2)],
)
def test_loss_is_that_of_the_formulas(bounded, largest):
    """Without target noise: the smaller of the target critics sets one target for both (Eq. 10), between 0 and the
    largest value if it is bounded; the actor climbs the first critic and pays for large actions."""
    agent, batch = agent_of("td3", layer_norm=True, huber=False, bounded=bounded), random_batch()
    batch = batch.replace(reward=3.0 * (batch.reward - 0.5), largest_value=largest)
    params, state = started(agent)
    target_params, hyper = varied(params, 1), td3.TD3Hyperparameters(target_noise=0.0, action_cost=0.7)
    found, metrics = jax.jit(agent.loss)(params, target_params, batch, state, hyper, jax.random.key(0))
    following = np.tanh(mlp(target_params["actor"], joined(batch.target_features, batch.target_code)))
    target = batch.reward + batch.discount * twin(
        target_params["critic"], batch.target_features, batch.target_code, following
    ).min(0)
    assert (target < 0).any() and (target > (largest or 1)).any()
    target = np.clip(target, 0, largest or 1) if bounded else target
    values = twin(params["critic"], batch.features, batch.code, batch.action)
    own = np.tanh(mlp(params["actor"], joined(batch.features, batch.code)))
    climbed = twin(params["critic"], batch.features, batch.code, own)[0].mean()
    expected = (0.5 * (values - target) ** 2).mean(1).sum() - climbed + 0.7 * (own**2).mean()
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    np.testing.assert_allclose(metrics["td_error"], np.abs(values - target).mean(), rtol=1e-5)
    worth = jax.jit(agent.value)(params, batch.features, batch.code, batch.action_mask)
    np.testing.assert_allclose(
        worth, twin(params["critic"], batch.features, batch.code, own).min(0), rtol=1e-4, atol=1e-6
    )


@pytest.mark.parametrize("critic", ["concatenated", pytest.param("product", marks=pytest.mark.long)])
def test_noise_and_chance_alone_lead_away_from_the_best_action(critic):
    agent, batch = agent_of("td3", critic=critic, bounded=critic == "product"), random_batch()
    params, _ = started(agent)
    take = jax.jit(agent.act)

    def act(exploration, seed=0):
        key = jax.random.key(seed)
        return np.asarray(take(params, batch.features, batch.code, batch.action_mask, key, exploration))

    best = act(GREEDY)
    assert best.shape == (B, A) and best.dtype == np.float32
    np.testing.assert_array_equal(act(GREEDY, 1), best)
    for exploration in (Exploration(1.0, 0.0), Exploration(0.0, 0.3)):
        assert (act(exploration) != best).all() and (abs(act(exploration)) <= 1).all()


@pytest.mark.long
def test_learns_where_to_go_on_a_line():
    """Before it has learned it gets to few places."""
    agent = agent_of("td3", 1, hidden=(32, 32), layer_norm=True, bounded=True)
    before, after = success_on_the_line(agent, td3.TD3Hyperparameters(), 0.8)
    assert before < 0.6 and after > 0.95
