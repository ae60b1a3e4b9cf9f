"""The recorded trajectories of an image dataset (data/frames.py) as a Minari dataset, bit by bit and back. Needs `pip
install "minari[hdf5]" pillow`.

A trajectory becomes an episode. An observation is a dictionary: the index of the frame, the state, the image, and the
poses as far as they are known. Rewards are 0, since goals are chosen later; the end of a trajectory is a truncation,
since nothing was reached or failed.
"""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from infogoal_jax import checks
from infogoal_jax.data.archives import new_folder
from infogoal_jax.data.episodes import Episodes, as_array
from infogoal_jax.data.frames import FrameDataset
from infogoal_jax.errors import UserError, require
from infogoal_jax.goals import MOST_CHANNELS

POSES = ("rotation", "joints", "position", "detected")
EPISODES_AT_ONCE = 256
"""Minari opens its file again for each batch of episodes, and a batch is held in memory."""
NOTE = "infogoal"
"""Key of the metadata under which names and `about` stand, as JSON text."""


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


def observations_of(dataset: FrameDataset, shown: np.ndarray) -> dict[str, np.ndarray]:
    """The observations of the frames `shown` [T + 1], each [T + 1, ...]."""
    seen = {"frame": shown, "state": dataset.state[shown], "image": dataset.frames[shown]}
    poses = {name: getattr(dataset, name) for name in POSES}
    return seen | {name: values[shown] for name, values in poses.items() if values is not None}


def observation_space(dataset: FrameDataset):
    """The Gymnasium space of one observation."""
    from gymnasium import spaces

    described = {
        "frame": spaces.Discrete(len(dataset.frames)),
        "state": spaces.Discrete(dataset.num_states),
        "image": spaces.Box(0, 255, dataset.frames.shape[1:], np.uint8),
    }
    for name in POSES:
        values = getattr(dataset, name)
        if values is not None:
            is_flags = values.dtype == bool
            described[name] = (
                spaces.MultiBinary(values.shape[1])
                if is_flags
                else spaces.Box(-np.inf, np.inf, values.shape[1:], np.float32)
            )
    return spaces.Dict(described)


def to_minari(dataset: FrameDataset, out: str | os.PathLike, progress: Callable[[float], None] | None = None) -> Path:
    """Write the trajectories as the Minari dataset `out`, FOLDER/NAME-v0. With MINARI_DATASETS_PATH=FOLDER
    `minari.load_dataset("NAME-v0")` reads it.

    Images are kept as they are, not as JPEG, and stand in the file as often as they are seen. Frames that no move shows
    are left out.

    Raises UserError if Minari is missing, `out` is there already, its name is none of Minari's, or the disk refuses.
    """
    require(
        isinstance(dataset, FrameDataset), "dataset", type(dataset).__name__, "give a FrameDataset of data/frames.py"
    )
    out = Path(checks.path(out, "out"))
    require(
        re.fullmatch(r"[\w-]+-v\d+", out.name) is not None,
        "out",
        str(out),
        "Minari wants names with a version, such as cube-v0",
    )
    require(not out.exists(), "out", str(out), "is there already; give a new folder")
    minari = import_minari()
    with new_folder(out, "out") as beside:
        write_episodes(minari, dataset, beside / "data", out.name, progress)
    return out


def write_episodes(
    minari: ModuleType, dataset: FrameDataset, folder: Path, name: str, progress: Callable[[float], None] | None
) -> None:
    """The episodes, a batch at a time, and the metadata."""
    from gymnasium import spaces
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    storage = MinariStorage.new(
        folder, observation_space(dataset), spaces.Discrete(len(dataset.actions)), jpeg_encoding=False
    )
    ends = np.flatnonzero(dataset.terminal) + 1
    starts = np.append(0, ends[:-1])
    for first in range(0, len(ends), EPISODES_AT_ONCE):
        episodes = []
        for start, end in zip(
            starts[first : first + EPISODES_AT_ONCE], ends[first : first + EPISODES_AT_ONCE], strict=True
        ):
            shown = np.append(dataset.frame[start:end], dataset.next_frame[end - 1])
            episodes.append(
                EpisodeBuffer(
                    options={"trajectory": int(dataset.trajectory[start])},
                    observations=observations_of(dataset, shown),
                    infos={},
                    actions=dataset.action[start:end],
                    rewards=np.zeros(end - start),
                    terminations=np.zeros(end - start, bool),
                    truncations=dataset.terminal[start:end],
                )
            )
        storage.update_episodes(episodes)
        if progress is not None:
            progress(min(1.0, (first + EPISODES_AT_ONCE) / len(ends)))
    names = {
        "actions": dataset.actions,
        "objects": dataset.objects,
        "joint_names": dataset.joint_names,
        "about": dataset.about,
    }
    storage.update_metadata(
        {
            "dataset_id": name,
            "minari_version": minari.__version__,
            "description": str(dataset.about.get("name", name)),
            NOTE: json.dumps(names),
        }
    )


def check_note(metadata: dict, path: str | os.PathLike) -> None:
    """Raise `UserError` for metadata without the note of `to_minari`: Minari's `combine_datasets` does not copy it."""
    combined = metadata.get("combined_datasets")
    if NOTE not in metadata and combined is not None:
        names = ", ".join(map(str, combined))
        raise UserError(
            f"path = {str(path)!r}: was combined of {names} by Minari, which drops the names of actions, objects and "
            "joints and numbers frames of each from 0; give these to from_minari, one by one"
        )
    if NOTE not in metadata:
        raise UserError(f"path = {str(path)!r}: its metadata has no {NOTE!r}; give a folder that to_minari wrote")


