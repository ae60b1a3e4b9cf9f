"""How far our Fetch tasks part from recorded episodes of the reference: the same actions from the same start, and the
positions of grip and object, as tables and as a file.

It measures without a threshold: where contacts are chaotic, two runs of the reference that start a tenth of a
millimetre apart diverge too (fetch_chaos.py).

    .venv/bin/python benchmarks/fidelity/fetch_parity.py tests/fixtures/fetch_gymnasium_v4.npz
        --kinds random held scripted --out parity.json

A recording is an npz as record_fetch_reference.py writes it. Arrays of a task, of E episodes with T steps of 40 ms, in
m, rad and (velocities) m or rad a step: `<task>/observation` [E, T + 1, 10 or 25], `achieved_goal` [E, T + 1, 3],
`desired_goal` [E, 1, 3], `action` [E, T, 4] and `reward` [E, T]. A text `source` says where they are from.
"""

import argparse
import dataclasses
import functools
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import mujoco
import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from infogoal_jax.envs.fetch.environment import Fetch, make
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.runs import disk

OFF_TABLE = 0.3
"""An object that ends lower than this (m) has fallen off the table, whose top is at 0.4."""
LIFTED = 0.45
"""An object that ends higher than this (m) has been lifted: on the table its centre is at 0.425."""
ALL = "all"
"""The kind that every episode belongs to."""


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


def load_recordings(path: Path) -> tuple[dict[str, Recording], str]:
    """The recordings of our tasks in a file, by task, and its source in words. Actions are clipped to [-1, 1], as the
    environments do."""
    with np.load(path) as arrays:
        tasks = [task for task in TASKS if f"{task}/action" in arrays]
        source = str(arrays["source"]) if "source" in arrays else "an unnamed source"
        return {
            task: Recording(
                task,
                arrays[f"{task}/observation"].astype(np.float32),
                arrays[f"{task}/desired_goal"][:, 0].astype(np.float32),
                np.clip(arrays[f"{task}/action"], -1, 1).astype(np.float32),
                arrays[f"{task}/reward"].astype(np.float32),
            )
            for task in tasks
        }, source


@dataclasses.dataclass(frozen=True, eq=False)
class Replayed:
    """The outcome of the recorded actions in our task: grip and thing (the object; zeros without one) [E, T + 1, 3] in
    m, reward [E, T], diverged bool [E]."""

    grip: np.ndarray
    thing: np.ndarray
    reward: np.ndarray
    diverged: np.ndarray


def replay(env: Fetch, recording: Recording) -> Replayed:
    """Step through all episodes of a recording, side by side. Episodes continue to their last step, also after the goal
    was reached."""
    grip, thing, reward, diverged = jax.device_get(
        replay_program(env, recording.observation[:, 0], recording.goal, recording.action)
    )
    return Replayed(grip, thing, reward, diverged)


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0, 0, 0))
def replay_program(env: Fetch, first, goal, actions):
    """Grip and object [T + 1, 3], reward [T] and whether it diverged, for one episode: first observation [10 or 25],
    goal [3] and actions [T, 4]."""
    has_object = env.task.object_height is not None
    motion = env.physics.start()
    if has_object:
        # The reference's puck lies 6.5 mm deep in the table, where ours would be thrown out of it: it stands at its own
        # height.
        motion = env.physics.place_object(motion, first[3:5] if env.task.puck else first[3:6])

    def positions(state):
        observation = state.observation
        return observation[:3], observation[3:6] if has_object else jax.numpy.zeros(3)

    def step(state, action):
        state = env.step(state, action)
        return state, (*positions(state), env.reward(env.achieved(state), goal), state.diverged)

    start = env.begin(motion, goal)
    _, (grip, thing, reward, diverged) = jax.lax.scan(step, start, actions)
    grip, thing = (
        jax.numpy.concatenate([here[None], later]) for here, later in zip(positions(start), (grip, thing), strict=True)
    )
    return grip, thing, reward, diverged.any()


