"""The members of a file of an image dataset (frames.py), their types and shapes, and everything that is wrong with
them, found in one pass. What each means is in docs/reference/datasets.md.

An error is what makes the data unusable or would make a policy learn moves that were never made; `frames.load` and
`frames.save` stop at the first. A warning is a member that nothing reads, or an object that no frame shows.
"""

import os
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from infogoal_jax.data import archives
from infogoal_jax.data.check import Finding
from infogoal_jax.errors import UserError, nearest, typed
from infogoal_jax.files import from_json

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
MOST_FINDINGS = 10
"""Rows that are listed of one kind of fault; the rest is counted."""
ROTATION_WITHIN = 1e-3
"""Entries of R R^T - 1, and the determinant, may be off by this much: float32, or poses written down with four
digits."""


def check_frames(path: str | os.PathLike) -> list[Finding]:
    """Every fault of the file at `path`, errors first; empty if there is none."""
    try:
        with archives.naming("image dataset", path, GIVE_A_FILE):
            archive = archives.read(path, REMEDY, version=None)
    except UserError as error:
        return [Finding("error", str(path), str(error).removeprefix(f"image dataset = {str(path)!r}: "))]
    members, unreadable = read_members(archive)
    faults = [*unreadable, *member_faults(members, set(archive.sizes))]
    errors = [Finding("error", f"{path}: {where}", problem) for where, problem in faults]
    surprising = (*unknown_members(archive), *limited(unseen_objects(members)))
    return errors + [Finding("warning", f"{path}: {where}", problem) for where, problem in surprising]


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


def member_faults(members: Mapping[str, np.ndarray], present: set[str]) -> Iterator[Fault]:
    """Every error in what the members say. present: names of all members, those that cannot be read too."""
    for name, (_, _, needed) in SCHEMA.items():
        if needed and name not in present:
            yield name, f"missing; {REMEDY}"
    yield from pair_faults(present)
    fitting, lengths, faults = fitting_members(members)
    yield from faults
    yield from text_faults(fitting)
    yield from limited(value_faults(fitting, lengths))
    if {"frame", "next_frame", "trajectory", "time", "terminal"} <= set(fitting):
        yield from limited(trajectory_faults(fitting))
    if {"state", "frame", "action", "next_frame"} <= set(fitting):
        yield from limited(contradiction_faults(fitting))


def pair_faults(present: set[str]) -> Iterator[Fault]:
    """Members that make sense together only."""
    for values, names in (("detected", "objects"), ("joints", "joint_names")):
        if values in present and names not in present:
            yield names, f"missing, but there is {values}; give a name for each column"
        if names in present and values not in present:
            yield values, f"missing, but there is {names}; leave both out or give both"


def text_faults(members: Mapping[str, np.ndarray]) -> Iterator[Fault]:
    """Another version, names that come twice or are empty, and `about`."""
    version = members.get("format_version")
    if version is not None and version != FORMAT_VERSION:
        yield (
            "format_version",
            f"is {version}; this program reads {FORMAT_VERSION}: install the one that wrote the file, or {REMEDY}",
        )
    for name in ("actions", "objects", "joint_names"):
        names = members[name].tolist() if name in members else []
        for row, word in enumerate(names):
            if not word.strip():
                yield f"{name}[{row}]", "is empty; give a name"
            elif word in names[:row]:
                yield f"{name}[{row}]", f"{word!r} is {name}[{names.index(word)}] already; give each a name of its own"
    if "about" in members:
        try:
            about = from_json(str(members["about"]))
        except ValueError as error:
            yield "about", f"is no JSON ({error}); give the JSON text of a dictionary"
        else:
            yield from about_faults(about)


def about_faults(about: Any) -> Iterator[Fault]:
    """What is missing in `about`, which reports read."""
    if not isinstance(about, dict):
        yield "about", f"is a {type(about).__name__}; give a dictionary with name, stand_in and made_by"
        return
    for name, kind, words in (
        ("name", str, "words"),
        ("stand_in", bool, "true if generated, false if recorded"),
        ("made_by", str, "the command"),
    ):
        if not isinstance(about.get(name), kind):
            yield "about", f"its {name} is {about.get(name)!r}; give {words}"


def value_faults(members: Mapping[str, np.ndarray], lengths: Mapping[str, int]) -> Iterator[Fault]:
    """Numbers that cannot be: indices out of range, states with gaps, matrices that are no rotations, numbers that are
    not finite."""
    for name, letter in (("frame", "K"), ("next_frame", "K"), ("action", "A")):
        if name in members and letter in lengths:
            outside = np.flatnonzero((members[name] < 0) | (members[name] >= lengths[letter]))
            last = lengths[letter] - 1
            yield from (
                (f"{name}[{row}]", f"is {members[name][row]}, which is not there; give 0 to {last}") for row in outside
            )
    if "state" in members:
        state = members["state"]
        yield from ((f"state[{row}]", f"is {state[row]}; count states from 0") for row in np.flatnonzero(state < 0))
        used = np.unique(state[state >= 0])
        after_gap = np.flatnonzero(np.diff(used, prepend=-1) != 1)
        for place in after_gap:
            row = int(np.flatnonzero(state == used[place])[0])
            below = used[place - 1] if place else -1
            yield f"state[{row}]", f"is {used[place]}, but no frame shows state {below + 1}; number states without gaps"
    for name, unit in (("rotation", ""), ("joints", "radians"), ("position", "metres")):
        if name in members:
            values = members[name].reshape(len(members[name]), -1)
            broken = np.flatnonzero(~np.isfinite(values).all(1))
            if name == "rotation":
                yield from (
                    (f"rotation[{row}]", "is no rotation; give orthogonal matrices of determinant 1")
                    for row in not_rotations(members[name])
                )
            else:
                yield from (
                    (f"{name}[{row}]", f"is {values[row].tolist()}; give finite numbers, {unit}, or leave {name} out")
                    for row in broken
                )


