"""docs/own_task.md: a task made outside of the repository keeps the contract, is trained on, and can be learned."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import numpy as np
import pytest

from infogoal_jax import envs, presets
from infogoal_jax.envs.environment import Environment

PAGE = Path(__file__).parents[1] / "docs" / "own_task.md"
TASK = "walled_square"


@pytest.fixture(scope="module")
def block() -> str:
    """The page's one block of Python."""
    (found,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.M | re.S)
    return found


@contextmanager
def run(block: str) -> Iterator[dict]:
    """The names that the block leaves behind, for as long as its task is registered."""
    names = {"__name__": "own_task"}
    with pytest.MonkeyPatch.context() as kept:
        for registry in (envs.registry, presets.registry):
            kept.setitem(registry, TASK, None)  # The script sets it; afterwards it is gone again.
        exec(compile(block, "own_task", "exec"), names)
        yield names
    assert TASK not in envs.registry and TASK not in presets.registry


@pytest.fixture(scope="module")
def script(block) -> dict:
    """The same with half of the training."""
    assert block.count('"num_epochs": 20') == 1
    with run(block.replace('"num_epochs": 20', '"num_epochs": 10')) as names:
        yield names


def test_it_is_short(block):
    assert len([line for line in block.splitlines() if line.strip()]) <= 80


def test_it_is_being_learned(script):
    """A random walk reaches a third of the goals."""
    metrics = script["result"].metrics
    assert metrics["train_goal/success_rate"][-1] > 0.5 and metrics["test_goal/success_rate"][-1] > 0.4


@pytest.mark.long
def test_it_is_learned(block):
    """Goals that were never commanded too."""
    with run(block) as names:
        metrics = names["result"].metrics
    assert metrics["train_goal/success_rate"][-1] > 0.8 and metrics["test_goal/success_rate"][-1] > 0.7


def test_it_keeps_the_contract(script):
    """What is not written has the default that most tasks need."""
    env = script["train"].env
    assert isinstance(env, Environment) and env.discrete and env.recorded is None and not env.has_target_states
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 50))
    assert not np.any(env.reached(env.achieved(state), state.goal)) and np.all(env.goals.train_mask[state.goal])
    assert env.action_mask(env.observe(state)).shape == (50, 4) and env.action_mask(env.observe(state)).all() and env.decides(state).all()


def test_the_door_is_the_only_way(script):
    """Every cell can be reached from every other through the door, and only through it."""
    env = script["train"].env
    near = np.eye(64, dtype=bool)
    for _ in range(64):
        near |= near[:, np.asarray(env.next_cell)].any(-1)
    assert near.all()
    crossings = [(cell, following) for cell, row in enumerate(np.asarray(env.next_cell)) for following in row if cell // 32 != following // 32]
    assert sorted(map(tuple, np.asarray(crossings).tolist())) == [(25, 33), (33, 25)]
