"""A run: all seeds of one configuration, in a folder with tables, a checkpoint and the policy."""

import contextlib
import dataclasses
import math
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import infogoal_jax
from infogoal_jax import checks, hyperparameters
from infogoal_jax.config import TrainConfig
from infogoal_jax.envs.environment import data_of
from infogoal_jax.errors import require
from infogoal_jax.imports import checksums, typed_command
from infogoal_jax.loading import make_train
from infogoal_jax.runner import distributed
from infogoal_jax.runner.sweep import Callback, Member, Programs, Sweep, side_by_side, train_sweep
from infogoal_jax.runs import checkpoint, configuration, tables
from infogoal_jax.runs.checkpoint import BEGINNING, Point, last_point
from infogoal_jax.runs.configuration import Description
from infogoal_jax.runs.folder import RUN, check_new, only_writer
from infogoal_jax.runs.tables import Timing
from infogoal_jax.stopping import Stopped, StopRequest, stop_on_signal
from infogoal_jax.train.contracts import check_is_environment
from infogoal_jax.train.program import Train


@dataclasses.dataclass
class Progress:
    """What the loop tells its listeners after each chunk: numbers of this run, and the tables' new rows."""

    epoch: int
    num_epochs: int
    compile_seconds: float
    run_seconds: float
    env_steps_per_second: float
    updates_per_second: float
    epochs: list[dict]
    evaluations: list[dict]


Listener = Callable[[Progress], None]
Phase = Callable[[str, int], None]
"""Told the name of the phase that begins and how many epochs are done: loading, tracing, compiling, training."""


@dataclasses.dataclass
class RunResult:
    """A finished or stopped run.

    params: of all seeds, [seeds, ...].
    diverged: seeds whose metrics stopped being finite, with the first such epoch.
    stopped: by a signal before the end.
    """

    folder: Path
    train: Train
    params: Any
    diverged: dict[int, int]
    stopped: bool


def describe(config: TrainConfig, env: Any, seeds: list[int]) -> Description:
    """What config.json says of a run with these seeds, which is to be found again from any folder."""
    versions = {
        "infogoal_jax": infogoal_jax.__version__,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }
    device = str(jax.devices()[0].device_kind)
    return Description(configuration.located(config), seeds, data_of(env), versions, device, imports=checksums())


def rows_of(epoch_numbers, seeds: list[int], metrics: dict[str, np.ndarray]) -> list[dict]:
    """Metrics {name: [seeds, epochs, ...]} as rows: seed and epoch first, then every name; arrays become lists."""
    names = sorted(metrics)
    return [
        {"seed": seed, "epoch": int(number)} | {name: metrics[name][i, j].tolist() for name in names}
        for j, number in enumerate(epoch_numbers)
        for i, seed in enumerate(seeds)
    ]


def checked_seeds(seeds: Sequence[int]) -> Sequence[int]:
    """The seeds, those of NumPy as numbers of Python. Raises `UserError` for what cannot be used. A range of them is
    not looked at one by one."""
    if not isinstance(seeds, range):
        try:
            given = np.asarray(seeds)
        except (TypeError, ValueError):  # Of several shapes.
            given = np.zeros(())
        masked = isinstance(seeds, np.ma.MaskedArray)
        whole = not masked and given.ndim == 1 and (given.size == 0 or np.issubdtype(given.dtype, np.integer))
        require(whole, "seeds", seeds, "give a list of whole numbers, such as range(3)")
        seeds = given.tolist()
        require(len(set(seeds)) == len(seeds), "seeds", seeds, "give different seeds")
    require(len(seeds) > 0, "seeds", len(seeds), "give at least 1")
    first, last = (seeds[0], seeds[-1]) if isinstance(seeds, range) else (min(seeds), max(seeds))
    require(
        first >= 0 and last < checks.MOST_SEEDS,
        "seeds",
        f"{first} to {last}",
        "give seeds from 0 to below 2^32 (--first-seed)",
    )
    return seeds


