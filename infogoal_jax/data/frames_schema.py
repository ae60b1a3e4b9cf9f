"""The members of a file of an image dataset: their types and shapes, and which of a file have them.

What each means is in docs/reference/datasets.md; what else can be wrong with their values is in frames_check.py.
"""

from collections.abc import Mapping

import numpy as np

from infogoal_jax.data import archives
from infogoal_jax.errors import UserError

FORMAT_VERSION = 1
REMEDY = "write it again with infogoal_jax.data.frames.save or infogoal data import (docs/reference/datasets.md)"
"""What helps where a file is damaged."""
GIVE_A_FILE = "give an npz of `infogoal data import` (docs/reference/datasets.md)"
"""What helps where there is no file that can be read."""

# Member -> type, shape, whether it must be there. A letter stands for a length that all members share; a tuple for
# lengths that may be had.
SCHEMA: dict[str, tuple[str, tuple, bool]] = {
    "format_version": ("integer", (), True),
    "about": ("text", (), True),
    "actions": ("text", ("A",), True),
    "objects": ("text", ("O",), False),
    "joint_names": ("text", ("J",), False),
    "state": ("int32", ("K",), True),
    "frame": ("int32", ("M",), True),
    "action": ("int32", ("M",), True),
    "next_frame": ("int32", ("M",), True),
    "trajectory": ("int32", ("M",), True),
    "time": ("int32", ("M",), True),
    "terminal": ("bool", ("M",), True),
    "rotation": ("float32", ("K", 3, 3), False),
    "joints": ("float32", ("K", "J"), False),
    "position": ("float32", ("K", (2, 3)), False),
    "detected": ("bool", ("K", "O"), False),
    "frames": ("uint8", ("K", "H", "W", (1, 3)), True),
}
LENGTHS = {
    "K": "frames",
    "M": "moves",
    "A": "actions",
    "O": "objects",
    "J": "joints",
    "H": "pixels of height",
    "W": "pixels of width",
}
Fault = tuple[str, str]
"""Where in the file, such as `action[3]`, and what is wrong, with the remedy."""


def read_members(archive: archives.Archive) -> tuple[dict[str, np.ndarray], list[Fault]]:
    """The members of the schema that can be read, and those that cannot: damaged, or pickled objects."""
    members, faults = {}, []
    for name in SCHEMA:
        if name in archive.sizes:
            try:
                members[name] = archives.member(archive, name, REMEDY)
            except UserError as error:
                faults.append((name, str(error).removeprefix(f"{name} = ")))
    return members, faults


def fitting_members(members: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, int], list[Fault]]:
    """The members of the right type and shape, the lengths that they share, and what is wrong with the others."""
    fitting: dict[str, np.ndarray] = {}
    lengths: dict[str, tuple[int, str]] = {}
    faults = []
    for name in sorted(
        set(SCHEMA) & set(members), key=lambda name: (name != "frames", list(SCHEMA).index(name))
    ):  # frames say what K is
        kind, shape, _ = SCHEMA[name]
        array = np.asarray(members[name])
        right = {"text": array.dtype.kind == "U", "integer": array.dtype.kind in "iu"}.get(kind, array.dtype == kind)
        if not right:
            faults.append(
                (
                    name,
                    f"is {array.dtype}; give {kind}" + ("" if kind in ("text", "integer") else f": .astype(np.{kind})"),
                )
            )
        problem = shape_problem(array.shape, shape, lengths)
        if problem:
            faults.append((name, problem))
        if right and not problem:
            fitting[name] = array
            for letter, length in zip(shape, array.shape, strict=True):
                if letter in LENGTHS:
                    lengths.setdefault(letter, (length, name))
    return fitting, {letter: length for letter, (length, _) in lengths.items()}, faults


def shape_problem(found: tuple[int, ...], shape: tuple, lengths: Mapping[str, tuple[int, str]]) -> str:
    """What is wrong with a shape, or nothing. lengths: letter -> length so far, and the member that it comes from."""
    words = (
        "[" + ", ".join(" or ".join(map(str, part)) if isinstance(part, tuple) else str(part) for part in shape) + "]"
    )
    if len(found) != len(shape):
        return f"has the shape {list(found)}; give {words}"
    for length, part in zip(found, shape, strict=True):
        if part in lengths and length != lengths[part][0]:
            wanted, source = lengths[part]
            return f"has {length} {LENGTHS[part]}, but {source} has {wanted}; give {words} with one {part} for all"
        if part in LENGTHS and length == 0:
            return f"has no {LENGTHS[part]}; give at least one"
        if (isinstance(part, tuple) and length not in part) or (isinstance(part, int) and length != part):
            return f"has the shape {list(found)}; give {words}"
    return ""
