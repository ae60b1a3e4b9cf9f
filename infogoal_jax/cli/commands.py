"""What commands are, and the tree that they make: groups of commands within groups, as tyro takes them; and what
several commands ask for: new folders under runs/, folders that must be empty, seeds."""

import errno
import functools
import os
import secrets
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Union

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec

from infogoal_jax.errors import UserError, nearest, require, shown

Command = Callable[..., int]
PATHS = {
    errno.ENAMETOOLONG: "give a shorter path",
    errno.EACCES: "give a path that you may read and write",
    errno.ELOOP: "give a path that does not lead through a circle of links",
}
"""What helps where the system refuses a path."""
LETTERS = "abcdefghjkmnpqrstuvwxyz23456789"
"""Of the mark of a new folder: none that looks like another."""
NOTHING = Annotated[object, tyro.conf.Suppress]
"""An arm of a union that is no command, since a command alone would be no union. Anything is an `object`: so tyro does
not ask typeguard about the arms after it, whose import is a tenth of a help's time."""


def whole_numbers(words: list[str]) -> tuple[int, ...]:
    """The whole numbers that these words are. Raises `ValueError`, which tyro prints, for anything else."""
    try:
        return tuple(int(word) for word in words)
    except ValueError:
        raise ValueError(f"give {len(words)} whole numbers in place of {' '.join(words)!r}") from None


Pair = Annotated[
    tuple[int, int] | None,
    PrimitiveConstructorSpec(
        nargs=2,
        metavar="INT INT",
        instance_from_str=whole_numbers,
        is_instance=lambda value: value is None or (isinstance(value, tuple) and len(value) == 2),
        str_from_instance=lambda pair: ["None"] if pair is None else [str(number) for number in pair],
    ),
]
"""Two whole numbers, or None where the flag is left out. What tyro makes of the type alone says a wrong count with its
markup unread: `[bold]INT INT[/bold]`."""


def several(kind: type, metavar: str) -> PrimitiveConstructorSpec:
    """Of a flag that takes one value of a kind or more. What tyro makes of the type alone takes a flag that nothing
    follows for one that is left out."""

    def read(words: list[str]) -> tuple:
        if not words:
            raise ValueError("no value follows")
        return tuple(map(kind, words))

    return PrimitiveConstructorSpec(
        nargs="*",
        metavar=f"{metavar} [{metavar} ...]",
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, tuple) and all(isinstance(each, kind) for each in value),
        str_from_instance=lambda values: list(map(str, values)),
    )


Words = Annotated[tuple[str, ...], several(str, "STR")]
WholeNumbers = Annotated[tuple[int, ...], several(int, "INT")]


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
    """Raise `UserError`, with the nearest name, if the words in front lead to no command. A help is left to tyro."""
    known, name = list(group.commands), first_word(arguments)
    if arguments and (arguments[0] in ("-h", "--help") or arguments[0].startswith("--tyro-")):
        return
    if name not in known:
        if name:
            wrong = f"{path}{name!r}: no such command.{nearest(name, known)}"
        elif arguments:
            wrong = f"{path}{arguments[0]!r}: flags come after the command; name it first."
        else:
            wrong = f"{path.strip()}: a word is missing; give one."
        raise UserError(f"{wrong} Known: {', '.join(known)}")
    command = group.commands[name]
    if isinstance(command, Group):
        check_names(command, arguments[1:], f"{path}{name} ")


def help_of(command: "Command | Group") -> str | None:
    """What stands above the help of a command or a group; None: the docstring of the command's function."""
    if isinstance(command, Group):
        return command.help
    return command.__doc__ if isinstance(command, functools.partial) else None


def type_of(group: Group) -> Any:
    """The group as a type that tyro parses: a union with a subcommand for each command."""
    arms = [NOTHING]
    for name, command in group.commands.items():
        constructor = type_of(command) if isinstance(command, Group) else command
        described = tyro.conf.subcommand(name, constructor=constructor, description=help_of(command))
        arms.append(Annotated[Any, described])
    return Union[(*arms,)]


def tell(text: str) -> None:
    """Print what a command came to: on a terminal, broken between words."""
    from rich.console import Console

    from infogoal_jax.runner.progress import say

    say(Console(), text)


def new_folder(*words: str) -> Path:
    """A folder under runs/ that says what it holds, and since when. The last word tells it from that of another process
    that began in the same second, as the jobs of an array do."""
    mark = "".join(secrets.choice(LETTERS) for _ in range(6))
    return Path("runs") / "-".join([*words, time.strftime("%Y%m%d-%H%M%S"), mark])


def empty_folder(path: str | Path, flag: str) -> Path:
    """The folder of this path. Raises `UserError`, naming the flag that it was given by, if it holds anything or cannot
    be looked into."""
    folder = Path(path)
    try:
        holds_something = not folder.is_dir() or any(folder.iterdir())
        there = os.path.lexists(folder)  # A link that leads nowhere, too: nothing is written through it.
    except OSError as error:
        raise UserError(f"{flag} = {str(path)!r}: {error.strerror or error}; give a new folder") from error
    if there and holds_something:
        raise UserError(f"{flag} = {str(path)!r}: is there already and not empty; give a new folder")
    return folder


def check_resumed_in_place(resume: str, out: str) -> None:
    """Raise `UserError` if a resumed run or search was to be written somewhere else."""
    require(
        not (resume and out) or Path(resume).resolve() == Path(out).resolve(),
        "out",
        out,
        f"what is resumed stays in its folder, {resume}; leave the flag out, or copy the folder first",
    )


def draw(figures: Callable[..., list[Path]], *arguments: Any) -> list[Path]:
    """Draw figures(*arguments), and print where each is."""
    from infogoal_jax.runner.progress import working_on

    with working_on("drawing"):
        paths = figures(*arguments)
    for path in paths:
        print(f"figure      {path}")
    return paths


def check_seed(seed: int, flag: str = "seed") -> None:
    """Raise `UserError`, naming the flag, for a number that is not a seed."""
    require(0 <= seed < 2**32, flag, seed, "give a seed from 0 to below 2^32")


def seeds_from(first: int, count: int) -> range:
    """`count` seeds from the first on. Raises `UserError` for a count below 1, or for numbers that are not
    seeds."""
    require(count > 0, "seeds", count, "give at least 1")
    require(
        first >= 0 and first + count <= 2**32,
        "seeds",
        f"{first} to {first + count - 1}",
        "give seeds from 0 to below 2^32 (--seeds, --first-seed)",
    )
    return range(first, first + count)


def mistake_of(error: OSError, arguments: list[str]) -> UserError | None:
    """What the system refused to do with a path, if these words of the command line name it or a folder above it; None
    if they do not: then it is no mistake of the user's."""
    if not isinstance(error.filename, str | os.PathLike):
        return None
    refused = os.path.abspath(error.filename)
    for flag, word in zip(["", *arguments], arguments, strict=False):
        named, _, joined = word.partition("=") if word.startswith("--") else (flag, "", word)
        if joined and (refused + os.sep).startswith(os.path.abspath(joined) + os.sep):
            field = named.removeprefix("--").replace("-", "_") if named.startswith("--") else "path"
            return UserError(
                f"{field} = {shown(joined)}: {error.strerror}; {PATHS.get(error.errno, 'give another path')}"
            )
    return None
