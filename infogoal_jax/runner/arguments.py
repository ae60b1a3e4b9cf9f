"""What `run` is given, checked before anything is loaded or written."""

from typing import Any

import jax
import numpy as np

from infogoal_jax import checks, hyperparameters
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import require
from infogoal_jax.train.contracts import check_is_environment


def check_run(config: Any, folder: Any, resume: Any, listeners: Any, env: Any, phase: Any, left: Any) -> None:
    """Raise `UserError` for arguments of `run` of other kinds than it declares, and for hyperparameters that are not
    one number each: seeds of a run share them."""
    require(isinstance(config, TrainConfig), "config", config, "give a TrainConfig, such as presets.load makes")
    for name, value, _ in hyperparameters.floats(config.hyper):
        several = isinstance(value, np.ndarray | jax.Array)
        require(not several, f"hyper.{name}", value, "give one number; for several see jax.vmap(train)")
    checks.path(folder, "folder", "give the folder of the run")
    checks.flag(resume, "resume")
    require(isinstance(listeners, tuple | list), "listeners", listeners, "give a tuple of functions of a Progress")
    for place, listener in enumerate(listeners):
        checks.function(listener, f"listeners[{place}]", 1, "give a function of a Progress")
    if env is not None:
        check_is_environment(env)
    checks.function(phase, "phase", 2, "give a function of a name and a number of epochs")
    checks.function(left, "left", 0, "give a function that returns seconds")
