"""Image datasets of moves: every frame stored once, what is known of each, and the recorded moves between them as
indices (docs/reference/datasets.md).

The object that an arm turns and the shelf that a drone flies along are both such datasets, generated or recorded by a
laboratory.
"""

import dataclasses
import json
import os
import sys
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np

from infogoal_jax.data import archives, frames_check
from infogoal_jax.data.members import read
from infogoal_jax.errors import UserError, require, typed
from infogoal_jax.files import from_json

# Measured on 13,824 flat-shaded frames of 64 x 64 x 3 on 2 cores: stored 170 MB, level 1 24 MB, level 6 22 MB and twice
# as long to write; all are read in 0.4 s or less. Of noisy frames level 1 leaves 124 MB, read in 1 s.
DEFLATE_LEVEL = 1
TEXTS = ("actions", "objects", "joint_names")
SLIDES = "_m"
"""How the name of a joint ends that slides, whose places are metres."""


@dataclasses.dataclass(frozen=True)
class FrameDataset:
    """K frames of S states, and M moves between frames.

    frames: uint8 [K, H, W, C].
    state: int32 [K], which state each frame shows, 0 to S - 1; several frames may show one state.
    actions: names of the A actions.
    objects: names of the O objects that are looked for, () where there are none.
    frame, action, next_frame, trajectory, time: int32 [M], of moves by trajectory and time.
    terminal: bool [M], the last move of its trajectory.
    rotation: float32 [K, 3, 3], orientation of the object; None where it is not known.
    joints: float32 [K, J], radians (metres of one that `SLIDES`); None where they are not known.
    position: float32 [K, 2 or 3], metres; None where it is not known.
    detected: bool [K, O], whether each object is seen; None where it is not known.
    joint_names: of the J joints.
    about: JSON values; `name` (in words), `stand_in` (bool: generated, not recorded) and `made_by` (the command).
    """

    frames: np.ndarray
    state: np.ndarray
    actions: tuple[str, ...]
    frame: np.ndarray
    action: np.ndarray
    next_frame: np.ndarray
    trajectory: np.ndarray
    time: np.ndarray
    terminal: np.ndarray
    about: dict[str, Any]
    rotation: np.ndarray | None = None
    joints: np.ndarray | None = None
    position: np.ndarray | None = None
    detected: np.ndarray | None = None
    objects: tuple[str, ...] = ()
    joint_names: tuple[str, ...] = ()

    @property
    def num_states(self) -> int:
        """S, the number of states."""
        return int(self.state.max()) + 1

    def describe(self, *content: np.ndarray) -> str:
        """What the data are, in words: the name, whether it is a stand-in, and a checksum of these arrays."""
        return (
            f"{self.about['name']}{', a stand-in' if self.about.get('stand_in') else ''}, content "
            f"{archives.checksum(*content)}"
        )

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays, as they are held in memory or on a device."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, np.ndarray))


def next_state(dataset: FrameDataset) -> np.ndarray:
    """Where each action leads from each state, its own index where no such move is recorded: int32 [S, A].

    Raises `UserError` that names two moves that lead from one state by one action to different states.
    """
    moves = {name: getattr(dataset, name) for name in ("state", "frame", "action", "next_frame")}
    for where, problem in frames_check.contradiction_faults(moves):
        raise UserError(f"{dataset.about.get('name', 'image dataset')}: {where}: {problem}")
    table = np.repeat(np.arange(dataset.num_states, dtype=np.int32)[:, None], len(dataset.actions), 1)
    table[dataset.state[dataset.frame], dataset.action] = dataset.state[dataset.next_frame]
    return table


def members_of(dataset: FrameDataset) -> dict[str, Any]:
    """The members of the file: the fields by their names, without those that are not known."""
    members = {name: getattr(dataset, name) for name in frames_check.SCHEMA if name != "format_version"}
    try:
        members |= {"format_version": frames_check.FORMAT_VERSION, "about": json.dumps(dataset.about)}
    except TypeError as error:
        raise UserError(
            f"about = {dataset.about!r}: {error}; give values that JSON has: texts, plain numbers, true and false, "
            "lists"
        ) from error
    members |= {name: np.array(getattr(dataset, name), np.str_) for name in TEXTS}
    return {
        name: np.asarray(members[name])
        for name, member in frames_check.SCHEMA.items()
        if member.needed is True or (members[name] is not None and np.size(members[name]))
    }


def save(path: str | os.PathLike, dataset: FrameDataset) -> None:
    """Write a dataset. The file at `path` is always whole: the old one or the new one. The same dataset gives the same
    bytes.

    Raises `UserError` if the parts do not belong together (nothing is written then), or if the disk refuses.
    """
    require(isinstance(dataset, FrameDataset), "dataset", type(dataset).__name__, "give a FrameDataset")
    members = members_of(dataset)
    frames_check.check_members(path, members, "nothing is written")
    archives.save(path, members, "image dataset", zipfile.ZIP_DEFLATED, DEFLATE_LEVEL)


def load(path: str | os.PathLike) -> FrameDataset:
    """Read a dataset that `save` wrote. Raises `UserError` for a file that is missing, damaged or something else, and
    for its first error."""
    with archives.naming("image dataset", path, frames_check.REMEDY):
        archive = archives.read(path, frames_check.REMEDY, version=None)
    members, unreadable = read(archive, frames_check.SCHEMA, frames_check.REMEDY)
    more = f"`infogoal data check {typed(path)}` lists everything that is wrong"
    frames_check.stop_at_first(path, unreadable, more)
    frames_check.check_members(path, members, more)
    fields = {name: members.get(name) for name in frames_check.SCHEMA if name != "format_version"}
    fields |= {name: tuple(members[name].tolist()) if name in members else () for name in TEXTS}
    return FrameDataset(**(fields | {"about": from_json(str(members["about"]))}))


def cached(name: str, build: Callable[[], FrameDataset]) -> FrameDataset:
    """The dataset `name` of the user's cache; what `build` returns, kept there, if it is not there yet, or damaged.

    name: of the file, without its ending; what the dataset depends on must be in it (generator, version, seed,
    options). Building is announced on stderr. A folder that cannot be written to costs the cache, nothing else.
    """
    path = archives.user_cache() / f"{name}.npz"
    why = "is not in the cache yet"
    if path.exists():
        try:
            return load(path)
        except UserError:
            why = "in the cache is damaged"
    print(
        f"infogoal: the dataset {name} {why}; it is built now, which takes a minute or two, and kept as {path}",
        file=sys.stderr,
    )
    dataset = build()
    members = members_of(dataset)
    frames_check.check_members(name, members, "nothing is kept")
    try:
        archives.write(path, members, zipfile.ZIP_DEFLATED, DEFLATE_LEVEL)
    except OSError as error:
        print(
            f"infogoal: {path} cannot be written ({error.strerror or error}); it will be built again next time",
            file=sys.stderr,
        )
    return dataset
