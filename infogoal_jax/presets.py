"""The tuned configuration of each (task, method), as data."""

import dataclasses
from typing import Any

from infogoal_jax import envs, learners
from infogoal_jax.agents.dqn import DQNConfig
from infogoal_jax.agents.hrac import HRACConfig
from infogoal_jax.config import Hyperparameters, StateEncoderConfig, TrainConfig
from infogoal_jax.errors import require

IMAGE_TASKS = ("fetch_reach", "fetch_push", "fetch_pick_and_place")

AGENTS = {"object_search": DQNConfig} | dict.fromkeys(IMAGE_TASKS, HRACConfig)
"""The agent of each task [P]."""

ENVIRONMENTS: dict[str, dict[str, Any]] = {task: {"goals": "images"} for task in IMAGE_TASKS}
"""Fields of each task's environment that training sets."""

LEARNERS: dict[tuple[str, str], dict[str, Any]] = {
    ("fetch_reach", "infogoal"): {"window": 5, "num_pairs": 128},
    ("fetch_push", "infogoal"): {"window": 3, "num_pairs": 128},
    ("fetch_pick_and_place", "infogoal"): {"window": 3, "num_pairs": 256},
}
"""Fields of each learner [M]: what moves in a few steps less far than the 20 cm between test and training goals."""

FETCH_HYPERPARAMETERS = {"discount": 0.99, "epsilon": 0.4}

HYPERPARAMETERS: dict[tuple[str, str], dict[str, float]] = {
    ("object_search", "infogoal"): {"learning_rate": 5e-4, "target_rate": 0.05, "discount": 0.98, "intrinsic_weight": 3.0},
    ("object_search", "none"): {"learning_rate": 1e-3, "target_rate": 0.05, "discount": 0.98, "intrinsic_weight": 0.0},
    **{(task, "infogoal"): FETCH_HYPERPARAMETERS | {"intrinsic_weight": 1.0} for task in IMAGE_TASKS},
    **{(task, "none"): FETCH_HYPERPARAMETERS | {"intrinsic_weight": 0.0} for task in IMAGE_TASKS},
}
"""What was tuned away from the defaults of `Hyperparameters` [M]: object search on houses, Fetch on goal sets, of other seeds than those that results
are shown on."""

FETCH_TRAINING = {
    "num_envs": 256, "rollout_steps": 50, "batch_size": 256, "buffer_steps": 400_000, "num_epochs": 60, "epochs_per_evaluation": 20,
    "evaluation_starts": 5, "state_encoder": StateEncoderConfig(features=128),
}
REACH_TRAINING = FETCH_TRAINING | {"num_envs": 64, "batch_size": 128, "buffer_steps": 200_000}  # For two cores.

TRAINING: dict[tuple[str, str], dict[str, Any]] = {
    ("object_search", "infogoal"): {"num_epochs": 100},
    ("object_search", "none"): {"num_epochs": 160},  # Without the intrinsic reward, training goals take longer to level off.
    **{(task, method): FETCH_TRAINING for task in IMAGE_TASKS for method in ("infogoal", "none")},
    **{("fetch_reach", method): REACH_TRAINING for method in ("infogoal", "none")},
}
"""What was tuned away from the defaults of `TrainConfig` [M]."""


def load(task: str, method: str = "infogoal", **changes: Any) -> TrainConfig:
    """The configuration for a task and a method; `changes` replace fields of `TrainConfig`. Raises `UserError` for an unknown name."""
    env = envs.entry(task).config(**ENVIRONMENTS.get(task, {}))
    learner = learners.entry(method).config(**LEARNERS.get((task, method), {}))
    require(task in AGENTS, "task", task, f"there is no agent for it yet; the environment alone is envs.load({task!r}). Known: {', '.join(AGENTS)}")
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
