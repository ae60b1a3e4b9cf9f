"""The members of a file of an image dataset (frames.py), their types and shapes, and everything that is wrong with
them, found in one pass. What each means is in docs/reference/datasets.md.

An error is what makes the data unusable or would make a policy learn moves that were never made; `frames.load` and
`frames.save` stop at the first. A warning is a member that nothing reads, or an object that no frame shows.
"""

import os
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from infogoal_jax.data.members import Fault, Finding, Member, check_file, fitting, limited, missing
from infogoal_jax.errors import UserError
from infogoal_jax.files import from_json

FORMAT_VERSION = 1
REMEDY = "give an npz of `infogoal data import` or of infogoal_jax.data.frames.save (docs/reference/datasets.md)"
SCHEMA = {
    "frames": Member("uint8", ("frames", "rows of pixels", "columns of pixels", (1, 3))),
    "format_version": Member("integer", ()),
    "about": Member("text", ()),
    "actions": Member("text", ("actions",)),
    "objects": Member("text", ("objects",), needed="detected"),
    "joint_names": Member("text", ("joints",), needed="joints"),
    "state": Member("int32", ("frames",)),
    "frame": Member("int32", ("moves",)),
    "action": Member("int32", ("moves",)),
    "next_frame": Member("int32", ("moves",)),
    "trajectory": Member("int32", ("moves",)),
    "time": Member("int32", ("moves",)),
    "terminal": Member("bool", ("moves",)),
    "rotation": Member("float32", ("frames", 3, 3), needed=False),
    "joints": Member("float32", ("frames", "joints"), needed="joint_names"),
    "position": Member("float32", ("frames", (2, 3)), needed=False),
    "detected": Member("bool", ("frames", "objects"), needed="objects"),
}
ROTATION_WITHIN = 1e-3
"""Entries of R R^T - 1, and the determinant, may be off by this much: float32, or poses written down with four
digits."""


def check_frames(path: str | os.PathLike) -> list[Finding]:
    """Every fault of the file at `path`, errors first; empty if there is none."""
    return check_file(path, SCHEMA, REMEDY, member_faults, unseen_objects)


def member_faults(members: Mapping[str, np.ndarray]) -> Iterator[Fault]:
    """Every error in what the members say."""
    found, lengths, faults = fitting(members, SCHEMA)
    yield from limited(faults)
    yield from text_faults(found)
    yield from limited(value_faults(found, lengths))
    if {"frame", "next_frame", "trajectory", "time", "terminal"} <= set(found):
        yield from limited(trajectory_faults(found))
    if {"state", "frame", "action", "next_frame"} <= set(found):
        yield from limited(contradiction_faults(found))


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
    """Numbers that cannot be: indices out of range, states with gaps, matrices that are no rotations."""
    for name, length in (("frame", "frames"), ("next_frame", "frames"), ("action", "actions")):
        if name in members and length in lengths:
            outside = np.flatnonzero((members[name] < 0) | (members[name] >= lengths[length]))
            last = lengths[length] - 1
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
    for row in not_rotations(members["rotation"]) if "rotation" in members else ():
        yield f"rotation[{row}]", "is no rotation; give orthogonal matrices of determinant 1"


def not_rotations(rotation: np.ndarray) -> np.ndarray:
    """Rows of [K, 3, 3] that are not orthogonal or not of determinant 1, both within 1e-3."""
    matrix = np.asarray(rotation, np.float64)
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


def unseen_objects(members: Mapping[str, np.ndarray]) -> Iterator[Fault]:
    """Objects that no frame shows."""
    found, _, _ = fitting(members, SCHEMA)
    if {"detected", "objects"} <= set(found):
        for column in np.flatnonzero(~found["detected"].any(0)):
            yield f"objects[{column}]", f"{str(found['objects'][column])!r} is detected in no frame; it can be no goal"


def check_members(name: str | os.PathLike, members: Mapping[str, np.ndarray], more: str) -> None:
    """Raise the first fault of the members of a dataset as a `UserError`, which ends in `more`."""
    stop_at_first(name, (*missing(members, SCHEMA, REMEDY), *member_faults(members)), more)


def stop_at_first(name: str | os.PathLike, faults: Iterable[Fault], more: str) -> None:
    """Raise the first fault as a `UserError`, in the words of `check_frames`."""
    for where, problem in faults:
        raise UserError(f"{name}: {where}: {problem}; {more}")
