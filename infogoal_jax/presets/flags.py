"""Which flags of the command line give a configuration."""

import dataclasses
from typing import Any

from infogoal_jax import presets
from infogoal_jax.config import TrainConfig


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
