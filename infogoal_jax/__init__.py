"""infogoal-jax: goal-conditioned reinforcement learning as one pure, jitted program. See `make_train`, `presets` and
`envs`."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from infogoal_jax import envs, presets
    from infogoal_jax.config import Hyperparameters, TrainConfig
    from infogoal_jax.errors import UserError
    from infogoal_jax.loading import make_train
    from infogoal_jax.report.runs import load_run
    from infogoal_jax.report.sweeps import SweepResult, sweep
    from infogoal_jax.runner.compilation import compiled, compiler_options, jit, use_compilation_cache
    from infogoal_jax.runner.listeners import print_success
    from infogoal_jax.train.episodes import rollout
    from infogoal_jax.train.evaluation import GoalView, Scores, evaluate
    from infogoal_jax.train.program import Train, TrainResult

__version__ = "0.2.0.dev0"
"""The only place of the version: pyproject.toml reads it. Without `.dev0` once CHANGELOG.md gives it a date."""
__all__ = [
    "GoalView",
    "Hyperparameters",
    "Scores",
    "SweepResult",
    "Train",
    "TrainConfig",
    "TrainResult",
    "UserError",
    "compiled",
    "compiler_options",
    "envs",
    "evaluate",
    "jit",
    "load_run",
    "make_train",
    "presets",
    "print_success",
    "rollout",
    "sweep",
    "use_compilation_cache",
]
MODULES = {
    "Hyperparameters": "config",
    "TrainConfig": "config",
    "UserError": "errors",
    "compiled": "runner.compilation",
    "compiler_options": "runner.compilation",
    "jit": "runner.compilation",
    "use_compilation_cache": "runner.compilation",
    "Train": "train.program",
    "TrainResult": "train.program",
    "make_train": "loading",
    "print_success": "runner.listeners",
    "load_run": "report.runs",
    "sweep": "report.sweeps",
    "SweepResult": "report.sweeps",
    "rollout": "train.episodes",
    "GoalView": "train.evaluation",
    "Scores": "train.evaluation",
    "evaluate": "train.evaluation",
}
"""Where each name is written. They are imported when they are first asked for: JAX takes half a second, which a help
text need not wait for."""


def __getattr__(name: str) -> Any:
    """What `__all__` names, imported now."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f"{__name__}.{MODULES.get(name, name)}")
    value = getattr(module, name) if name in MODULES else module
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
