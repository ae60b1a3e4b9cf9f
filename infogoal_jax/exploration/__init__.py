"""Explorers, one file each: a representation of states and a bonus. A new one is registered in `registry`."""

from infogoal_jax.exploration import explorer, sse_db
from infogoal_jax.registry import Entry, Registry

registry = Registry(
    "explorer",
    {"none": Entry(explorer.NoneConfig, explorer.make_none), "sse_db": Entry(sse_db.SSEDBConfig, sse_db.make)},
)
