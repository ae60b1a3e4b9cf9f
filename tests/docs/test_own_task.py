"""docs/own_task.md: a task made outside of the repository keeps the contract, is trained on, and can be learned."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pages import block_of, lines_of, run

from infogoal_jax import envs, presets
from infogoal_jax.envs.environment import Environment

REGISTERED = "walled_square", envs.registry, presets.registry


@pytest.fixture(scope="module")
def block() -> str:
    """The page's one block of Python."""
    return block_of("own_task.md")


@pytest.fixture(scope="module")
def script(block) -> dict:
    """The names that the block leaves behind, with half of the training."""
    assert block.count("num_epochs=20") == 1
    with run(block.replace("num_epochs=20", "num_epochs=10"), *REGISTERED) as names:
        yield names


def test_it_is_short(block):
    assert lines_of(block) <= 80


def test_it_is_being_learned(script):
    """A random walk reaches a third of the goals."""
    metrics = script["result"].metrics
    assert metrics["train_goal/success_rate"][-1] > 0.5 and metrics["test_goal/success_rate"][-1] > 0.4


@pytest.mark.long
def test_it_is_learned(block):
    """Goals that were never commanded too."""
    with run(block, *REGISTERED) as names:
        metrics = names["result"].metrics
    assert metrics["train_goal/success_rate"][-1] > 0.8 and metrics["test_goal/success_rate"][-1] > 0.7


def test_it_keeps_the_contract(script):
    """What is not written has the default that most tasks need."""
    env = script["train"].env
    assert isinstance(env, Environment) and env.discrete and env.recorded is None and not env.has_target_states
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 50))
    assert not np.any(env.reached(env.achieved(state), state.goal)) and np.all(env.goals.train_mask[state.goal])
    assert (
        env.action_mask(env.observe(state)).shape == (50, 4)
        and env.action_mask(env.observe(state)).all()
        and env.decides(state).all()
    )


def test_the_door_is_the_only_way(script):
    """Every cell can be reached from every other through the door, and only through it."""
    env = script["train"].env
    near = np.eye(64, dtype=bool)
    for _ in range(64):
        near |= near[:, np.asarray(env.next_cell)].any(-1)
    assert near.all()
    crossings = [
        (cell, following)
        for cell, row in enumerate(np.asarray(env.next_cell))
        for following in row
        if cell // 32 != following // 32
    ]
    assert sorted(map(tuple, np.asarray(crossings).tolist())) == [(25, 33), (33, 25)]


def test_all_actions_can_be_taken_after_vectors_too(script):
    """The contract's default tells the axes of a batch from those of an observation."""
    env = script["train"].env

    class SeenAsVectors(script["WalledSquare"]):
        observe = lambda self, state: jnp.zeros(3)  # noqa: E731

    assert SeenAsVectors(env.next_cell, env.goals, env.episode_length).action_mask(jnp.zeros((5, 2, 3))).shape == (
        5,
        2,
        4,
    )
