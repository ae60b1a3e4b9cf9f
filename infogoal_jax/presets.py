"""The tuned configuration of each (task, method), as data."""

import dataclasses
import math
from typing import Any, NamedTuple

from infogoal_jax import agents, envs, hindsight, learners
from infogoal_jax import exploration as explorers
from infogoal_jax.config import Hyperparameters, StateEncoderConfig, TrainConfig
from infogoal_jax.errors import nearest, require

IMAGE_TASKS = ("fetch_reach", "fetch_push", "fetch_pick_and_place")
TASKS = ("object_search", "object_manipulation", *IMAGE_TASKS, "embodied_qa")


class Method(NamedTuple):
    """What a row of the paper's Table I is made of: names of a learner, a relabelling (None: the task's own) and an explorer."""

    learner: str
    relabelling: str | None = None
    exploration: str = "none"


METHODS = {name: Method(name) for name in learners.registry} | {name: Method("none", name) for name in hindsight.registry if name != "none"} | {
    name: Method("none", None, name) for name in explorers.registry if name != "none"
}
"""What can be asked for by one name. Learners, relabellings and explorers can be combined by their own names too."""

ALGORITHMS = {"object_search": "dqn"} | dict.fromkeys(IMAGE_TASKS, "hrac") | {"object_manipulation": "hrac", "embodied_qa": "cql"}
"""The agent of each task [P]."""

AGENTS: dict[tuple[str, str], dict[str, Any]] = {
    ("object_manipulation", "hrac"): {"interval": 3, "subgoal_scale": math.pi / 4, "cell": math.pi / 6},
}
"""Fields of the agent of each (task, algorithm)."""

RELABELLINGS = {"embodied_qa": "her"}
"""How goals are relabelled where the task has it [P]; elsewhere not at all."""

HINDSIGHTS: dict[tuple[str, str], dict[str, Any]] = {
    **{("embodied_qa", relabelling): {"future_share": 0.6, "random_share": 0.2} for relabelling in ("her", "cher")},
    ("embodied_qa", "ghrl"): {"share": 0.6, "random_share": 0.2},
    **{(task, "ghrl"): {"share": 0.8} for task in IMAGE_TASKS},
}
"""Fields of the relabelling of each (task, relabelling)."""

ENVIRONMENTS: dict[str, dict[str, Any]] = {task: {"goals": "images"} for task in IMAGE_TASKS}
"""Fields of each task's environment that training sets."""

EVERY = "every method"
"""Stands for the methods of which nothing else is said."""

SIMILAR = {
    "fetch_reach": {"window": 5, "num_pairs": 128}, "fetch_push": {"window": 3, "num_pairs": 128},
    "fetch_pick_and_place": {"window": 3, "num_pairs": 256}, "object_manipulation": {"window": 3, "num_pairs": 256},
    "embodied_qa": {"window": 0, "num_pairs": 128},
}
"""Which goals count as similar [M]: what moves in a few steps less far than the 20 cm between test and training goals."""

LEARNERS: dict[tuple[str, str], dict[str, Any]] = {
    **{(task, EVERY): {"standardise_images": True} for task in IMAGE_TASKS},  # For corrupted goals (docs/hrac.md).
    **{(task, method): fields for task, fields in SIMILAR.items() for method in ("infogoal", "cogoal")},
    **{("embodied_qa", method): {"vector_std": 1.0} for method in ("vae", "dgrl")},  # Its embeddings are scaled to numbers of the order of 1.
}
"""Fields of each learner."""

