"""Contrastive RL: one update's losses as its authors define them, computed once more in NumPy; where the contrast is
least; what it is combined with; and a line on which it learns."""

import functools

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hand_made import ROWS, STEPS, later_goals, random_rows
from hand_made_points import config as points_config
from hand_made_points import points
from scipy.special import logsumexp
from vector_agents import B, agent_of, joined, mlp, random_batch, started, success_on_the_line

from infogoal_jax import make_train, networks, presets, replay
from infogoal_jax.agents import crl
from infogoal_jax.learners.none import NoneConfig
from infogoal_jax.loading import reasons_against, remarks
from infogoal_jax.relabelling.her import HERConfig
from infogoal_jax.replay import Trajectories
from infogoal_jax.train.experience import leading_to_goals, make_experience, update_statistics
from infogoal_jax.train.update import sample

contrastive_loss = jax.jit(crl.contrastive_loss)


def energy(kind, first, second):
    """-|first - second|, or the scalar product."""
    if kind == "dot":
        return (first * second).sum(-1)
    return -np.sqrt(((first - second) ** 2).sum(-1) + 1e-6)


@pytest.mark.parametrize("kind", ["norm", pytest.param("dot", marks=pytest.mark.long)])
def test_losses_of_an_update_are_those_of_jaxgcrl(kind):
    """Its definitions: energies of all pairs, symmetric InfoNCE, the penalty on rows, and the actor's log density with
    its own small constant; on random parameters."""
    agent, batch, key = agent_of("crl", energy=kind), random_batch(), jax.random.key(4)
    params, state = started(agent, 7)
    hyper = crl.CRLHyperparameters(logsumexp_weight=0.1, target_entropy=-0.5, initial_temperature=0.3)
    total, metrics = jax.jit(agent.loss)(params, None, batch, state, hyper, key)
    states, goals = mlp(params["phi"], joined(batch.features, batch.action)), mlp(params["psi"], batch.code)
    logits = np.array([[energy(kind, one, goal) for goal in goals] for one in states])
    own = np.diag(logits)
    critic_loss = -(2 * own - logsumexp(logits, axis=1) - logsumexp(logits, axis=0)).mean()
    critic_loss += 0.1 * (logsumexp(logits + 1e-6, axis=1) ** 2).mean()
    mean, raw = np.split(mlp(params["actor"], joined(batch.features, batch.code)), 2, axis=-1)
    std = np.exp(-5.0 + 0.5 * 7.0 * (np.tanh(raw) + 1.0))
    noise = np.asarray(jax.random.normal(key, mean.shape, jnp.float32), np.float64)
    action = np.tanh(mean + std * noise)
    log_pi = (-0.5 * noise**2 - np.log(std) - 0.5 * np.log(2 * np.pi) - np.log(1 - action**2 + 1e-6)).sum(-1)
    fits = energy(kind, mlp(params["phi"], joined(batch.features, action)), goals)
    actor_loss = (0.3 * log_pi - fits).mean()
    temperature_loss = 0.3 * (-log_pi + 0.5 * 2).mean()
    np.testing.assert_allclose(metrics["critic_loss"], critic_loss, rtol=1e-5)
    np.testing.assert_allclose(metrics["actor_loss"], actor_loss, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(total, critic_loss + actor_loss + temperature_loss, rtol=1e-5, atol=1e-5)
    assert metrics["accuracy"] == pytest.approx((logits.argmax(1) == np.arange(B)).mean())
    assert metrics["energy_of_positives"] == pytest.approx(own.mean(), rel=1e-4)
    assert metrics["energy_of_negatives"] == pytest.approx(logits[~np.eye(B, dtype=bool)].mean(), rel=1e-4)


def test_contrast_is_least_for_pairs_that_belong_together():
    """Of all ways to pair four far representations with themselves, and at 0 for pairs infinitely far from others."""
    places = 3.0 * np.random.default_rng(0).normal(size=(4, 6)).astype(np.float32)
    logits = np.asarray(jax.jit(functools.partial(crl.energy, "norm"))(places[:, None], places[None]))
    orders = np.array([[0, 1, 2, 3], [1, 0, 2, 3], [1, 2, 3, 0], [3, 2, 1, 0], [0, 2, 1, 3]])
    losses = [float(contrastive_loss(logits[:, order], 0.0)) for order in orders]
    assert min(losses[1:]) > losses[0] > 0
    assert contrastive_loss(1000.0 * logits, 0.0) < 1e-3


def test_penalty_alone_fixes_the_level_of_energies():
    logits = np.random.default_rng(0).normal(size=(5, 5)).astype(np.float32)
    assert contrastive_loss(logits, 0.0) == pytest.approx(float(contrastive_loss(logits + 3.0, 0.0)), abs=1e-5)
    assert contrastive_loss(logits, 0.1) < contrastive_loss(logits + 3.0, 0.1)


def test_equal_representations_have_a_finite_gradient():
    assert np.isfinite(jax.grad(lambda one: crl.energy("norm", one, one))(jnp.ones(3))).all()
    same = jnp.ones((2, 3))
    assert np.isfinite(jax.grad(lambda one: crl.distances(one, one).sum())(same)).all()


@pytest.mark.parametrize("kind", ["norm", "dot"])
def test_energies_of_all_pairs_are_those_of_each_and_so_are_their_gradients(kind):
    """Far from the origin, and for pairs that are close, too; under `jax.vmap` over seeds, as they are trained."""
    random = np.random.default_rng(0)
    first = random.normal(size=(3, 5, 4)).astype(np.float32) + 50.0
    second = first[:, ::-1] + 0.01 * random.normal(size=(3, 5, 4)).astype(np.float32)
    weight = random.normal(size=(5, 5)).astype(np.float32)

    def of(function):
        weighted = jax.vmap(jax.value_and_grad(lambda a, b: (weight * function(a, b)).sum(), (0, 1)))
        return jax.tree.leaves(jax.jit(weighted)(first, second))

    each = of(lambda a, b: crl.energy(kind, a[:, None], b[None]))
    for found, wanted in zip(of(functools.partial(crl.energies, kind)), each, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4)


def test_the_critic_of_jaxgcrls_environments_tells_a_place_from_one_behind_it():
    """States go in as they are there: layer norm on the first layer saw their direction alone, and the far corner of
    the maze, at three times its coordinates, as the corner of the start."""
    fields = presets.JAXGCRL.agents.get("crl", {})
    config, agent = crl.CRLConfig(**fields), agent_of("crl", hidden=(256, 256), **fields)
    params, _ = hand_made.initial(agent, jax.random.key(0), np.zeros(4, np.float32), np.zeros(2, np.float32))
    phi = networks.MLP(config.hidden, config.size, config.layer_norm)
    places = np.float32([[place, place, 0.0, 0.0, 0.0, 0.0] for place in (4.0, 12.0)])
    start, corner = np.asarray(jax.jit(phi.apply)(params["phi"], places))
    assert np.linalg.norm(corner - start) > 1.5 * np.linalg.norm(start)


@pytest.mark.long
def test_learns_where_to_go_on_a_line():
    """From goals that were reached alone."""
    agent = agent_of("crl", 1, hidden=(32, 32), size=16)
    assert success_on_the_line(agent, crl.CRLHyperparameters(), 1.0)[1] > 0.95


def fields(**parts) -> set[str]:
    """What is refused of crl with these parts."""
    return {refusal.field for refusal in reasons_against(presets.load("fetch_push", agent="crl", **parts))}


def test_goals_that_were_achieved_are_asked_for():
    assert fields(method="her") == fields(method="cogoal", relabelling="her") == set()
    assert fields(method="none") == fields(method="cher") == {"relabelling"}
    assert fields(method="her", relabelling=HERConfig(future_share=0.8)) == {"relabelling.future_share"}
    in_prefix, skipping = HERConfig(1.0, strategy="prefix"), HERConfig(1.0, skip_reached=True)
    assert fields(method="her", relabelling=in_prefix) == {"relabelling.strategy"}
    assert fields(method="her", relabelling=skipping) == {"relabelling.skip_reached"}
    for task in ("fetch_push_positions", "gymnasium"):  # Their own relabelling skips, with other agents.
        assert reasons_against(presets.load(task, "none", agent="crl")) == []
    assert fields(method="dgrl", relabelling="her") <= {"learner"}
    (remark,) = remarks(presets.load("fetch_push", "infogoal", agent="crl", relabelling="her"))
    assert "no reward" in remark


def test_a_code_that_depends_on_the_state_is_refused():
    """It would tell which state of the batch a goal belongs to."""
    for agent, others in (("crl", "td3 or sac"), ("offline_crl", "gcivl or gciql or hiql or qrl")):
        parts = {"relabelling": "her"} if agent == "crl" else {}
        (refusal,) = reasons_against(presets.load("point_maze", "gcb", agent=agent, **parts))
        assert refusal.field == "learner" and refusal.remedy.endswith(
            f"(--learner.policy-input goal), or agent {others}"
        )


def test_a_decision_counts_where_its_episode_achieves_a_known_goal_later():
    rows = random_rows()
    achieved_count = replay.running_count((rows.record >= 0).any(-1))
    decisions = rows.valid & (np.arange(STEPS) % 3 > 0)
    leading = leading_to_goals(decisions, achieved_count, replay.steps_left(rows.valid))
    found = [[bool(later_goals(rows, row, step)) for step in range(STEPS)] for row in range(ROWS)]
    assert np.array_equal(leading, decisions & np.array(found)) and leading.sum() < decisions.sum()
    nothing = leading_to_goals(decisions, jnp.zeros_like(achieved_count), replay.steps_left(rows.valid))
    assert np.array_equal(nothing, decisions)


def test_every_transition_carries_a_goal_that_was_achieved_later_out_of_a_list():
    """Of positions of a grid, which most states lie outside of."""
    env, generator = points(), np.random.default_rng(0)
    agent, learner = crl.CRLConfig(hidden=(8,)), NoneConfig(hidden=(8,))
    parts = {"agent": agent, "learner": learner, "hyper": presets.default_hyperparameters(learner, agent)}
    config = points_config("none", relabelling=HERConfig(1.0, strategy="soon"), **parts)
    train, (count, steps) = make_train(config, env), (config.num_envs, config.rollout_steps)
    observation = np.zeros((count, steps + 1, 10), np.float32)
    observation[..., :3] = env.positions[generator.integers(0, 125, observation.shape[:2])]
    observation[..., :3] += generator.random(observation.shape[:2])[..., None] < 0.8  # By a metre.
    observation[..., 3] = np.arange(observation[..., 3].size).reshape(observation.shape[:2])  # To know it again.
    valid = generator.random((count, steps)) < 0.8
    desired = env.goals.training_goals[generator.integers(0, 4, valid.shape)]
    none = np.zeros(valid.shape, bool)
    action = np.zeros((*valid.shape, 4), np.float32)
    record = observation[..., :3]
    rows = Trajectories(observation, record, action, desired, valid, none, none, valid)

    @jax.jit
    def drawn(key, env, rows):
        state = train.initial(key, train.config.hyper, env)
        state = update_statistics(train.setup(env=env), state.replace(buffer=replay.add(state.buffer, rows, 0)), rows)
        return sample(train.setup(env=env), make_experience(train.setup(env=env), state, 0)[0], key).transitions

    batch, left = jax.device_get((drawn(jax.random.key(0), env, rows), replay.steps_left(jnp.asarray(valid))))
    achieved = np.asarray(env.goals_of(record))
    for seen, goal in zip(batch.observation, batch.desired_goal, strict=True):
        row, step = divmod(int(seen[3]), steps + 1)
        assert goal in achieved[row, step + 1 : step + 1 + left[row, step]]
