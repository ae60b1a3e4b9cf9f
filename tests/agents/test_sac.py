"""SAC: the density of its actions, targets and losses by hand, the temperature's way to the target entropy, and a line
on which it learns."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vector_agents import GREEDY, A, agent_of, joined, mlp, random_batch, started, success_on_the_line, twin, varied

from infogoal_jax.agents import sac
from infogoal_jax.agents.agent import Exploration


def normal_cdf(value: np.ndarray) -> np.ndarray:
    """Of the standard normal distribution."""
    return np.array([0.5 * math.erfc(-one / math.sqrt(2)) for one in value])


def of_policy(params, features, code) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation [B, A] of u, in NumPy."""
    mean, raw = np.split(mlp(params["actor"], joined(features, code)), 2, axis=-1)
    return mean, np.exp(-5.0 + 3.5 * (np.tanh(raw) + 1.0))


def drawn(key, mean, std) -> tuple[np.ndarray, np.ndarray]:
    """Actions and the logarithms of their densities, by the change of variables; noise as the key gives it."""
    noise = np.asarray(jax.random.normal(key, mean.shape, jnp.float32), np.float64)
    action = np.tanh(mean + std * noise)
    log_pi = -0.5 * noise**2 - np.log(std) - 0.5 * np.log(2 * np.pi) - np.log(1 - action**2)
    return action, log_pi.sum(-1)


@pytest.mark.parametrize(("mean", "std"), [(0.0, 1.0), (0.7, 0.3), (-1.5, 0.9)])
def test_density_is_that_of_squashed_draws(mean, std):
    """The probability of a small interval of actions, by its width."""
    action, half = np.linspace(-0.95, 0.95, 39), 1e-5
    expected = (
        normal_cdf((np.arctanh(action + half) - mean) / std) - normal_cdf((np.arctanh(action - half) - mean) / std)
    ) / (2 * half)
    one = np.ones((39, 1))
    found = jax.jit(sac.log_probability)(*map(np.float32, (np.arctanh(action)[:, None], mean * one, np.log(std) * one)))
    np.testing.assert_allclose(np.exp(found), expected, rtol=1e-4, atol=1e-8)


def test_actions_at_the_edge_have_a_finite_density_and_gradient():
    far = jnp.array([[-40.0], [40.0]])
    density = jax.jit(jax.value_and_grad(lambda u: sac.log_probability(u, far, jnp.zeros((2, 1))).sum()))
    found, slope = density(far)
    assert np.isfinite(found) and np.isfinite(slope).all()


@pytest.mark.parametrize(
    ("bounded", "largest"),
    [(False, None), *(pytest.param(True, largest, marks=pytest.mark.long) for largest in (None, 1.2))],
)
def test_loss_is_that_of_the_formulas(bounded, largest):
    """The trained actor draws what follows, the smaller target critic values it; entropy is worth its temperature in
    targets that have no bounds."""
    agent, batch = agent_of("sac", layer_norm=True, huber=False, bounded=bounded), random_batch()
    batch = batch.replace(largest_value=largest)
    params, state = started(agent)
    params, target_params = params | {"log_temperature": jnp.float32(0.4)}, varied(params, 1)
    hyper = sac.SACHyperparameters(target_entropy=-0.7, initial_temperature=0.2)
    found, metrics = jax.jit(agent.loss)(params, target_params, batch, state, hyper, jax.random.key(3))
    target_key, actor_key = jax.random.split(jax.random.key(3))
    alpha = 0.2 * np.exp(0.4)
    action, log_pi = drawn(target_key, *of_policy(params, batch.next_features, batch.next_code))
    worth = twin(target_params["critic"], batch.target_features, batch.target_code, action).min(0)
    target = batch.reward + batch.discount * (worth if bounded else worth - alpha * log_pi)
    target = np.clip(target, 0, largest or 1) if bounded else target
    values = twin(params["critic"], batch.features, batch.code, batch.action)
    own, own_log_pi = drawn(actor_key, *of_policy(params, batch.features, batch.code))
    climbed = twin(params["critic"], batch.features, batch.code, own).min(0)
    actor_loss = (alpha * own_log_pi - climbed).mean()
    expected = (0.5 * (values - target) ** 2).mean(1).sum() + actor_loss - alpha * (own_log_pi - 0.7 * A).mean()
    np.testing.assert_allclose(metrics["actor_loss"], actor_loss, rtol=1e-5)
    np.testing.assert_allclose(metrics["entropy"], -own_log_pi.mean(), rtol=1e-5)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize(("target", "rises"), [(0.69, True), pytest.param(-20.0, False, marks=pytest.mark.long)])
