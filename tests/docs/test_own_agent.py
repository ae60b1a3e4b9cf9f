"""The agent that docs/own_agent.md makes is complete, short, learns quantiles, and trains as it says."""

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from pages import block_of, in_hand_made_rooms, lines_of, run

import infogoal_jax
from infogoal_jax import agents, presets
from infogoal_jax.agents.agent import AgentBatch
from infogoal_jax.train.evaluation import evaluate, random_policy

SMALL = {"num_epochs": 2, "epochs_per_evaluation": 2, "updates_per_epoch": 5, "evaluation_starts": 1}
LONG = {
    "num_epochs": 12,
    "epochs_per_evaluation": 12,
    "updates_per_epoch": 100,
    "batch_size": 64,
    "evaluation_starts": 20,
}
QUANTILES = 8


@pytest.fixture(scope="module")
def block() -> str:
    """The page's one block of Python."""
    return block_of("own_agent.md")


@pytest.fixture(scope="module")
def script(block) -> dict:
    """The names that the block leaves behind, run on the hand-made rooms instead of a house, with nothing else
    changed."""
    with run(block, "qr_dqn", agents.registry, prepare=in_hand_made_rooms(**SMALL)) as names:
        yield names


def test_it_takes_at_most_eighty_lines(block):
    assert lines_of(block) <= 80


def test_it_trains_with_infogoal_and_reports_the_spread(script):
    result, config = script["result"], script["config"]
    assert presets.names_of(config)["agent"] == "qr_dqn" and presets.names_of(config)["learner"] == "infogoal"
    assert np.asarray(result.epochs["agent/spread"]).shape == (SMALL["num_epochs"],)
    assert all(np.isfinite(values).all() for values in jax.tree.leaves((result.epochs, result.params)))


@pytest.mark.long
def test_it_learns_its_training_goals(block):
    """Twice as often as a random policy reaches them."""
    with run(block, "qr_dqn", agents.registry, prepare=in_hand_made_rooms(**LONG)) as names:
        env, success = names["train"].env, names["result"].metrics["train_goal/success_rate"][-1]
    chance = evaluate(random_policy(env), env, env.goals.commanded, LONG["evaluation_starts"]).success.mean()
    assert 2 * chance < success > 0.7


def test_its_loss_finds_the_quantiles_of_the_reward(script):
    """Of one state whose action ends the episode with a reward that is uniform in [0, 1]: 1/16, 3/16, ..., 15/16."""
    env = hand_made.environment()
    agent = script["make"](script["QRDQNConfig"](hidden=(16,), num_quantiles=QUANTILES), env)
    hyper = script["QRDQNHyperparameters"](threshold=0.01)
    params, state = agent.init(jax.random.key(0), jnp.ones(2), jnp.ones(3))
    size, optimizer = 256, optax.adam(optax.linear_schedule(0.02, 0.0, 1000))
    features, code, mask = jnp.ones((size, 2)), jnp.ones((size, 3)), jnp.ones((size, env.action_size), bool)

    def step(carry, key):
        params, moments = carry
        batch = AgentBatch(
            observation=None,
            next_observation=None,
            features=features,
            code=code,
            action=jnp.zeros(size, jnp.int32),
            next_features=features,
            next_code=code,
            target_features=features,
            target_code=code,
            reward=jax.random.uniform(key, (size,)),
            discount=jnp.zeros(size),
            action_mask=mask,
            next_action_mask=mask,
        )
        gradient, metrics = jax.grad(agent.loss, has_aux=True)(params, params, batch, state, hyper, key)
        change, moments = optimizer.update(gradient, moments)
        return (optax.apply_updates(params, change), moments), metrics

    keys = jax.random.split(jax.random.key(1), 1000)
    (_, _), metrics = jax.jit(lambda carry: jax.lax.scan(step, carry, keys))((params, optimizer.init(params)))
    expected = (np.arange(QUANTILES) + 0.5) / QUANTILES
    assert metrics["spread"][-1] == pytest.approx(expected.std(), abs=0.03)
    assert metrics["value"][-1] == pytest.approx(0.5, abs=0.03)


def test_settings_that_make_no_sense_are_refused(script):
    with pytest.raises(infogoal_jax.UserError, match="agent.num_steps"):
        hand_made.config("infogoal", agent=script["QRDQNConfig"](num_steps=21))
