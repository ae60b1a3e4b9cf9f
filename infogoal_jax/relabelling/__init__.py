"""Hindsight relabelling, one file each. A new one is registered in `registry`."""

from infogoal_jax.registry import Entry, Registry
from infogoal_jax.relabelling import cher, ghrl, her, mixed, random, relabelling

registry = Registry(
    "relabelling",
    {
        "none": Entry(relabelling.NoneConfig, relabelling.make_none),
        "her": Entry(her.HERConfig, her.make),
        "cher": Entry(cher.CHERConfig, cher.make),
        "ghrl": Entry(ghrl.GHRLConfig, ghrl.make),
        "mixed": Entry(mixed.MixedConfig, mixed.make, is_method=False),
        "random": Entry(random.RandomConfig, random.make, is_method=False),
    },
)
