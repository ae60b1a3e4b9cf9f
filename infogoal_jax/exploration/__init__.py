"""State representation and bonus, a file a method. `registry` is the one place where a new one is named."""

from infogoal_jax.exploration import none, sse_db
from infogoal_jax.registry import Entry, find

registry: dict[str, Entry] = {
    "none": Entry(none.NoneConfig, none.make),
    "sse_db": Entry(sse_db.SSEDBConfig, sse_db.make),
}


def entry(exploration: str) -> Entry:
    """The registered explorer of this name, or a `UserError` with the nearest one."""
    return find(registry, "exploration", exploration)
