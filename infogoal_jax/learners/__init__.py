"""Goal-representation learners, a file a method. `registry` is the one place where a new method is named."""

from infogoal_jax.learners import infogoal, none
from infogoal_jax.registry import Entry, find

registry: dict[str, Entry] = {
    "infogoal": Entry(infogoal.InfoGoalConfig, infogoal.make),
    "none": Entry(none.NoneConfig, none.make),
}


def entry(method: str) -> Entry:
    """The registered method of this name, or a `UserError` with the nearest one."""
    return find(registry, "method", method)
