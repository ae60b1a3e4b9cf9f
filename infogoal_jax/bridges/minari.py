"""Recorded episodes of Minari, for learning offline, and ours for Minari. Needs `pip install "minari[hdf5]" pillow`."""

import os
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from infogoal_jax import checks
from infogoal_jax.data.archives import new_folder
from infogoal_jax.data.episodes import WITHIN, Episodes, as_array
from infogoal_jax.envs.goal_task import between
from infogoal_jax.errors import UserError, require

COMPOSED = ("MultiDiscrete", "MultiBinary", "Dict", "Tuple")
"""Spaces of actions that are neither vectors nor moves."""
UNBOUNDED = 1e6
"""A bound of actions this far out is none, such as the largest float32."""
EPISODES_AT_ONCE = 256
"""Minari opens its file again for each batch of episodes."""


def import_minari() -> ModuleType:
    """Import Minari. Raises `UserError` if it, or a package that its HDF5 files need, is not installed (Pillow is such
    a package, which Minari does not declare)."""
    try:
        import h5py  # noqa: F401
        import minari
        import PIL  # noqa: F401
    except ImportError as error:
        raise UserError(f'minari: cannot be imported ({error}); pip install "minari[hdf5]" pillow') from error
    return minari


def episodes_of(dataset: Any) -> Episodes:
    """The episodes of a Minari dataset whose actions are vectors or moves, for learning offline (data/episodes.py).

    dataset: of `minari.load_dataset`. Observations are vectors, images uint8 (`as_observations`), or dictionaries: of a
    `GoalEnv` its `observation`, beside its goals; of others all vectors in the order of their keys, or the one image.
    Goals that are dictionaries, such as those of the kitchen, become vectors in the same way.
    Actions between the bounds of the dataset's space are scaled to lie from -1 to 1, as those of `envs.from_gymnasium`;
    those of a discrete one are moves, from its first on. Raises `UserError` for what cannot be read so.
    """
    known = callable(getattr(dataset, "iterate_episodes", None))
    require(known, "dataset", type(dataset).__name__, "give a MinariDataset, as minari.load_dataset makes it")
    recorded = [(one.observations, as_numbers(one.actions, "actions")) for one in dataset.iterate_episodes()]
    require(len(recorded) > 0, "dataset", "no episodes", "give a dataset with episodes")
    space = getattr(dataset, "action_space", None)
    remedy = "give a dataset whose actions are a Box or Discrete"
    require(type(space).__name__ not in COMPOSED, "action_space", str(space), remedy)
    moves = recorded[0][1].dtype.kind in "iu"
    low, high = bounds_of(space)
    first = int(getattr(space, "start", 0)) if moves else 0
    columns: dict[str, list[np.ndarray]] = {name: [] for name in ("observations", "actions", "last")}
    for observations, actions in recorded:
        told = observations.keys() & {"achieved_goal", "desired_goal"} if isinstance(observations, dict) else set()
        if len(told) == 2 or (told and "observation" in observations):
            goals = {f"{name}s": observations[name] for name in sorted(told)}
            named = [sorted(each) if isinstance(each, dict) else [] for each in goals.values()]
            require(named[0] == named[-1], "desired_goals", named[-1], f"give the keys of achieved_goals, {named[0]}")
            for name, each in goals.items():
                columns.setdefault(name, []).append(as_goals(each, name))
            require("observation" in observations, "observations", sorted(observations), "give an `observation` too")
            observations = observations["observation"]
        seen = as_observations(observations)
        require(
            actions.ndim == (1 if moves else 2) and len(seen) == len(actions) + 1,
            "actions",
            list(actions.shape),
            f"give a {'move' if moves else 'vector'} for each of the {len(seen) - 1} steps of an episode",
        )
        columns["observations"].append(seen)
        if moves:
            columns["actions"].append(np.pad(actions.astype(np.int64) - first, (0, 1)))
        else:
            scaled = (actions - (low + high) / 2) / ((high - low) / 2)
            check_inside(scaled, actions, space)
            columns["actions"].append(np.pad(scaled.astype(np.float32), ((0, 1), (0, 0))))
        columns["last"].append(np.arange(len(seen)) == len(seen) - 1)
    different = {parts[0].shape[1:] != part.shape[1:] for parts in columns.values() for part in parts}
    require(True not in different, "observations", "episodes of different shapes", "give one shape")
    bounded = not moves and ((low != -1).any() or (high != 1).any())
    bounds = np.stack([low, high]) if bounded else None
    return Episodes(**{name: np.concatenate(parts) for name, parts in columns.items()}, action_bounds=bounds)


