"""The work on a folder: take what nobody else is training, train it, keep what is finished, and stop by the clock.

Any number of processes, on any machines that see the folder, may work on it. A run is taken by the lock of its file,
which goes with the process, however it ends.
"""

import contextlib
import dataclasses
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path

from infogoal_jax.errors import UserError
from infogoal_jax.runner.compilation import compiling_quickly
from infogoal_jax.runner.executors import BEGINNING, Outcome, Place, run_here
from infogoal_jax.runner.memory import bytes_of
from infogoal_jax.runner.sweep import Callback, Sweep, train_sweep
from infogoal_jax.runs import disk
from infogoal_jax.runs.folder import BeingWrittenError, locked
from infogoal_jax.stopping import StopRequest, stop_on_signal
from infogoal_paper import batches, checkpoints, files, finishing, plan, progress
from infogoal_paper.finishing import Extras
from infogoal_paper.manifest import Run
from infogoal_paper.plan import Program, config_of, programs_of

BYTES_A_SECOND = 2e8
"""At which a checkpoint is written, roughly, so that the clock can be kept."""
MEASURING = 60.0
"""Seconds that have to be left for a run to be measured."""
KEEPING = 600.0
"""Seconds after which an evaluation is followed by a checkpoint, for a process that is killed outright; more where
writing takes long."""


@dataclasses.dataclass
class Work(Place):
    """What a process does, beside where and until when.

    retry: whether runs that failed, or could not be measured, are run again.
    goal_images: folder of further goal sets of Fetch.
    most_members: side by side in one program.
    """

    retry: bool = False
    goal_images: Path | None = None
    most_members: int = 64


@dataclasses.dataclass
class Keeping:
    """The checkpoint of a batch while it is trained. evaluations: after how many it was written; when: seconds of
    `time.time()` at which this was tried last, or training began."""

    work: Work
    evaluations: int
    when: float = dataclasses.field(default_factory=time.time)

    def is_behind(self, training: batches.Training) -> bool:
        """Whether there were evaluations since it was written."""
        return training.evaluations > self.evaluations

    def keep(self, training: batches.Training) -> None:
        """Write it. Raises `UserError` if the disk refuses."""
        checkpoints.save(checkpoints.path_of(self.work.folder, training.batch), training)
        self.evaluations, self.when = training.evaluations, time.time()

    def keep_now_and_then(self, training: batches.Training) -> None:
        """Write it, if the last one is long ago. Training can do without: where the disk refuses, that is said."""
        passed = time.time() - self.when
        if not self.is_behind(training) or passed <= max(KEEPING, 20 * writing_seconds(training)):
            return
        self.when = time.time()
        try:
            self.keep(training)
        except UserError as error:
            self.work.say(f"no checkpoint is written for now: {error}")


def writing_seconds(training: batches.Training) -> float:
    """Roughly how long a checkpoint of a batch takes."""
    return bytes_of(training.shapes) / BYTES_A_SECOND


@dataclasses.dataclass(frozen=True)
class ProgramJob:
    """The runs of a program, to be trained.

    every: all runs of the reproduction, which its page shows.
    retry, goal_images, most_members: as in `Work`.
    """

    program: Program
    every: tuple[Run, ...]
    retry: bool
    goal_images: Path | None
    most_members: int

    @property
    def name(self) -> str:
        """The task and the method."""
        return self.program.name

    @property
    def members(self) -> tuple[Run, ...]:
        """Its runs."""
        return self.program.runs

    def of(self, runs: Iterable[Run]) -> "ProgramJob":
        """The job of these of its runs."""
        return dataclasses.replace(self, program=self.program._replace(runs=tuple(runs)))

    def work_at(self, place: Place) -> Work:
        """The work on its runs at this place."""
        return Work(
            **vars(place) | {"retry": self.retry, "goal_images": self.goal_images, "most_members": self.most_members}
        )

    def without(self, members: set[Run]) -> "ProgramJob":
        """The job without some of its runs."""
        return self.of(run for run in self.members if run not in members)

    def claim(self, place: Place, claims: contextlib.ExitStack, whole: bool) -> "ProgramJob | None":
        """The part that this process may train: to be done, and locked by it until `claims` is closed."""
        mine = claim(self.program, self.work_at(place), claims, whole)
        return self.of(mine) if mine else None

    def files(self, folder: Path) -> list[Path]:
        """What there is of its runs, which are not done: files of some, and checkpoints of what was stopped."""
        names = {run.name for run in self.members}
        there = [files.path_of(folder, run, kind) for run in self.members for kind in ("npz", "failed.json")]
        kept = [path for path, own in checkpoints.kept(folder).items() if names & own]
        return [path for path in (*there, *kept) if path.exists()]

    def train(self, place: Place) -> None:
        """Train the runs until each is done or failed, or the clock or a signal says stop."""
        for run in self.members:
            disk.make_folder(files.path_of(place.folder, run).parent)
        with compiling_quickly(self.members[0].toy), stop_on_signal() as stop:
            train_program(self.program, self.every, self.work_at(place), stop)

    def fail(self, place: Place, error: Exception) -> None:
        """Write why its runs failed, but for those that are trained."""
        work = self.work_at(place)
        report_failure([run for run in self.members if to_do(run, work)], error, work)

    def outcome(self, folder: Path) -> Outcome:
        """Which of its runs are finished, but for measures that the clock left no time for, and which failed."""
        found = Outcome()
        for run in self.members:
            status, why = files.status_of(folder, run, config_of(run, self.goal_images))
            if status == "failed":
                found.failed.append(run)
            elif status in TRAINED and why != plan.NO_TIME:
                found.finished.append(run)
        return found

    def tidy(self, folder: Path) -> None:
        """Delete checkpoints of what is measured, and failures of what was finished after all."""
        checkpoints.delete_measured(folder, self.members)
        progress.write(folder, list(self.every))


