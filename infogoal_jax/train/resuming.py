"""Where a run goes on: what its folder holds is checked as a whole before anything in it is changed."""

import json
from pathlib import Path
from typing import Any, NamedTuple

from infogoal_jax.errors import UserError, require
from infogoal_jax.runs import checkpoint, description, tables
from infogoal_jax.runs.configuration import to_dict
from infogoal_jax.runs.decoding import Place, decode_value
from infogoal_jax.runs.description import Description
from infogoal_jax.runs.tables import Row


class Point(NamedTuple):
    """Where a run goes on. epoch: done so far; states: of all seeds, None before the first checkpoint; rows: of each
    table until then."""

    epoch: int
    states: Any
    rows: dict[str, list[Row]]


BEGINNING = Point(0, None, {table: [] for table in tables.TABLES})


def last_point(folder: Path, now: Description, states_shape: Any) -> Point:
    """Where the run in this folder goes on with the description of now: its last checkpoint, or the beginning if it was
    stopped before there was one.

    states_shape: shapes of all seeds' states. Raises `UserError`, and changes nothing, for a folder without a run, a
    file that is not what was written, another configuration, or a table without all rows until the checkpoint.
    """
    then, saved = description.read(folder), folder / "checkpoint"
    check_same(folder / description.NAME, then, now)
    if never_got_past_a_chunk(folder, now.config.epochs_per_evaluation):
        return BEGINNING
    header, payload = checkpoint.read_header(saved)
    epoch = checked_epoch(header, saved, now)
    check_same(saved, description.from_values(header, Place(saved, remedy=checkpoint.REMEDY)), now)
    states = checkpoint.arrays(saved, payload, states_shape)
    every = {"epochs": 1, "evaluations": now.config.epochs_per_evaluation}
    rows = {
        table: tables.rows_until(folder, table, now.seeds, range(every[table], epoch + 1, every[table]))
        for table in tables.TABLES
    }
    return Point(epoch, states, rows)


def never_got_past_a_chunk(folder: Path, epochs_per_chunk: int) -> bool:
    """Whether a run was stopped before its first checkpoint: it has none, and at most the rows of one chunk."""
    if (folder / "checkpoint").exists() or (folder / "policy").exists():
        return False
    there = [table for table in tables.TABLES if (folder / tables.file_names(table)[1]).exists()]
    return all(row["epoch"] <= epochs_per_chunk for table in there for row in tables.read_table(folder, table))


def checked_epoch(header: dict[str, Any], saved: Path, now: Description) -> int:
    """The epoch of a checkpoint. Raises `UserError` if the run as it is described now does not come through it."""
    place = Place(saved, remedy=checkpoint.REMEDY)
    if "epoch" not in header:
        raise place.refusal("epoch is missing")
    epoch, chunk = decode_value(int, header["epoch"], "epoch", place), now.config.epochs_per_evaluation
    if epoch <= 0 or epoch % chunk:
        raise place.wrong("epoch", epoch, f"should be a multiple of epochs_per_evaluation = {chunk}")
    require(
        epoch <= now.config.num_epochs,
        "num_epochs",
        now.config.num_epochs,
        f"the run is already at epoch {epoch}; give at least that",
    )
    return epoch


def check_same(path: Path, then: Description, now: Description, longer: bool = True) -> None:
    """Raise `UserError` with the fields in which two descriptions of a run differ. longer: whether `num_epochs` may."""
    may_differ = {"num_epochs": None} if longer else {}
    before, after = (
        {"seeds": of.seeds, "data": of.data, **json.loads(json.dumps(to_dict(of.config))), **may_differ}
        for of in (then, now)
    )
    different = differences(before, after)
    if different:
        raise UserError(
            f"{path}: is of another configuration: {'; '.join(different)}. Give the same values, or start a new run"
        )


def differences(first: dict, second: dict, prefix: str = "") -> list[str]:
    """The fields in which two nested dictionaries differ, as `field was first value, now second value`."""
    found = []
    for name in sorted(first.keys() | second.keys()):
        left, right = first.get(name), second.get(name)
        if isinstance(left, dict) and isinstance(right, dict):
            found += differences(left, right, f"{prefix}{name}.")
        elif json.dumps(left) != json.dumps(right):
            found.append(f"{prefix}{name} was {left!r}, now {right!r}")
    return found