@dataclasses.dataclass(frozen=True)
class Distance:
    """Distance between a position and the recorded one in mm, over all steps of some episodes; at the start and the
    end: means over the episodes."""

    mean: float
    median: float
    largest: float
    start: float
    end: float


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The number of episodes for which something holds: in the recording, here, and in both."""

    recorded: int
    here: int
    both: int


@dataclasses.dataclass(frozen=True)
class Parity:
    """Episodes of one kind compared. thing, fallen and lifted: None without an object; equal_rewards: share of the
    steps."""

    kind: str
    episodes: int
    grip: Distance
    thing: Distance | None
    equal_rewards: float
    fallen: Outcome | None
    lifted: Outcome | None
    diverged: int


def distances(here: np.ndarray, recorded: np.ndarray) -> np.ndarray:
    """Distances [E, T + 1] in mm between positions [E, T + 1, 3] in m."""
    return 1000 * np.linalg.norm(np.asarray(here, float) - np.asarray(recorded, float), axis=-1)


def measure(error: np.ndarray) -> Distance:
    """Summarise errors [E, T + 1] in mm by five numbers. The start is given, so that only later steps count."""
    moved = error[:, 1:]
    return Distance(
        float(moved.mean()),
        float(np.median(moved)),
        float(moved.max()),
        float(error[:, 0].mean()),
        float(error[:, -1].mean()),
    )


def count(recorded: np.ndarray, here: np.ndarray) -> Outcome:
    """Count the episodes of two masks, bool [E]."""
    return Outcome(int(recorded.sum()), int(here.sum()), int((recorded & here).sum()))


def kind_masks(kinds: Sequence[str], episodes: int) -> dict[str, np.ndarray]:
    """Which episodes are of each kind, {kind: bool [E]}, if their kinds repeat in this order; the first is `ALL`."""
    order = np.array([kinds[episode % len(kinds)] if kinds else ALL for episode in range(episodes)])
    masks = {kind: order == kind for kind in dict.fromkeys(kinds)}
    return {ALL: np.ones(episodes, bool)} | {kind: mask for kind, mask in masks.items() if mask.any()}


def compare(recording: Recording, replayed: Replayed, kinds: Sequence[str] = ()) -> list[Parity]:
    """Compare a recording with its replay: over all episodes, then over those of each kind."""
    grip, has_object = distances(replayed.grip, recording.grip), recording.has_object
    thing = distances(replayed.thing, recording.thing) if has_object else None
    ends = recording.thing[:, -1, 2], replayed.thing[:, -1, 2]
    rows = []
    for kind, mask in kind_masks(kinds, recording.episodes).items():
        heights = [end[mask] for end in ends]
        rows.append(
            Parity(
                kind=kind,
                episodes=int(mask.sum()),
                grip=measure(grip[mask]),
                thing=measure(thing[mask]) if has_object else None,
                equal_rewards=float((replayed.reward == recording.reward)[mask].mean()),
                fallen=count(*(height < OFF_TABLE for height in heights)) if has_object else None,
                lifted=count(*(height > LIFTED for height in heights)) if has_object else None,
                diverged=int(replayed.diverged[mask].sum()),
            )
        )
    return rows


def episode_rows(recording: Recording, replayed: Replayed, kinds: Sequence[str]) -> list[dict]:
    """One record an episode, for the file: errors in mm and the object's height at the end in m."""
    errors = {"grip": distances(replayed.grip, recording.grip)}
    if recording.has_object:
        errors["thing"] = distances(replayed.thing, recording.thing)
    rows = []
    for episode in range(recording.episodes):
        row = {"episode": episode, "kind": kinds[episode % len(kinds)] if kinds else ALL}
        row |= {
            f"{name}_{part}_mm": float(value)
            for name, error in errors.items()
            for part, value in (
                ("mean", error[episode, 1:].mean()),
                ("largest", error[episode, 1:].max()),
                ("end", error[episode, -1]),
            )
        }
        row["diverged"] = bool(replayed.diverged[episode])
        row["equal_rewards"] = float((replayed.reward[episode] == recording.reward[episode]).mean())
        if recording.has_object:
            row |= {
                "height_recorded": float(recording.thing[episode, -1, 2]),
                "height_here": float(replayed.thing[episode, -1, 2]),
            }
        rows.append(row)
    return rows


