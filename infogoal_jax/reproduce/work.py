"""The work on a folder: take what nobody else is training, train it, keep what is finished, and stop by the clock.

Any number of processes, on any machines that see the folder, may work on it. A run is taken by the lock of its file,
which goes with the process, however it ends.
"""

import contextlib
import dataclasses
import hashlib
import shlex
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from infogoal_jax.report.machine import describe_machine
from infogoal_jax.reproduce import budget, files, lanes, measure, progress
from infogoal_jax.reproduce.files import Result
from infogoal_jax.reproduce.manifest import Run, command_of
from infogoal_jax.reproduce.plan import Program, config_of, programs_of
from infogoal_jax.runs import disk
from infogoal_jax.runs.folder import BeingWrittenError, locked
from infogoal_jax.stopping import StopRequest, stop_on_signal
from infogoal_jax.train.host import describe
from infogoal_jax.train.memory import bytes_of

UNFINISHED = "unfinished"
"""Folder of the checkpoints of what was stopped."""
BYTES_A_SECOND = 2e8
"""At which a checkpoint is written, roughly, so that the clock can be kept."""
BEGINNING, MEASURING = 45.0, 60.0
"""Seconds that have to be left for a new program to be compiled, and for a run to be measured."""


@dataclasses.dataclass
class Work:
    """What a process does. folder: of the reproduction; deadline: seconds of `time.time()` at which it has to have
    stopped; retry: whether runs that failed are run again; most_lanes: side by side in one program."""

    folder: Path
    deadline: float = float("inf")
    retry: bool = False
    goal_images: Path | None = None
    most_lanes: int = 64
    say: Callable[[str], None] = print

    def left(self) -> float:
        """Seconds until the deadline."""
        return self.deadline - time.time()


@dataclasses.dataclass
class Outcome:
    """What a process did: runs finished and failed, and whether it stopped before the end."""

    finished: list[Run] = dataclasses.field(default_factory=list)
    failed: list[Run] = dataclasses.field(default_factory=list)
    stopped: bool = False


def work_on(runs: list[Run], work: Work) -> Outcome:
    """Train what is not done of these runs, program by program, until all are done or taken by others, the clock says
    stop, or a signal does. Raises `UserError` where the disk refuses."""
    outcome = Outcome()
    programs = programs_of(runs, work.goal_images)
    with stop_on_signal() as stop:
        # First whole programs that nobody has begun, then what others left of those that they have.
        for whole in (True, False):
            for program in programs:
                outcome.stopped |= stop.requested or work.left() < BEGINNING
                if outcome.stopped:
                    break
                with contextlib.ExitStack() as claims:
                    mine = claim(program, work, claims, whole)
                    if mine:
                        train_program(program._replace(runs=tuple(mine)), runs, work, stop, outcome)
    progress.write(work.folder, runs, at_once=True)
    return outcome


def to_do(run: Run, work: Work) -> bool:
    """Whether a run is to be trained: it is not done, or its file is damaged or of other settings."""
    status, why = files.status_of(work.folder, run, config_of(run, work.goal_images))
    if status in ("damaged", "other settings"):
        work.say(f"{run.name}: {status}, is made again ({why})")
    return status in ("left", "damaged", "other settings") or (status == "failed" and work.retry)


def claim(program: Program, work: Work, claims: contextlib.ExitStack, whole: bool) -> list[Run]:
    """The runs of a program that this process may train: to be done, and locked by it until `claims` is closed. whole:
    none of a program that another process has begun."""
    mine = []
    for run in program.runs:
        if not to_do(run, work):
            continue
        path = files.path_of(work.folder, run, "lock")
        disk.make_folder(path.parent)
        with contextlib.ExitStack() as one:
            try:
                one.enter_context(locked(path, path.parent))
            except BeingWrittenError:
                if whole and not mine:
                    return []
                continue
            if to_do(run, work):  # Another process may have finished it between the two looks.
                mine.append(run)
                claims.enter_context(one.pop_all())
    return mine