def episodes_of(dataset: Any) -> Episodes:
    """The episodes of a Minari dataset whose actions are vectors, for learning offline (data/episodes.py).

    dataset: of `minari.load_dataset`. Observations are vectors, images uint8 with channels last or first, or
    dictionaries: of a `GoalEnv` its `observation`, beside its goals; of others all vectors in the order of their keys.
    Raises `UserError` for what cannot be read so.
    """
    known = callable(getattr(dataset, "iterate_episodes", None))
    require(known, "dataset", type(dataset).__name__, "give a MinariDataset, as minari.load_dataset makes it")
    recorded = [(one.observations, as_numbers(one.actions, "actions")) for one in dataset.iterate_episodes()]
    require(len(recorded) > 0, "dataset", "no episodes", "give a dataset with episodes")
    columns: dict[str, list[np.ndarray]] = {name: [] for name in ("observations", "actions", "last")}
    for observations, actions in recorded:
        is_goal_env = isinstance(observations, dict) and {"achieved_goal", "desired_goal"} <= observations.keys()
        if is_goal_env:
            for name in ("achieved_goal", "desired_goal"):
                goals = as_numbers(observations[name], f"{name}s")
                columns.setdefault(f"{name}s", []).append(goals.astype(np.float32))
            require("observation" in observations, "observations", sorted(observations), "give an `observation` too")
            observations = observations["observation"]
        seen = as_observations(observations)
        require(
            actions.ndim == 2 and len(seen) == len(actions) + 1,
            "actions",
            list(actions.shape),
            f"give a vector for each of the {len(seen) - 1} steps of an episode",
        )
        columns["observations"].append(seen)
        columns["actions"].append(np.pad(actions.astype(np.float32), ((0, 1), (0, 0))))
        columns["last"].append(np.arange(len(seen)) == len(seen) - 1)
    different = {parts[0].shape[1:] != part.shape[1:] for parts in columns.values() for part in parts}
    require(True not in different, "observations", "episodes of different shapes", "give one shape")
    return Episodes(**{name: np.concatenate(parts) for name, parts in columns.items()})


def as_observations(observations: Any) -> np.ndarray:
    """The observations of an episode as one array: vectors [T, F], or images [T, H, W, C]."""
    if isinstance(observations, dict):
        parts = [as_observations(observations[name]) for name in sorted(observations)]
        vectors = all(part.ndim == 2 for part in parts)
        require(vectors, "observations", sorted(observations), "give vectors, or images alone, under their keys")
        return np.concatenate(parts, 1)
    found = as_numbers(observations, "observations")
    if found.dtype == np.uint8 and found.ndim == 4:
        channels_first = found.shape[1] <= MOST_CHANNELS < found.shape[3]
        return np.moveaxis(found, 1, -1) if channels_first else found
    return found.reshape(len(found), -1).astype(np.float32)


def as_numbers(values: Any, field: str) -> np.ndarray:
    """The values of an episode, [T, ...], as an array of numbers. Raises `UserError`, naming the field, for others."""
    found = as_array(field, values)
    require(found.dtype.kind in "fiub" and found.ndim > 0, field, str(found.dtype), "give numbers for each step")
    return found


def from_minari(path: str | os.PathLike) -> FrameDataset:
    """The dataset that `to_minari` wrote to `path`. Frames and states that no move showed are gone, the others numbered
    anew without gaps.

    Raises UserError if Minari is missing, or the folder is no dataset of `to_minari`.
    """
    checks.path(path, "path", "give the folder that to_minari wrote")
    minari = import_minari()
    try:
        episodes = minari.MinariDataset(Path(path) / "data")
        check_note(episodes.storage.metadata, path)
        note = json.loads(episodes.storage.metadata[NOTE])
        labels = [
            metadata["options"]["trajectory"]
            for metadata in episodes.storage.get_episode_metadata(episodes.episode_indices)
        ]
        moves: dict[str, list[np.ndarray]] = {
            name: [] for name in ("frame", "action", "next_frame", "trajectory", "time", "terminal")
        }
        kept: dict[int, dict[str, np.ndarray]] = {}
        for episode, label in zip(episodes, labels, strict=True):
            seen, length = episode.observations, len(episode)
            for step, frame in enumerate(seen["frame"].tolist()):
                if frame not in kept:
                    kept[frame] = {name: values[step] for name, values in seen.items()}
            record = (
                seen["frame"][:-1],
                episode.actions,
                seen["frame"][1:],
                np.full(length, label),
                np.arange(length),
                episode.truncations,
            )
            for column, values in zip(moves.values(), record, strict=True):
                column.append(values)
    except UserError:
        raise
    except (OSError, KeyError, ValueError, AttributeError) as error:
        raise UserError(
            f"path = {str(path)!r}: is no dataset of infogoal data export-minari ({error}); give the folder that it "
            "wrote"
        ) from error
    shown = sorted(kept)
    fields = {name: np.concatenate(columns) for name, columns in moves.items()}
    fields = {name: values.astype(bool if name == "terminal" else np.int32) for name, values in fields.items()}
    fields |= {name: np.searchsorted(shown, fields[name]).astype(np.int32) for name in ("frame", "next_frame")}
    seen = {name: np.stack([kept[frame][name] for frame in shown]) for name in kept[shown[0]] if name != "frame"}
    state = np.unique(seen.pop("state"), return_inverse=True)[1].astype(np.int32)
    names = {name: tuple(note[name]) for name in ("actions", "objects", "joint_names")}
    return FrameDataset(frames=seen.pop("image"), state=state, about=note["about"], **fields, **names, **seen)
