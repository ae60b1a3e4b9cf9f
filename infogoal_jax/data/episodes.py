"""Recorded episodes of vectors or images with actions that are vectors or moves, in the layout of OGBench: one npz,
episode after episode. `load` reads one, `check_episodes` says everything that is wrong with one, `save` writes one.

    member             type and shape                      what it is
    observations       float32 [N, F], uint8 [N, H, W, C]  what was seen, each episode with its last observation
    actions            float32 [N, A] or int32 [N]         taken there, from -1 to 1, of a last one too
    terminals          [N], 0 or 1                         1 for the last observation of an episode
    achieved_goals     float32 [N, D], optional            the goal that was achieved, of a `GoalEnv`
    desired_goals      float32 [N, D], optional            the goal that was desired
    action_bounds      float32 [2, A], optional            what -1 and 1 are where it was recorded; the same if missing

The layouts that `ogbench.load_dataset` makes in memory are read too: compact, with `valids`, and regular, with
`next_observations`.
"""

import dataclasses
import os
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from infogoal_jax.data import archives
from infogoal_jax.data.members import KINDS, Fault, Finding, Member, check, check_file, fitting, limited, missing
from infogoal_jax.errors import UserError, require

REMEDY = "give an npz with observations, actions and terminals (docs/reference/datasets.md)"
VECTORS = Member("float", ("rows", "numbers of an observation"))
IMAGES = Member("uint8", ("rows", "rows of pixels", "columns of pixels", "channels"))
MOVES = Member("integer", ("rows",))
GOAL = Member("number", ("rows", "numbers of a goal"), needed=False)
SCHEMA = {
    "observations": VECTORS,
    "actions": Member("float", ("rows", "numbers of an action")),
    "terminals": Member("0 or 1", ("rows",)),
    "achieved_goals": GOAL,
    "desired_goals": GOAL,
    "action_bounds": Member("number", ((2,), "numbers of an action"), needed=False),
    "valids": Member("0 or 1", ("rows",), needed=False),
    "next_observations": VECTORS._replace(needed=False),
}
GOALS = ("achieved_goals", "desired_goals")
OTHERS = ("qpos", "qvel", "button_states", "rewards", "masks", "tasks")
"""Members of OGBench's files that nothing here needs."""
MOST_MOVES = 2**16
"""Moves that a task may have; larger numbers are none, and int32 would hold some as others."""
WITHIN = 1e-5
"""How far beyond 1 an action may lie."""
ROUNDED = 1e-3
"""Rounding to float32 that is told of, in standard deviations of what is rounded."""


