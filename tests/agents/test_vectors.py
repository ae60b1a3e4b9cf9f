"""What holds for every agent whose actions are vectors: which loss trains what, what cannot be a configuration, the
task that it acts in, and the whole program around it."""

import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vector_agents
from vector_agents import B, random_batch, started, varied

from infogoal_jax import agents, make_train, presets
from infogoal_jax.errors import UserError
from infogoal_jax.loading import reasons_against

VECTORS = ("td3", "sac", "crl")
every_agent = pytest.mark.parametrize("name", VECTORS)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "crl" else pytest.mark.long) for name in VECTORS]
)
def test_critics_and_encoders_learn_from_the_critics_loss_alone(name):
    """Their gradient is the same whatever the actor does, and whatever actions cost or entropy is worth, where nothing
    follows. Everything has a gradient."""
    entry = agents.registry.entry(name)
    agent, batch = vector_agents.agent_of(name), random_batch(discount=jnp.zeros(B))
    params, state = started(agent)
    cost = "action_cost" if name == "td3" else "initial_temperature"

    def slopes(params, hyper):
        def loss(params, features, code):
            seen = batch.replace(features=features, code=code)
            return agent.loss(params, params, seen, state, hyper, jax.random.key(0))[0]

        return jax.grad(loss, argnums=(0, 1, 2))(params, batch.features, batch.code)

    slopes = jax.jit(slopes)
    (own, *inputs) = slopes(params, entry.hyper(**{cost: 0.1}))
    (other, *other_inputs) = slopes(params | {"actor": varied(params["actor"], 5)}, entry.hyper(**{cost: 3.0}))
    critics = {part for part in params if part not in ("actor", "log_temperature")}
    for one, same in zip(
        jax.tree.leaves(([own[part] for part in critics], inputs)),
        jax.tree.leaves(([other[part] for part in critics], other_inputs)),
        strict=True,
    ):
        np.testing.assert_allclose(one, same, atol=1e-6)
    assert all((leaf != 0).any() for leaf in jax.tree.leaves((own["actor"], own.get("log_temperature"), inputs)))
    assert all(any((leaf != 0).any() for leaf in jax.tree.leaves(own[part])) for part in critics)


@pytest.mark.parametrize(("name", "num_steps"), [("td3", 0), ("sac", 10_000)])
def test_returns_longer_than_an_episode_are_refused(name, num_steps):
    with pytest.raises(UserError, match=r"^agent.num_steps = "):
        presets.load("fetch_push", "her", agent=agents.registry.entry(name).config(num_steps=num_steps))


@every_agent
def test_acts_where_actions_are_vectors(name):
    assert not reasons_against(presets.load("fetch_push", "her", agent=name))
    for task in ("object_search", "object_manipulation"):
        assert reasons_against(presets.load(task, "her", agent=name))[0].field == "agent"


def test_all_goals_at_once_are_learned_from_by_products_alone():
    assert not reasons_against(presets.load("fetch_push", "all_goals", agent="td3"))
    with pytest.raises(UserError, match="^agent = 'sac': values one goal at a time"):
        presets.load("fetch_push", "all_goals", agent="sac")


@pytest.mark.parametrize(
    ("name", "method"),
    [
        pytest.param("td3", "infogoal", marks=pytest.mark.long),
        ("td3", "all_goals"),
        pytest.param("sac", "her", marks=pytest.mark.long),
        ("crl", "her"),
        pytest.param("gcivl", "none", marks=pytest.mark.long),
        pytest.param("gciql", "infogoal", marks=pytest.mark.long),  # An update of each is held to OGBench's code.
        pytest.param("qrl", "none", marks=pytest.mark.long),
        pytest.param("hiql", "none", marks=pytest.mark.long),
    ],
)
def test_goes_through_an_epoch_and_an_evaluation(name, method):
    """Traced, not run, on points that are moved by vectors."""
    small = hand_made_points.config("infogoal" if method == "infogoal" else "none")
    preset = presets.load("fetch_reach", method, agent=name)
    hyper = presets.default_hyperparameters(small.learner, preset.agent)
    config = hand_made_points.config(
        "infogoal" if method == "infogoal" else "none", agent=preset.agent, relabelling=preset.relabelling, hyper=hyper
    )
    train = make_train(config, hand_made_points.points())

    def chunk(key, env):
        return train.chunk(train.initial(key, train.config.hyper, env), jnp.arange(1), train.config.hyper, env)

    state, epochs, metrics = jax.eval_shape(chunk, jax.random.key(0), train.env)
    assert metrics["test_goal/success_rate"].shape == () and epochs["agent/loss"].shape == (1,)
    assert state.params["agent"].keys() == state.target_params["agent"].keys()
