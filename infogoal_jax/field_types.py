"""Values checked against the types that the fields of a record declare, in configurations and in files alike."""

import dataclasses
import functools
import os
import re
import reprlib
import typing
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np

from infogoal_jax.errors import UserError

Record = TypeVar("Record")
LARGEST_WHOLE = 2**31 - 1
"""Of sizes and counts: programs index by int32."""
LARGEST_FLOAT = float(np.finfo(np.float32).max)


class Within(NamedTuple):
    """What the numbers of a field may be, each of them where it holds several, which are one at least: `Annotated[int,
    Within("[1, inf)", "give a whole number greater than 0")]`. interval: such as "(0, 1]"; remedy: what to give
    instead."""

    interval: str
    remedy: str


Size = Annotated[int, Within("[1, inf)", "give a whole number greater than 0")]
Sizes = Annotated[tuple[int, ...], Within("[1, inf)", "give widths greater than 0, for example 128 128")]
Count = Annotated[int, Within("[0, inf)", "give 0 or more")]
Share = Annotated[float, Within("[0, 1]", "give a share from 0 to 1")]
Weight = Annotated[float, Within("[0, inf)", "give 0 or more")]
Positive = Annotated[float, Within("(0, inf)", "give a number greater than 0")]
"""What most fields of configurations are."""


def lies_in(value: float, interval: str) -> bool:
    """Whether the value lies in an interval such as "(0, 1]"; a float as the float32 that programs are given."""
    low, high = (float(end) for end in interval[1:-1].split(","))
    if isinstance(value, float):
        value, low, high = np.float32(value), np.float32(low), np.float32(high)
    above = value >= low if interval[0] == "[" else value > low
    below = value <= high if interval[-1] == "]" else value < high
    return above and below


class WrongTypeError(ValueError):
    """A value is of another type than it should be. Its text says which, as the end of a sentence."""


def converted(value: Any, hint: Any) -> Any:
    """The value as this type: numbers of numpy as those of Python, lists as the tuples that are asked for, paths as
    their names. Raises `WrongTypeError` for a value of another type; nothing is guessed from text."""
    value = plain(value)
    try:
        return msgspec.convert(value, hint)
    except msgspec.ValidationError as error:
        raise WrongTypeError(in_words(error, hint)) from error
    except UnicodeEncodeError as error:
        raise WrongTypeError("is text with a half of a character; give whole ones") from error
    except AttributeError as error:  # What has items as a dict does, but no keys: an array.
        raise WrongTypeError(f"expected dict, got {type(value).__name__}") from error
    except TypeError:  # A type of a user's own record that cannot be checked.
        return value


def plain(value: Any) -> Any:
    """Numbers of numpy as those of Python, paths as their names; in lists too."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return type(value)(map(plain, value)) if type(value) in (tuple, list) else value


def in_words(error: msgspec.ValidationError, hint: Any) -> str:
    """The message of a typed decoder, as the end of a sentence."""
    if typing.get_origin(hint) is Literal:
        return f"give one of {', '.join(map(repr, typing.get_args(hint)))}"
    problem = re.sub(r"\barray\b", "list", str(error).replace("`", "").partition(" - at ")[0])
    problem = re.sub(r"\bobject\b", "dict", re.sub(r"\bnull\b", "None", problem))
    return problem[0].lower() + problem[1:]


@functools.cache
def hints_of(record: type) -> dict[str, Any]:
    """The types of a record's fields; none of those whose names cannot be resolved, as in a class within a function."""
    try:
        return typing.get_type_hints(record, include_extras=True)
    except NameError:
        return {}


def checked(record: Record, prefix: str = "") -> Record:
    """A frozen configuration with each value as the type of its field. Raises `UserError`, naming the field behind
    `prefix`, for a value of another type, and for numbers that no program can hold or that lie outside of what the
    field declares (`Within`)."""
    hints, found = hints_of(type(record)), {}
    for field in dataclasses.fields(record):
        value, name = getattr(record, field.name), f"{prefix}{field.name}"
        hint = hints.get(field.name, Any)
        if dataclasses.is_dataclass(value) and takes_records(hint):
            new = checked(value, f"{name}.")
        else:
            new = checked_value(value, hint, name)
        if new is not value:
            found[field.name] = new
    return dataclasses.replace(record, **found) if found else record


def takes_records(hint: Any) -> bool:
    """Whether a field of this type can be another record; one of a container's elements may be."""
    if typing.get_origin(hint) in (dict, list, tuple, Literal):
        return False
    return any(each is Any or dataclasses.is_dataclass(each) for each in (hint, *typing.get_args(hint)))


def checked_value(value: Any, hint: Any, name: str) -> Any:
    """A value of a configuration as its type. Raises `UserError` as `checked` does."""
    try:
        value = converted(value, hint)
    except WrongTypeError as error:
        raise UserError(f"{name} = {reprlib.repr(value)}: {error}") from error
    withins = [each for each in getattr(hint, "__metadata__", ()) if isinstance(each, Within)]
    if withins and value == ():
        raise UserError(f"{name} = (): {withins[0].remedy}")
    for number in value if isinstance(value, tuple) else (value,):
        if isinstance(number, int) and abs(number) > (2**64 if name.endswith("seed") else LARGEST_WHOLE):
            raise UserError(f"{name} = {reprlib.repr(value)}: give a whole number of at most {LARGEST_WHOLE}")
        if isinstance(number, float) and not abs(number) <= LARGEST_FLOAT:
            raise UserError(f"{name} = {reprlib.repr(value)}: give a finite number that float32 holds")
        for within in withins:
            if not lies_in(number, within.interval):
                raise UserError(f"{name} = {reprlib.repr(value)}: {within.remedy}")
    return value