TRAINED = ("done", "not measured")
"""States of runs that are trained to their end."""


def jobs_of(runs: list[Run], work: Work) -> list[ProgramJob]:
    """These runs as jobs, one for each program."""
    settings = work.retry, work.goal_images, work.most_members
    return [ProgramJob(program, tuple(runs), *settings) for program in programs_of(runs, work.goal_images)]


def work_on(runs: list[Run], work: Work, execute: Callable[..., Outcome] = run_here) -> Outcome:
    """Train what is not done of these runs, program by program. execute: (jobs, place) -> outcome, an executor. Raises
    `UserError` where the disk refuses."""
    checkpoints.tidy(work.folder, runs)
    try:
        return execute(jobs_of(runs, work), work)
    finally:
        checkpoints.tidy(work.folder, runs)
        progress.write(work.folder, runs, at_once=True)


def to_do(run: Run, work: Work) -> bool:
    """Whether there is something to do for a run: it is not done, or its file is damaged or of other settings, or it is
    not measured and its checkpoint is there."""
    status, why = files.status_of(work.folder, run, config_of(run, work.goal_images))
    if status in ("damaged", "other settings"):
        work.say(f"{run.name}: {status}, is made again ({why})")
    if status == "not measured":
        return work.retry or (why == plan.NO_TIME and checkpoints.has(work.folder, run))
    return status in ("left", "damaged", "other settings") or (status == "failed" and work.retry)


def claim(program: Program, work: Work, claims: contextlib.ExitStack, whole: bool) -> list[Run]:
    """The runs of a program that this process may train: to be done, and locked by it until `claims` is closed. whole:
    none of a program that another process has begun."""
    mine = []
    for run in program.runs:
        path = files.path_of(work.folder, run, "lock")
        if not (to_do(run, work) or path.exists()):  # One that was killed leaves its lock, beside a finished run too.
            continue
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


def train_program(program: Program, all_runs: Iterable[Run], work: Work, stop: StopRequest) -> None:
    """Train the runs of a program, and keep or report each."""
    for runs in checkpoints.apart(work.folder, program.runs):
        try:
            found = batches.batches_of(runs, work.goal_images, work.most_members)
        except Exception as error:
            report_failure(runs, error, work)
            continue
        for batch in found:
            if stop.requested or work.left() < BEGINNING:
                return
            try:
                if train_batch(batch, list(all_runs), work, stop):
                    return
            except Exception as error:
                report_failure(list(batch.runs.values()), error, work)


def report_failure(runs: list[Run], error: Exception, work: Work) -> None:
    """Write why these runs failed, but for those that are trained; the others go on."""
    why = f"{type(error).__name__}: {error}"
    trace = "".join(traceback.format_exception(error))
    for run in runs:
        if files.status_of(work.folder, run, config_of(run, work.goal_images))[0] not in TRAINED:
            files.write_failure(work.folder, run, why[:2000], trace[-20_000:])
    work.say(f"failed: {', '.join(run.name for run in runs)}: {why[:500]}")


def train_batch(batch: batches.Batch, all_runs: list[Run], work: Work, stop: StopRequest) -> bool:
    """Train a batch until each of its runs has levelled off, or the ceiling, and write and measure each as soon as it
    has; or until the clock or a signal says stop, and keep a checkpoint. Returns whether it stopped."""
    for run in batch.runs.values():
        files.path_of(work.folder, run, "failed.json").unlink(missing_ok=True)  # It is tried anew.
    training = batches.begin(batch)
    kept = BatchFiles(training, all_runs, work, stop)
    if checkpoints.resume(work.folder, training):
        work.say(f"{kept.name}: goes on after evaluation {training.evaluations}")
        kept.keeping.evaluations = training.evaluations
    train_sweep(training.sweep, kept, stop)
    if not kept.is_stopped:
        checkpoints.delete_measured(work.folder, batch.places)
    progress.write(work.folder, all_runs)
    return kept.is_stopped