def bounds_of(space: Any) -> tuple[np.ndarray, np.ndarray]:
    """The bounds of a space of actions, float64 [A] or numbers; -1 and 1 where it tells none."""
    low, high = (np.asarray(getattr(space, name, bound), np.float64) for name, bound in (("low", -1), ("high", 1)))
    bounded = max(np.abs(low).max(), np.abs(high).max()) < UNBOUNDED and (low < high).all()
    return (low, high) if bounded else (np.float64(-1), np.float64(1))


def check_inside(scaled: np.ndarray, actions: np.ndarray, space: Any) -> None:
    """Raise `UserError` for actions of an episode [T, A] that are scaled beyond -1 to 1, with their own numbers."""
    out = np.flatnonzero((np.abs(scaled) > 1 + WITHIN).any(-1)) if scaled.ndim == 2 else []
    if len(out):
        place = f"lies outside of the dataset's space, {space}"
        given = f"actions[{out[0]}] = {actions[out[0]].tolist()}"
        raise UserError(f"{given}: {place}: give actions inside of it, or a space with their bounds")


def as_observations(observations: Any, field: str = "observations") -> np.ndarray:
    """The observations of an episode as one array: vectors [T, F], or images [T, H, W, C], which uint8 [T, H, W], [T,
    C, H, W] and stacks of frames [T, K, ...] of these become, those of a stack one behind the other in C. Of a tuple
    the parts stand one behind the other, as those of a dictionary. Raises `UserError`, naming the field, for others."""
    if isinstance(observations, tuple):
        observations = {f"{place:03}": part for place, part in enumerate(observations)}
    if isinstance(observations, dict):
        parts = {name: as_observations(part, f"{field}[{name!r}]") for name, part in observations.items()}
        if len(parts) == 1:
            return next(iter(parts.values()))
        return joined(parts, field, "give a vector for each step under each key, or one image alone")
    found = as_numbers(observations, field)
    remedy = "give images as uint8, from 0 to 255"
    require(found.dtype == np.uint8 or found.ndim < 4, field, f"{found.dtype} {list(found.shape)}", remedy)
    if found.dtype != np.uint8 or found.ndim not in (3, 4, 5):
        return found.reshape(len(found), -1).astype(np.float32)
    if found.ndim == 3:
        return found[..., None]
    if found.shape[-3] < min(found.shape[-2:]):  # A side of an image is longer than its channels.
        found = np.moveaxis(found, -3, -1)
    if found.ndim == 4:
        return found
    return np.ascontiguousarray(np.moveaxis(found, 1, -2)).reshape(len(found), *found.shape[2:4], -1)


def as_goals(goals: Any, field: str) -> np.ndarray:
    """The goals of an episode, float32 [T, D]: vectors, or a dictionary of them, such as one for each thing to do."""
    if not isinstance(goals, dict):
        return as_numbers(goals, field).astype(np.float32)
    parts = {name: as_numbers(part, f"{field}[{name!r}]") for name, part in goals.items()}
    return joined(parts, field, "give a vector for each step under each key").astype(np.float32)


def joined(parts: dict[str, np.ndarray], field: str, remedy: str) -> np.ndarray:
    """The vectors [T, F] under each key one behind the other, in the order of the keys, as `gymnasium.spaces.flatten`
    has those of a `Dict`. Raises `UserError` for others."""
    shapes = {name: list(parts[name].shape) for name in sorted(parts)}
    is_vectors = all(len(shape) == 2 for shape in shapes.values())
    require(is_vectors and len({shape[0] for shape in shapes.values()}) == 1, field, shapes, remedy)
    return np.concatenate([parts[name] for name in shapes], 1)


