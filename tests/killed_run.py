"""Runs of the hand-made task in processes of their own, to be killed. A run that is there goes on, and says what it is
doing at each moment."""

import contextlib
import dataclasses
import functools
import multiprocessing
import os
from collections.abc import Callable
from pathlib import Path

import flax.struct
import hand_made
import jax
import jax.numpy as jnp

from infogoal_jax import files
from infogoal_jax.errors import UserError
from infogoal_jax.hyperparameters import values_of
from infogoal_jax.loading import make_train
from infogoal_jax.report import tuning
from infogoal_jax.report.canvas import empty_figure, save
from infogoal_jax.runner import search, training
from infogoal_jax.runs import tables
from infogoal_jax.runs.folder import remove_abandoned
from infogoal_jax.runs.search import Trial, read_plan

FILES = ("checkpoint", "policy", "epochs.csv", "epochs.jsonl", "evaluations.csv", "evaluations.jsonl", "config.json")
"""Of a run: those that have the same bits whenever the run is the same."""
REFUSED = 2
STOPPED = 130
STARTING, COMPILING, TRAINING, WRITING, DRAWING = MOMENTS = ("starting", "compiling", "training", "writing", "drawing")
moment = multiprocessing.get_context("forkserver").Value("i", 0, lock=False)
"""What this process is doing, as a place in `MOMENTS`; that of a child is the one that `start` returns."""


@contextlib.contextmanager
def doing(what: str, afterwards: str | None = None):
    """Inside, the process says that it does this, unless it draws; then what it did before, or `afterwards`."""
    before = moment.value
    if before != MOMENTS.index(DRAWING):
        moment.value = MOMENTS.index(what)
    try:
        yield
    finally:
        moment.value = before if afterwards is None else MOMENTS.index(afterwards)


def watched(module, name: str, what: str, afterwards: str | None = None) -> None:
    """Let a function of a module say that it does this."""
    function = getattr(module, name)

    @functools.wraps(function)
    def call(*arguments, **named):
        with doing(what, afterwards):
            return function(*arguments, **named)

    setattr(module, name, call)


def same_run(first: Path, second: Path) -> bool:
    """Whether two runs left the same bits in every file."""
    return all((first / name).read_bytes() == (second / name).read_bytes() for name in FILES)


def chunk_config(**changes):
    """Chunks of two epochs, long enough that a kill may hit computing, writing a table or writing the checkpoint."""
    return hand_made.config(**({"num_epochs": 12, "epochs_per_evaluation": 2, "updates_per_epoch": 5} | changes))


def small_config(**changes):
    """A run of the small program: so many chunks that a signal meets it on the way."""
    return chunk_config(**({"num_epochs": 24} | changes))


def search_config():
    """A method without many hyperparameters, in fifteen chunks."""
    return hand_made.config("none", num_epochs=30, epochs_per_evaluation=2, updates_per_epoch=5)


MEGABYTE = 250_000
"""Weights of the small program where it is killed: writing them takes its time."""


@flax.struct.dataclass
class SmallState:
    """What the small program carries."""

    params: dict
    env_steps: jax.Array
    key: jax.Array


def small_train(config, env=None, size: int = MEGABYTE):
    """Training whose program compiles in a moment: its numbers depend on every epoch, seed and hyperparameter before.
    size: of its weights.

    Nothing is learned by it; what is killed here is the loop around the program. `tests/runner/test_signals.py`
    kills the real one.
    """

    def initial(key, hyper, env):
        return SmallState({"weight": jax.random.normal(key, (size,))}, jnp.int32(0), key)

    def epochs(state, numbers, hyper, env):
        def epoch(state, number):
            noise = jax.random.normal(jax.random.fold_in(state.key, number), (size,))
            weight = hyper.discount * state.params["weight"] + hyper.learning_rate * noise
            state = state.replace(params={"weight": weight}, env_steps=state.env_steps + 10)
            seen = {"agent/loss": jnp.square(weight).mean(), "agent/gradient_norm": jnp.abs(weight).max()}
            return state, seen | {"env_steps": state.env_steps}

        return jax.lax.scan(epoch, state, numbers)

    def evaluation(state, hyper, env):
        rate = jax.nn.sigmoid(state.params["weight"].sum())
        scores = {f"{group}_goal/success_rate": rate for group in ("train", "test")}
        return scores | {"env_steps": state.env_steps}

    return dataclasses.replace(make_train(config, env), initial=initial, epochs=epochs, evaluation=evaluation)


