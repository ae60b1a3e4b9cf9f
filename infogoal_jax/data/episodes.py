"""Recorded episodes of vectors or images with actions that are vectors, in the layout of OGBench: one npz, episode
after episode. `load` reads one, `check_episodes` says everything that is wrong with one, `save` writes one.

    member             type and shape                      what it is
    observations       float32 [N, F], uint8 [N, H, W, C]  what was seen, each episode with its last observation
    actions            float32 [N, A]                      taken there, from -1 to 1; of a last one not counted
    terminals          [N], 0 or 1                         1 for the last observation of an episode
    achieved_goals     float32 [N, D], optional            the goal that was achieved, of a `GoalEnv`
    desired_goals      float32 [N, D], optional            the goal that was desired

The layouts that `ogbench.load_dataset` makes in memory are read too: compact, with `valids`, and regular, with
`next_observations`.
"""

import dataclasses
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from infogoal_jax.data import archives
from infogoal_jax.data.check import Finding
from infogoal_jax.errors import UserError, nearest, require

REMEDY = "give an npz with observations, actions and terminals (docs/reference/datasets.md)"
MEMBERS = ("observations", "actions", "terminals")
GOALS = ("achieved_goals", "desired_goals")
READ = (*MEMBERS, *GOALS, "valids", "next_observations")
OTHERS = ("qpos", "qvel", "button_states", "rewards", "masks", "tasks")
"""Members of OGBench's files that nothing here needs."""
WITHIN = 1e-5
"""How far beyond 1 an action may lie."""


