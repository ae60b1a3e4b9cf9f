"""What commands are, and the tree that they make: groups of commands within groups, as tyro takes them."""

import functools
import itertools
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple, Union

import tyro
from tyro.constructors import ConstructorRegistry

from infogoal_jax.errors import UserError, nearest

Command = Callable[..., int]


class Group(NamedTuple):
    """Commands under one name. help: what they are for, in a line; commands: functions and groups by name."""

    help: str
    commands: "dict[str, Command | Group]"


class TaskCommands(NamedTuple):
    """A command whose flags depend on the task: one command a task, the words that follow its name, and how tyro shows the task's configuration."""

    group: Group
    arguments: list[str]
    registry: ConstructorRegistry | None = None


def named(command: Command, help: str, /, **values) -> Command:
    """The command with these values as the defaults of its parameters, and a help of its own."""
    command = functools.partial(command, **values)
    command.__doc__ = help
    return command


def leading_words(arguments: list[str]) -> list[str]:
    """The words in front of the first flag."""
    return list(itertools.takewhile(lambda word: not word.startswith("-"), arguments))


def check_names(group: Group, words: list[str], path: str = "") -> None:
    """Raise `UserError`, with the nearest name, if the words lead to no command."""
    if not words:
        return
    if words[0] not in group.commands:
        known = list(group.commands)
        raise UserError(f"{path}{words[0]!r}: no such command.{nearest(words[0], known)} Known: {', '.join(known)}")
    command = group.commands[words[0]]
    if isinstance(command, Group):
        check_names(command, words[1:], f"{path}{words[0]} ")


def type_of(group: Group) -> Any:
    """The group as a type that tyro parses: a union with a subcommand for each command."""
    arms = []
    for name, command in group.commands.items():
        if isinstance(command, Group):
            described = tyro.conf.subcommand(name, constructor=type_of(command), description=command.help)
        else:
            help = command.__doc__ if isinstance(command, functools.partial) else None
            described = tyro.conf.subcommand(name, constructor=command, description=help)
        arms.append(Annotated[Any, described])
    return Union[(*arms, Annotated[None, tyro.conf.Suppress])]