def train(folder: Path) -> bool:
    """A run of two seeds, with a figure. Returns whether it finished."""
    finished = run_of(chunk_config(num_epochs=60), folder)
    if finished:
        remove_abandoned(folder)
        with doing(DRAWING):
            for number in range(3):
                figure = empty_figure("a figure", (), (6, 4))
                figure.add_subplot().plot(range(number + 2))
                save(figure, folder / "figures" / f"{number}.png")
    return finished


def tune(folder: Path) -> bool:
    """A search of two trials, or what is left of it."""
    config, env = search_config(), hand_made.environment()
    resume = (folder / "config.json").exists()
    trials = read_plan(folder)[1] if resume else None
    with tuning.watching(config, 2, 2, folder) as watch:
        if resume:
            return search.final(config, trials, [1000, 1001], env, watch, resume=True).finished
        return search.tune(config, 2, [1000, 1001], jax.random.key(0), ("discount",), env, watch).finished


def final(folder: Path) -> bool:
    """A final of two trials, or what is left of it."""
    config, env = search_config(), hand_made.environment()
    preset = {"discount": values_of(config.hyper)["discount"]}
    trials = [Trial(0, preset), Trial(3, {"discount": 0.9})]
    with tuning.watching(config, 2, 2, folder, "final") as watch:
        resume = (folder / "config.json").exists()
        return search.final(config, trials, [1008, 1009], env, watch, resume).finished


def short(folder: Path) -> bool:
    """A new run of one chunk, for processes that want the same folder."""
    config = hand_made.config("none", num_epochs=1, epochs_per_evaluation=1, updates_per_epoch=3)
    return not training.run(config, [0], folder, env=hand_made.environment()).stopped


def small(folder: Path) -> bool:
    """A run of two seeds, without a figure."""
    return run_of(small_config(), folder)


def run_of(config, folder: Path) -> bool:
    """A run of two seeds, or what is left of it. Returns whether it finished."""
    resume = (folder / "config.json").exists()
    return not training.run(config, [0, 1], folder, resume, env=hand_made.environment()).stopped


def child(kind: str, folder: str, shared) -> None:
    """What a process does: exit status 0 for a run that finished, `STOPPED` or `REFUSED` otherwise."""
    global moment
    moment = shared
    if kind != "small":
        jax.config.update("jax_enable_compilation_cache", False)  # So that each process compiles.
    training.make_train = search.make_train = small_train
    watched(jax.stages.Lowered, "compile", COMPILING, afterwards=TRAINING)
    watched(tables, "append_rows", WRITING)
    watched(files, "replace_file", WRITING)
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        try:
            finished = globals()[kind](Path(folder))
        except UserError:
            os._exit(REFUSED)
        except KeyboardInterrupt:
            os._exit(STOPPED)
        os._exit(0 if finished else STOPPED)


def start(kind: str, folder: Path) -> tuple[multiprocessing.Process, Callable[[], str]]:
    """A process that runs `train`, `tune`, `final`, `short` or `small` in this folder, and what tells which of
    `MOMENTS` it is at; one that has everything imported forks it, which saves seconds."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["killed_run"])
    shared = context.Value("i", 0, lock=False)
    process = context.Process(target=child, args=(kind, str(folder), shared))
    process.start()
    return process, lambda: MOMENTS[shared.value]