@dataclasses.dataclass(frozen=True)
class Episodes:
    """N observations of one or more episodes, see the top of the file."""

    observations: np.ndarray
    """float32 [N, F] or uint8 [N, H, W, C]."""
    actions: np.ndarray
    """float32 [N, A], or int32 [N] from 0 on: the numbers of moves."""
    last: np.ndarray
    """bool [N], the last observations of episodes."""
    achieved_goals: np.ndarray | None = None
    """float32 [N, D]; None: unknown."""
    desired_goals: np.ndarray | None = None
    """float32 [N, D]; None: unknown."""
    action_bounds: np.ndarray | None = None
    """float32 [2, A], what -1 and 1 of an action are where it was recorded; None: the same."""

    def __post_init__(self):
        members = {name: as_array(name, array) for name, array in self.members().items()}
        check(faults_of(members))
        object.__setattr__(self, "last", members.pop("terminals").astype(bool))
        for name, array in members.items():
            kind = np.uint8 if array.dtype == np.uint8 else np.float32
            if name == "actions" and array.ndim == 1:
                kind = np.int32
            object.__setattr__(self, name, np.asarray(array, kind))

    def members(self) -> dict[str, np.ndarray]:
        """The members of a file of them."""
        others = {name: getattr(self, name) for name in (*GOALS, "action_bounds")}
        found = {"observations": self.observations, "actions": self.actions, "terminals": self.last} | others
        return {name: array for name, array in found.items() if array is not None}

    @property
    def moves(self) -> bool:
        """Whether actions are the numbers of moves."""
        return self.actions.ndim == 1

    @property
    def action_size(self) -> int:
        """Numbers in an action, or how many moves there are: one more than the largest number."""
        return int(self.actions.max()) + 1 if self.moves else self.actions.shape[1]

    @property
    def lengths(self) -> np.ndarray:
        """Steps of each episode, int [E]."""
        return np.diff(np.flatnonzero(self.last), prepend=-1) - 1

    @property
    def width(self) -> int:
        """Observations of the longest episode: of a row that they are learned from."""
        return int(self.lengths.max()) + 1

    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """The row [E] and the column [E] where each episode begins, in rows of `width` with as many whole episodes as
        follow each other in it."""
        lengths, width = self.lengths + 1, self.width
        row, column, place, filled = np.zeros(len(lengths), int), np.zeros(len(lengths), int), 0, 0
        for number, length in enumerate(lengths):
            if filled + length > width:
                place, filled = place + 1, 0
            row[number], column[number] = place, filled
            filled += length
        return row, column

    @property
    def nbytes(self) -> int:
        """Bytes of the rows that a task makes of them, as they lie in the memory of a device: observations, the goals
        achieved there, desired goals, actions, and four marks a step; with a mark of each place where some are
        empty. Goals that are not told are states; of images they are left out."""
        seen, action = (array[0].nbytes for array in (self.observations, self.actions))
        goal = 0 if self.observations.dtype == np.uint8 else seen
        goal = goal if self.achieved_goals is None else self.achieved_goals[0].nbytes
        rows = int(self.places()[0][-1]) + 1
        mark = int(rows * self.width > len(self.last))
        return rows * (self.width * (seen + goal + mark) + (self.width - 1) * (goal + action + 4))


def load(path: str | os.PathLike) -> Episodes:
    """The episodes of a file. Raises `UserError`, naming the file, for the first thing that is wrong with it."""
    with archives.naming("dataset", path, REMEDY):
        archive = archives.read(path, REMEDY)
        return of_arrays({name: archives.member(archive, name, REMEDY) for name in SCHEMA if name in archive.sizes})


def save(path: str | os.PathLike, episodes: Episodes) -> None:
    """Write the episodes to a file, in the layout of OGBench. Raises `UserError` where the disk refuses."""
    require(isinstance(episodes, Episodes), "episodes", type(episodes).__name__, "give Episodes, as load returns them")
    members = episodes.members()
    archives.save(path, members | {"terminals": members["terminals"].astype(np.float32)}, "path")


def of_arrays(arrays: Mapping[str, Any]) -> Episodes:
    """The episodes of arrays by name: as they stand in a file, or as `ogbench.load_dataset` gives them. Raises
    `UserError`, naming the array, for what does not fit together."""
    require(isinstance(arrays, Mapping), "arrays", type(arrays).__name__, f"give arrays by their names: {REMEDY}")
    found = {name: as_array(name, arrays[name]) for name in SCHEMA if name in arrays}
    check((*missing(found, SCHEMA, REMEDY), *faults_of(found)))
    last = found.pop("terminals")
    if "next_observations" in found:
        return regular(found, last)
    if "valids" in found:
        last = 1 - found.pop("valids")
    return Episodes(last=last, **found)


def as_array(name: str, value: Any) -> np.ndarray:
    """An array, or nested lists, as an array. Raises `UserError` for one with a mask, and for rows of several
    lengths."""
    require(not isinstance(value, np.ma.MaskedArray), name, "a masked array", "give an array without a mask")
    try:
        return np.asarray(value)
    except (TypeError, ValueError) as error:
        raise UserError(f"{name}: give an array, not {type(value).__name__} of several shapes") from error


