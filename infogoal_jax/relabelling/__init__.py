"""Hindsight relabelling, one file each. A new one is registered in `registry`."""

from infogoal_jax.registry import Entry, Registry
from infogoal_jax.relabelling import all_goals, cher, ghrl, her, mixed, relabelling

registry = Registry(
    "relabelling",
    {
        "none": Entry(relabelling.NoneConfig, relabelling.make_none),
        "her": Entry(her.HERConfig, her.make),
        "cher": Entry(cher.CHERConfig, cher.make),
        "ghrl": Entry(ghrl.GHRLConfig, ghrl.make),
        "mixed": Entry(mixed.MixedConfig, mixed.make, method="none"),
        "all_goals": Entry(all_goals.AllGoalsConfig, all_goals.make, of_agent=all_goals.OF_AGENT),
    },
)
