"""How float hyperparameters are declared: once, beside the part that they belong to.

    @flax.struct.dataclass
    class VAEHyperparameters:
        kl_weight: Annotated[float, Number("[0, inf)", Search(1e-3, 10.0, "log"))] = 1.0
        \"\"\"Weight of the KL divergence beside the reconstruction error [M].\"\"\"

Validation, the help text of the command line and the space of `infogoal tune` are read off this declaration. A record
of floats is a pytree, and an argument of every compiled program: sweep it with `jax.vmap`, change it without compiling
again.
"""

import dataclasses
import functools
import math
import re
import typing
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import flax.struct
import jax
import numpy as np

from infogoal_jax import checks
from infogoal_jax.errors import require
from infogoal_jax.field_types import LARGEST_FLOAT, lies_in, plain


class Search(NamedTuple):
    """Where a search looks for a number.

    scale: uniform in it, in its logarithm, or in the logarithm of its distance to 1.
    always: in every search, or only where it is asked for.
    is_term: it is the weight of a term of a method's own, which a search must not turn off: low is its floor.
    """

    low: float
    high: float
    scale: Literal["linear", "log", "log of 1 - x"]
    always: bool = True
    is_term: bool = False

    def at(self, fraction: float) -> float:
        """The value that lies this fraction, in [0, 1], of the way from low to high; four digits of it, so that it can
        be given as a flag."""
        if self.scale == "linear":
            value = self.low + fraction * (self.high - self.low)
        elif self.scale == "log":
            value = self.low * (self.high / self.low) ** fraction
        else:
            value = 1 - (1 - self.low) * ((1 - self.high) / (1 - self.low)) ** fraction
        return float(f"{value:.4g}")

    def is_at_floor(self, value: float) -> bool:
        """Whether the weight of a method's own term lies in the lowest twentieth of its range, or below: a search that
        ends there would rather have it off."""
        return self.is_term and value <= self.at(0.05)


class Number(NamedTuple):
    """What a hyperparameter may be: an interval such as "(0, 1]", and where a search looks for it, if it does."""

    interval: str
    search: Search | None = None

    def allows(self, value: float) -> bool:
        """Whether the value lies in the interval."""
        return lies_in(value, self.interval)


@flax.struct.dataclass
class NoHyperparameters:
    """The record of a part without float hyperparameters."""


@functools.cache
def numbers_of(record_type: type) -> dict[str, Number]:
    """The declarations of a record's own floats, by field."""
    hints = typing.get_type_hints(record_type, include_extras=True)
    declared = {name: getattr(hint, "__metadata__", ()) for name, hint in hints.items()}
    return {name: number for name, metadata in declared.items() for number in metadata if isinstance(number, Number)}


def check_declared(record_type: type, name: str) -> None:
    """Raise `UserError` for a record of floats with a field that declares no `Number`, or one whose interval, search or
    default makes no sense."""
    declared = numbers_of(record_type)
    for field in dataclasses.fields(record_type):
        where = f"{name}.hyper.{field.name}"
        require(field.name in declared, where, field.type, "declare it as Annotated[float, Number(interval)]")
        number = declared[field.name]
        ends = re.fullmatch(r"[(\[]\s*(\S+)\s*,\s*(\S+)\s*[)\]]", str(number.interval))
        try:
            low, high = map(float, ends.groups() if ends else ("nan", "nan"))
        except ValueError:
            low = high = math.nan
        require(low < high, where, number.interval, 'give an interval such as "(0, 1]"')
        require(
            number.search is None or isinstance(number.search, Search), where, number.search, "give a Search or None"
        )
        if number.search is not None:
            first, last = (checks.number(end, where) for end in number.search[:2])
            require(first < last, where, (first, last), "give a Search(low, high) with low below high")
            known = typing.get_args(typing.get_type_hints(Search)["scale"])
            require(number.search.scale in known, where, number.search.scale, f"give one of {', '.join(known)}")
        has_default = field.default is not dataclasses.MISSING
        require(
            has_default and number.allows(checks.number(field.default, where)),
            where,
            field.default,
            f"give a default in {number.interval}",
        )


def floats(record: Any, prefix: str = "") -> Iterator[tuple[str, Any, Number]]:
    """(dotted name, value, declaration) of every float of a record and of the records in it."""
    declared = numbers_of(type(record))
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if dataclasses.is_dataclass(value):
            yield from floats(value, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", value, declared[field.name]


def check(record: Any) -> None:
    """Raise `UserError` for a value outside of its interval, or that float32 cannot hold: of numbers, and of each
    number in an array. What is traced, inside of a jitted function, has no value to look at."""
    for name, value, number in floats(record):
        if isinstance(value, jax.core.Tracer):
            continue
        if type(value) is float:  # Most are, and NumPy takes a while for one.
            check_number(name, value, number)
            continue
        number_or_array = isinstance(value, int | float | np.ndarray | jax.Array) and not isinstance(value, bool)
        array = np.asarray(value) if number_or_array else np.zeros(0, bool)
        numeric = array.size and (array.dtype.kind in "fiu" or array.dtype == jax.numpy.bfloat16)
        require(bool(numeric), f"hyper.{name}", value, "give a number, or an array of them")
        for one in np.unique(array.astype(float)):
            check_number(name, float(one), number)


def check_number(name: str, value: float, number: Number) -> None:
    """Raise `UserError` for a number outside of its interval, or that float32 cannot hold."""
    require(abs(value) <= LARGEST_FLOAT, f"hyper.{name}", value, "give a finite number that float32 holds")
    require(number.allows(value), f"hyper.{name}", value, f"give a number in {number.interval}")


def check_record(record: Any, name: str) -> None:
    """Raise `UserError` for what is no record of floats, or has something else in it where another record belongs."""
    of_floats = dataclasses.is_dataclass(record) and not isinstance(record, type)
    require(of_floats, name, record, "give a record of hyperparameters, see presets.default_hyperparameters")
    for field in dataclasses.fields(record):
        if field.name not in numbers_of(type(record)):
            check_record(getattr(record, field.name), f"{name}.{field.name}")


def checked(record: Any) -> Any:
    """A record with numbers of numpy as those of Python. Raises `UserError` as `check` does, and for what is no record
    of floats."""
    check_record(record, "hyper")
    record = with_values(record, {name: plain(value) for name, value, _ in floats(record)})
    check(record)
    return record


def with_values(record: Any, values: dict[str, Any]) -> Any:
    """The record with the floats of these dotted names replaced."""
    own = {name: value for name, value in values.items() if "." not in name}
    parts: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        part, _, field = name.partition(".")
        if field:
            parts.setdefault(part, {})[field] = value
    return dataclasses.replace(
        record, **own, **{part: with_values(getattr(record, part), inner) for part, inner in parts.items()}
    )


def values_of(record: Any) -> dict[str, Any]:
    """Every float of a record by its dotted name."""
    return {name: value for name, value, _ in floats(record)}


def search_space(record: Any) -> dict[str, Search]:
    """Where a search looks, by dotted name, for every float of a record that can be searched."""
    return {name: number.search for name, _, number in floats(record) if number.search is not None}
