"""`infogoal pretrain TASK`: the low levels that drive a robot to target states."""

from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Suppress

from infogoal_jax.cli.commands import Group, TaskCommands, first_word, named
from infogoal_jax.cli.folders import new_folder, seeds_from
from infogoal_jax.errors import UserError, nearest

JOINTS = "object_manipulation"
"""Trained with one seed where nothing else is asked for, as the shipped one was."""


def pretrain(
    config: Annotated[object, tyro.conf.arg(name="")] = None,
    seeds: int = 4,
    first_seed: int = 0,
    out: str = "",
    evaluation_episodes: int = 2000,
    command: Suppress[str] = "",
) -> int:
    """Train the low level that drives a robot to target states.

    Args:
        config: That of the task.
        seeds: Seeds that are trained side by side: 0, 1, 2, ...
        first_seed: Number of the first seed.
        out: Folder to write to; empty: a new one under runs/.
        evaluation_episodes: Fresh episodes that each seed is measured on at the end.
        command: What is written into the file as the command that made it.

    Returns:
        0 when it finished, 130 when it was stopped by Ctrl-C (with what was learned until then).
    """
    from infogoal_jax.train.compilation import use_compilation_cache
    from infogoal_jax.train.low_level import host

    numbers = seeds_from(first_seed, seeds)
    use_compilation_cache()
    folder = Path(out) if out else new_folder(config.task, "low-level")
    result = host.pretrain(config, numbers, folder, evaluation_episodes, command)
    host.print_result(result)
    return 130 if result.stopped else 0


def tasks(arguments: list[str]) -> TaskCommands:
    """`pretrain` for each task that has a low level, with its configuration as the defaults."""
    from infogoal_jax.cli.flags import configuration_flags
    from infogoal_jax.train.low_level.host import TASKS, preset

    task = first_word(arguments)
    if task and task not in TASKS:
        raise UserError(
            f"task = {task!r}: no low level can be trained for it.{nearest(task, list(TASKS))} Known: "
            f"{', '.join(TASKS)}"
        )
    written = " ".join(["infogoal pretrain", *arguments])
    commands = {
        task: named(pretrain, f"The low level of {task} (docs/low_level.md).", config=preset(task), command=written)
        for task in TASKS
    }
    help = "The low level of object manipulation (docs/object_manipulation.md)."
    commands[JOINTS] = named(pretrain, help, config=preset(JOINTS), command=written, seeds=1, evaluation_episodes=4000)
    group = Group("Train the low level of a task. `infogoal pretrain TASK --help` shows the flags of one.", commands)
    return TaskCommands(group, arguments, configuration_flags(brief=False))
