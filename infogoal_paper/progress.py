"""How far a reproduction is, and a page that can be looked at while it runs, FOLDER/progress.html."""

import dataclasses
import html
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import require
from infogoal_jax.files import from_json, has_no_locks, open_lock, read_bytes, try_lock
from infogoal_jax.runs import disk
from infogoal_paper import checkpoints, files, plan
from infogoal_paper.manifest import Run
from infogoal_paper.plan import budget_of

PAGE, TIMES = "progress.html", "times"
LONGEST = 10**9
"""Seconds that no batch of runs takes."""
SECONDS = 10
"""The page is written anew at most this often, and reloads itself as often."""
STYLE = """body{font:16px/1.4 system-ui,sans-serif;margin:1rem;max-width:70rem}table{border-collapse:collapse}
td,th{padding:.15rem .6rem;border-bottom:1px solid #ccc;text-align:left}.failed{color:#a00}.running{color:#06c}
.done{color:#080}pre{white-space:pre-wrap}div{overflow-x:auto}"""


class State(NamedTuple):
    """How far a run is. kind: done, running, failed or left, or of a finished one not measured; words: what is known of
    it."""

    kind: str
    words: str = ""


def note(folder: Path, run: Run, evaluations: int, seconds: float) -> None:
    """Write how far a run is. seconds: that its program takes from one evaluation to the next."""
    most = budget_of(run.task, run.toy).evaluations
    values = {"evaluations": evaluations, "of": most, "seconds": seconds}
    disk.write_json(files.path_of(folder, run, "progress.json"), values)


def forget(folder: Path, run: Run) -> None:
    """Delete what `note` wrote."""
    files.path_of(folder, run, "progress.json").unlink(missing_ok=True)


def keep_times(folder: Path, task: str, runs: int, seconds: float) -> None:
    """Keep what a batch of runs took, so that the time to go can be told."""
    disk.make_folder(disk.below(folder, TIMES))
    disk.write_json(folder / TIMES / f"{uuid.uuid4().hex}.json", {"task": task, "runs": runs, "seconds": seconds})


@dataclasses.dataclass(frozen=True)
class Took:
    """What a batch of so many runs of a task took."""

    task: str
    runs: int
    seconds: float

    def __post_init__(self):
        require(self.runs > 0, "runs", self.runs, "should be 1 or more")
        require(0 <= self.seconds < LONGEST, "seconds", self.seconds, f"should be from 0 to below {LONGEST:,}")


def seconds_a_run(folder: Path) -> dict[str, float]:
    """Mean seconds of a run of each task, and under "" of all, of those that are known."""
    rows = []
    for path in sorted((folder / TIMES).glob("*.json")):
        place = disk.Place(path, remedy="delete it: only the time to go is told by it")
        rows.append(vars(disk.decode(Took, disk.parse(disk.read_bytes(place, f"{path}: not there"), place), place)))
    found = {}
    for task in {row["task"] for row in rows} | ({""} if rows else set()):
        own = [row for row in rows if task in ("", row["task"])]
        found[task] = sum(row["seconds"] for row in own) / sum(row["runs"] for row in own)
    return found


def is_locked(path: Path) -> bool:
    """Whether a process holds the lock of this file."""
    try:
        with open_lock(path, make=False) as file:
            return not try_lock(file)
    except FileNotFoundError:
        return False
    except OSError as error:
        if has_no_locks(error):
            return True  # It is there, and nothing more can be told.
        raise


def state_of(folder: Path, run: Run) -> State:
    """How far a run is, by the files that are there; whether a finished one is sound is not looked at."""
    noted = files.path_of(folder, run, "progress.json")
    if is_locked(files.path_of(folder, run, "lock")):
        try:
            known = from_json(read_bytes(noted))
            return State("running", f"evaluation {known['evaluations']} of at most {known['of']}")
        except (OSError, ValueError, KeyError, TypeError):
            return State("running", "compiling, or being measured")
    if files.has_failed(folder, run):
        return State("failed", files.why_failed(folder, run))
    if files.path_of(folder, run).exists():
        return State("done")
    if not noted.exists():
        return State("left")
    kept = checkpoints.has(folder, run)
    return State("left", "was stopped, goes on from its checkpoint" if kept else "was stopped without a checkpoint")


def sound_state_of(folder: Path, run: Run, config_of: Callable[[Run], TrainConfig]) -> State:
    """How far a run is. A finished one is read: it is left where its file is damaged or of another configuration, or
    where it is not measured and will be."""
    state = state_of(folder, run)
    if state.kind != "done":
        return state
    status, why = files.status_of(folder, run, config_of(run))
    if status == "not measured":
        waits = why == plan.NO_TIME and checkpoints.has(folder, run)
        return State("left", "is trained, and to be measured") if waits else State(status, why)
    return State("done") if status == "done" else State("left", why)


def time_to_go(folder: Path, runs: list[Run], states: dict[Run, State]) -> float | None:
    """Seconds until all is done, if as many processes go on working as do now; None while nothing is known."""
    known = seconds_a_run(folder)
    if not known:
        return None
    working = max(1, len({run.task + run.label for run in runs if states[run].kind == "running"}))
    left = [run for run in runs if states[run].kind in ("left", "running")]
    return sum(known.get(run.task, known[""]) for run in left) / working


def in_words(seconds: float | None) -> str:
    """A time as hours and minutes."""
    if seconds is None:
        return "not known yet"
    minutes = int(np.ceil(seconds / 60))
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"


def summary(folder: Path, runs: list[Run], states: dict[Run, State] | None = None) -> str:
    """How many runs are done, running, failed and left, and the time to go. states: None for those of `state_of`."""
    states = states or {run: state_of(folder, run) for run in runs}
    kinds = [state.kind for state in states.values()]
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in ("done", "running", "failed", "left"))
    counts += f", {kinds.count('not measured')} not measured" if "not measured" in kinds else ""
    return f"{len(runs)} runs: {counts}; time to go: {in_words(time_to_go(folder, runs, states))}"


def write(folder: Path, runs: list[Run], at_once: bool = False) -> None:
    """Write the page, unless it is a few seconds old."""
    path = folder / PAGE
    if not at_once and path.exists() and time.time() - path.stat().st_mtime < SECONDS:
        return
    states = {run: state_of(folder, run) for run in runs}
    rows = "".join(
        f'<tr class="{state.kind}"><td>{html.escape(run.name)}</td><td>{state.kind}</td>'
        f"<td>{html.escape(state.words)}</td></tr>"
        for run, state in sorted(states.items(), key=lambda item: ORDER.index(item[1].kind))
    )
    disk.make_folder(folder)
    disk.write_text(
        path,
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f'<meta http-equiv="refresh" content="{SECONDS}"><title>Reproduction: progress</title><style>{STYLE}</style>'
        f"<h1>Reproduction: progress</h1><p>{html.escape(summary(folder, runs, states))}</p>"
        f"<div><table><tr><th>run</th><th></th><th></th></tr>{rows}</table></div></html>\n",
    )


ORDER = ("running", "failed", "left", "done")
