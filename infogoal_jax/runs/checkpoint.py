"""Checkpoints: one file that holds a pytree of arrays, names its configuration and notices when it was changed; and
where a run goes on from one.

The first line is a header of JSON values, what follows are the arrays; the checksum in the header is of both. What a
folder holds is checked as a whole before anything in it is changed.
"""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any, NamedTuple

import flax.serialization
import jax

from infogoal_jax.errors import UserError, require
from infogoal_jax.files import open_to_read
from infogoal_jax.keys import is_key, restored
from infogoal_jax.runs import configuration, tables
from infogoal_jax.runs.configuration import DATA, Description, located, to_dict
from infogoal_jax.runs.disk import MOST_OF_ARRAYS, Place, decode, decode_value, parse, read_bytes, write_atomically
from infogoal_jax.runs.tables import Row

FORMAT = "infogoal-jax checkpoint 2"
LONGEST_HEADER = 2**20
REMEDY = "train again, or bring back a copy of the file"


@dataclasses.dataclass(frozen=True)
class Seal:
    """What every header has: the format, and the checksum of the header without it and of the arrays."""

    format: str
    sha256: str


def checksum(header: dict[str, Any], payload: bytes) -> str:
    """What tells this header and these arrays from all others."""
    return hashlib.sha256(json.dumps(header).encode() + b"\n" + payload).hexdigest()


def save(path: Path, header: dict[str, Any], tree: Any) -> None:
    """Write a pytree of arrays (typed keys included) with a header of JSON values. The old file stays until the new one
    is whole."""
    plain = jax.tree.map(lambda leaf: jax.device_get(jax.random.key_data(leaf) if is_key(leaf) else leaf), tree)
    payload = flax.serialization.to_bytes(in_lists(plain))
    header = {"format": FORMAT, **json.loads(json.dumps(header))}
    first_line = json.dumps(header | {"sha256": checksum(header, payload)})

    def write(file):
        file.write(first_line.encode() + b"\n")
        file.write(payload)

    write_atomically(path, write)


def in_lists(tree: Any) -> Any:
    """The pytree with a list of leaves for each node that flax does not know, as `mjx.Data` in an environment's
    state."""
    return jax.tree.map(lambda node: jax.tree.leaves(node) if is_unknown(node) else node, tree, is_leaf=is_unknown)


def is_unknown(node: Any) -> bool:
    """Whether this is a node, none of whose fields flax would write."""
    return not jax.tree_util.all_leaves([node]) and node is not None and flax.serialization.to_state_dict(node) is node


def read_header(path: Path) -> tuple[dict[str, Any], bytes]:
    """The header, without format and checksum, and the arrays' bytes of a checkpoint. Raises `UserError` for a file
    that is not what was written."""
    place = Place(path, remedy=REMEDY)
    missing = f"{path}: there is no checkpoint; give the folder of a run that got past its first evaluation"
    first_line, _, payload = read_bytes(place, missing, MOST_OF_ARRAYS).partition(b"\n")
    header, sha256 = parse_header(first_line, place)
    if checksum(header, payload) != sha256:
        raise place.refusal("its content does not have its checksum")
    del header["format"]
    return header, payload


def parse_header(first_line: bytes, place: Place) -> tuple[dict[str, Any], str]:
    """The header of a checkpoint with its format, and the checksum. Raises `UserError` for another format."""
    header = parse(first_line, place)
    seal = decode(Seal, header, place)
    if seal.format != FORMAT:
        raise place.wrong("format", seal.format, f"should be {FORMAT!r}")
    del header["sha256"]
    return header, seal.sha256


def read_epoch(path: Path) -> int:
    """The epoch in the header of a checkpoint, whose gigabytes of arrays are not read for it; 0 where there is none."""
    try:
        with open_to_read(path) as file:
            header, _ = parse_header(file.readline(LONGEST_HEADER), Place(path))
        return decode_value(int, header.get("epoch", 0), "epoch", Place(path))
    except (OSError, UserError):  # What is wrong with it is named when all of it is read.
        return 0


def load(path: Path, template: Any) -> tuple[dict[str, Any], Any]:
    """The header and the pytree of a checkpoint. template: a pytree of the same structure (shapes are enough), as
    `jax.eval_shape` gives it.

    Raises `UserError` if the file is damaged, or holds arrays of other shapes: it belongs to another configuration.
    """
    header, payload = read_header(path)
    return header, arrays(path, payload, template)


def arrays(path: Path, payload: bytes, template: Any) -> Any:
    """The pytree whose bytes `read_header` returned. Raises `UserError` for another structure or other shapes than the
    template's."""
    plain_template = jax.tree.map(
        lambda leaf: jax.eval_shape(jax.random.key_data, leaf) if is_key(leaf) else leaf, template
    )
    other = UserError(
        f"{path}: this checkpoint belongs to another configuration; train with the configuration in "
        f"{path.parent / 'config.json'}"
    )
    try:
        plain = flax.serialization.from_bytes(in_lists(plain_template), payload)
    except (KeyError, TypeError, ValueError) as error:
        raise other from error
    for expected, found in zip(jax.tree.leaves(plain_template), jax.tree.leaves(plain), strict=True):
        if expected.shape != found.shape or expected.dtype != found.dtype:
            raise other
    plain = jax.tree.structure(template).unflatten(jax.tree.leaves(plain))
    return jax.tree.map(lambda like, leaf: restored(leaf, like) if is_key(like) else leaf, template, plain)


class Point(NamedTuple):
    """Where a run goes on.

    epoch: done so far.
    states: of all seeds, None before the first checkpoint.
    rows: of each table until then.
    """

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
    then, saved = configuration.read(folder, "resume"), folder / "checkpoint"
    check_same(folder / configuration.NAME, then, now)
    if never_got_past_a_chunk(folder, now.config.epochs_per_evaluation):
        return BEGINNING
    header, payload = read_header(saved)
    epoch = checked_epoch(header, saved, now)
    check_same(saved, configuration.from_values(header, Place(saved, remedy=REMEDY)), now)
    states = arrays(saved, payload, states_shape)
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
    place = Place(saved, remedy=REMEDY)
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
    """Raise `UserError` with the fields in which two descriptions of a run differ. longer: whether `num_epochs` may.
    Where the data lie may differ: what they are has a checksum."""
    before, after = ({"seeds": of.seeds, "data": of.data} for of in (then, now))
    check_same_config(path, then.config, now.config, longer, before, after)


def check_same_config(
    path: Path, then: Any, now: Any, longer: bool = False, before: dict | None = None, after: dict | None = None
) -> None:
    """Raise `UserError` with the fields in which two configurations differ, as `check_same` does. before, after: other
    values of them."""
    may_differ = {"num_epochs": None} if longer else {}
    before, after = (
        {**(values or {}), **json.loads(json.dumps(to_dict(located(config)))), **may_differ}
        for values, config in ((before, then), (after, now))
    )
    for values in (before, after):
        values["env"] |= dict.fromkeys(DATA)
        values["agent"] |= {"low_level": None}
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