def check_run(config: Any, folder: Any, resume: Any, listeners: Any, env: Any, phase: Any, left: Any) -> None:
    """Raise `UserError` for arguments of `run` of other kinds than it declares, and for hyperparameters that are not
    one number each: seeds of a run share them."""
    require(isinstance(config, TrainConfig), "config", config, "give a TrainConfig, such as presets.load makes")
    for name, value, _ in hyperparameters.floats(config.hyper):
        several = isinstance(value, np.ndarray | jax.Array)
        require(not several, f"hyper.{name}", value, "give one number; for several see jax.vmap(train)")
    checks.path(folder, "folder", "give the folder of the run")
    checks.flag(resume, "resume")
    require(isinstance(listeners, tuple | list), "listeners", listeners, "give a tuple of functions of a Progress")
    for place, listener in enumerate(listeners):
        checks.function(listener, f"listeners[{place}]", 1, "give a function of a Progress")
    if env is not None:
        check_is_environment(env)
    checks.function(phase, "phase", 2, "give a function of a name and a number of epochs")
    checks.function(left, "left", 0, "give a function that returns seconds")


def run(
    config: TrainConfig,
    seeds: Sequence[int],
    folder: str | Path,
    resume: bool = False,
    listeners: tuple[Listener, ...] = (),
    env: Any = None,
    phase: Phase = lambda name, epoch: None,
    left: Callable[[], float] = lambda: math.inf,
    onward: str = "",
) -> RunResult:
    """Train these seeds in one program and leave the run in `folder`. With `resume`, go on from its last checkpoint, or
    from the beginning if it was stopped before there was one. Of several processes (`distributed.join`) each trains its
    own seeds, and the first alone writes and has listeners; to go on, all have to see the folder.

    phase: called when loading, tracing, compiling and training begin, with the epochs that are done; left: seconds
    until it has to have stopped; onward: the command that goes on with what this run is part of, to be named when it
    stops; empty: that of the run. Raises `UserError` before any compilation, and without a change on the disk, for a
    folder that holds another run or is being written, a damaged checkpoint, or one of another configuration. Raises
    `Stopped` if a signal asked for it before the first checkpoint.
    """
    check_run(config, folder, resume, listeners, env, phase, left)
    folder, seeds = Path(folder), checked_seeds(seeds)
    onward = checks.text(onward, "onward", "give a command") or typed_command("train", "--resume", folder)
    writes = distributed.is_writer()
    if writes and not resume:
        check_new(folder, RUN)
    with stop_on_signal() as stop, distributed.noted(stop):
        done = checkpoint.read_epoch(folder / "checkpoint") if resume else 0
        phase("loading", done)
        train = make_train(config, env)
        phase("tracing", done)
        programs = side_by_side(train, distributed.own_seeds(seeds))
        now = describe(config, train.env, list(seeds))
        if not resume:
            programs.check()  # So that a refusal leaves no folder behind.
        with only_writer(folder, new=() if resume else RUN) if writes else contextlib.nullcontext():
            point = last_point(folder, now, distributed.of_all(programs.states.shapes.state)) if resume else BEGINNING
            if resume:
                programs.check()
            distributed.any_process(False)  # Nobody changes what another one is still reading.
            if writes:
                for table, rows in point.rows.items():
                    tables.replace_table(folder, table, rows)
                if not resume or configuration.read(folder) != now:
                    configuration.write(folder, now)
            stop.advice = how_to_go_on(folder, point.epoch, onward)
            distributed.check(stop)
            files = RunFiles(folder, now, point.epoch, listeners, phase, left, stop, onward)
            return train_in(train, programs, point, files, stop)


def how_to_go_on(folder: Path, epoch: int, onward: str) -> str:
    """What is on disk after this epoch, in words, and the command that goes on with it."""
    there = f"{folder} has a checkpoint of epoch {epoch}" if epoch else f"{folder} has no checkpoint yet"
    return f"{there}; go on with: {onward}"