def as_numbers(values: Any, field: str) -> np.ndarray:
    """The values of an episode, [T, ...], as an array of numbers. Raises `UserError`, naming the field, for others."""
    found = as_array(field, values)
    require(found.dtype.kind in "fiub" and found.ndim > 0, field, str(found.dtype), "give numbers for each step")
    return found


def to_minari(episodes: Episodes, out: str | os.PathLike) -> Path:
    """Write the episodes as the Minari dataset `out`, FOLDER/NAME-v0, which `episodes_of` reads back. With
    MINARI_DATASETS_PATH=FOLDER `minari.load_dataset("NAME-v0")` finds it.

    Actions lie between their bounds again. Observations are those of a `GoalEnv` where the goals are known. Rewards are
    0, since episodes have none, and the end of an episode is a truncation. Raises `UserError` if Minari is missing,
    `out` is there already, its name is none of Minari's, or the disk refuses.
    """
    require(isinstance(episodes, Episodes), "episodes", type(episodes).__name__, "give Episodes of data/episodes.py")
    out = Path(checks.path(out, "out"))
    named = re.fullmatch(r"[\w-]+-v\d+", out.name) is not None
    require(named, "out", str(out), "Minari wants names with a version, such as walks-v0")
    require(not os.path.lexists(out), "out", str(out), "is there already; give a new folder")
    shortest = int(episodes.lengths.min())
    require(shortest > 0, "episodes", "one of a single observation", "Minari's have a step at least; leave it out")
    library = import_minari()
    with new_folder(out, "out") as beside:
        write_episodes(library, episodes, beside / "data", out.name)
    return out


def write_episodes(library: ModuleType, episodes: Episodes, folder: Path, name: str) -> None:
    """The episodes, a batch at a time, and what Minari wants to know of them."""
    from gymnasium import spaces
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    def space(values: np.ndarray) -> spaces.Box:
        low, high = (0, 255) if values.dtype == np.uint8 else (-np.inf, np.inf)
        return spaces.Box(low, high, values.shape[1:], values.dtype.type)

    seen = {"observation": episodes.observations}
    goals = {"achieved_goal": episodes.achieved_goals, "desired_goal": episodes.desired_goals}
    seen |= {key: values for key, values in goals.items() if values is not None}
    of_goals = len(seen) > 1
    described = spaces.Dict({key: space(values) for key, values in seen.items()})
    if episodes.moves:
        taken, actions = episodes.actions.astype(np.int64), spaces.Discrete(episodes.action_size)
    else:
        low, high = np.float32([[-1], [1]]) if episodes.action_bounds is None else episodes.action_bounds
        taken = np.clip(between((low, high), episodes.actions), low, high)
        lowest, highest = (np.broadcast_to(bound, taken.shape[1:]) for bound in (low, high))
        actions = spaces.Box(lowest, highest, dtype=np.float32)
    storage = MinariStorage.new(
        folder, described if of_goals else described["observation"], actions, jpeg_encoding=False
    )
    ends = np.flatnonzero(episodes.last) + 1
    starts = np.append(0, ends[:-1])
    for first in range(0, len(ends), EPISODES_AT_ONCE):
        batch = []
        some = slice(first, first + EPISODES_AT_ONCE)
        for start, end in zip(starts[some], ends[some], strict=True):
            steps = end - start - 1
            shown = {key: values[start:end] for key, values in seen.items()}
            batch.append(
                EpisodeBuffer(
                    observations=shown if of_goals else shown["observation"],
                    infos={},
                    actions=taken[start : end - 1],
                    rewards=np.zeros(steps),
                    terminations=np.zeros(steps, bool),
                    truncations=np.arange(steps) == steps - 1,
                )
            )
        storage.update_episodes(batch)
    about = "Episodes of infogoal-jax; rewards are 0, since they record none."
    storage.update_metadata({"dataset_id": name, "minari_version": library.__version__, "description": about})