FOUND: dict[tuple[str, str], dict[str, float]] = {
    ("object_search", "cogoal"): {"learning_rate": 1.057e-3, "discount": 0.9866, "target_rate": 0.07083, "learner_weight": 0.2341},
    ("fetch_reach", "infogoal"): {
        "learning_rate": 1.351e-3, "discount": 0.9313, "target_rate": 0.04286, "learner_weight": 5.164, "intrinsic_weight": 3.768,
    },
    ("fetch_reach", "infobot"): {
        "learning_rate": 7.555e-4, "discount": 0.9493, "target_rate": 0.01356, "intrinsic_weight": 0.4549, "fixed_beta": 1.064e-6,
    },
    **{("fetch_reach", method): {"learning_rate": 1.165e-3, "discount": 0.93, "target_rate": 0.02287, "learner_weight": 1.817}
       for method in ("cogoal", "vae")},
    ("fetch_reach", "dgrl"): {"learning_rate": 1.351e-3, "discount": 0.9313, "target_rate": 0.04286, "learner_weight": 5.164},
    ("fetch_reach", "gcb"): {"learning_rate": 1.399e-4, "discount": 0.972, "target_rate": 0.00858, "learner_weight": 1.453e-3},
    ("fetch_reach", "rad"): {"learning_rate": 2.614e-3, "discount": 0.9654, "target_rate": 0.05371},
    **{("fetch_reach", method): {"learning_rate": 1.859e-4, "discount": 0.9061, "target_rate": 0.07689} for method in ("her", "cher")},
    ("fetch_reach", "ghrl"): {"learning_rate": 1.165e-3, "discount": 0.93, "target_rate": 0.02287},
    ("fetch_reach", "none"): {"learning_rate": 1.399e-4, "discount": 0.972, "target_rate": 0.00858},
}
"""What `infogoal tune` found to be better than the values below, by the rule of docs/methods.md (docs/results/tuning)."""

HYPERPARAMETERS: dict[tuple[str, str], dict[str, float]] = {
    ("object_search", EVERY): {"learning_rate": 1e-3, "target_rate": 0.05, "discount": 0.98, "intrinsic_weight": 0.0},
    ("object_search", "infogoal"): {"learning_rate": 5e-4, "intrinsic_weight": 3.0},
    **{(task, EVERY): {"discount": 0.99, "epsilon": 0.4, "intrinsic_weight": 0.0} for task in IMAGE_TASKS},
    **{(task, "infogoal"): {"intrinsic_weight": 1.0} for task in IMAGE_TASKS},
    ("object_manipulation", EVERY): {"discount": 0.98, "epsilon": 0.3, "intrinsic_weight": 0.0},
    ("object_manipulation", "infogoal"): {"intrinsic_weight": 3.0},
    ("embodied_qa", EVERY): {"discount": 0.95, "intrinsic_weight": 0.0, "conservative_weight": 0.02},
    ("embodied_qa", "infogoal"): {"intrinsic_weight": 1.0, "conservative_weight": 0.01},
    **{(task, "infobot"): {"intrinsic_weight": 1.0, "fixed_beta": 3e-5} for task in TASKS},  # The authors' 0.01 is beside rewards of 10, squared.
    **{(task, "gcb"): {"learner_weight": 0.1} for task in TASKS} | {("object_search", "gcb"): {"learner_weight": 0.03}},
    ("object_search", "vae"): {"learner_weight": 0.1},
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
    ("object_search", EVERY): {"num_epochs": 160},  # Without the intrinsic reward, training goals take longer to level off.
    ("object_search", "infogoal"): {"num_epochs": 100},
    **{(task, EVERY): FETCH_TRAINING for task in IMAGE_TASKS},
    ("fetch_reach", EVERY): REACH_TRAINING,
    ("object_manipulation", EVERY): CUBE_TRAINING,
    ("embodied_qa", EVERY): SHELF_TRAINING,
}
"""What was tuned away from the defaults of `TrainConfig` [M]."""


def method_named(name: str) -> Method:
    """The method of this name, or a `UserError` with the nearest one."""
    if name in learners.registry:
        return Method(name)  # One that was registered after this module was imported, too.
    require(name in METHODS, "method", name, f"no such method.{nearest(name, list(METHODS))} Known: {', '.join(METHODS)}")
    return METHODS[name]


def name_of(config: TrainConfig) -> str:
    """The name of the method that a configuration is made of; a combination without one is named by its parts."""
    own = RELABELLINGS.get(config.task, "none")
    relabelling = "none" if config.relabelling == own else "unrelabelled" if config.relabelling == "none" else config.relabelling
    parts = [name for name in (config.method, relabelling, config.exploration) if name != "none"]
    return "+".join(parts) or "none"


def method_of(task: str, learner: str, relabelling: str, exploration: str) -> str:
    """The name of the method that these parts make on a task; of a combination without one, that of its learner."""
    parts = Method(learner, None if relabelling == RELABELLINGS.get(task, "none") else relabelling, exploration)
    return next((name for name, known in METHODS.items() if known == parts), learner)


