"""Recorded episodes of the reference beside our Fetch tasks, as tables and as a file."""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import mujoco
from rich import box
from rich.console import Console
from rich.table import Table

from infogoal_jax.envs.fetch.environment import make
from infogoal_jax.envs.fetch.parity import ALL, Parity, Replayed, compare, distances, replay
from infogoal_jax.envs.fetch.recordings import Recording, Recordings
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.errors import UserError
from infogoal_jax.runs import disk


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


def check_recordings(
    recordings: Recordings,
    faithful: bool = False,
    kinds: Sequence[str] = (),
    out: Path | None = None,
    console: Console | None = None,
) -> dict[str, list[Parity]]:
    """Replay every task of a file, print what came of it, and write it to `out` (json) if given, with a record an
    episode.

    Returns {task: [over all episodes, of each kind]}. Raises `UserError` if `out` cannot be written.
    """
    console = console or Console()
    if out is not None:
        disk.check_out(out)
    if out is not None and not out.parent.is_dir():
        raise UserError(f"out = {str(out)!r}: cannot be written; give a file in a folder that is there")
    for name in recordings.skipped:
        console.print(
            f"{recordings.path}: {name} is no task of ours; skipped",
            style="yellow",
            soft_wrap=True,
            highlight=False,
            markup=False,
        )
    setting = "faithful" if faithful else "default"
    device = jax.devices()[0].device_kind
    console.print(
        f"{recordings.path}, {setting} setting, MuJoCo {mujoco.__version__} on {device}",
        style="bold",
        soft_wrap=True,
        markup=False,
    )
    console.print(
        f"recorded by {recordings.source or 'an unnamed source'}", soft_wrap=True, highlight=False, markup=False
    )
    parities, written = {}, {}
    for task, recording in recordings.tasks.items():
        started = time.perf_counter()
        replayed = replay(make(task, FetchConfig(faithful=faithful, ends_at_goal=False)), recording)
        seconds = time.perf_counter() - started
        done = f"{task}: {recording.episodes} x {recording.steps} steps, {seconds:.0f} s with compiling"
        console.print(done, soft_wrap=True, highlight=False, markup=False)
        parities[task] = compare(recording, replayed, kinds)
        written[task] = {
            "kinds": [dataclasses.asdict(row) for row in parities[task]],
            "episodes": episode_rows(recording, replayed, kinds),
        }
    console.print(distance_table(parities))
    console.print(outcome_table(parities))
    diverged = {task: rows[0].diverged for task, rows in parities.items() if rows[0].diverged}
    for task, number in diverged.items():
        console.print(
            f"{task}: {number} episodes diverged; their errors are those of the last finite states",
            style="bold red",
            soft_wrap=True,
        )
    if out is not None:
        content = {
            "file": str(recordings.path),
            "source": recordings.source,
            "setting": setting,
            "device": device,
            "mujoco": mujoco.__version__,
            "jax": jax.__version__,
            "tasks": written,
        }
        disk.write_json(out, content, indent=1)
        console.print(f"file        {out}", soft_wrap=True, highlight=False, markup=False)
    return parities