def regular(found: dict[str, np.ndarray], last: np.ndarray) -> Episodes:
    """The episodes of transitions: `last` marks those that an episode ends with, whose next observation is its last
    one."""
    following = found.pop("next_observations")
    observations, actions, ends = found["observations"], found["actions"], np.flatnonzero(last)
    nothing = np.zeros((len(ends), *actions.shape[1:]), actions.dtype)
    marks = np.insert(np.zeros(len(observations)), ends + 1, 1)
    return Episodes(
        np.insert(observations, ends + 1, following[ends], 0),
        np.insert(actions, ends + 1, nothing, 0),
        marks,
        action_bounds=found.get("action_bounds"),
    )


def is_one(path: str | os.PathLike) -> bool:
    """Whether a file has more members of recorded episodes than of anything else."""
    try:
        names = {*archives.read(path, REMEDY, version=None).sizes}
    except (OSError, UserError):
        return False
    return bool({"observations", "actions", "terminals"} & names) and "frames" not in names


def holds_moves(path: str | os.PathLike) -> bool:
    """Whether the actions of a file are moves, by their header alone; not of what cannot be read."""
    try:
        shape, dtype = archives.header(path, "actions")
    except (OSError, UserError):
        return False
    return is_moves(dtype, shape)


def is_moves(dtype: np.dtype, shape: tuple[int, ...]) -> bool:
    """Whether actions of this type and shape are the numbers of moves."""
    return dtype.kind in "iu" and len(shape) == 1


def check_episodes(path: str | os.PathLike) -> list[Finding]:
    """Everything that is wrong with the file at `path`, in one pass; empty if there is nothing."""
    return check_file(path, SCHEMA, REMEDY, faults_of, remarks_on, ignored=OTHERS)


def remarks_on(members: Mapping[str, np.ndarray]) -> Iterator[Fault]:
    """What can be used and may not be meant: numbers that float32 has not, and one episode alone."""
    if [*missing(members, SCHEMA, REMEDY)] or any(faults_of(members)):
        return
    for name, array in members.items():
        if array.dtype.itemsize > 4 and array.ndim == 2:
            error = np.abs(array - array.astype(np.float32)).max(0)
            varies = array.max(0) > array.min(0)
            for column in np.flatnonzero(varies & (error > ROUNDED * array.std(0)))[:1]:
                by = (
                    f"its column {column} by up to {error[column]:.3g}, where it varies by {array[:, column].std():.3g}"
                )
                yield name, f"is {array.dtype}; float32 rounds {by}; subtract its mean"
    marks = 1 - members["valids"] if "valids" in members else members["terminals"]
    if np.count_nonzero(marks) == 1:
        yield "terminals", "all is one episode; mark the end of each, if there are more"


def faults_of(members: Mapping[str, np.ndarray]) -> Iterator[Fault]:
    """Every fault of the members of a file in any of the layouts: of each by itself, of their lengths, and of where
    episodes end."""
    images = "observations" in members and is_images(members["observations"])
    seen = IMAGES if images else VECTORS
    moves = "actions" in members and is_moves(members["actions"].dtype, members["actions"].shape)
    found, lengths, faults = fitting(
        members,
        SCHEMA
        | {"observations": seen, "next_observations": seen._replace(needed=False)}
        | ({"actions": MOVES} if moves else {}),
    )
    yield from limited(faults)
    if lengths.get("channels", 0) > lengths.get("rows of pixels", 0):
        yield "observations", f"is {list(found['observations'].shape)}, more channels than rows; give [N, H, W, C]"
    taken = found.get("actions", np.zeros((0, 1)))
    for row in np.flatnonzero((taken < 0) | (taken >= MOST_MOVES))[:1] if moves else ():
        yield f"actions[{row}]", f"is {taken[row]}; moves have numbers from 0 on, below {MOST_MOVES:,}"
    if moves and "action_bounds" in members:
        yield "action_bounds", "is of actions that are vectors, and these are moves; leave it out"
    beyond = np.zeros(0) if moves else (np.abs(taken) > 1 + WITHIN).any(1)
    for row in np.flatnonzero(beyond)[:1]:
        given = f"is {found['actions'][row].tolist()}, and {beyond.sum():,} rows go beyond -1 to 1"
        bounded = "give them as fractions of the way between the action_bounds, from -1 to 1"
        yield f"actions[{row}]", f"{given}; {bounded if 'action_bounds' in found else 'divide by the largest action'}"
    low, high = found.get("action_bounds", ((0,), (1,)))
    if not np.less(low, high).all():
        yield "action_bounds", f"is {found['action_bounds'].tolist()}; give the lowest actions, then the highest"
    for name in ("terminals", "valids"):
        for row in np.flatnonzero(~np.isin(found.get(name, 0), (0, 1)))[:1]:
            yield f"{name}[{row}]", f"is {found[name][row]}; give 0 or 1"
    yield from faults_of_ends(members, found)


