"""Files that survive a crash at any moment: written beside, synced and renamed. And what a file holds as the record
that it should be: JSON text to values, values to a dataclass by its declaration.

Whatever is wrong with a file that is read is one `UserError` that names the file, the line, the field, its value and a
remedy.
"""

import dataclasses
import errno
import json
import reprlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from infogoal_jax import files
from infogoal_jax.errors import UserError
from infogoal_jax.field_types import WrongTypeError, converted, hints_of

Record = TypeVar("Record")
REMEDIES = {
    errno.ENOSPC: "free some space",
    errno.EFBIG: "raise the limit on file sizes, or write elsewhere",
    errno.EACCES: "choose a folder that you may write to",
    errno.EROFS: "choose a folder that you may write to",
    errno.ENOTDIR: "choose a folder, and a path that does not lead through a file",
    errno.EEXIST: "choose another folder; a file stands there",
    errno.EISDIR: "choose another folder; a folder stands there",
    errno.ENAMETOOLONG: "choose a shorter path",
    errno.ELOOP: "put the file itself in the place of the link, or choose another path",
    errno.EMLINK: "work on a copy, as cp -r makes it",
    errno.EINVAL: "choose the path of a file",
}


def write_atomically(path: Path, write: Callable[[Any], None]) -> None:
    """Write a file so that `path` holds either its old or its whole new content, whatever happens. Raises `UserError`
    if the disk refuses."""
    try:
        files.replace_file(path, write)
    except OSError as error:
        raise disk_error(path, error) from error


def check_out(path: Path, field: str = "out") -> None:
    """Raise `UserError`, naming the field, where a file is to be written and something stands that is none: said before
    the work, and not after it."""
    try:
        files.check_writable(path)
    except OSError as error:
        raise UserError(f"{field} = {str(path)!r}: {error.strerror}; give the path of a file") from error


