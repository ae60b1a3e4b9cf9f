"""The work on a folder: take what nobody else is training, train it, keep what is finished, and stop by the clock.

Any number of processes, on any machines that see the folder, may work on it. A run is taken by the lock of its file,
which goes with the process, however it ends.
"""

import contextlib
import dataclasses
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from infogoal_jax.errors import UserError
from infogoal_jax.runner.compilation import compiling_quickly
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
BEGINNING, MEASURING = 45.0, 60.0
"""Seconds that have to be left for a new program to be compiled, and for a run to be measured."""
KEEPING = 600.0
"""Seconds after which an evaluation is followed by a checkpoint, for a process that is killed outright; more where
writing takes long."""


@dataclasses.dataclass
class Work:
    """What a process does. folder: of the reproduction; deadline: seconds of `time.time()` at which it has to have
    stopped; retry: whether runs that failed, or could not be measured, are run again; goal_images: folder of further
    goal sets of Fetch; most_lanes: side by side in one program; say: what prints a line."""

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


@dataclasses.dataclass
class Outcome:
    """What a process did: runs finished and failed, and whether it stopped before the end."""

    finished: list[Run] = dataclasses.field(default_factory=list)
    failed: list[Run] = dataclasses.field(default_factory=list)
    stopped: bool = False


def work_on(runs: list[Run], work: Work) -> Outcome:
    """Train what is not done of these runs, program by program, until all are done or taken by others, the clock says
    stop, or a signal does. Raises `UserError` where the disk refuses."""
    outcome, tried = Outcome(), set[Run]()
    checkpoints.tidy(work.folder, runs)
    programs = programs_of(runs, work.goal_images)
    with stop_on_signal() as stop:
        # First whole programs that nobody has begun, then what others left of those that they have.
        for whole in (True, False):
            for program in programs:
                outcome.stopped |= stop.requested or work.left() < BEGINNING
                if outcome.stopped:
                    break
                with contextlib.ExitStack() as claims:
                    untried = program._replace(runs=tuple(run for run in program.runs if run not in tried))
                    mine = claim(untried, work, claims, whole)
                    tried.update(mine)  # What fails here is not begun again before the next start.
                    if mine:
                        with compiling_quickly(mine[0].toy):
                            train_program(program._replace(runs=tuple(mine)), runs, work, stop, outcome)
    checkpoints.tidy(work.folder, runs)
    progress.write(work.folder, runs, at_once=True)
    return outcome


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


def train_program(program: Program, all_runs: list[Run], work: Work, stop: StopRequest, outcome: Outcome) -> None:
    """Train the runs of a program, and keep or report each."""
    work.say(f"{program.name}: {len(program.runs)} runs")
    for runs in checkpoints.apart(work.folder, program.runs):
        try:
            found = batches.batches_of(runs, work.goal_images, work.most_lanes)
        except Exception as error:
            report_failure(runs, error, work, outcome)
            continue
        for batch in found:
            outcome.stopped |= stop.requested or work.left() < BEGINNING
            if outcome.stopped:
                return
            try:
                train_batch(batch, all_runs, work, stop, outcome)
            except Exception as error:
                report_failure(list(batch.runs.values()), error, work, outcome)


def report_failure(runs: list[Run], error: Exception, work: Work, outcome: Outcome) -> None:
    """Write why these runs failed, but for those that are trained; the others go on."""
    why, trace = f"{type(error).__name__}: {error}", traceback.format_exc()
    trained = ("done", "not measured")
    for run in runs:
        if files.status_of(work.folder, run, config_of(run, work.goal_images))[0] not in trained:
            files.write_failure(work.folder, run, why[:2000], trace[-20_000:])
            outcome.failed.append(run)
    work.say(f"failed: {', '.join(run.name for run in runs)}: {why[:500]}")


def train_batch(batch: batches.Batch, all_runs: list[Run], work: Work, stop: StopRequest, outcome: Outcome) -> None:
    """Train a batch until each of its runs has levelled off, or the ceiling, and write and measure each as soon as it
    has; or until the clock or a signal says stop, and keep a checkpoint."""
    training = batches.begin(batch)
    kept = BatchFiles(training, all_runs, work, stop, outcome)
    if checkpoints.resume(work.folder, training):
        work.say(f"{kept.name}: goes on after evaluation {training.evaluations}")
        kept.keeping.evaluations = training.evaluations
    train_sweep(training.sweep, kept, stop)
    if not outcome.stopped:
        checkpoints.delete_measured(work.folder, batch.places)
    progress.write(work.folder, all_runs)


class BatchFiles(Callback):
    """What is kept of a batch: a file of each run as soon as it has levelled off, and a checkpoint of the others."""

    def __init__(
        self, training: batches.Training, all_runs: list[Run], work: Work, stop: StopRequest, outcome: Outcome
    ):
        self.training, self.all_runs, self.work, self.stop, self.outcome = training, all_runs, work, stop, outcome
        self.keeping, self.ended = Keeping(work, training.evaluations), set[Run]()
        self.name = f"{training.batch.config.task} {next(iter(training.batch.runs.values())).label}"

    def going_on(self, sweep: Sweep) -> Sweep | None:
        """Write the runs that are trained to their end, and go on with the others."""
        training = self.training
        now = [run for run in finishing.ended(training) if run not in self.ended]
        end(now, training, self.keeping, self.stop, self.outcome)
        self.ended.update(now)
        if self.ended.issuperset(training.batch.runs.values()) or self.outcome.stopped:
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
        self.outcome.stopped = True

    def evaluated(self, sweep: Sweep) -> None:
        """Keep the numbers, and show them."""
        training = self.training
        training.note()
        say_how_far(self.name, training, self.work)
        for run in set(training.batch.runs.values()) - self.ended:
            progress.note(self.work.folder, run, training.evaluations, sweep.last_seconds)
        progress.write(self.work.folder, self.all_runs)


def end(runs: list[Run], training: batches.Training, keeping: Keeping, stop: StopRequest, outcome: Outcome) -> None:
    """Write and measure the runs of a batch that are trained to their end."""
    new = [run for run in runs if run.name not in training.costs]
    if new:
        seconds = finishing.share_out(training, new)
        progress.keep_times(keeping.work.folder, training.batch.config.task, len(new), seconds)
    if any(Extras().missing(run) for run in new):  # Until all is measured, however this process ends.
        keeping.keep(training)
    finish(runs, training, keeping.work, stop, outcome)


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


def finish(runs: list[Run], training: batches.Training, work: Work, stop: StopRequest, outcome: Outcome) -> None:
    """Write the files of trained runs of a batch, then measure what is missing of them, as long as there is time."""

    def keep(run: Run) -> None:
        config = config_of(run, work.goal_images)
        files.save(work.folder, finishing.result_of(training, run, config, measured[run]))

    measured = {run: finishing.known_of(work.folder, training, run) for run in runs}
    for run in measured:
        keep(run)
        files.path_of(work.folder, run, "failed.json").unlink(missing_ok=True)
        progress.forget(work.folder, run)
        outcome.finished.append(run)
    for name in finishing.MEASURES:
        for run, before in measured.items():
            if name not in before.missing(run):
                continue
            if stop.requested or work.left() < MEASURING:
                outcome.stopped = True
                return
            config = config_of(run, work.goal_images)
            measured[run], trace = finishing.measured_also(name, training, run, config, before)
            if trace:
                work.say(f"{run.name}: measuring failed, its numbers are kept: {trace}")
            keep(run)