def train_in(train: Train, programs: Programs, point: Point, files: "RunFiles", stop: StopRequest) -> RunResult:
    """Train from this point to the end or until a signal comes."""
    now, folder = files.now, files.folder
    sweep = Sweep(now.config, programs, evaluations=point.epoch // now.config.epochs_per_evaluation)
    if point.states is not None:
        mine = jax.tree.map(lambda leaf: leaf[distributed.own_slice(len(now.seeds))], point.states)
        sweep.states = Member(mine, None)
    train_sweep(sweep, files, stop)
    if sweep.states is None:
        raise Stopped(stop.advice)
    params, diverged = jax.device_get(distributed.gathered(sweep.states.state.params)), {}
    if distributed.is_writer():
        files.save_policy(params)  # Again, if a kill came between the two files.
        diverged = tables.diverged_seeds(tables.read_table(folder, "epochs"))
    return RunResult(folder, train, params, diverged, stopped=not sweep.finished)


CHECKPOINT_FRACTION = 0.1
"""Of the time that passes, what goes into checkpoints at most: those of several seeds' replay buffers are gigabytes."""


class RunFiles(Callback):
    """The files of a run, its rows written after each chunk, and what is told to listeners."""

    def __init__(
        self,
        folder: Path,
        now: Description,
        epoch: int,
        listeners: tuple[Listener, ...],
        phase: Phase,
        left: Callable[[], float],
        stop: StopRequest,
        onward: str,
    ):
        self.folder, self.now, self.listeners, self.stop = folder, now, listeners, stop
        self.phase, self.left, self.onward = phase, left, onward
        self.epoch = self.first = self.saved = epoch
        self.steps_before = 0
        self.saved_at = self.save_seconds = 0.0

    def compiling(self, sweep: Sweep) -> None:
        self.phase("compiling", self.epoch)

    def has_time(self, sweep: Sweep) -> bool:
        """Whether the clock allows another chunk."""
        return self.left() >= 1.2 * sweep.last_seconds

    def compiled(self, sweep: Sweep) -> None:
        """Note how many steps earlier sessions took."""
        self.phase("training", self.epoch)
        self.saved_at = time.monotonic()
        self.steps_before = int(np.sum(distributed.gathered(jax.device_get(sweep.states.state.env_steps))))

    def evaluated(self, sweep: Sweep) -> None:
        """Write the rows of the chunk, then the checkpoint and the policy if they are due, and tell the listeners."""
        config, seeds, before = self.now.config, self.now.seeds, self.epoch
        self.epoch = sweep.evaluations * config.epochs_per_evaluation
        epochs = rows_of(range(before + 1, self.epoch + 1), seeds, sweep.learned)
        evaluations = rows_of([self.epoch], seeds, {name: value[:, None] for name, value in sweep.scored.items()})
        timing = Timing(
            compile_seconds=sweep.prepare_seconds,
            run_seconds=sweep.run_seconds,
            env_steps_per_second=(int(sweep.scored["env_steps"].sum()) - self.steps_before) / sweep.run_seconds,
            updates_per_second=(self.epoch - self.first) * config.updates_per_epoch * len(seeds) / sweep.run_seconds,
        )
        if distributed.is_writer():
            tables.append_rows(self.folder, "epochs", epochs)
            tables.append_rows(self.folder, "evaluations", evaluations)
            tables.write_timing(self.folder, timing)
        if distributed.any_process(sweep.finished or self.is_due()):
            self.save(sweep)
        if not distributed.is_writer():
            return
        progress = Progress(
            self.epoch, config.num_epochs, epochs=epochs, evaluations=evaluations, **dataclasses.asdict(timing)
        )
        for listener in self.listeners:
            listener(progress)

    def stopped(self, sweep: Sweep) -> None:
        """Write what was not due after the last chunk."""
        if self.saved < self.epoch:
            self.save(sweep)

    def is_due(self) -> bool:
        """Whether this process writes, and writing takes a second at most or little of the time since it was last done;
        the first chunk tells how long it takes."""
        passed = time.monotonic() - self.saved_at
        return distributed.is_writer() and self.save_seconds < max(1.0, CHECKPOINT_FRACTION * passed)

    def save(self, sweep: Sweep) -> None:
        """Write the checkpoint, then the policy."""
        began = time.monotonic()
        states = distributed.gathered_by_writer(sweep.states.state)
        self.saved = self.epoch
        if not distributed.is_writer():
            return
        checkpoint.save(self.folder / "checkpoint", {"epoch": self.epoch, **self.now.values()}, states)
        self.save_policy(states.params)
        self.stop.advice = how_to_go_on(self.folder, self.epoch, self.onward)
        self.saved_at = time.monotonic()
        self.save_seconds = self.saved_at - began

    def save_policy(self, params: Any) -> None:
        """Write the parameters of all seeds."""
        checkpoint.save(self.folder / "policy", {"epoch": self.epoch, **self.now.values()}, params)
