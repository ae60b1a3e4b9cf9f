"""Recorded episodes of the reference Fetch environments: one npz, as benchmarks/fidelity/record_fetch_reference.py
writes it, checked throughout.

Arrays of a task, of E episodes with T steps of 40 ms, in m, rad and (velocities) m or rad a step: `<task>/observation`
[E, T + 1, 10 or 25], `achieved_goal` [E, T + 1, 3], `desired_goal` [E, 1, 3], `action` [E, T, 4] and `reward` [E, T].
Texts beside them (`source`, `mujoco`) say where they are from.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from infogoal_jax.data import archives
from infogoal_jax.envs.fetch.tasks import TASKS, Task
from infogoal_jax.errors import UserError, nearest

ARRAYS = ("observation", "achieved_goal", "desired_goal", "action", "reward")
NOTES = ("source", "mujoco")
"""Texts in a file that say where its episodes are from."""
REMEDY = "give an npz of episodes, as benchmarks/fidelity/record_fetch_reference.py writes it"
ROUNDING = 1e-4
"""Achieved goals may differ this much (m) from the position in the observation."""


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
    """E episodes of one task with T steps, float32: observation [E, T + 1, 10 or 25], goal [E, 3] (m), action [E, T, 4]
    in [-1, 1], reward [E, T]."""

    task: str
    observation: np.ndarray
    goal: np.ndarray
    action: np.ndarray
    reward: np.ndarray

    @property
    def episodes(self) -> int:
        """E."""
        return self.action.shape[0]

    @property
    def steps(self) -> int:
        """T."""
        return self.action.shape[1]

    @property
    def has_object(self) -> bool:
        """Whether the task has an object."""
        return TASKS[self.task].object_height is not None

    @property
    def grip(self) -> np.ndarray:
        """Positions of the grip, [E, T + 1, 3] in m."""
        return self.observation[..., :3]

    @property
    def thing(self) -> np.ndarray:
        """Positions of the object, [E, T + 1, 3] in m."""
        return self.observation[..., 3:6]


@dataclasses.dataclass(frozen=True)
class Recordings:
    """The content of a file: the recording of each known task, its source in words, and the names of unknown tasks,
    which are skipped."""

    path: Path
    tasks: dict[str, Recording]
    source: str
    skipped: tuple[str, ...]


def load_recordings(path: str | Path) -> Recordings:
    """Read a file of recorded episodes. Unknown tasks are skipped; known tasks must be complete.

    Raises `UserError` for a file that is missing, damaged or no npz, that holds no known task, or of which an array is
    missing, has a wrong shape or type, is not finite, or does not fit the others. Actions are clipped to [-1, 1], as
    the environments do.
    """
    path = Path(path)
    arrays = read_arrays(path)
    owners = list(dict.fromkeys(name.split("/")[0] for name in arrays if "/" in name))
    known = [task for task in TASKS if task in owners]
    unknown = tuple(name for name in owners if name not in TASKS)
    if not known:
        found = f", only of {', '.join(unknown[:5])}.{nearest(unknown[0], list(TASKS))}" if unknown else "."
        remedy = f"Its arrays must be named TASK/observation and so on, with TASK one of {', '.join(TASKS)}"
        raise UserError(f"file = {str(path)!r}: holds no episodes of a Fetch task{found} {remedy}")
    notes = (
        f"{name} {arrays[name]}"
        for name in NOTES
        if name in arrays and arrays[name].dtype.kind == "U" and arrays[name].ndim == 0
    )
    return Recordings(
        path,
        {task: read_task(path, arrays, TASKS[task]) for task in known},
        "; ".join(notes).removeprefix("source "),
        unknown,
    )


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an npz. Raises `UserError` if it cannot be read; pickled objects are never loaded, because they can
    run code."""
    with archives.naming("file", path, REMEDY):
        archive = archives.read(path, REMEDY)
        return {name: archives.member(archive, name, REMEDY) for name in archive.sizes}


def read_task(path: Path, arrays: Mapping[str, np.ndarray], task: Task) -> Recording:
    """The recording of a task. Raises `UserError` naming the file, the array, its value and what would be right."""
    missing = [name for name in ARRAYS if f"{task.name}/{name}" not in arrays]
    if missing:
        others = ", ".join(name.split("/", 1)[1] for name in arrays if name.startswith(f"{task.name}/"))
        raise UserError(
            f"{path}: {task.name}/{missing[0]} is missing; the task has {others} and needs {', '.join(ARRAYS)}"
        )
    values = {name: arrays[f"{task.name}/{name}"] for name in ARRAYS}

    def check(name: str, condition, value, remedy: str) -> None:
        if not condition:
            raise UserError(f"{path}: {task.name}/{name} = {value}: {remedy}")

    width = 10 if task.object_height is None else 25
    for name, value in values.items():
        check(name, value.dtype.kind in "fiu", f"an array of {value.dtype}", "give real numbers (float32)")
    action = values["action"]
    shaped = action.ndim == 3 and action.shape[2] == 4
    check(
        "action",
        shaped,
        f"an array of shape {action.shape}",
        "give [E, T, 4]: episodes, steps and the 4 numbers of an action",
    )
    episodes, steps = action.shape[:2]
    check(
        "action",
        episodes and steps,
        f"an array of shape {action.shape}",
        "give at least one episode of at least one step",
    )
    shapes = {
        "observation": (episodes, steps + 1, width),
        "achieved_goal": (episodes, steps + 1, 3),
        "desired_goal": (episodes, 1, 3),
        "action": (episodes, steps, 4),
        "reward": (episodes, steps),
    }
    for name, value in values.items():
        shape = shapes[name]
        remedy = f"give {shape}, for {episodes} episodes of {steps} steps as {task.name}/action has them"
        check(name, value.shape == shape, f"an array of shape {value.shape}", remedy)
        for index in np.argwhere(~np.isfinite(value))[:1].tolist():
            check(name, False, float(value[tuple(index)]), f"stands at {index}; give finite numbers")
    reward, position = (
        values["reward"],
        values["observation"][..., :3] if width == 10 else values["observation"][..., 3:6],
    )
    other = reward[(reward != 0) & (reward != -1)]
    check("reward", not len(other), other[:1].tolist(), "give the sparse reward, 0 at the goal and -1 elsewhere")
    apart = np.abs(position - values["achieved_goal"]).max()
    remedy = f"differs up to {apart:.4g} m from the position in {task.name}/observation; give both of the same moments"
    check("achieved_goal", apart < ROUNDING, f"an array of shape {position.shape}", remedy)
    return Recording(
        task.name,
        values["observation"].astype(np.float32),
        values["desired_goal"][:, 0].astype(np.float32),
        np.clip(action, -1, 1).astype(np.float32),
        reward.astype(np.float32),
    )
