"""Which loss of HRAC trains which network, and the targets of its critics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import pairs, replay
from infogoal_jax.agents import td3
from infogoal_jax.envs.cells import Cells
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.train.update import agent_batch


@pytest.fixture(scope="module")
def gradients(train, rows):
    """The gradient of HRAC's loss, and its metrics, for parameters, target parameters, hyperparameters and whether goal
    encoders are left alone."""
    row, first = (jnp.asarray(index[:64]) for index in np.nonzero(np.asarray(rows.valid & rows.decided)))
    batch = replay.transitions_at(rows, row, first, train.parts.agent.num_steps)
    cells = Cells.over(train.env.space.bounds, train.config.agent.cell)
    apart = train.parts.agent.observe(pairs.initial_dissimilarity(cells.count)[None], rows)

    def gradient(params, target_params, hyper, stop=False):
        parts = train.parts._replace(config=dataclasses.replace(train.config, stop_encoder_gradient=stop))

        def loss(params):
            codes = agent_batch(
                parts, train.env, hyper, params, target_params, batch, jnp.ones(64), None, jax.random.key(1)
            )
            return parts.agent.loss(
                params["agent"], target_params["agent"], codes, apart, hyper.agent, jax.random.key(2)
            )

        return jax.grad(loss, has_aux=True)(params)

    return jax.jit(gradient, static_argnums=3)


def scaled(params, name: str):
    """The parameters with another actor, critic or adjacency network."""
    return params | {
        "agent": params["agent"] | {name: jax.tree.map(lambda leaf: 1.5 * leaf + 0.01, params["agent"][name])}
    }


def norm(tree) -> float:
    """The largest entry."""
    return max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(tree))


def assert_close(one, other):
    jax.tree.map(lambda first, second: np.testing.assert_allclose(first, second, atol=1e-5), one, other)


def test_the_critic_trains_the_encoders_and_the_actor_trains_nothing_but_itself(train, params, gradients):
    hyper = train.config.hyper
    found, _ = gradients(params, params, hyper)
    for part in (found["goal"], found["state"], *(found["agent"][name] for name in ("actor", "critic", "adjacency"))):
        assert norm(part) > 0
    other_actor, _ = gradients(scaled(params, "actor"), params, hyper)
    for gradient in (found, other_actor):
        gradient["others"] = [
            gradient["goal"],
            gradient["state"],
            gradient["agent"]["critic"],
            gradient["agent"]["adjacency"],
        ]
    assert_close(other_actor["others"], found["others"])
    other_critic, _ = gradients(scaled(params, "critic"), params, hyper)
    # It climbs the critic.
    assert norm(jax.tree.map(jnp.subtract, other_critic["agent"]["actor"], found["agent"]["actor"])) > 1e-4
    assert_close(other_critic["agent"]["adjacency"], found["agent"]["adjacency"])


def test_the_goal_encoder_can_be_left_to_its_own_loss(train, params, gradients):
    hyper = train.config.hyper
    let_through, _ = gradients(params, params, hyper)
    stopped, _ = gradients(params, params, hyper, True)
    assert norm(stopped["goal"]) == 0 and norm(let_through["goal"]) > 0
    assert_close(stopped["state"], let_through["state"])


def test_targets_come_from_the_target_networks_where_an_episode_goes_on(train, params, gradients):
    hyper = train.config.hyper
    _, near = gradients(params, params, hyper.replace(discount=0.0))
    _, blind = gradients(params, scaled(params, "critic"), hyper.replace(discount=0.0))
    assert near["td_error"] == blind["td_error"]  # Nothing follows.
    _, far = gradients(params, scaled(params, "critic"), hyper)
    _, smooth = gradients(params, params, hyper)
    assert len({float(found["td_error"]) for found in (near, far, smooth)}) == 3
    _, sharp = gradients(params, params, with_values(hyper, {"agent.target_noise": 0.0}))
    assert smooth["td_error"] != sharp["td_error"]


def test_the_adjacency_penalty_moves_the_actor_alone(train, params, gradients):
    far_off = scaled(params, "adjacency")
    # Everything lies far apart.
    far_off["agent"]["adjacency"] = jax.tree.map(lambda leaf: 4.0 * leaf, far_off["agent"]["adjacency"])
    free, metrics = gradients(far_off, far_off, with_values(train.config.hyper, {"agent.adjacency_weight": 0.0}))
    bound, _ = gradients(far_off, far_off, with_values(train.config.hyper, {"agent.adjacency_weight": 20.0}))
    assert metrics["adjacency_penalty"] > 0
    assert norm(jax.tree.map(jnp.subtract, bound["agent"]["actor"], free["agent"]["actor"])) > 1e-3
    for name in ("critic", "adjacency"):
        assert_close(bound["agent"][name], free["agent"][name])
    assert_close(bound["goal"], free["goal"])


def test_smoothing_noise_is_clipped_and_actions_stay_in_range():
    """As in TD3's own code: noise of standard deviation 0.2, clipped at 0.5."""
    action = jnp.tile(jnp.array([0.0, 0.9, -1.0]), (20_000, 1))
    noisy = np.asarray(td3.smoothed(jax.random.key(0), action, 0.2))
    assert abs(noisy[:, 0]).max() == pytest.approx(0.5) and 0.18 < noisy[:, 0].std() < 0.2
    assert abs(noisy).max() <= 1
    explored = np.asarray(td3.explore(jax.random.key(0), action, 0.01, 0.25))
    assert abs(explored).max() <= 1
    assert np.mean(abs(explored[:, 0]) > 0.06) == pytest.approx(0.25 * 0.94, abs=0.02)
    np.testing.assert_array_equal(td3.explore(jax.random.key(0), action, 0.0, 0.0), action)


def test_the_smaller_critic_sets_the_target_for_both():
    values, target = jnp.array([[0.0, 3.0], [2.0, 3.0]]), jnp.array([1.0, 3.0])
    assert td3.critic_loss(values, target, huber=True) == pytest.approx((0.5 + 0.5) / 2)
    assert jax.grad(lambda target: td3.critic_loss(values, target, huber=True))(target).max() == 0
    both = td3.TwinCritic((8,))
    params = both.init(jax.random.key(0), jnp.zeros(2), jnp.zeros(1))
    one, other = both.apply(params, jnp.ones((5, 2)), jnp.ones((5, 1)))
    assert one.shape == (5,) and not np.allclose(one, other)
