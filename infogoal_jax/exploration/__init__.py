"""State representation and bonus, a file a method. `registry` is the one place where a new one is named."""

from infogoal_jax.exploration import none
from infogoal_jax.registry import Entry, find

registry: dict[str, Entry] = {
    "none": Entry(none.NoneConfig, none.make),
}


def entry(exploration: str) -> Entry:
    """The registered explorer of this name, or a `UserError` with the nearest one."""
    return find(registry, "exploration", exploration)