def write_json(path: Path, values: Any, indent: int | None = None) -> None:
    """Write JSON values as a file that is whole or the old one. Raises `UserError` if the disk refuses."""
    write_text(path, json.dumps(values, indent=indent) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text as a file that is whole or the old one. Raises `UserError` if the disk refuses."""
    write_atomically(path, lambda file: file.write(text.encode()))


def make_folder(folder: Path) -> None:
    """Make the folder of a run, if it is not there. Raises `UserError` if the disk refuses, or a file stands in the
    way."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(folder, error) from error


def below(folder: Path, path: str) -> Path:
    """The file or folder of this path below a folder. Raises `UserError` for one that leads out of it, or through a
    link: whoever made the folder could have it write somewhere else."""
    there, parts = folder / path, Path(path).parts
    if Path(path).is_absolute() or ".." in parts:
        raise UserError(f"{path!r}: lies outside of {folder}")
    for place in (there, *there.parents[: max(0, len(parts) - 1)]):
        if place != folder and place.is_symlink():
            raise UserError(f"{place}: is a link, through which nothing is written; give a folder without it")
    return there


def disk_error(path: Path, error: OSError) -> UserError:
    """The refusal of a disk in words: what was not written, why, and what is still there."""
    goes_on = f"; what has its checkpoint in {path.parent} goes on from there with --resume"
    return UserError(
        f"{path}: could not be written ({error.strerror or error}): {REMEDIES.get(error.errno, 'look at the disk')}. "
        f"This file is as it was before{goes_on if (path.parent / 'checkpoint').exists() else ''}"
    )


class Place(NamedTuple):
    """Where values were read. line: of a file of JSON lines; prefix: of the fields, such as `config.learner.`."""

    path: Path
    remedy: str = "bring back a copy of the file, or start a new run"
    line: int | None = None
    prefix: str = ""

    def within(self, name: str) -> "Place":
        """The place of the fields of this field."""
        return self._replace(prefix=f"{self.prefix}{name}.")

    def refusal(self, problem: str) -> UserError:
        """The error for something that is wrong here."""
        line = "" if self.line is None else f", line {self.line}"
        return UserError(f"{self.path}{line}: is damaged or was not written by this version ({problem}); {self.remedy}")

    def wrong(self, name: str, value: Any, problem: str) -> UserError:
        """The error for the value of a field."""
        return self.refusal(f"{self.prefix}{name} = {reprlib.repr(value)}: {problem}")


MOST_OF_TEXTS, MOST_OF_ARRAYS = 2**28, 2**40
"""Bytes of a file of JSON values or of a table, and of one that holds arrays too."""


def read_bytes(place: Place, missing: str, most: int = MOST_OF_TEXTS) -> bytes:
    """The content of a file. most: bytes that it may have. Raises `UserError` if it cannot be read; missing: what is
    said where nothing is there."""
    try:
        return files.read_bytes(place.path, most)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise UserError(missing) from error
    except IsADirectoryError as error:
        raise place.refusal("it is a folder") from error
    except MemoryError as error:
        raise place.refusal("it does not fit into the memory of this machine") from error
    except OSError as error:
        if error.errno in (errno.EINVAL, errno.EFBIG):
            raise place.refusal(error.strerror) from error
        raise UserError(
            f"{place.path}: could not be read ({error.strerror or error}); give files that you may read"
        ) from error


def parse(content: bytes, place: Place) -> Any:
    """The value of a JSON text. Raises `UserError` for anything else."""
    try:
        return json.loads(content.decode())
    except UnicodeDecodeError as error:
        raise place.refusal(f"byte {error.start + 1} is not UTF-8") from error
    except json.JSONDecodeError as error:
        at = f"column {error.colno}" if place.line else f"line {error.lineno}, column {error.colno}"
        raise place.refusal(f"not JSON: {error.msg}, {at}") from error
    except RecursionError as error:
        raise place.refusal("it is nested thousands of levels deep") from error
    except ValueError as error:  # A whole number of thousands of digits.
        raise place.refusal(str(error)) from error


def parse_lines(content: bytes, place: Place) -> Iterator[tuple[Place, Any]]:
    """The value of each line of a file of JSON lines and its place, up to a last line that was cut short."""
    *whole, _ = content.split(b"\n")
    for number, line in enumerate(whole, 1):
        yield place._replace(line=number), parse(line, place._replace(line=number))


def decode(record: type[Record], values: Any, place: Place, all_fields: bool = False) -> Record:
    """The record of these values, each checked against the type of its field.

    all_fields: defaults do not stand in for missing fields, and unknown fields are refused; otherwise unknown ones are
    left out. Raises `UserError` for a field that is missing or has a value of another type, and for what the record's
    own checks refuse.
    """
    if not isinstance(values, dict):
        raise place.refusal(f"{place.prefix.rstrip('.') or 'it'} should be an object, not {reprlib.repr(values)}")
    hints = hints_of(record)
    fields = {field.name: field for field in dataclasses.fields(record)}
    unknown = sorted(values.keys() - fields.keys())
    if all_fields and unknown:
        raise place.wrong(unknown[0], values[unknown[0]], f"no such field. Known: {', '.join(fields)}")
    found = {}
    for name, field in fields.items():
        if name in values:
            found[name] = decode_value(hints[name], values[name], name, place, all_fields)
        elif all_fields or (field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING):
            raise place.refusal(f"{place.prefix}{name} is missing")
    return built(place, lambda: record(**found))


def built(place: Place, make: Callable[[], Record]) -> Record:
    """What `make` returns; what it refuses is said with the place."""
    try:
        return make()
    except UserError as error:
        raise place.refusal(str(error)) from error


def decode_value(hint: Any, value: Any, name: str, place: Place, all_fields: bool = False) -> Any:
    """A value of this type. Raises `UserError` if it is of another."""
    if dataclasses.is_dataclass(hint):
        return decode(hint, value, place.within(name), all_fields)
    try:
        return converted(value, hint)
    except WrongTypeError as error:
        raise place.wrong(name, value, str(error)) from error
