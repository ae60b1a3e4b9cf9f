"""The numbers of a run. epochs and evaluations: tables to which it appends, as CSV and as JSON lines.
timing.json and evaluation.json: numbers about a run that are no part of it.

A line is a row of a seed and an epoch. Lists of numbers stand in the JSON lines only. What a killed run wrote after its
last checkpoint is cut off when it goes on.
"""

import csv
import dataclasses
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from infogoal_jax import files
from infogoal_jax.errors import UserError, require
from infogoal_jax.runs.disk import Place, decode, disk_error, parse, parse_lines, read_bytes, write_json, write_text

MOST_OF_TIMES = 1e15
"""Of seconds, and of anything a second."""
TABLES = ("epochs", "evaluations")
WATCHED = ("agent/loss", "agent/gradient_norm")
"""Metrics of an epoch that stop being finite when a member diverges."""
Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class RowKey:
    """What every row has; its other columns are numbers, or lists of numbers."""

    seed: int
    epoch: int


def file_names(table: str) -> tuple[str, str]:
    """The two files of a table."""
    return f"{table}.csv", f"{table}.jsonl"


def scalar_columns(rows: list[Row]) -> list[str]:
    """Names of the columns that hold single numbers: those that go into the CSV."""
    return [name for name, value in rows[0].items() if not isinstance(value, list)]


def append_rows(folder: Path, table: str, rows: list[Row]) -> None:
    """Add rows to both files of a table and sync them. Numbers are written in full, so that equal bits give equal
    files. Raises `UserError` if the disk refuses."""
    if not rows:
        return
    header, _, lines = csv_text(rows).partition("\r\n")
    csv_name, lines_name = file_names(table)
    for name, first, text in ((csv_name, f"{header}\r\n", lines), (lines_name, "", lines_text(rows))):
        try:
            files.append(folder / name, text.encode(), first.encode())
        except OSError as error:
            raise disk_error(folder / name, error) from error


def lines_text(rows: list[Row]) -> str:
    """The rows as JSON lines."""
    return "".join(json.dumps(row) + "\n" for row in rows)


def csv_text(rows: list[Row]) -> str:
    """The rows as CSV with a header, or nothing where there are none."""
    text = io.StringIO(newline="")
    if rows:
        writer = csv.DictWriter(text, scalar_columns(rows), extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    return text.getvalue()


def read_table(folder: Path, table: str) -> list[Row]:
    """The rows of a run's table. Raises `UserError` if the run has none, and for a line that is not one of them; a last
    line that was cut short is left out."""
    place = Place(folder / file_names(table)[1])
    content = read_bytes(place, f"{place.path}: not there; give the folder of a run of `infogoal train`")
    needed = WATCHED if table == "epochs" else ()
    rows: list[Row] = []
    for at, values in parse_lines(content, place):
        decode(RowKey, values, at)
        shapes = {name: shape_of(value) for name, value in values.items()}
        for name, shape in shapes.items():
            if shape is None:
                raise at.wrong(name, values[name], "should be a number, or a list of numbers")
        if not rows:
            first = shapes
        for name in sorted({*first, *shapes, *needed}):
            if name not in shapes:
                raise at.refusal(f"{name} is missing")
            if name not in first:
                raise at.refusal(f"{name} is in this row and not in the first one")
            if shapes[name] != first[name]:
                raise at.wrong(name, values[name], f"should have the shape of the first row, {list(first[name])}")
        rows.append(values)
    return rows


def shape_of(value: Any) -> tuple[int, ...] | None:
    """The shape of a number, which is (), or of numbers in lists; None for what is neither, and for lists of several
    lengths."""
    if isinstance(value, list):
        shapes = {shape_of(item) for item in value}
        (shape,) = shapes if len(shapes) == 1 else [None if shapes else ()]
        return None if shape is None else (len(value), *shape)
    return () if isinstance(value, int | float) and not isinstance(value, bool) else None


def diverged_seeds(rows: Sequence[Row]) -> dict[int, int]:
    """Seeds whose watched metrics stopped being finite, with the first such epoch, from the rows of the table
    `epochs`."""
    diverged: dict[int, int] = {}
    for row in rows:
        if any(not math.isfinite(row[name]) for name in WATCHED):
            diverged.setdefault(row["seed"], row["epoch"])
    return dict(sorted(diverged.items()))


def rows_until(folder: Path, table: str, seeds: Sequence[int], epochs: Sequence[int]) -> list[Row]:
    """The rows of these epochs, each of all seeds, which the table should have in this order.

    Raises `UserError` if it does not: the run cannot go on without losing what is there.
    """
    wanted = [(seed, epoch) for epoch in epochs for seed in seeds]
    path = folder / file_names(table)[1]
    rows = read_table(folder, table) if wanted or path.exists() else []
    found = [(row["seed"], row["epoch"]) for row in rows[: len(wanted)]]
    if found != wanted:
        number = next((n for n, (a, b) in enumerate(zip(found, wanted, strict=False)) if a != b), len(found))
        seed, epoch = wanted[number]
        raise UserError(
            f"{path}, line {number + 1}: should be the row of epoch {epoch} and seed {seed}, which the checkpoint is "
            "later than; bring back a copy of the file, or start a new run"
        )
    return rows[: len(wanted)]


def replace_table(folder: Path, table: str, rows: list[Row]) -> None:
    """Make these the rows of a table that is there: files that hold something else are written anew."""
    for name, text in zip(file_names(table), (csv_text(rows), lines_text(rows)), strict=True):
        path = folder / name
        if (rows or path.exists()) and not (path.exists() and files.read_bytes(path) == text.encode()):
            write_text(path, text)


@dataclasses.dataclass(frozen=True)
class Timing:
    """Seconds of compiling and running in the last session of a run, and rates over all seeds."""

    compile_seconds: float
    run_seconds: float
    env_steps_per_second: float
    updates_per_second: float

    def __post_init__(self):
        for name, value in vars(self).items():
            require(0 <= value < MOST_OF_TIMES, name, value, f"should be from 0 to below {MOST_OF_TIMES:g}")


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """What `infogoal evaluate` found.

    epoch: of the parameters.
    starts: a goal.
    corruption: weight of the backgrounds, None for goals that are not images.
    seeds: those that did not diverge.
    diverged: the others, with the epoch.
    metrics: {name: [seeds, ...]}.
    goals: those that were typed, None for those of the task.
    """

    epoch: int
    starts: int
    start_seed: int
    test_epsilon: float
    corruption: float | None
    seeds: list[int]
    diverged: dict[int, int]
    data: str
    metrics: dict[str, Any]
    goals: list[Any] | None = None


def write_timing(folder: Path, timing: Timing) -> None:
    """Write RUN/timing.json."""
    write_json(folder / "timing.json", dataclasses.asdict(timing))


def read_timing(folder: Path) -> Timing | None:
    """The times of the last session of a run; None if no session got past a chunk. Raises `UserError` for a file that
    holds something else."""
    place = Place(
        folder / "timing.json", remedy="delete it: it is not needed to go on, or bring back a copy of the file"
    )
    if not place.path.exists():
        return None
    return decode(Timing, parse(read_bytes(place, f"{place.path}: not there"), place), place)


def write_evaluation(folder: Path, evaluation: Evaluation) -> None:
    """Write RUN/evaluation.json."""
    write_json(folder / "evaluation.json", dataclasses.asdict(evaluation))