def distance_table(parities: dict[str, list[Parity]]) -> Table:
    """Errors of grip and object in mm: for each task and kind, over all steps, and the mean at the episodes' end."""
    table = Table(
        box=box.SIMPLE_HEAD, pad_edge=False, title="distance from the recorded position (mm)", title_justify="left"
    )
    for column in ("task", "episodes", "of", "mean", "median", "max", "end"):
        table.add_column(column, justify="left" if column in ("task", "episodes", "of") else "right", no_wrap=True)
    for task, rows in parities.items():
        for row in rows:
            for name, error in (("grip", row.grip), ("object", row.thing)):
                if error is not None:
                    first = (
                        (task if row.kind == ALL else "", f"{row.episodes} {row.kind}") if name == "grip" else ("", "")
                    )
                    numbers = (error.mean, error.median, error.largest, error.end)
                    table.add_row(
                        *first, name, *(f"{number:.1f}" if number < 1000 else f"{number:.0f}" for number in numbers)
                    )
    return table


def outcome_table(parities: dict[str, list[Parity]]) -> Table:
    """What came of the episodes: rewards, and objects that fell or were lifted."""
    title = "equal rewards; objects that fell or were lifted: both (recorded, here)"
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=title, title_justify="left")
    for column in ("task", "episodes", "rewards", "fell", "lifted"):
        table.add_column(column, justify="left" if column in ("task", "episodes") else "right", no_wrap=True)
    for task, rows in parities.items():
        for row in rows:
            outcomes = (
                "-" if outcome is None else f"{outcome.both} ({outcome.recorded}, {outcome.here})"
                for outcome in (row.fallen, row.lifted)
            )
            table.add_row(
                task if row.kind == ALL else "", f"{row.episodes} {row.kind}", f"{row.equal_rewards:.1%}", *outcomes
            )
    return table


def main() -> None:
    """Replay every task of a file, print what came of it, and write it with a record an episode if asked to."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("file", type=Path, help="the episodes, an npz")
    parser.add_argument("--faithful", action="store_true", help="simulate as finely as the reference does")
    parser.add_argument("--kinds", nargs="*", default=[], help="kinds of the first, second, ... episode of each task")
    parser.add_argument("--out", type=Path, help="file to write the numbers to (json)")
    arguments = parser.parse_args()
    recordings, source = load_recordings(arguments.file)
    console, setting = Console(), "faithful" if arguments.faithful else "default"
    device = jax.devices()[0].device_kind
    console.print(f"{arguments.file}, {setting} setting, MuJoCo {mujoco.__version__} on {device}")
    console.print(f"recorded by {source}")
    parities, written = {}, {}
    for task, recording in recordings.items():
        started = time.perf_counter()
        replayed = replay(make(task, FetchConfig(faithful=arguments.faithful, ends_at_goal=False)), recording)
        seconds = time.perf_counter() - started
        console.print(f"{task}: {recording.episodes} x {recording.steps} steps, {seconds:.0f} s with compiling")
        parities[task] = compare(recording, replayed, arguments.kinds)
        written[task] = {
            "kinds": [dataclasses.asdict(row) for row in parities[task]],
            "episodes": episode_rows(recording, replayed, arguments.kinds),
        }
    console.print(distance_table(parities))
    console.print(outcome_table(parities))
    for task, (everything, *_) in parities.items():
        if everything.diverged:
            console.print(f"{task}: {everything.diverged} episodes diverged; their errors are those of finite states")
    if arguments.out:
        content = {
            "file": str(arguments.file),
            "source": source,
            "setting": setting,
            "device": device,
            "mujoco": mujoco.__version__,
            "jax": jax.__version__,
            "tasks": written,
        }
        disk.write_json(arguments.out, content, indent=1)


if __name__ == "__main__":
    main()