class BatchFiles(Callback):
    """What is kept of a batch: a file of each run as soon as it has levelled off, and a checkpoint of the others."""

    def __init__(self, training: batches.Training, all_runs: list[Run], work: Work, stop: StopRequest):
        self.training, self.all_runs, self.work, self.stop, self.is_stopped = training, all_runs, work, stop, False
        self.keeping, self.ended = Keeping(work, training.evaluations), set[Run]()
        self.name = f"{training.batch.config.task} {next(iter(training.batch.runs.values())).label}"

    def going_on(self, sweep: Sweep) -> Sweep | None:
        """Write the runs that are trained to their end, and go on with the others."""
        training = self.training
        now = [run for run in finishing.ended(training) if run not in self.ended]
        self.is_stopped = not end(now, training, self.keeping, self.stop)
        self.ended.update(now)
        if self.ended.issuperset(training.batch.runs.values()) or self.is_stopped:
            return None
        self.training = batches.without_ended(training, self.ended)
        if self.training.evaluations:
            self.keeping.keep_now_and_then(self.training)
        return self.training.sweep

    def compiled(self, sweep: Sweep) -> None:
        """Say how long it took."""
        training, seconds = self.training, sweep.prepare_seconds
        training.compile_seconds += seconds
        self.work.say(f"{self.name}: {training.finite.size} seeds and settings compiled in {seconds:.0f} s")

    def has_time(self, sweep: Sweep) -> bool:
        """Whether the clock allows another evaluation, with a checkpoint after it."""
        return self.work.left() >= 1.2 * sweep.last_seconds + 5 + writing_seconds(self.training)

    def stopped(self, sweep: Sweep) -> None:
        """Keep a checkpoint."""
        training = self.training
        if self.keeping.is_behind(training):
            self.keeping.keep(training)
        kept = f"after evaluation {training.evaluations}; a checkpoint is kept"
        self.work.say(f"{self.name}: stopped {kept if training.evaluations else 'before the first evaluation'}")
        self.is_stopped = True

    def evaluated(self, sweep: Sweep) -> None:
        """Keep the numbers, and show them."""
        training = self.training
        training.note()
        say_how_far(self.name, training, self.work)
        for run in set(training.batch.runs.values()) - self.ended:
            progress.note(self.work.folder, run, training.evaluations, sweep.last_seconds)
        progress.write(self.work.folder, self.all_runs)


def end(runs: list[Run], training: batches.Training, keeping: Keeping, stop: StopRequest) -> bool:
    """Write and measure the runs of a batch that are trained to their end. Returns whether there was time for all."""
    new = [run for run in runs if run.name not in training.costs]
    if new:
        seconds = finishing.share_out(training, new)
        progress.keep_times(keeping.work.folder, training.batch.config.task, len(new), seconds)
    if any(Extras().missing(run) for run in new):  # Until all is measured, however this process ends.
        keeping.keep(training)
    return finish(runs, training, keeping.work, stop)


def say_how_far(name: str, training: batches.Training, work: Work) -> None:
    """Say what the last evaluation gave."""
    batch = training.batch
    updates = training.finite.size * batch.config.epochs_per_evaluation * batch.config.updates_per_epoch
    rate = updates / training.sweep.last_seconds
    work.say(f"{name}: evaluation {training.evaluations}, {rate:,.0f} updates/s; training, test goals:")
    for run in batch.runs.values():
        if run.name in training.costs:
            continue
        train, test = finishing.mean_success(training, run)
        work.say(f"    {run.name.split('/', 1)[1]}: {train:.2f}, {test:.2f}")


def finish(runs: list[Run], training: batches.Training, work: Work, stop: StopRequest) -> bool:
    """Write the files of trained runs of a batch, then measure what is missing of them, as long as there is time.
    Returns whether there was."""

    def keep(run: Run) -> None:
        config = config_of(run, work.goal_images)
        files.save(work.folder, finishing.result_of(training, run, config, measured[run]))

    measured = {run: finishing.known_of(work.folder, training, run) for run in runs}
    for run in measured:
        keep(run)
        progress.forget(work.folder, run)
    for name in finishing.MEASURES:
        for run, before in measured.items():
            if name not in before.missing(run):
                continue
            if stop.requested or work.left() < MEASURING:
                return False
            config = config_of(run, work.goal_images)
            measured[run], trace = finishing.measured_also(name, training, run, config, before)
            if trace:
                work.say(f"{run.name}: measuring failed, its numbers are kept: {trace}")
            keep(run)
    return True
