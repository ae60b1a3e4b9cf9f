"""Files of a run that survive a crash at any moment: written beside, synced and renamed, or appended and cut back to
the last checkpoint.

RUN/config.json              the resolved configuration, seeds, dataset and versions
RUN/checkpoint               everything that training carries, for all seeds
RUN/policy                   parameters alone, of the same epoch
RUN/timing.json              seconds compiling and running, and rates, of the last session
RUN/epochs.csv, .jsonl       a line for each seed and epoch
RUN/evaluations.csv, .jsonl  a line for each seed and evaluation
RUN/evaluation.json          what `infogoal evaluate` found last; RUN/figures/ what `infogoal report` drew
"""

import csv
import errno
import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path

from infogoal_jax.data import archives
from infogoal_jax.errors import UserError

TABLES = ("epochs", "evaluations")


def write_atomically(path: Path, write: Callable[[object], None]) -> None:
    """Write a file so that `path` holds either its old or its whole new content, whatever happens. Raises `UserError`
    if the disk refuses."""
    try:
        archives.replace_file(path, write)
    except OSError as error:
        raise disk_error(path, error) from error


def make_folder(folder: Path) -> None:
    """Make the folder of a run, if it is not there. Raises `UserError` if the disk refuses, or a file stands in the
    way."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(folder, error) from error


def disk_error(path: Path, error: OSError) -> UserError:
    """The refusal of a disk in words: what was not written, why, and what is still there."""
    remedy = {
        errno.ENOSPC: "free some space",
        errno.EFBIG: "raise the limit on file sizes, or write elsewhere",
        errno.EACCES: "choose a folder that you may write to",
        errno.EROFS: "choose a folder that you may write to",
        errno.ENOTDIR: "choose a path that does not lead through a file",
        errno.EEXIST: "choose another folder; a file stands there",
    }.get(error.errno, "look at the disk")
    return UserError(
        f"{path}: could not be written ({error.strerror or error}): {remedy}. What was there before is unchanged; "
        "a run with a checkpoint goes on with --resume"
    )


def scalar_columns(rows: list[dict]) -> list[str]:
    """Names of the columns that hold single numbers: those that go into the CSV. Lists go into the JSON lines only."""
    return [name for name, value in rows[0].items() if not isinstance(value, list)]


def append_rows(folder: Path, table: str, rows: list[dict]) -> None:
    """Add rows to both files of a table and sync them. Numbers are written in full, so that equal bits give equal
    files."""
    if not rows:
        return
    columns = scalar_columns(rows)
    csv_path, lines_path = folder / f"{table}.csv", folder / f"{table}.jsonl"
    try:
        with open(csv_path, "a", newline="") as file:
            writer = csv.DictWriter(file, columns, extrasaction="ignore")
            if file.tell() == 0:
                writer.writeheader()
            writer.writerows(rows)
            sync(file)
        with open(lines_path, "a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)
            sync(file)
    except OSError as error:
        raise disk_error(csv_path, error) from error


def sync(file) -> None:
    """Bring a file's content to the disk."""
    file.flush()
    os.fsync(file.fileno())


def cut_back(folder: Path, epoch: int) -> None:
    """Drop the rows after `epoch` (and a last line cut short): what a killed run wrote after its last checkpoint."""
    for table in TABLES:
        path = folder / f"{table}.jsonl"
        if not path.exists():
            (folder / f"{table}.csv").unlink(missing_ok=True)  # Of a run that was killed between its first two appends.
            continue
        kept = [row for row in read_lines(path) if row["epoch"] <= epoch]
        columns = scalar_columns(kept) if kept else []
        write_atomically(
            path, lambda file, kept=kept: file.writelines((json.dumps(row) + "\n").encode() for row in kept)
        )
        write_atomically(
            folder / f"{table}.csv", lambda file, kept=kept, columns=columns: file.write(csv_bytes(kept, columns))
        )


def csv_bytes(rows: list[dict], columns: list[str]) -> bytes:
    """The rows as a CSV file with a header, or nothing where there are none."""
    import io

    if not rows:
        return b""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def read_lines(path: Path) -> Iterable[dict]:
    """The rows of a file of JSON lines, up to the first that is not whole."""
    with open(path) as file:
        for line in file:
            if not line.endswith("\n"):
                return
            yield json.loads(line)


def read_table(folder: Path, table: str) -> list[dict]:
    """The rows of a run's table: one of `TABLES`. Raises `UserError` if the run has none."""
    path = folder / f"{table}.jsonl"
    if not path.exists():
        raise UserError(f"{path}: not there; give the folder of a run of `infogoal train`")
    return list(read_lines(path))