@dataclasses.dataclass(frozen=True)
class Episodes:
    """N observations of one or more episodes, see the top of the file."""

    observations: np.ndarray
    """float32 [N, F] or uint8 [N, H, W, C]."""
    actions: np.ndarray
    """float32 [N, A]."""
    last: np.ndarray
    """bool [N], the last observations of episodes."""
    achieved_goals: np.ndarray | None = None
    """float32 [N, D]; None: unknown."""
    desired_goals: np.ndarray | None = None
    """float32 [N, D]; None: unknown."""

    def __post_init__(self):
        check(faults_of(self.members()))
        for name in ("observations", "actions", *GOALS):
            array = getattr(self, name)
            if array is not None and array.dtype != np.uint8:
                object.__setattr__(self, name, np.asarray(array, np.float32))
        object.__setattr__(self, "last", np.asarray(self.last, bool))

    def members(self) -> dict[str, np.ndarray]:
        """The members of a file of them."""
        goals = {name: getattr(self, name) for name in GOALS}
        found = {"observations": self.observations, "actions": self.actions, "terminals": self.last} | goals
        return {name: array for name, array in found.items() if array is not None}

    @property
    def lengths(self) -> np.ndarray:
        """Steps of each episode, int [E]."""
        return np.diff(np.flatnonzero(self.last), prepend=-1) - 1

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays, as they lie in the memory of a device."""
        return sum(array.nbytes for array in self.members().values())


def load(path: str | os.PathLike) -> Episodes:
    """The episodes of a file. Raises `UserError`, naming the file, for the first thing that is wrong with it."""
    with archives.naming("dataset", path, REMEDY):
        archive = archives.read(path, REMEDY)
        missing = [name for name in MEMBERS if name not in archive.sizes]
        require(not missing, "members", list(archive.sizes), f"has no {', '.join(missing)}; {REMEDY}")
        return of_arrays({name: archives.member(archive, name, REMEDY) for name in READ if name in archive.sizes})


def save(path: str | os.PathLike, episodes: Episodes) -> None:
    """Write the episodes to a file, in the layout of OGBench. Raises `UserError` where the disk refuses."""
    require(isinstance(episodes, Episodes), "episodes", type(episodes).__name__, "give Episodes, as load returns them")
    members = episodes.members()
    archives.save(path, members | {"terminals": members["terminals"].astype(np.float32)}, "path")


def of_arrays(arrays: Mapping[str, Any]) -> Episodes:
    """The episodes of arrays by name: as they stand in a file, or as `ogbench.load_dataset` gives them. Raises
    `UserError`, naming the array, for what does not fit together."""
    require(isinstance(arrays, Mapping), "arrays", type(arrays).__name__, f"give arrays by their names: {REMEDY}")
    missing = [name for name in MEMBERS if name not in arrays]
    require(not missing, "arrays", list(arrays), f"has no {', '.join(missing)}; {REMEDY}")
    found = {name: as_array(name, arrays[name]) for name in READ if name in arrays}
    check(faults_of_arrays(found))
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


def check(faults: Iterator[tuple[str, str]]) -> None:
    """Raise `UserError` for the first of these faults, if there is one."""
    for where, problem in faults:
        raise UserError(f"{where}: {problem}")


def regular(found: dict[str, np.ndarray], last: np.ndarray) -> Episodes:
    """The episodes of transitions: `last` marks those that an episode ends with, whose next observation is its last
    one."""
    following = found.pop("next_observations")
    observations = found["observations"]
    require(
        following.shape == observations.shape,
        "next_observations",
        list(following.shape),
        f"give as many as observations, {list(observations.shape)}",
    )
    unknown = [name for name in GOALS if name in found]
    require(not unknown, "next_observations", unknown, "goals after the last transitions are unknown: leave it out")
    ends = np.flatnonzero(last)
    require(
        len(last) == len(observations) and len(ends) > 0 and ends[-1] == len(last) - 1,
        "terminals",
        f"{len(ends)} ends",
        "mark the last transition of each episode, the last of all too",
    )
    actions = found["actions"]
    nothing = np.zeros((len(ends), *actions.shape[1:]), actions.dtype)
    marks = np.insert(np.zeros(len(observations)), ends + 1, 1)
    return Episodes(
        np.insert(observations, ends + 1, following[ends], 0), np.insert(actions, ends + 1, nothing, 0), marks
    )


def is_one(path: str | os.PathLike) -> bool:
    """Whether a file has more members of recorded episodes than of anything else."""
    try:
        names = {*archives.read(path, REMEDY, version=None).sizes}
    except (OSError, UserError):
        return False
    return bool({*MEMBERS} & names) and "frames" not in names


def check_episodes(path: str | os.PathLike) -> list[Finding]:
    """Everything that is wrong with the file at `path`, in one pass; empty if there is nothing."""
    try:
        with archives.naming("dataset", path, REMEDY):
            archive = archives.read(path, REMEDY)
    except UserError as error:
        return [Finding("error", str(path), str(error).removeprefix(f"dataset = {str(path)!r}: "))]
    findings, members = [], {}
    for name in archive.sizes:
        if name in READ:
            try:
                members[name] = archives.member(archive, name, REMEDY)
            except UserError as error:
                findings.append(Finding("error", f"{path}: {name}", str(error).removeprefix(f"{name} = ")))
        elif name not in OTHERS:
            where = f"{path}: {name}"
            findings.append(Finding("warning", where, f"no such member: it is not read.{nearest(name, list(READ))}"))
    if "next_observations" in members or "valids" in members:
        faults = [*faults_of_arrays(members)]
        if faults:
            return [*findings, *(Finding("error", f"{path}: {where}", problem) for where, problem in faults)]
        try:
            members = of_arrays(members).members()
        except UserError as error:
            return [*findings, Finding("error", str(path), str(error))]
    faults = faults_of(members, archive.sizes)
    findings += [Finding("error", f"{path}: {where}", problem) for where, problem in faults]
    if not any(finding.severity == "error" for finding in findings):
        findings += [Finding("warning", f"{path}: {where}", problem) for where, problem in remarks_on(members)]
    return sorted(findings, key=lambda finding: finding.severity)


def faults_of(members: Mapping[str, np.ndarray], unreadable: Iterable[str] = ()) -> Iterator[tuple[str, str]]:
    """Every fault of these members of a file: where, and what is wrong with the remedy. unreadable: names of members
    whose fault is known."""
    wrong = False
    for name in MEMBERS:
        if name not in members and name not in unreadable:
            yield name, f"is missing; {REMEDY}"
    for fault in faults_of_arrays(members):
        wrong |= fault[0] == "lengths"
        yield fault
    terminals = members.get("terminals")
    if not wrong and isinstance(terminals, np.ndarray):
        yield from faults_of_ends(terminals)


def faults_of_arrays(members: Mapping[str, np.ndarray]) -> Iterator[tuple[str, str]]:
    """The faults of these arrays, each by itself, and of their lengths."""
    lengths = {}
    for name, array in members.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
            yield name, f"is {getattr(array, 'dtype', type(array).__name__)}; give numbers"
            continue
        if array.ndim == 0 or not array.size:
            yield name, f"has the shape {list(array.shape)}; give one row for each observation"
            continue
        lengths[name] = len(array)
        yield from SHAPES[name](name, array)
        if array.dtype.kind == "f":
            with np.errstate(over="ignore"):
                wrong = ~np.isfinite(array.astype(np.float32)).reshape(len(array), -1).all(1)
            if wrong.any():
                yield (
                    f"{name}[{np.flatnonzero(wrong)[0]}]",
                    f"is not finite as float32, as {wrong.sum():,} of {len(array):,} rows; leave these episodes out",
                )
    if len(set(lengths.values())) > 1:
        shown = ", ".join(f"{name} {length:,}" for name, length in lengths.items())
        yield "lengths", f"disagree: {shown}; give each observation an action and a terminal"


def faults_of_ends(terminals: np.ndarray) -> Iterator[tuple[str, str]]:
    """What is wrong with where episodes end."""
    if terminals.ndim != 1 or not len(terminals) or not np.isin(terminals, (0, 1)).all():
        return
    ends = np.flatnonzero(terminals)
    if not len(ends):
        yield "terminals", "no episode ends; mark the last observation of each"
        return
    if ends[-1] != len(terminals) - 1:
        left = len(terminals) - 1 - ends[-1]
        yield f"terminals[{len(terminals) - 1}]", f"is 0: the last {left:,} observations belong to no episode; give 1"
    if (np.diff(ends, prepend=-1) < 2).all():
        yield "terminals", "no episode has a step; mark the last observation of each alone"


def vectors(name: str, array: np.ndarray) -> Iterator[tuple[str, str]]:
    """What is wrong with vectors [N, D]."""
    if array.ndim != 2 or array.dtype.kind == "b":
        yield name, f"is {array.dtype} {list(array.shape)}; give float32 [N, D]"


def observed(name: str, array: np.ndarray) -> Iterator[tuple[str, str]]:
    """What is wrong with observations."""
    image = array.dtype == np.uint8 and array.ndim == 4
    if image and array.shape[3] > array.shape[1]:
        yield name, f"is uint8 {list(array.shape)}, more channels than rows; give [N, H, W, C]"
    if not image and (array.ndim != 2 or array.dtype.kind != "f"):
        yield name, f"is {array.dtype} {list(array.shape)}; give vectors float32 [N, F], or images uint8 [N, H, W, C]"


def acted(name: str, array: np.ndarray) -> Iterator[tuple[str, str]]:
    """What is wrong with actions."""
    if array.ndim != 2 or array.dtype.kind != "f":
        yield name, f"is {array.dtype} {list(array.shape)}; give vectors float32 [N, A] from -1 to 1"
        return
    beyond = (np.abs(array) > 1 + WITHIN).any(1)
    if beyond.any():
        first = np.flatnonzero(beyond)[0]
        yield (
            f"{name}[{first}]",
            (f"is {array[first].tolist()}, and {beyond.sum():,} rows go beyond -1 to 1; divide by the largest action"),
        )


def marked(name: str, array: np.ndarray) -> Iterator[tuple[str, str]]:
    """What is wrong with marks of 0 and 1."""
    if array.ndim != 1 or not np.isin(array, (0, 1)).all():
        yield name, f"is {array.dtype} {list(array.shape)}; give 0 or 1 for each observation, [N]"


SHAPES: dict[str, Callable[[str, np.ndarray], Iterator[tuple[str, str]]]] = {
    "observations": observed,
    "actions": acted,
    "terminals": marked,
    "achieved_goals": vectors,
    "desired_goals": vectors,
    "valids": marked,
    "next_observations": observed,
}


def remarks_on(members: Mapping[str, np.ndarray]) -> Iterator[tuple[str, str]]:
    """What may surprise in a file without faults."""
    wide = [name for name, array in members.items() if array.dtype == np.float64 and name != "terminals"]
    if wide:
        yield ", ".join(wide), "is float64, which is rounded to float32"
    lengths = np.diff(np.flatnonzero(members["terminals"]), prepend=-1) - 1
    if len(lengths) == 1:
        yield "terminals", f"one episode of {lengths[0]:,} steps; hindsight looks ahead within its episode"
    if (lengths == 0).any():
        yield "terminals", f"{(lengths == 0).sum():,} of {len(lengths):,} episodes have no step"


def describe(episodes: Episodes) -> str:
    """What is in them, in a line, and what it takes on a device."""
    lengths = episodes.lengths
    seen = " x ".join(map(str, episodes.observations.shape[1:]))
    span = f"{lengths.min():,}" + (f" to {lengths.max():,}" if lengths.min() < lengths.max() else "")
    return (
        f"{len(lengths):,} episodes of {span} steps, {lengths.sum():,} in all; observations {seen} "
        f"{episodes.observations.dtype}, actions {episodes.actions.shape[1]}; {episodes.nbytes / 1e6:,.1f} MB on the "
        "device"
    )