def train_program(program: Program, all_runs: list[Run], work: Work, stop: StopRequest, outcome: Outcome) -> None:
    """Train the runs of a program, and keep or report each."""
    work.say(f"{program.name}: {len(program.runs)} runs")
    try:
        batches = lanes.batches_of(list(program.runs), work.goal_images, work.most_lanes)
    except Exception as error:
        report_failure(list(program.runs), error, work, outcome)
        return
    for batch in batches:
        if stop.requested or work.left() < BEGINNING:
            outcome.stopped = True
            return
        try:
            train_batch(batch, all_runs, work, stop, outcome)
        except Exception as error:
            report_failure([run for run in batch.runs.values() if run not in outcome.finished], error, work, outcome)


def report_failure(runs: list[Run], error: Exception, work: Work, outcome: Outcome) -> None:
    """Write why these runs failed; the others go on."""
    why, trace = f"{type(error).__name__}: {error}", traceback.format_exc()
    for run in runs:
        files.write_failure(work.folder, run, why[:2000], trace[-20_000:])
        outcome.failed.append(run)
    work.say(f"failed: {', '.join(run.name for run in runs)}: {why[:500]}")


def checkpoint_of(folder: Path, batch: lanes.Batch) -> Path:
    """The file in which a batch that was stopped is kept."""
    names = "\n".join(sorted(run.name for run in batch.runs.values()))
    return folder / UNFINISHED / hashlib.sha256(names.encode()).hexdigest()[:16]


def train_batch(batch: lanes.Batch, all_runs: list[Run], work: Work, stop: StopRequest, outcome: Outcome) -> None:
    """Train a batch until each of its runs has levelled off, or the ceiling, and write their files; or until the clock
    or a signal says stop, and write a checkpoint."""
    training, path = lanes.begin(batch), checkpoint_of(work.folder, batch)
    resumed = lanes.resume(path, training)
    name = f"{batch.config.task} {next(iter(batch.runs.values())).label}"
    count = len(batch.envs) * len(batch.lanes)
    work.say(
        f"{name}: {count} lanes compiled in {training.compile_seconds:.0f} s"
        + (f", goes on after evaluation {training.evaluations}" if resumed else "")
    )
    size = bytes_of(training.states)
    stop.finishing = "this chunk of epochs, with a checkpoint"
    try:
        while not is_finished(training):
            if stop.requested or work.left() < 1.2 * training.last_seconds + 5 + size / BYTES_A_SECOND:
                disk.make_folder(path.parent)
                lanes.save(path, training)
                work.say(f"{name}: stopped after evaluation {training.evaluations}; a checkpoint is kept")
                outcome.stopped = True
                return
            lanes.go_on(training)
            for run in batch.runs.values():
                progress.note(work.folder, run, training.evaluations, training.last_seconds)
            progress.write(work.folder, all_runs)
            shown = {run.name: mean_success(training, run) for run in batch.runs.values()}
            rate = count * batch.config.epochs_per_evaluation * batch.config.updates_per_epoch / training.last_seconds
            work.say(f"{name}: evaluation {training.evaluations}, {rate:,.0f} updates/s; training, test goals:")
            for each, (train, test) in shown.items():
                work.say(f"    {each.split('/', 1)[1]}: {train:.2f}, {test:.2f}")
        for run in batch.places:
            files.save(work.folder, result_of(training, run, work, Extras(why="no time was left to measure it")))
            files.path_of(work.folder, run, "failed.json").unlink(missing_ok=True)
            progress.forget(work.folder, run)
            outcome.finished.append(run)
        path.unlink(missing_ok=True)
        measured: dict[Run, Extras] = {}
        for pictures in (False, True):
            for run in batch.places:
                if (not pictures or measure.is_pictured(run)) and not stop.requested and work.left() > MEASURING:
                    measured[run] = extras(training, run, work, measured.get(run, Extras()), pictures)
                    files.save(work.folder, result_of(training, run, work, measured[run]))
        seconds = training.compile_seconds + training.run_seconds
        progress.keep_times(work.folder, batch.config.task, len(batch.runs), seconds)
    finally:
        stop.finishing = ""
    progress.write(work.folder, all_runs)


def curve_of(training: lanes.Training, run: Run, metric: str) -> np.ndarray:
    """A metric of a run so far, [seeds, evaluations, ...]."""
    place, which = training.batch.places[run]
    return np.stack([values[place, which] for values in training.history[metric]], 1)


