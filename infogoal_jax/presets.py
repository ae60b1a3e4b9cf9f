"""The tuned configuration of each (task, method), as data."""

import dataclasses
from typing import Any

from infogoal_jax import envs, learners
from infogoal_jax.agents.dqn import DQNConfig
from infogoal_jax.config import Hyperparameters, TrainConfig

AGENTS = {"object_search": DQNConfig}
"""The agent of each task [P]."""

HYPERPARAMETERS: dict[tuple[str, str], dict[str, float]] = {}
"""What was tuned away from the defaults of `Hyperparameters` [M]."""

TRAINING: dict[tuple[str, str], dict[str, Any]] = {}
"""What was tuned away from the defaults of `TrainConfig` [M]."""


def load(task: str, method: str = "infogoal", **changes: Any) -> TrainConfig:
    """The configuration for a task and a method; `changes` replace fields of `TrainConfig`. Raises `UserError` for an unknown name."""
    env, learner = envs.entry(task).config(), learners.entry(method).config()
    settings = {
        "task": task, "method": method, "env": env, "learner": learner, "agent": AGENTS[task](),
        "hyper": Hyperparameters(**HYPERPARAMETERS.get((task, method), {})), **TRAINING.get((task, method), {}),
    }
    return TrainConfig(**(settings | changes))


def from_dict(values: dict[str, Any]) -> TrainConfig:
    """The configuration that `config.to_json` wrote, parsed as JSON. Unknown fields are an error of the file, not of the user."""
    base = load(values["task"], values["method"])
    parts = {}
    for field in dataclasses.fields(base):
        value = values[field.name]
        parts[field.name] = type(getattr(base, field.name))(**{k: tuplify(v) for k, v in value.items()}) if isinstance(value, dict) else value
    return TrainConfig(**parts)


def tuplify(value: Any) -> Any:
    """Lists of JSON as the tuples that configurations hold."""
    return tuple(tuplify(item) for item in value) if isinstance(value, list) else value
