"""The folder of a run: new where none of its files is there yet, and written by one process at a time."""

import contextlib
import os
import platform
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from infogoal_jax.config import TrainConfig
from infogoal_jax.data.archives import has_no_locks, try_lock
from infogoal_jax.errors import UserError
from infogoal_jax.runs import configuration, tables
from infogoal_jax.runs.configuration import to_dict
from infogoal_jax.runs.disk import disk_error, make_folder
from infogoal_jax.stopping import temporary

LOCK = ".lock"
RUN = (
    "config.json",
    "checkpoint",
    "policy",
    "timing.json",
    *(name for table in tables.TABLES for name in tables.file_names(table)),
    "evaluation.json",
    "figures",
)
"""What `infogoal train`, and what looks at its run, writes."""
SEARCH = ("config.json", "checkpoint", "trials.jsonl", "best.json")
"""What `infogoal tune` and `infogoal final` write."""
LOW_LEVEL = ("low_level", *tables.file_names("curve"))
"""What `infogoal pretrain` writes."""


class BeingWrittenError(UserError):
    """Another process holds the lock."""


def check_new(folder: Path, names: Sequence[str], flag: str = "out") -> None:
    """Raise `UserError`, naming the flag, if the folder holds any of these, or cannot be looked into."""
    try:
        there = {path.name for path in folder.iterdir()} & {*names}
    except FileNotFoundError:
        return
    except OSError as error:
        raise disk_error(folder, error) from error
    if there:
        raise UserError(
            f"{flag} = {str(folder)!r}: holds a run already, or other files of its names ({', '.join(sorted(there))}); "
            f"give another folder, or go on with the run by --resume {folder}"
        )


def newest_run(parent: Path, config: TrainConfig, seeds: Sequence[int]) -> Path | None:
    """The folder below `parent` whose run of this configuration and these seeds was started last, however many epochs
    it was to have; None where there is none. Folders that hold something else are passed over."""
    wanted = to_dict(config) | {"num_epochs": None}
    found = []
    for path in parent.glob(f"*/{configuration.NAME}"):
        try:
            about = configuration.read(path.parent)
        except UserError:
            continue
        if to_dict(about.config) | {"num_epochs": None} == wanted and about.seeds == list(seeds):
            found.append((path.stat().st_mtime_ns, path.parent))
    return max(found)[1] if found else None


@contextlib.contextmanager
def only_writer(folder: Path, new: Sequence[str] = ()) -> Iterator[None]:
    """Inside, no other process writes the run in this folder, which is made if it is not there.

    new: names of the files that must not be there yet. Raises `UserError` if another process writes there, or for one
    of these files. The lock goes with the process, so that a killed one leaves none behind.
    """
    make_folder(folder)
    with locked(folder / LOCK, folder):
        check_new(folder, new)
        remove_abandoned(folder)
        yield


@contextlib.contextmanager
def locked(path: Path, folder: Path) -> Iterator[None]:
    """Hold the lock of this file, which is there as long as it is held."""
    while True:
        try:
            file = open(path, "a+")  # noqa: SIM115 (closed below; the lock is that of the open file)
        except OSError as error:
            raise disk_error(path, error) from error
        with file:
            try:
                mine = try_lock(file)
            except OSError as error:
                if not has_no_locks(error):
                    raise disk_error(path, error) from error
                print(
                    f"infogoal: {folder} is on a file system without locks ({error.strerror}): let no two processes "
                    "write there",
                    file=sys.stderr,
                )
                mine = True
            if not mine:
                file.seek(0)
                raise BeingWrittenError(
                    f"{folder}: is being written by another process ({file.read(200).strip() or 'just started'}); wait "
                    "for its end, or give another folder"
                )
            if not is_at(file, path):
                continue  # The process that had it deleted it between our two steps.
            with temporary(path):
                file.truncate(0)
                file.write(f"process {os.getpid()} on {platform.node()}")
                file.flush()
                yield
            return


def is_at(file, path: Path) -> bool:
    """Whether the open file is the one at this path."""
    try:
        there, own = path.stat(), os.fstat(file.fileno())
    except OSError:
        return False
    return (there.st_dev, there.st_ino) == (own.st_dev, own.st_ino)


def remove_abandoned(folder: Path) -> None:
    """Delete what killed processes were writing beside a file. Whoever is still writing holds the lock of its file."""
    for path in (*folder.glob(".*.partial"), *folder.glob("figures/.*.partial")):
        with contextlib.suppress(OSError), open(path, "r+b") as file:
            if try_lock(file):
                path.unlink(missing_ok=True)