def mean_success(training: lanes.Training, run: Run) -> tuple[float, float]:
    """Success on training and test goals at the last evaluation, mean over seeds."""
    return tuple(
        float(curve_of(training, run, f"{group}_goal/success_rate")[:, -1].mean()) for group in ("train", "test")
    )


def is_finished(training: lanes.Training) -> bool:
    """Whether every run of the batch has levelled off, or the ceiling is reached."""
    if not training.evaluations:
        return False
    if training.evaluations >= budget.budget_of(training.batch.config.task, is_toy(training)).evaluations:
        return True
    curves = (curve_of(training, run, "train_goal/success_rate") for run in training.batch.runs.values())
    return all(budget.levelled(curve) is not None for curve in curves)


def is_toy(training: lanes.Training) -> bool:
    """Whether the batch is at a size at which nothing is learned."""
    return next(iter(training.batch.runs.values())).toy


class Extras(NamedTuple):
    """What is measured of a run when its training has ended. share: of the learner's loss in the gradient, of the first
    seed, None where it has none; arrays: of its pictures; why: they could not be had; seconds: that it took."""

    share: float | None = None
    arrays: dict[str, np.ndarray] = {}  # noqa: RUF012 (never written to)
    why: str = ""
    seconds: float = 0.0


def result_of(training: lanes.Training, run: Run, work: Work, measured: Extras) -> Result:
    """What a run of a finished batch came to."""
    batch, (place, which) = training.batch, training.batch.places[run]
    env = training.env_of(place)
    evaluations = {
        name: curve_of(training, run, name).astype(float) for name in training.history if name != "first_reached"
    }
    about = {
        "config": files.recorded_config(config_of(run, work.goal_images)),
        "data": env.source,
        "versions": describe(batch.config, env, [0]).versions,
        "machine": describe_machine(),
        "updates": batch.config.epochs_per_evaluation * batch.config.updates_per_epoch,
        "diverged": [seed for seed, good in zip(run.seeds, training.finite[place, which], strict=True) if not good],
        "learner": training.train.parts.name,
        "learner_share": measured.share,
        "measuring_failed": measured.why,
        "episode_length": env.episode_length,
        "program": {
            "runs": sorted(each.name for each in batch.runs.values()),
            "lanes": len(batch.envs) * len(batch.lanes),
            "compile_seconds": round(training.compile_seconds, 1),
            "run_seconds": round(training.run_seconds, 1),
        },
        "measure_seconds": round(measured.seconds, 1),
        "command": shlex.join(command_of(run)),
    }
    first = curve_of(training, run, "first_reached")
    masks = [np.asarray(mask)[np.asarray(env.goals.evaluated)] for mask in masks_of(env)]
    arrays = {
        "first_reached": first.astype(np.min_scalar_type(int(first.max()))),
        "uses": np.select(masks, [0, 1, 2]).astype(np.int8),
    }
    return Result(run, about, evaluations, arrays | measured.arrays)


def masks_of(env: Any) -> tuple:
    """Training, validation and test goals."""
    return env.goals.train_mask, env.goals.validation_mask, env.goals.test_mask


def extras(training: lanes.Training, run: Run, work: Work, before: Extras, pictures: bool) -> Extras:
    """Measure the share of a run, or make its pictures. What fails costs a figure, or a mark in a table, and not the
    run."""
    started = time.perf_counter()
    place, which = training.batch.places[run]
    state, hyper = jax.tree.map(lambda leaf: leaf[place, which.start], (training.states, training.hyper))
    env, share, arrays, why = training.env_of(place), before.share, before.arrays, before.why
    try:
        if pictures:
            config = config_of(run, work.goal_images)
            subject = measure.subject_of(training.train, config, env, state.params, run.seeds[0])
            arrays = measure.pictures(subject)
        elif training.share is not None:
            last = training.evaluations * training.batch.config.epochs_per_evaluation - 1
            share = float(training.share(state, last, hyper, env))
    except Exception as error:
        work.say(f"{run.name}: measuring failed, its numbers are kept: {traceback.format_exc()}")
        why = f"{type(error).__name__}: {error}"[:500]
    return Extras(share, arrays, why, before.seconds + time.perf_counter() - started)
