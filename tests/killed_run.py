"""Runs of the hand-made task in processes of their own, to be killed: `python killed_run.py FOLDER`, or `start` below.
A run that is there goes on."""

import contextlib
import multiprocessing
import os
import sys
from pathlib import Path

import hand_made

from infogoal_jax.errors import UserError
from infogoal_jax.hyperparameters import values_of
from infogoal_jax.report import tuning
from infogoal_jax.report.figures import draw_figures
from infogoal_jax.train import host
from infogoal_jax.train import tune as search
from infogoal_jax.train.trials import Trial

REFUSED = 2
STOPPED = 130
FOREVER = 10_000
"""Seconds that a test would wait."""


def chunk_config(**changes):
    """Chunks of two epochs, long enough that a kill may hit computing, writing a table or writing the checkpoint."""
    return hand_made.config(**({"num_epochs": 12, "epochs_per_evaluation": 2, "updates_per_epoch": 5} | changes))


def search_config():
    """A method without many hyperparameters, in three chunks."""
    return hand_made.config("none", num_epochs=6, epochs_per_evaluation=2, updates_per_epoch=5)


def train(folder: Path) -> bool:
    """A run of two seeds, with its figures. Returns whether it finished."""
    env = hand_made.environment()
    sweep = host.run(chunk_config(), [0, 1], folder, resume=(folder / "config.json").exists(), env=env)
    if not sweep.stopped:
        draw_figures(folder, env)
    return not sweep.stopped


def tune(folder: Path) -> bool:
    """A search of two trials, or what is left of it."""
    config, env = search_config(), hand_made.environment()
    resume = (folder / "config.json").exists()
    trials = tuning.read_drawn(folder)[1] if resume else None
    with tuning.watching(config, 2, 2, folder) as watch:
        if resume:
            return search.final(config, trials, [1000, 1001], env, watch, resume=True).finished
        key = host.jax.random.key(0)
        return search.tune(config, 2, [1000, 1001], key, ("discount",), env, watch).finished


def final(folder: Path) -> bool:
    """A final of two trials, or what is left of it."""
    config, env = search_config(), hand_made.environment()
    preset = {"discount": values_of(config.hyper)["discount"]}
    trials = [Trial(0, preset, [], [], []), Trial(3, {"discount": 0.9}, [], [], [])]
    with tuning.watching(config, 2, 2, folder, "final") as watch:
        resume = (folder / "config.json").exists()
        return search.final(config, trials, [1008, 1009], env, watch, resume).finished


def short(folder: Path) -> bool:
    """A new run of one chunk, for processes that want the same folder."""
    config = hand_made.config("none", num_epochs=1, epochs_per_evaluation=1, updates_per_epoch=3)
    return not host.run(config, [0], folder, env=hand_made.environment()).stopped


def child(kind: str, folder: str) -> None:
    """What a process does: exit status 0 for a run that finished, `STOPPED` or `REFUSED` otherwise."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        try:
            finished = globals()[kind](Path(folder))
        except UserError:
            os._exit(REFUSED)
        except KeyboardInterrupt:
            os._exit(STOPPED)
        os._exit(0 if finished else STOPPED)


def start(kind: str, folder: Path) -> multiprocessing.Process:
    """A process that runs `train`, `tune`, `final` or `short` in this folder; one that has everything imported forks
    it, which saves seconds."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["killed_run"])
    process = context.Process(target=child, args=(kind, str(folder)))
    process.start()
    return process


if __name__ == "__main__":
    print("starting", flush=True)
    folder = Path(sys.argv[1])
    host.run(chunk_config(), [0, 1], folder, resume=(folder / "config.json").exists(), env=hand_made.environment())
