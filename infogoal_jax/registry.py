"""What stands in the registries of tasks, learners, agents and relabellings: a configuration class, and the function that makes the part."""

from collections.abc import Callable
from typing import Any, NamedTuple

from infogoal_jax.errors import UserError, nearest


class Entry(NamedTuple):
    """The configuration class of a part and the function that makes the part from such a configuration."""

    config: type
    make: Callable[..., Any]


def find(entries: dict[str, Entry], field: str, name: str) -> Entry:
    """The entry of this name, or a `UserError` that names the field and the nearest name."""
    if name not in entries:
        raise UserError(f"{field} = {name!r}: no such {field}.{nearest(name, list(entries))} Known: {', '.join(entries)}")
    return entries[name]
