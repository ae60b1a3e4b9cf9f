"""How a configuration is written to a run's folder and read back, and which flags of the command line give it."""

import dataclasses
import json
from typing import Any

from infogoal_jax import presets
from infogoal_jax.config import Hyperparameters, TrainConfig
from infogoal_jax.errors import require

FORMAT = 2
"""Version of the format of saved runs. Runs of another one are refused: the names of 1 were others."""


def to_json(config: TrainConfig) -> str:
    """The resolved configuration as indented JSON; each part with its name."""
    return json.dumps(to_dict(config), indent=2, sort_keys=True)


def to_dict(config: TrainConfig) -> dict[str, Any]:
    """The resolved configuration as plain values; each part with its name."""
    values = dataclasses.asdict(config)
    for kind, name in presets.names_of(config).items():
        values[kind] = {"name": name, **values[kind]}
    return {"format": FORMAT, **values}


def from_dict(values: dict[str, Any]) -> TrainConfig:
    """The configuration that `to_dict` made. Raises `UserError` for another format; unknown fields are an error of the
    file, not of the user."""
    found = values.get("format", 1)
    require(
        found == FORMAT,
        "format",
        found,
        f"this version of infogoal-jax reads runs of format {FORMAT}; use the version that wrote the run",
    )
    fields = {field.name: values[field.name] for field in dataclasses.fields(TrainConfig)}
    base = presets.load(fields["task"], **{kind: fields[kind]["name"] for kind in presets.REGISTRIES})
    for kind in presets.REGISTRIES:
        own = dict(fields[kind])
        own.pop("name")
        fields[kind] = record(getattr(base, kind), own)
    fields["env"], fields["state_encoder"] = (
        record(base.env, fields["env"]),
        record(base.state_encoder, fields["state_encoder"]),
    )
    floats = dict(fields["hyper"])
    inner = {kind: record(getattr(base.hyper, kind), floats.pop(kind)) for kind in ("learner", "agent")}
    return TrainConfig(**fields | {"hyper": Hyperparameters(**floats, **inner)})


def record(like: Any, values: dict[str, Any]) -> Any:
    """A record of the class of `like` with values read from JSON."""
    return type(like)(**{name: as_tuple(value) for name, value in values.items()})


def as_tuple(value: Any) -> Any:
    """Lists of JSON as the tuples that configurations hold."""
    return tuple(as_tuple(item) for item in value) if isinstance(value, list) else value


def words_of(value: Any) -> list[str]:
    """A value as the words that follow its flag."""
    return (
        [str(item) for item in value]
        if isinstance(value, tuple)
        else [repr(value) if isinstance(value, float) else str(value)]
    )


def changed_flags(config: Any, default: Any, prefix: str = "") -> list[str]:
    """The flags that make one configuration record of another."""
    flags = []
    for field in dataclasses.fields(config):
        value, before, name = (
            getattr(config, field.name),
            getattr(default, field.name),
            f"{prefix}{field.name.replace('_', '-')}",
        )
        if dataclasses.is_dataclass(value):
            flags += changed_flags(value, before, f"{name}.")
        elif value != before and isinstance(value, bool):
            flags.append(f"--{name}" if value else f"--{prefix}no-{name.removeprefix(prefix)}")
        elif value != before:
            flags += [f"--{name}", *words_of(value)]
    return flags


def train_flags(config: TrainConfig) -> list[str]:
    """What follows `infogoal train TASK` for this configuration: the inverse of `presets.load`."""
    names, name = presets.names_of(config), presets.name_of(config)
    method = name if name in presets.METHODS else names["learner"]
    default, flags = presets.names_of(presets.load(config.task, method)), ["--method", method]
    for kind, own in names.items():
        flags += [f"--{kind}", own] if own != default[kind] else []
    return flags + changed_flags(config, presets.load(config.task, method, **names))
