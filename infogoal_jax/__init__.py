"""infogoal-jax: goal-conditioned reinforcement learning as one pure, jitted program. See `make_train`, `presets` and `envs`."""

from infogoal_jax import envs, presets
from infogoal_jax.config import Hyperparameters, TrainConfig
from infogoal_jax.errors import UserError
from infogoal_jax.train.compilation import compiler_options, use_compilation_cache
from infogoal_jax.train.program import Train, TrainResult, make_train

__version__ = "0.1.0"
__all__ = [
    "Hyperparameters", "Train", "TrainConfig", "TrainResult", "UserError", "compiler_options", "envs", "make_train", "presets",
    "use_compilation_cache",
]