def is_images(observations: np.ndarray) -> bool:
    """Whether these are meant as images: by their type, or their axes."""
    return observations.dtype == np.uint8 or observations.ndim == len(IMAGES.shape)


def faults_of_ends(members: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray]) -> Iterator[Fault]:
    """What is wrong with where episodes end, in each of the layouts. found: the members that are right by
    themselves."""
    name, following = "valids" if "valids" in members else "terminals", members.get("next_observations")
    if following is not None and "valids" in members:
        yield "next_observations", "goes without valids; leave one of both out"
        return
    for goal in GOALS if following is not None else ():
        if goal in members:
            yield goal, "goals after the last transitions are unknown; leave next_observations out"
    marks = members.get(name, np.zeros(0))
    is_marks = marks.dtype.kind in KINDS["0 or 1"] and marks.ndim == 1 and len(marks) > 0
    if not is_marks or not np.isin(marks, (0, 1)).all():
        return
    end = int(name == "terminals")
    ends, what = np.flatnonzero(marks == end), "observations" if following is None else "transitions"
    if not len(ends):
        yield name, f"no episode ends; mark the last of its {what} by {end}"
        return
    terminals = found.get("terminals")
    if name == "valids" and terminals is not None and len(terminals) == len(marks):
        # The last observation of an episode has to be marked there too; OGBench marks the one before as well.
        last = marks == 0
        for row in np.flatnonzero((terminals < last) | (terminals > last | np.append(last[1:], False)))[:1]:
            given = f"is {terminals[row]:g}, but episodes end elsewhere by valids"
            yield f"terminals[{row}]", f"{given}; leave one of both out"
    left = len(marks) - 1 - ends[-1]
    if left and name in found:
        yield f"{name}[{len(marks) - 1}]", f"is {1 - end}: the last {left:,} {what} belong to no episode; give {end}"
    if following is None and (np.diff(ends, prepend=-1) < 2).all():
        yield name, f"no episode has a step; mark the last of its observations alone by {end}"
    if {name, "observations", "next_observations"} <= found.keys():
        seen = found["observations"]
        differs = (following[:-1] != seen[1:]).any(axis=tuple(range(1, seen.ndim)))
        apart = differs & (marks[:-1] != end)
        for row in np.flatnonzero(apart)[:1]:
            said = f"is not the observation that follows, in {apart.sum():,} rows"
            yield f"next_observations[{row}]", f"{said}; mark the ends of episodes in terminals"


def describe(episodes: Episodes) -> str:
    """What is in them, in a line, and what it takes on a device."""
    lengths = episodes.lengths
    seen = " x ".join(map(str, episodes.observations.shape[1:]))
    acts = "moves" if episodes.moves else episodes.action_size
    span = f"{lengths.min():,}" + (f" to {lengths.max():,}" if lengths.min() < lengths.max() else "")
    return (
        f"{len(lengths):,} episodes of {span} steps, {lengths.sum():,} in all; observations {seen} "
        f"{episodes.observations.dtype}, actions {acts}; {episodes.nbytes / 1e6:,.1f} MB on the device"
    )