def not_rotations(rotation: np.ndarray) -> np.ndarray:
    """Rows of [K, 3, 3] that are not orthogonal, not of determinant 1 (both within 1e-3) or not finite."""
    matrix = np.asarray(rotation, np.float64)
    finite = np.isfinite(matrix).all((1, 2))
    matrix = np.where(finite[:, None, None], matrix, 0)
    off = np.abs(matrix @ matrix.swapaxes(1, 2) - np.eye(3)).max((1, 2))
    return np.flatnonzero((off > ROTATION_WITHIN) | (np.abs(np.linalg.det(matrix) - 1) > ROTATION_WITHIN))


def trajectory_faults(members: Mapping[str, np.ndarray]) -> Iterator[Fault]:
    """Moves out of order, gaps in time, moves that do not join, and ends in the middle."""
    frame, next_frame, trajectory, time, terminal = (
        members[name] for name in ("frame", "next_frame", "trajectory", "time", "terminal")
    )
    new = np.diff(trajectory, prepend=trajectory[0] - 1) != 0
    last = np.append(new[1:], True)
    for row in np.flatnonzero(trajectory[1:] < trajectory[:-1]) + 1:
        yield (
            f"trajectory[{row}]",
            f"is {trajectory[row]} after {trajectory[row - 1]}; sort the moves by trajectory and time",
        )
    for row in np.flatnonzero(new & (time != 0)):
        yield f"time[{row}]", f"is {time[row]}, but trajectory {trajectory[row]} begins here; count time from 0"
    before = np.flatnonzero(~last)
    for row in before[time[before + 1] != time[before] + 1] + 1:
        yield (
            f"time[{row}]",
            f"is {time[row]} after {time[row - 1]}, a gap in trajectory {trajectory[row]}; split it there, or add what "
            "is missing",
        )
    for row in before[next_frame[before] != frame[before + 1]]:
        yield (
            f"next_frame[{row}]",
            (
                f"is {next_frame[row]}, but the next move of trajectory {trajectory[row]} starts at frame[{row + 1}] = "
                f"{frame[row + 1]}; split it there"
            ),
        )
    for row in np.flatnonzero(terminal & ~last):
        yield (
            f"terminal[{row}]",
            f"is true in the middle of trajectory {trajectory[row]}; only its last move ends it: split it there",
        )
    for row in np.flatnonzero(last & ~terminal):
        yield f"terminal[{row}]", f"is false, but trajectory {trajectory[row]} has no later move; set it"


def contradictions(state: np.ndarray, frame: np.ndarray, action: np.ndarray, next_frame: np.ndarray) -> np.ndarray:
    """Pairs of moves that lead from one state by one action to different states: int [N, 2] rows, the first such move
    and the contradicting one."""
    start, end = state[frame].astype(np.int64), state[next_frame]
    _, first, choice = np.unique(
        start * (int(action.max(initial=0)) + 1) + action, return_index=True, return_inverse=True
    )
    earlier = first[choice]
    rows = np.flatnonzero(end != end[earlier])
    return np.stack([earlier[rows], rows], 1)


def contradiction_faults(members: Mapping[str, np.ndarray]) -> Iterator[Fault]:
    """The contradictions among the moves whose frames are there."""
    state, frame, action, next_frame = (members[name] for name in ("state", "frame", "action", "next_frame"))
    sound = np.flatnonzero(
        (np.minimum(frame, next_frame) >= 0) & (np.maximum(frame, next_frame) < len(state)) & (action >= 0)
    )
    for one, other in sound[contradictions(state, frame[sound], action[sound], next_frame[sound])]:
        yield (
            f"next_frame[{other}]",
            (
                f"moves {one} and {other} are both action {action[one]} in state {state[frame[one]]}, but lead to the "
                f"states {state[next_frame[one]]} and {state[next_frame[other]]}; remove the wrong one, or give what "
                "differs states of its own"
            ),
        )


def unknown_members(archive: archives.Archive) -> Iterator[Fault]:
    """Members that nothing reads; a slip of the pen in the name of an optional one would go unnoticed."""
    for name in archive.sizes:
        if name not in SCHEMA:
            yield name, f"nothing reads it.{nearest(name, list(SCHEMA))} Remove or rename it"


def unseen_objects(members: Mapping[str, np.ndarray]) -> Iterator[Fault]:
    """Objects that no frame shows."""
    fitting, _, _ = fitting_members(members)
    if {"detected", "objects"} <= set(fitting):
        for column in np.flatnonzero(~fitting["detected"].any(0)):
            name = fitting["objects"].tolist()[column]
            yield f"objects[{column}]", f"{name!r} is detected in no frame; it can be no goal"


def limited(faults: Iterator[Fault]) -> Iterator[Fault]:
    """The first `MOST_FINDINGS` faults of each member, and how many more there are."""
    counts: dict[str, int] = {}
    for where, problem in faults:
        name = where.split("[")[0]
        counts[name] = counts.get(name, 0) + 1
        if counts[name] <= MOST_FINDINGS:
            yield where, problem
    for name, count in counts.items():
        if count > MOST_FINDINGS:
            yield name, f"{count - MOST_FINDINGS} more rows with such faults; mend the first ones and check again"


def stop_at_first(path: str | os.PathLike, faults: Iterator[Fault]) -> None:
    """Raise the first fault as a `UserError`, in the words of `check_frames`."""
    for where, problem in faults:
        raise UserError(
            f"{path}: {where}: {problem}; `infogoal data check {typed(path)}` lists everything that is wrong"
        )
