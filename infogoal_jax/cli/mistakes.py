"""Words of the command line that tyro cannot take, told as every other mistake of a user is: one line with the field,
what was given and what would be right."""

import contextlib
import io
import itertools
import re
from collections.abc import Callable
from typing import Any

import tyro

from infogoal_jax import imports
from infogoal_jax.errors import UserError, nearest, shown

try:
    from tyro import _errors  # No promise of theirs: where a version has no such module, its own box is printed.
except ImportError:
    _errors = None

VALUES = {"INT": "a whole number", "FLOAT": "a number", "STR": "a word", "NAME": "a name"}
"""What a flag takes, by the word in the help."""


def parsed(command: Any, prog: str, arguments: list[str], **settings: Any) -> Any:
    """What `tyro.cli` makes of these words. Raises `UserError` for what it cannot take.

    prog: the words in front of them, as a user types them."""

    def known_flags() -> list[str]:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            tyro.cli(
                command, prog=prog, args=["--help"], **{**settings, "add_help": True, "return_unknown_args": False}
            )
        return re.findall(r"(?<!\S)--[a-z][\w.-]*", printed.getvalue())

    def refuse(event: Any) -> None:
        if said := explanation(event, arguments, known_flags):
            raise UserError(f"{said} (see {event.prog} --help)")

    with _errors.on_parse_error(refuse) if _errors else contextlib.nullcontext():
        return tyro.cli(command, prog=prog, args=arguments, **settings)


def field_of(flag: str) -> str:
    """The field that a flag sets, without the part that has it."""
    return flag.lstrip("-").rpartition(".")[2]


def explanation(event: Any, arguments: list[str], known_flags: Callable[[], list[str]]) -> str:
    """What is wrong and what would be right; empty for a kind of mistake that is not known here."""
    argument = getattr(event, "argument", None)
    match type(event).__name__:
        case "UnrecognizedArgs":
            flag = next((word.partition("=")[0] for word in event.tokens if word.startswith("-")), "")
            if not flag:
                return f"{' '.join(map(shown, event.tokens))}: no flag takes it; leave it out"
            known = list(dict.fromkeys([*known_flags(), imports.FLAG]))
            of_other_parts = [repr(name) for name in known if field_of(name) == field_of(flag)]
            meant = f" Did you mean {' or '.join(of_other_parts)}?" if of_other_parts else nearest(flag, known)
            return f"{flag}: there is no such flag.{meant}".rstrip(".")
        case "MissingArgs":
            return f"{', '.join(name_of(missing.arg) for missing in event.missing_arguments)}: is missing; give it"
        case "BadValue" if event.reason == "too_few_values":
            few = "too few values follow" if argument.lowered.nargs > 1 else "no value follows"
            return f"{name_of(argument)}: {few}; give {remedy(argument)}"
        case "InvalidChoice":
            near = nearest(event.value, [*event.choices])
            return f"{name_of(argument)} = {shown(event.value)}: give {remedy(argument)}.{near}".rstrip(".")
        case "InstantiationFailure" if argument is not None:
            given = given_for(argument, arguments)
            if not given:
                return f"{name_of(argument)}: no value follows; give at least one, or leave the flag out"
            return f"{name_of(argument)} = {given}: give {remedy(argument)}"
    return ""


def name_of(argument: Any) -> str:
    """The field that a flag sets, as other errors name it; of a word without a flag, its name in the help."""
    flag = argument.lowered.name_or_flags[-1]
    return flag.removeprefix("--").replace("-", "_") if flag.startswith("-") else argument.lowered.metavar or flag


def given_for(argument: Any, arguments: list[str]) -> str:
    """The words that were given for a flag, the last time it was."""
    flags = {flag.replace("_", "-") for flag in argument.lowered.name_or_flags}
    found = ""
    for place, word in enumerate(arguments):
        flag, sign, value = word.partition("=")
        if flag.replace("_", "-") in flags:
            nargs, words = argument.lowered.nargs, arguments[place + 1 :]
            if isinstance(nargs, int):
                words = words[:nargs]
            else:
                words = itertools.takewhile(lambda word: not word.startswith("--"), words)
            value = value if sign else " ".join(words)
            found = shown(value) if value else ""
    return found


def remedy(argument: Any) -> str:
    """What an argument takes, in words."""
    words = re.sub(r" \[.*", "", str(argument.lowered.metavar or "")).removeprefix("[")  # Of several values, one.
    choices = argument.lowered.choices or tuple(re.sub(r"^\{|\}$", "", words).split(",")) * words.startswith("{")
    if choices and "|" not in words:
        return " or ".join(filter(None, [", ".join(choices[:-1]), choices[-1]]))
    parts = [part for part in words.split("|") if part != "{None}"]
    if (kinds := " ".join(parts).split()) and set(kinds) <= {"INT", "FLOAT"} and len(kinds) > 1:
        return f"{len(kinds)} {'whole ' * (set(kinds) == {'INT'})}numbers"
    return " or ".join(VALUES.get(part, part) for part in parts)
