"""Checkpoints: one file that holds a pytree of arrays, names its configuration and notices when it was changed.

The first line is a header of JSON values, what follows are the arrays; the checksum in the header is of both.
"""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import flax.serialization
import jax

from infogoal_jax.errors import UserError
from infogoal_jax.runs.decoding import Place, decode, parse, read_bytes
from infogoal_jax.runs.disk import write_atomically
from infogoal_jax.threefry import written_out

FORMAT = "infogoal-jax checkpoint 2"
EARLIER = "infogoal-jax checkpoint 1"
REMEDY = "train again, or bring back a copy of the file"


@dataclasses.dataclass(frozen=True)
class Seal:
    """What every header has: the format, and the checksum of the header without it and of the arrays."""

    format: str
    sha256: str


def is_key(leaf: Any) -> bool:
    """Whether a leaf is an array of typed PRNG keys."""
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def keys_like(like: Any, data: jax.Array) -> jax.Array:
    """The typed keys that were saved as these numbers, of the generator that `like` has."""
    keys = jax.random.wrap_key_data(data)
    return keys if keys.dtype == like.dtype else written_out(keys)


def checksum(header: dict[str, Any], payload: bytes) -> str:
    """What tells this header and these arrays from all others."""
    return hashlib.sha256(json.dumps(header).encode() + b"\n" + payload).hexdigest()


def save(path: Path, header: dict[str, Any], tree: Any) -> None:
    """Write a pytree of arrays (typed keys included) with a header of JSON values. The old file stays until the new one
    is whole."""
    plain = jax.tree.map(lambda leaf: jax.device_get(jax.random.key_data(leaf) if is_key(leaf) else leaf), tree)
    payload = flax.serialization.to_bytes(plain)
    header = {"format": FORMAT, **json.loads(json.dumps(header))}
    first_line = json.dumps(header | {"sha256": checksum(header, payload)})

    def write(file):
        file.write(first_line.encode() + b"\n")
        file.write(payload)

    write_atomically(path, write)


def read_header(path: Path) -> tuple[dict[str, Any], bytes]:
    """The header, without format and checksum, and the arrays' bytes of a checkpoint. Raises `UserError` for a file
    that is not what was written."""
    place = Place(path, remedy=REMEDY)
    missing = f"{path}: there is no checkpoint; give the folder of a run that got past its first evaluation"
    first_line, _, payload = read_bytes(place, missing).partition(b"\n")
    header = parse(first_line, place)
    seal = decode(Seal, header, place)
    if seal.format == EARLIER:
        raise UserError(f"{path}: was written by an earlier version, which cannot be read; start a new run")
    if seal.format != FORMAT:
        raise place.wrong("format", seal.format, f"should be {FORMAT!r}")
    del header["sha256"]
    if checksum(header, payload) != seal.sha256:
        raise place.refusal("its content does not have its checksum")
    del header["format"]
    return header, payload


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
        plain = flax.serialization.from_bytes(plain_template, payload)
    except (KeyError, TypeError, ValueError) as error:
        raise other from error
    for expected, found in zip(jax.tree.leaves(plain_template), jax.tree.leaves(plain), strict=True):
        if expected.shape != found.shape or expected.dtype != found.dtype:
            raise other
    return jax.tree.map(lambda like, leaf: keys_like(like, leaf) if is_key(like) else leaf, template, plain)
