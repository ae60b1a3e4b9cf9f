"""Recorded episodes of Minari, for learning offline. Needs `pip install "minari[hdf5]" pillow`."""

from types import ModuleType
from typing import Any

import numpy as np

from infogoal_jax.data.episodes import Episodes, as_array
from infogoal_jax.errors import UserError, require
from infogoal_jax.goals import MOST_CHANNELS


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
