"""What the members of an npz have to be, declared once for each kind of file, and everything that is wrong with one."""

import dataclasses
import os
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from infogoal_jax.data import archives
from infogoal_jax.errors import UserError, nearest, require


class Member(NamedTuple):
    """What a member of a file has to be."""

    kind: str
    """One of `KINDS`, or a type of NumPy."""
    shape: tuple
    """A length for each axis; a word for a length that all members share; a tuple of lengths that may be had."""
    needed: bool | str = True
    """Whether it must be there; the name of another: where that one is."""
    finite: bool = True
    """Whether its numbers must be."""


Schema = Mapping[str, Member]
KINDS = {"text": "U", "integer": "iu", "float": "f", "number": "iuf", "0 or 1": "biuf"}
"""Kinds of members, and NumPy's letters for their types."""
Fault = tuple[str, str]
"""Where in the file, such as `action[3]`, and what is wrong, with the remedy."""
MOST_FAULTS = 10
"""Rows that are listed of a member; the rest is counted."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """One fault: `severity` is "error" or "warning", `where` the file or the image, `problem` what is wrong with it."""

    severity: str
    where: str
    problem: str


def read_file(path: str | os.PathLike, schema: Schema, remedy: str) -> dict[str, np.ndarray]:
    """The members of the file at `path`. Raises `OSError` if it cannot be read, `UserError` for the first member that
    is not as declared."""
    archive = archives.read(path, remedy)
    absent = [name for name, _ in missing(archive.sizes, schema, remedy)]
    require(not absent, "arrays", sorted(archive.sizes), f"{', '.join(absent)} missing; {remedy}")
    found = {name: archives.member(archive, name, remedy) for name in schema if name in archive.sizes}
    check(fitting(found, schema)[2])
    return found


def check(faults: Iterable[Fault]) -> None:
    """Raise `UserError` for the first of these faults, if there is one."""
    for where, problem in faults:
        raise UserError(f"{where}: {problem}")


def check_file(
    path: str | os.PathLike,
    schema: Schema,
    remedy: str,
    faults_of: Callable[[dict[str, np.ndarray]], Iterable[Fault]],
    remarks_on: Callable[[dict[str, np.ndarray]], Iterable[Fault]] = lambda found: (),
    ignored: tuple[str, ...] = (),
) -> list[Finding]:
    """Every fault of the file at `path` in one pass, errors first; empty if there is none. faults_of: finds those of
    the members that can be read; remarks_on: the same, of warnings; ignored: members that nothing reads, and may be
    there."""
    try:
        with archives.naming("dataset", path, remedy):
            # A format that declares its version says what is wrong with it among everything else.
            archive = archives.read(path, remedy, version=None if archives.FORMAT in schema else 1)
    except UserError as error:
        return [Finding("error", str(path), str(error).removeprefix(f"dataset = {str(path)!r}: "))]
    found, unreadable = read(archive, schema, remedy)
    known = [*schema, *ignored]  # A slip of the pen in the name of an optional member would go unnoticed.
    unknown = [
        (name, f"nothing reads it.{nearest(name, list(schema))} Remove or rename it")
        for name in archive.sizes
        if name not in known
    ]
    faults = {"error": (*unreadable, *faults_of(found)), "warning": (*unknown, *remarks_on(found))}
    return [Finding(kind, f"{path}: {where}", problem) for kind in faults for where, problem in faults[kind]]


def missing(present: Container[str], schema: Schema, remedy: str) -> Iterator[Fault]:
    """The members that must be there and are not."""
    for name, member in schema.items():
        if name not in present and member.needed is True:
            yield name, f"missing; {remedy}"
        elif name not in present and member.needed in present:
            yield name, f"missing, but there is {member.needed}; give both or none"


def read(archive: archives.Archive, schema: Schema, remedy: str) -> tuple[dict[str, np.ndarray], list[Fault]]:
    """The members of the schema that can be read, and what is wrong with the others: missing, damaged or pickled."""
    found, faults = {}, [*missing(archive.sizes, schema, remedy)]
    for name in schema:
        if name in archive.sizes:
            try:
                found[name] = archives.member(archive, name, remedy)
            except UserError as error:
                faults.append((name, str(error).removeprefix(f"{name} = ")))
    return found, faults


def conversion(array: np.ndarray, kind: str) -> str:
    """How a member becomes one of this kind, in NumPy; empty for a kind that several types have."""
    if kind in KINDS:
        return ""
    if kind == "uint8" and array.dtype.kind == "f" and array.size and array.max() <= 1:
        return ": (255 * it).round().astype(np.uint8)"
    return f": .astype(np.{kind})"


def fitting(
    members: Mapping[str, np.ndarray], schema: Schema
) -> tuple[dict[str, np.ndarray], dict[str, int], list[Fault]]:
    """The members of the right type and shape with finite numbers, the lengths that they share, and what is wrong with
    the others."""
    found: dict[str, np.ndarray] = {}
    lengths: dict[str, tuple[int, str]] = {}
    faults = []
    for name, (kind, shape, _, finite) in schema.items():
        if name not in members:
            continue
        array = np.asarray(members[name])
        own = []
        typed = array.dtype.kind in KINDS[kind] if kind in KINDS else array.dtype == kind
        if not typed:
            own.append((name, f"is {array.dtype}; give {kind}{conversion(array, kind)}"))
        if problem := shape_problem(array.shape, shape, lengths):
            own.append((name, problem))
        else:  # Its lengths count, whatever its numbers are.
            for word, length in zip(shape, array.shape, strict=True):
                if isinstance(word, str):
                    lengths.setdefault(word, (length, name))
        if finite and typed:
            own += not_finite(name, array)
        faults += own
        if not own:
            found[name] = array
    return found, {word: length for word, (length, _) in lengths.items()}, faults


def shape_problem(found: tuple[int, ...], shape: tuple, lengths: Mapping[str, tuple[int, str]]) -> str:
    """What is wrong with a shape, or nothing. lengths: word -> length so far, and the member that it comes from."""
    axes = (" or ".join(map(str, part)) if isinstance(part, tuple) else str(part) for part in shape)
    wanted = f"give [{', '.join(axes)}]"
    if len(found) != len(shape):
        return f"has the shape {list(found)}; {wanted}"
    for length, part in zip(found, shape, strict=True):
        if isinstance(part, str) and length == 0:
            return f"has no {part}; give at least one"
        if part in lengths and length != lengths[part][0]:
            other, source = lengths[part]
            return f"has {length} {part}, but {source} has {other}; {wanted} with as many in both"
        if not isinstance(part, str) and length not in (part if isinstance(part, tuple) else (part,)):
            return f"has the shape {list(found)}; {wanted}"
    return ""


def not_finite(name: str, array: np.ndarray) -> Iterator[Fault]:
    """The rows with numbers that are not finite."""
    if array.dtype.kind == "f" and array.size:
        with np.errstate(over="ignore"):
            finite = np.isfinite(array.astype(np.float32))
        wrong = ~finite.reshape(*finite.shape[:1], -1).all(-1)
        for row in map(tuple, np.argwhere(wrong)):
            yield f"{name}{list(map(int, row)) or ''}", f"is {array[row].tolist()}; give finite numbers for float32"


def limited(faults: Iterable[Fault]) -> Iterator[Fault]:
    """The first `MOST_FAULTS` faults of each member, and how many more there are."""
    counts: dict[str, int] = {}
    for where, problem in faults:
        name = where.split("[")[0]
        counts[name] = counts.get(name, 0) + 1
        if counts[name] <= MOST_FAULTS:
            yield where, problem
    for name, count in counts.items():
        if count > MOST_FAULTS:
            yield name, f"{count - MOST_FAULTS} more rows with such faults; mend the first ones and check again"
