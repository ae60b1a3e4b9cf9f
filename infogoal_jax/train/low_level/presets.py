"""The tasks that a low level can be trained for: the configuration of each, and the agent that it makes."""

from typing import Any

from infogoal_jax.envs import object_manipulation
from infogoal_jax.errors import nearest, require
from infogoal_jax.train.low_level import fetch, joints
from infogoal_jax.train.low_level.fetch import FetchPretrainConfig
from infogoal_jax.train.low_level.joints import JointPretrainConfig
from infogoal_jax.train.low_level.trainer import PretrainConfig, TargetAgent

TASKS = (*fetch.PRESETS, JointPretrainConfig.task)


def preset(task: str, **changes: Any) -> PretrainConfig:
    """The tuned configuration of a task; `changes` replace its fields. Raises `UserError` for a task without a low
    level."""
    require(
        task in TASKS,
        "task",
        task,
        f"no low level can be trained for it.{nearest(task, list(TASKS))} Known: {', '.join(TASKS)}",
    )
    if task in fetch.PRESETS:
        return FetchPretrainConfig(**({"task": task} | fetch.PRESETS[task] | changes))
    return JointPretrainConfig(**changes)


def make_agent(config: PretrainConfig) -> TargetAgent:
    """The agent of a configuration. Raises `UserError` for a dataset that cannot be used."""
    if isinstance(config, JointPretrainConfig):
        return joints.make(config, object_manipulation.make(config.env))
    return fetch.make(config)
