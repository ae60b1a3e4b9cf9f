"""Commands that have a subcommand for each task, because their flags are the fields of its configuration."""

import shlex
from typing import Any

from infogoal_jax import presets
from infogoal_jax.cli.choice import Choice, parts_of
from infogoal_jax.cli.commands import Command, Group, TaskCommands, named
from infogoal_jax.errors import UserError


def all_tasks(command: Command, help: str, arguments: list[str], choice: Choice) -> TaskCommands:
    """The command for every task that has a preset, for the list of them: without configurations, which would need JAX.
    help: stands above it. Raises `UserError` if there are flags, but no task before them."""
    asked = choice.help or choice.help_all
    if arguments and not asked:
        task = next((word for word in arguments if word in presets.registry), "TASK")
        flags = [word for word in arguments if word != task]
        raise UserError(
            f"task = '': name the task first: {shlex.join(['infogoal', command.__name__, task, *flags])}"
            + (f". Known: {', '.join(presets.registry)}" if task == "TASK" else "")
        )
    commands = {task: named(command, preset.description) for task, preset in presets.registry.items()}
    return TaskCommands(Group(help, commands), ["--help"] if asked else arguments)


def of_task(command: Command, config: Any, choice: Choice, arguments: list[str]) -> TaskCommands:
    """The command for one task, with this configuration and the names of its parts as defaults."""
    from infogoal_jax.cli.flags import configuration_flags

    parts = parts_of(config)
    help = presets.registry[config.task].description if config.task in presets.registry else ""
    group = Group("", {config.task: named(command, help, config=config, parts=parts)})
    asked = choice.help or choice.help_all
    return TaskCommands(group, [config.task, "--help"] if asked else arguments, configuration_flags(brief=choice.help))
