"""Checkpoints: one file that holds a pytree of arrays, names its configuration and notices when it was damaged."""

import hashlib
import json
from pathlib import Path
from typing import Any

import flax.serialization
import jax

from infogoal_jax.errors import UserError
from infogoal_jax.train.files import write_atomically

FORMAT = "infogoal-jax checkpoint 1"


def is_key(leaf: Any) -> bool:
    """Whether a leaf is an array of typed PRNG keys."""
    return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def save(path: Path, header: dict[str, Any], tree: Any) -> None:
    """Write a pytree of arrays (typed keys included) with a header of JSON values. The old file stays until the new one
    is whole."""
    plain = jax.tree.map(lambda leaf: jax.device_get(jax.random.key_data(leaf) if is_key(leaf) else leaf), tree)
    payload = flax.serialization.to_bytes(plain)
    first_line = json.dumps(
        {"format": FORMAT, "sha256": hashlib.sha256(payload).hexdigest(), "bytes": len(payload), **header}
    )

    def write(file):
        file.write(first_line.encode() + b"\n")
        file.write(payload)

    write_atomically(path, write)


def read_header(path: Path) -> tuple[dict[str, Any], bytes]:
    """The header and the payload of a checkpoint, checked against each other. Raises `UserError` for a file that is not
    whole."""
    try:
        first_line, _, payload = path.read_bytes().partition(b"\n")
    except FileNotFoundError as error:
        raise UserError(
            f"{path}: there is no checkpoint; give the folder of a run that got past its first evaluation"
        ) from error
    except OSError as error:
        raise UserError(
            f"{path}: could not be read ({error.strerror}); give the folder of a run whose files you may read"
        ) from error
    damaged = UserError(
        f"{path}: this checkpoint is damaged or was not written by infogoal; train again, or bring back a copy of the "
        "file"
    )
    try:
        header = json.loads(first_line)
    except ValueError as error:
        raise damaged from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise damaged
    if len(payload) != header["bytes"] or hashlib.sha256(payload).hexdigest() != header["sha256"]:
        raise damaged
    return header, payload


def load(path: Path, template: Any) -> tuple[dict[str, Any], Any]:
    """The header and the pytree of a checkpoint. template: a pytree of the same structure (shapes are enough), as
    `jax.eval_shape` gives it.

    Raises `UserError` if the file is damaged, or holds arrays of other shapes: it belongs to another configuration.
    """
    header, payload = read_header(path)
    plain_template = jax.tree.map(
        lambda leaf: jax.eval_shape(jax.random.key_data, leaf) if is_key(leaf) else leaf, template
    )
    other = UserError(
        f"{path}: this checkpoint belongs to another configuration; train with the configuration in "
        f"{path.parent / 'config.json'}"
    )
    try:
        plain = flax.serialization.from_bytes(plain_template, payload)
    except ValueError as error:
        raise other from error
    for expected, found in zip(jax.tree.leaves(plain_template), jax.tree.leaves(plain), strict=True):
        if expected.shape != found.shape or expected.dtype != found.dtype:
            raise other
    return header, jax.tree.map(
        lambda like, leaf: jax.random.wrap_key_data(leaf) if is_key(like) else leaf, template, plain
    )
