"""Relabelling in hindsight, a file a method. `registry` is the one place where a new one is named."""

from infogoal_jax.hindsight import cher, ghrl, her, none
from infogoal_jax.registry import Entry, find

registry: dict[str, Entry] = {
    "none": Entry(none.NoneConfig, none.make),
    "her": Entry(her.HERConfig, her.make),
    "cher": Entry(cher.CHERConfig, cher.make),
    "ghrl": Entry(ghrl.GHRLConfig, ghrl.make),
}


def entry(relabelling: str) -> Entry:
    """The registered relabelling of this name, or a `UserError` with the nearest one."""
    return find(registry, "relabelling", relabelling)
