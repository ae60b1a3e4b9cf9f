"""Goal-representation learners, a file a method. `registry` is the one place where a new method is named."""

from collections.abc import Callable
from typing import Any, NamedTuple

from infogoal_jax.errors import UserError, nearest
from infogoal_jax.learners import infogoal, none
from infogoal_jax.learners.learner import Learner


class Entry(NamedTuple):
    """The configuration class of a method and the function that makes its learner."""

    config: type
    make: Callable[[Any], Learner]


registry: dict[str, Entry] = {
    "infogoal": Entry(infogoal.InfoGoalConfig, infogoal.make),
    "none": Entry(none.NoneConfig, none.make),
}


def entry(method: str) -> Entry:
    """The registered method of this name, or a `UserError` with the nearest one."""
    if method not in registry:
        raise UserError(f"method = {method!r}: no such method.{nearest(method, list(registry))} Known: {', '.join(registry)}")
    return registry[method]
