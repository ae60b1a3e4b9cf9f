"""The tuned configuration of each (task, method), as data."""

import dataclasses
import math
from typing import Any

from infogoal_jax import agents, envs, hindsight, learners
from infogoal_jax.config import Hyperparameters, StateEncoderConfig, TrainConfig
from infogoal_jax.errors import require

IMAGE_TASKS = ("fetch_reach", "fetch_push", "fetch_pick_and_place")

ALGORITHMS = {"object_search": "dqn"} | dict.fromkeys(IMAGE_TASKS, "hrac") | {"object_manipulation": "hrac", "embodied_qa": "cql"}
"""The agent of each task [P]."""

AGENTS: dict[tuple[str, str], dict[str, Any]] = {
    ("object_manipulation", "hrac"): {"interval": 3, "subgoal_scale": math.pi / 4, "cell": math.pi / 6},
}
"""Fields of the agent of each (task, algorithm)."""

RELABELLINGS = {"embodied_qa": "her"}
"""How goals are relabelled where the task has it [P]; elsewhere not at all."""

HINDSIGHTS: dict[tuple[str, str], dict[str, Any]] = {("embodied_qa", "her"): {"future_share": 0.6, "random_share": 0.2}}
"""Fields of the relabelling of each (task, relabelling)."""

ENVIRONMENTS: dict[str, dict[str, Any]] = {task: {"goals": "images"} for task in IMAGE_TASKS}
"""Fields of each task's environment that training sets."""

LEARNERS: dict[tuple[str, str], dict[str, Any]] = {
    ("fetch_reach", "infogoal"): {"window": 5, "num_pairs": 128},
    ("fetch_push", "infogoal"): {"window": 3, "num_pairs": 128},
    ("fetch_pick_and_place", "infogoal"): {"window": 3, "num_pairs": 256},
    ("object_manipulation", "infogoal"): {"window": 3, "num_pairs": 256},
    ("embodied_qa", "infogoal"): {"window": 0, "num_pairs": 128},
}
"""Fields of each learner [M]: what moves in a few steps less far than the 20 cm between test and training goals."""

FETCH_HYPERPARAMETERS = {"discount": 0.99, "epsilon": 0.4}

HYPERPARAMETERS: dict[tuple[str, str], dict[str, float]] = {
    ("object_search", "infogoal"): {"learning_rate": 5e-4, "target_rate": 0.05, "discount": 0.98, "intrinsic_weight": 3.0},
    ("object_search", "none"): {"learning_rate": 1e-3, "target_rate": 0.05, "discount": 0.98, "intrinsic_weight": 0.0},
    **{(task, "infogoal"): FETCH_HYPERPARAMETERS | {"intrinsic_weight": 1.0} for task in IMAGE_TASKS},
    **{(task, "none"): FETCH_HYPERPARAMETERS | {"intrinsic_weight": 0.0} for task in IMAGE_TASKS},
    ("object_manipulation", "infogoal"): {"discount": 0.98, "epsilon": 0.3, "intrinsic_weight": 3.0},
    ("object_manipulation", "none"): {"discount": 0.98, "epsilon": 0.3, "intrinsic_weight": 0.0},
    ("embodied_qa", "infogoal"): {"discount": 0.95, "intrinsic_weight": 1.0, "conservative_weight": 0.01},
    ("embodied_qa", "none"): {"discount": 0.95, "intrinsic_weight": 0.0, "conservative_weight": 0.02},
}
"""What was tuned away from the defaults of `Hyperparameters` [M]: object search on houses, Fetch on goal sets, of other seeds than those that results
are shown on."""

FETCH_TRAINING = {
    "num_envs": 256, "rollout_steps": 50, "batch_size": 256, "buffer_steps": 400_000, "num_epochs": 60, "epochs_per_evaluation": 20,
    "evaluation_starts": 5, "state_encoder": StateEncoderConfig(features=128),
}
REACH_TRAINING = FETCH_TRAINING | {"num_envs": 64, "batch_size": 128, "buffer_steps": 200_000}  # For two cores.

CUBE_TRAINING = {
    "num_envs": 256, "rollout_steps": 30, "batch_size": 256, "buffer_steps": 400_000, "num_epochs": 200, "epochs_per_evaluation": 20,
    "evaluation_starts": 5, "state_encoder": StateEncoderConfig(features=256),
}

SHELF_TRAINING = {
    "updates_per_epoch": 500, "batch_size": 256, "num_epochs": 60, "epochs_per_evaluation": 10, "evaluation_starts": 5,
    "state_encoder": StateEncoderConfig(features=128),
}

TRAINING: dict[tuple[str, str], dict[str, Any]] = {
    ("object_search", "infogoal"): {"num_epochs": 100},
    ("object_search", "none"): {"num_epochs": 160},  # Without the intrinsic reward, training goals take longer to level off.
    **{(task, method): FETCH_TRAINING for task in IMAGE_TASKS for method in ("infogoal", "none")},
    **{("fetch_reach", method): REACH_TRAINING for method in ("infogoal", "none")},
    **{("object_manipulation", method): CUBE_TRAINING for method in ("infogoal", "none")},
    **{("embodied_qa", method): SHELF_TRAINING for method in ("infogoal", "none")},
}
"""What was tuned away from the defaults of `TrainConfig` [M]."""


def load(task: str, method: str = "infogoal", algorithm: str | None = None, relabelling: str | None = None, **changes: Any) -> TrainConfig:
    """The configuration for a task and a method; `changes` replace fields of `TrainConfig`. Raises `UserError` for an unknown name.

    algorithm, relabelling: names of another agent and another relabelling than the task's own.
    """
    env = envs.entry(task).config(**ENVIRONMENTS.get(task, {}))
    learner = learners.entry(method).config(**LEARNERS.get((task, method), {}))
    require(task in ALGORITHMS, "task", task,
            f"there is no agent for it yet; the environment alone is envs.load({task!r}). Known: {', '.join(ALGORITHMS)}")
    algorithm, relabelling = algorithm or ALGORITHMS[task], relabelling or RELABELLINGS.get(task, "none")
    settings = {
        "task": task, "method": method, "algorithm": algorithm, "relabelling": relabelling, "env": env, "learner": learner,
        "agent": agents.entry(algorithm).config(**AGENTS.get((task, algorithm), {})),
        "hindsight": hindsight.entry(relabelling).config(**HINDSIGHTS.get((task, relabelling), {})),
        "hyper": Hyperparameters(**HYPERPARAMETERS.get((task, method), {})), **TRAINING.get((task, method), {}),
    }
    return TrainConfig(**(settings | changes))


def from_dict(values: dict[str, Any]) -> TrainConfig:
    """The configuration that `config.to_json` wrote, parsed as JSON. Unknown fields are an error of the file, not of the user."""
    base = load(values["task"], values["method"], values.get("algorithm"), values.get("relabelling"))  # Early runs do not name them.
    parts = {}
    for field in dataclasses.fields(base):
        own = getattr(base, field.name)
        value = values.get(field.name, own)
        parts[field.name] = type(own)(**{k: tuplify(v) for k, v in value.items()}) if isinstance(value, dict) else value
    return TrainConfig(**parts)


def tuplify(value: Any) -> Any:
    """Lists of JSON as the tuples that configurations hold."""
    return tuple(tuplify(item) for item in value) if isinstance(value, list) else value
