"""The tuned configuration of each task and method, a file a task. `registry` is the one place where a new one is
named."""

import importlib
from typing import TYPE_CHECKING, Any

from infogoal_jax.checked_dict import CheckedDict
from infogoal_jax.presets import embodied_qa, fetch, object_manipulation, object_search, plane
from infogoal_jax.presets.libraries import JAXGCRL, OGBENCH
from infogoal_jax.presets.preset import Changes, Preset

if TYPE_CHECKING:
    from infogoal_jax.presets.loading import METHODS, Method, default_hyperparameters, load, method_named, name_of
    from infogoal_jax.presets.registering import register


class Presets(CheckedDict):
    """The presets by the names of their tasks."""

    def check(self, name: str, value: Preset) -> None:
        """Raise `UserError` for what is no preset, and for one with other types in it than declared."""
        from infogoal_jax.presets.loading import check_preset  # It needs JAX, and a list of tasks does not.

        check_preset(name, value)


registry = Presets(
    {
        "object_search": object_search.PRESET,
        "object_manipulation": object_manipulation.PRESET,
        **fetch.PRESETS,
        "embodied_qa": embodied_qa.PRESET,
        **fetch.POSITION_PRESETS,
        **plane.PRESETS,
        **fetch.TARGET_PRESETS,
        "object_manipulation_targets": object_manipulation.TARGET_PRESET,
    }
)
TASKS, FETCH_TASKS = tuple(registry), tuple(fetch.PRESETS)

__all__ = [
    "FETCH_TASKS",
    "JAXGCRL",
    "METHODS",
    "OGBENCH",
    "TASKS",
    "Changes",
    "Method",
    "Preset",
    "default_hyperparameters",
    "load",
    "method_named",
    "name_of",
    "register",
    "registry",
]


def __getattr__(name: str) -> Any:
    """What `loading` and `registering` have, which are imported when they are first asked for: they need JAX, and a
    list of tasks does not."""
    module = "registering" if name == "register" else "loading"
    return getattr(importlib.import_module(f"{__name__}.{module}"), name)


def __dir__() -> list[str]:
    """All public names, those that are imported later too: what a notebook completes."""
    return sorted({*globals(), *__all__})
