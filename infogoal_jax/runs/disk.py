"""Files that survive a crash at any moment: written beside, synced and renamed."""

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from infogoal_jax.data import archives
from infogoal_jax.errors import UserError

REMEDIES = {
    errno.ENOSPC: "free some space",
    errno.EFBIG: "raise the limit on file sizes, or write elsewhere",
    errno.EACCES: "choose a folder that you may write to",
    errno.EROFS: "choose a folder that you may write to",
    errno.ENOTDIR: "choose a folder, and a path that does not lead through a file",
    errno.EEXIST: "choose another folder; a file stands there",
    errno.EISDIR: "choose another folder; a folder stands there",
    errno.ENAMETOOLONG: "choose a shorter path",
    errno.ELOOP: "choose a path that does not lead through a circle of links",
}


def write_atomically(path: Path, write: Callable[[Any], None]) -> None:
    """Write a file so that `path` holds either its old or its whole new content, whatever happens. Raises `UserError`
    if the disk refuses."""
    try:
        archives.replace_file(path, write)
    except OSError as error:
        raise disk_error(path, error) from error


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


def sync(file) -> None:
    """Bring a file's content to the disk."""
    file.flush()
    os.fsync(file.fileno())


def disk_error(path: Path, error: OSError) -> UserError:
    """The refusal of a disk in words: what was not written, why, and what is still there."""
    return UserError(
        f"{path}: could not be written ({error.strerror or error}): {REMEDIES.get(error.errno, 'look at the disk')}. "
        "What was there before is unchanged; a run with a checkpoint goes on with --resume"
    )
