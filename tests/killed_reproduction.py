"""Reproductions of a few runs with a small program, in this process or in processes of their own, to be killed."""

import contextlib
import dataclasses
import functools
import math
import multiprocessing
import os
import time
from pathlib import Path
from unittest import mock

import hand_made
import jax.numpy as jnp
from killed_run import small_train

from infogoal_jax.runner import sweep
from infogoal_paper import batches, files, finishing, plan, work
from infogoal_paper.manifest import Run, Setting
from infogoal_paper.work import Outcome, Work, work_on

SEEDS = 0, 1
SETTINGS = Setting("preset", ()), Setting("short sight", (("discount", 0.5),))
FEW = 20_000
"""Weights of the small program."""
LOG = "log"
SLOW = "slow"
"""A file beside it: where it is, an evaluation takes a second, and no second one comes before two workers had one."""


def runs(count: int = 3) -> list[Run]:
    """So many programs of two settings: object search on as many houses, which are no settings of one program."""
    return [
        Run("object_search", "none", None, None, number, setting, SEEDS, True)
        for number in range(count)
        for setting in SETTINGS
    ]


@functools.cache
def config_of(run: Run, goal_images: Path | None = None):
    """The hand-made task, of another episode length on each goal set, so that each has a program of its own."""
    hyper = dict(run.setting.values)
    config = hand_made.config("none", num_epochs=12, epochs_per_evaluation=2, updates_per_epoch=1 + run.goal_set)
    return dataclasses.replace(config, hyper=config.hyper.replace(**hyper))


environment = functools.cache(hand_made.environment)


def counted_train(config, env=None):
    """Training whose program compiles in a moment, with what an evaluation of a task says."""
    train = small_train(config, env, size=FEW)

    def evaluation(state, hyper, env):
        first = jnp.ones((len(train.env.goals.evaluated), 1), jnp.int32)
        return train.evaluation(state, hyper, env) | {"first_reached": first}

    return dataclasses.replace(train, evaluation=evaluation)


@contextlib.contextmanager
def small_programs(folder: Path, judge=None, keeping: float = work.KEEPING):
    """Inside, runs are small, and FOLDER/log names every run that was begun, every evaluation and every run that was
    finished. judge: what is measured of the codes of a run, as `finishing.codes_of`; None: nothing is wanted; keeping:
    seconds from one checkpoint to the next, 0: one after each evaluation."""

    def logged(words: str) -> None:
        with open(folder / LOG, "a") as file:
            file.write(f"{words} {os.getpid()}\n")

    def begin(batch):
        for run in batch.runs.values():
            logged(f"begun {run.name}")
        return whole_begin(batch)

    def advance(members):
        if (folder / SLOW).exists():
            while {str(os.getpid())} == {line.split()[2] for line in lines_of(folder, "evaluated")}:
                time.sleep(0.02)
            time.sleep(1)
        whole_advance(members)
        logged("evaluated program")

    def save(folder, result):
        new = not files.path_of(folder, result.run).exists()
        whole_save(folder, result)
        if new:  # It is written again when it has been measured.
            logged(f"finished {result.run.name}")

    whole_begin, whole_advance, whole_save = batches.begin, sweep.advance, files.save
    with contextlib.ExitStack() as patches:
        for module in (plan, batches, work):
            patches.enter_context(mock.patch.object(module, "config_of", config_of))
        for module, name, value in (
            (batches, "make_train", counted_train),
            (batches, "load_environment", lambda config: environment()),
            (batches, "build_data", lambda run: None),
            (batches, "begin", begin),
            (sweep, "advance", advance),
            (files, "save", save),
            (plan, "is_pictured", lambda run: False),
            (plan, "is_judged", lambda run: judge is not None),
            (finishing, "MEASURES", {"codes": judge}),
            (work, "KEEPING", keeping),
            (work, "BYTES_A_SECOND", work.BYTES_A_SECOND if keeping else math.inf),
        ):
            patches.enter_context(mock.patch.object(module, name, value))
        yield


def reproduce(
    folder: Path, wanted: int | list[Run] = 3, judge=None, keeping: float = work.KEEPING, **settings
) -> Outcome:
    """Train what is left of these runs, in this process. wanted: the runs, or how many programs of them; judge,
    keeping: see `small_programs`."""
    folder.mkdir(parents=True, exist_ok=True)
    with small_programs(folder, judge, keeping):
        wanted = runs(wanted) if isinstance(wanted, int) else wanted
        return work_on(wanted, Work(folder, **({"say": lambda words: None} | settings)))


def go_on(training: batches.Training) -> None:
    """Train a batch until its next evaluation."""
    if training.sweep.chunk is None:
        sweep.prepare(training.sweep)
    sweep.advance(training.sweep)
    training.note()


for_good = contextlib.ExitStack()


def prepare_worker() -> None:
    """Let all runs of this process be small, a worker of a cluster; FOLDER is in its environment."""
    for_good.enter_context(small_programs(Path(os.environ["LOG_IN"])))


def lines_of(folder: Path, what: str) -> list[str]:
    """Lines of the log that tell what was `begun`, `evaluated` or `finished`: that word, its name, the process."""
    lines = (folder / LOG).read_text().splitlines() if (folder / LOG).exists() else []
    return [line for line in lines if line.startswith(what)]


def log_of(folder: Path, what: str) -> list[str]:
    """Names of the runs that were `begun` or `finished`, in order."""
    return [line.split()[1] for line in lines_of(folder, what)]


def child(folder: str, count: int) -> None:
    """What a process does: exit status 0 when nothing is left for it."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        outcome = reproduce(Path(folder), count, keeping=0.0)
        os._exit(3 if outcome.stopped else 1 if outcome.failed else 0)


def start(folder: Path, count: int = 3) -> multiprocessing.Process:
    """A process that works on this folder; one that has everything imported forks it."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["killed_reproduction"])
    process = context.Process(target=child, args=(str(folder), count))
    process.start()
    return process