def fields_of(table: dict[tuple[str, str], dict[str, Any]], task: str, method: str) -> dict[str, Any]:
    """What a table holds for every method of a task, and over it what it holds for this one."""
    return table.get((task, EVERY), {}) | table.get((task, method), {})


def load(task: str, method: str = "infogoal", algorithm: str | None = None, relabelling: str | None = None, exploration: str | None = None,
         **changes: Any) -> TrainConfig:
    """The configuration for a task and a method; `changes` replace fields of `TrainConfig`. Raises `UserError` for an unknown name.

    algorithm, relabelling, exploration: names of another agent, relabelling and explorer than the task's and the method's own.
    """
    env = envs.entry(task).config(**ENVIRONMENTS.get(task, {}))
    parts = method_named(method)
    require(task in ALGORITHMS, "task", task,
            f"there is no agent for it yet; the environment alone is envs.load({task!r}). Known: {', '.join(ALGORITHMS)}")
    algorithm, explorer = algorithm or ALGORITHMS[task], exploration or parts.exploration
    relabelling = relabelling or parts.relabelling or RELABELLINGS.get(task, "none")
    method = method_of(task, parts.learner, relabelling, explorer)
    settings = {
        "task": task, "method": parts.learner, "algorithm": algorithm, "relabelling": relabelling, "exploration": explorer, "env": env,
        "learner": learners.entry(parts.learner).config(**fields_of(LEARNERS, task, parts.learner)),
        "agent": agents.entry(algorithm).config(**AGENTS.get((task, algorithm), {})),
        "hindsight": hindsight.entry(relabelling).config(**HINDSIGHTS.get((task, relabelling), {})),
        "explorer": explorers.entry(explorer).config(),
        "hyper": Hyperparameters(**fields_of(HYPERPARAMETERS, task, method) | FOUND.get((task, method), {})), **fields_of(TRAINING, task, method),
    }
    return TrainConfig(**(settings | changes))


def from_dict(values: dict[str, Any]) -> TrainConfig:
    """The configuration that `config.to_json` wrote, parsed as JSON. Unknown fields are an error of the file, not of the user."""
    named = (values.get(part) for part in ("algorithm", "relabelling", "exploration"))  # Early runs do not name them.
    base = load(values["task"], values["method"], *named)
    parts = {}
    for field in dataclasses.fields(base):
        own = getattr(base, field.name)
        value = values.get(field.name, own)
        parts[field.name] = type(own)(**{k: tuplify(v) for k, v in value.items()}) if isinstance(value, dict) else value
    return TrainConfig(**parts)


def tuplify(value: Any) -> Any:
    """Lists of JSON as the tuples that configurations hold."""
    return tuple(tuplify(item) for item in value) if isinstance(value, list) else value


def words_of(value: Any) -> list[str]:
    """A value as the words that follow its flag."""
    return [str(item) for item in value] if isinstance(value, tuple) else [repr(value) if isinstance(value, float) else str(value)]


def changed_flags(config: Any, default: Any, prefix: str = "") -> list[str]:
    """The flags that make one configuration record of another."""
    flags = []
    for field in dataclasses.fields(config):
        value, before, name = getattr(config, field.name), getattr(default, field.name), f"{prefix}{field.name.replace('_', '-')}"
        if dataclasses.is_dataclass(value):
            flags += changed_flags(value, before, f"{name}.")
        elif value != before and isinstance(value, bool):
            flags.append(f"--{name}" if value else f"--{prefix}no-{name.removeprefix(prefix)}")
        elif value != before:
            flags += [f"--{name}", *words_of(value)]
    return flags


def train_flags(config: TrainConfig) -> list[str]:
    """What follows `infogoal train TASK` for this configuration: the inverse of `load`."""
    name = name_of(config)
    method = name if name in METHODS else config.method
    default, flags = load(config.task, method), ["--method", method]
    parts = {part: getattr(config, part) for part in ("algorithm", "relabelling", "exploration")}
    for part, value in parts.items():
        flags += [f"--{part}", value] if value != getattr(default, part) else []
    return flags + changed_flags(config, load(config.task, method, **parts))
