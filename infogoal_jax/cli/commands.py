"""What commands are, and the tree that they make: groups of commands within groups, as tyro takes them."""

import functools
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple, Union

import tyro
from tyro.constructors import ConstructorRegistry

from infogoal_jax.errors import UserError, nearest

Command = Callable[..., int]
NOTHING = Annotated[object, tyro.conf.Suppress]
"""An arm of a union that is no command, since a command alone would be no union. Anything is an `object`: so tyro does
not ask typeguard about the arms after it, whose import is a tenth of a help's time."""


class Group(NamedTuple):
    """Commands under one name. help: what they are for, in a line; commands: functions and groups by name."""

    help: str
    commands: "dict[str, Command | Group]"


class TaskCommands(NamedTuple):
    """A command whose flags depend on the task: one command a task, the words that follow its name, and how tyro shows
    the task's configuration."""

    group: Group
    arguments: list[str]
    registry: ConstructorRegistry | None = None


def named(command: Command, help: str, /, **values) -> Command:
    """The command with these values as the defaults of its parameters, and a help of its own."""
    command = functools.partial(command, **values)
    command.__doc__ = help
    return command


def first_word(arguments: list[str]) -> str:
    """The first of the arguments; empty if there is none, or a flag comes first."""
    return arguments[0] if arguments and not arguments[0].startswith("-") else ""


def check_names(group: Group, arguments: list[str], path: str = "") -> None:
    """Raise `UserError`, with the nearest name, if the words in front lead to no command. Flags are left to tyro."""
    known, name = list(group.commands), first_word(arguments)
    if arguments and not name:
        return
    if name not in known:
        wrong = (
            f"{path}{name!r}: no such command.{nearest(name, known)}"
            if name
            else f"{path.strip()}: name what is meant."
        )
        raise UserError(f"{wrong} Known: {', '.join(known)}")
    command = group.commands[name]
    if isinstance(command, Group):
        check_names(command, arguments[1:], f"{path}{name} ")


def type_of(group: Group) -> Any:
    """The group as a type that tyro parses: a union with a subcommand for each command."""
    arms = [NOTHING]
    for name, command in group.commands.items():
        if isinstance(command, Group):
            described = tyro.conf.subcommand(name, constructor=type_of(command), description=command.help)
        else:
            help = command.__doc__ if isinstance(command, functools.partial) else None
            described = tyro.conf.subcommand(name, constructor=command, description=help)
        arms.append(Annotated[Any, described])
    return Union[(*arms,)]
