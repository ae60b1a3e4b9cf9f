"""State representation and bonus, a file each. `registry` is the one place where a new one is named."""

from infogoal_jax.exploration import none, sse_db
from infogoal_jax.registry import Entry, Registry

registry = Registry("explorer", {
    "none": Entry(none.NoneConfig, none.make),
    "sse_db": Entry(sse_db.SSEDBConfig, sse_db.make),
})