def test_temperature_rises_where_entropy_is_below_its_target(target, rises):
    agent, batch = agent_of("sac"), random_batch()
    params, state = started(agent)
    hyper = sac.SACHyperparameters(target_entropy=target)
    loss = lambda own: agent.loss(own, params, batch, state, hyper, jax.random.key(0))[0]  # noqa: E731
    slope = jax.jit(jax.grad(loss))(params)
    assert (slope["log_temperature"] < 0) == rises


def test_actor_and_temperature_learn_from_their_own_losses():
    """The temperature from how far the entropy is from its target, the actor from the temperature as it is."""
    agent, batch = agent_of("sac"), random_batch()
    params, state = started(agent)
    params = params | {"log_temperature": jnp.float32(0.4)}
    hyper = sac.SACHyperparameters(target_entropy=-0.7, initial_temperature=0.2)

    def losses(own):
        whole, metrics = agent.loss(own, params, batch, state, hyper, jax.random.key(0))
        return jnp.stack([whole, metrics["actor_loss"]]), metrics

    slopes, metrics = jax.jit(jax.jacrev(losses, has_aux=True))(params)
    far = metrics["temperature"] * (metrics["entropy"] + 0.7 * A)
    np.testing.assert_allclose(slopes["log_temperature"], [far, 0.0], rtol=1e-5)
    for slope in jax.tree.leaves(slopes["actor"]):
        whole, own = slope
        np.testing.assert_allclose(whole, own, rtol=1e-4, atol=1e-7)
    assert not any(leaf[1].any() for leaf in jax.tree.leaves(slopes["critic"]))


def test_policy_is_drawn_from_unless_there_is_no_noise():
    """Without noise an action is tanh(mean) under every key; with it the spread is the policy's own, however much noise
    is asked for; with probability epsilon an action is uniform."""
    agent, batch = agent_of("sac"), random_batch()
    params, _ = started(agent)
    act = jax.jit(agent.act)

    def actions(exploration):
        keys = jax.random.split(jax.random.key(1), 4000)
        features, code = batch.features[:1], batch.code[:1]
        each = jax.vmap(lambda key: act(params, features, code, batch.action_mask[:1], key, exploration))
        return np.asarray(each(keys))[:, 0]

    mean, std = (part[0] for part in of_policy(params, batch.features, batch.code))
    np.testing.assert_allclose(actions(GREEDY), np.tile(np.tanh(mean), (4000, 1)), atol=1e-6)
    np.testing.assert_array_equal(actions(Exploration(0.0, 0.1)), actions(Exploration(0.0, 1.0)))
    u = np.arctanh(np.clip(actions(Exploration(0.0, 0.1)), -1 + 1e-7, 1 - 1e-7))
    np.testing.assert_allclose(u.mean(0), mean, atol=4 * std.max() / np.sqrt(4000))
    np.testing.assert_allclose(u.std(0), std, rtol=0.06)
    uniform = actions(Exploration(1.0, 0.0))
    assert abs(uniform.mean()) < 0.03 and uniform.std() == pytest.approx(1 / np.sqrt(3), abs=0.02)


@pytest.mark.long
@pytest.mark.parametrize("bounded", [False, True])
def test_learns_where_to_go_on_a_line(bounded):
    agent = agent_of("sac", 1, hidden=(32, 32), layer_norm=True, bounded=bounded)
    assert success_on_the_line(agent, sac.SACHyperparameters(), 0.8)[1] > 0.95
