"""Equal noise at test: success of every method against the probability of a random action, on sampled codes and on
their means.

    python -m infogoal_paper.noise --list [--tasks ...]
    python -m infogoal_paper.noise --out FOLDER [--tasks ... --methods ...] [--missing] [--minutes M]
    python -m infogoal_paper.noise --merge FOLDER

A method's preset is trained to its end, all seeds and data sets in one program; then the last parameters are evaluated
on every data set at each of `EPSILONS`. Every task and method is a file of FOLDER; what lies there is not run again,
and several processes may work on one folder. --minutes stops in time: what is not trained to its end leaves no rows,
and what cannot end in what is left is not begun. Cubes of the studies beside are trained half as long. --list prints
what docs/results/noise.csv.xz lacks of what is asked for, or has of too few seeds; --missing runs that alone.
--merge puts the files of FOLDER into docs/results/noise.csv.xz, in place of what was there of the same tasks, methods
and data sets; `pages.py noise` then writes the tables of docs/research/noise_at_test.md, which says what came of it.
"""

import argparse
import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import use_compilation_cache
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import UserError
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.loading import load_environment
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.runner.compilation import jit
from infogoal_jax.runner.sweep import Callback, Sweep, train_sweep
from infogoal_jax.runs.folder import BeingWrittenError, locked
from infogoal_jax.runs.tables import csv_text
from infogoal_jax.stopping import StopRequest, stop_on_signal
from infogoal_paper import batches, noise_numbers, tuning
from infogoal_paper.batches import over_environments, stacked
from infogoal_paper.manifest import PRESET, Run, Setting
from infogoal_paper.noise_numbers import DATA_SETS, EPSILONS, HELD_OUT, NUMBERS, SEEDS, methods_of
from infogoal_paper.plan import config_of
from infogoal_paper.trial_numbers import Row

CHUNKS = 4
"""Of an equal number of updates, after each of which there is an evaluation."""
HALF = 2
"""The cubes of the studies beside are trained for this share of their preset's updates, which take the most time."""
BY_HALVES = (HELD_OUT, "object_manipulation+read", noise_numbers.HELD_OUT_HRAC)
"""These studies."""
OF_SIZE = ("updates_per_epoch", "env.episode_length")
"""Fields that a toy has of its own."""
HURRY = 0.6
"""What a chunk or a run takes at best, as a share of what one took before: others that share the GPU may end."""
GROUPS = ("train", "validation", "test")


def run_of(task: str, method: str, data_set: int, toy: bool, seeds: int = SEEDS) -> Run:
    """A method of `methods_of` on a data set, with so many seeds, fewer if it is a toy."""
    name, *protocol = task.split("+")
    learner, *added = method.partition("@")[0].split("+")
    agent, known_goals = protocol if len(protocol) == 2 else (None, "visited")
    floats = noise_numbers.floats_of(task, method)
    setting = Setting(method, tuple(floats.items())) if floats else Setting(*PRESET)
    relabelling = added[0] if added else None
    return Run(
        name, learner, relabelling, None, data_set, setting, tuple(range(2 if toy else seeds)), toy, agent, known_goals
    )


def to_its_end(config: TrainConfig, run: Run, share: int = 1, epochs: int | None = None) -> TrainConfig:
    """The configuration of a run, trained for as many updates as its preset says, or a share of them, or these
    epochs."""
    if run.toy:
        return config
    preset = run.preset()
    epochs = epochs or preset.num_epochs * preset.updates_per_epoch // config.updates_per_epoch // share
    return dataclasses.replace(config, num_epochs=epochs, epochs_per_evaluation=epochs // CHUNKS)


def batches_on(
    runs: list[Run], folder: Path, changes: dict[str, Any], share: int = 1, goal_images: Path | None = None
) -> list[batches.Batch]:
    """The batches of a method on data sets of a task, with these changes of its preset, trained for a share
    of its updates. The house of the tuning has a batch of its own, as its goals are split differently; it is built in
    FOLDER unless it is there. goal_images: folder of further goal sets of Fetch."""
    changes = dict(changes)
    epochs = changes.pop("num_epochs", None)
    others = [run for run in runs if (run.task, run.goal_set) != ("object_search", tuning.SEED)]
    found = batches.batches_of(others, goal_images, most_members=64, changes=changes) if others else []
    for run in set(runs) - set(others):
        _, dataset, _, split = tuning.tuning_house(folder)
        config = with_values(
            config_of(dataclasses.replace(run, goal_set=0)), changes | {"env.dataset": dataset, "env.split": split}
        )
        members = tuple((run.setting, seed) for seed in run.seeds)
        found.append(batches.Batch(config, (load_environment(config),), members, {(0, run.setting): run}))
    return [dataclasses.replace(batch, config=to_its_end(batch.config, runs[0], share, epochs)) for batch in found]


class Watch(Callback):
    """Keeps what the learner said of every epoch, and stops in time. rows: of the evaluations at every noise, to which
    it adds; they are written to `partial` whenever there are more."""

    def __init__(
        self, task: str, method: str, training: batches.Training, deadline: float, rows: list[Row], partial: Path
    ):
        self.task, self.method, self.training, self.deadline = task, method, training, deadline
        self.name, self.learner = f"{task} {method}", training.train.parts.name
        self.learned: dict[str, list[np.ndarray]] = {}
        self.rows, self.partial = rows, partial
        self.evaluate = evaluator(training)
        self.ended = True

    def compiled(self, sweep: Sweep) -> None:
        """Say how long it took."""
        print(f"{self.name}: compiled in {sweep.prepare_seconds:.0f} s", flush=True)

    def has_time(self, sweep: Sweep) -> bool:
        """Whether the clock allows what is left of this run. A run that cannot end leaves the GPU to others; these may
        end meanwhile, which would make it faster."""
        chunks = max(1.2, HURRY * (sweep.config.num_evaluations - sweep.evaluations))
        return time.time() + chunks * sweep.last_seconds <= self.deadline

    def stopped(self, sweep: Sweep) -> None:
        """Not trained to its end."""
        self.ended = False

    def evaluated(self, sweep: Sweep) -> None:
        """Keep beta, accuracy and KL of each epoch, [sets, members, E]."""
        for metric in batches.LEARNED:
            if (name := f"{self.learner}/{metric}") in sweep.learned:
                self.learned.setdefault(metric, []).append(np.asarray(sweep.learned[name]))
        print(f"{self.name}: chunk {sweep.evaluations} in {sweep.last_seconds:.0f} s", flush=True)
        if sweep.finished:
            self.rows += rows_of(self, sweep.evaluations * sweep.config.epochs_per_evaluation)
            self.partial.write_text(csv_text(self.rows), newline="")

    def columns(self) -> dict[str, np.ndarray]:
        """What tells whether a seed's code collapsed, by column, [*members]; nothing for learners that do not steer
        beta by their accuracy."""
        if not self.learned.keys() >= set(batches.LEARNED):
            return {}
        beta, accuracy, kl = (np.concatenate(self.learned[metric], -1) for metric in batches.LEARNED)
        half = kl.shape[-1] // 2
        return {"accuracy": accuracy.max(-1), "beta": beta[..., -1], "kl_half": kl[..., half], "kl": kl[..., -1]}


def evaluator(training: batches.Training) -> Callable[[float], dict[str, np.ndarray]]:
    """The function that evaluates the parameters of all members at an epsilon: metrics, [sets, members]."""
    train, envs = training.train, training.batch.envs

    def evaluated(params, hyper, epsilon, env):
        return train.evaluate(params, hyper.replace(test_epsilon=epsilon), env, train.config.evaluation_starts)

    leaves, axes = stacked(envs)
    over = jit(over_environments(jax.tree.structure(envs[0]), axes, evaluated, (0, 0, None)))
    one_set = len(envs) == 1  # `over` has an axis of data sets.
    if one_set:
        leaves = [leaf if axis is None else leaf[None] for leaf, axis in zip(leaves, axes, strict=True)]

    def evaluate(epsilon: float) -> dict[str, np.ndarray]:
        params, hyper = training.states.params, training.hyper
        if one_set:
            params, hyper = jax.tree.map(lambda leaf: leaf[None], (params, hyper))
        metrics = jax.device_get(over(params, hyper, jnp.float32(epsilon), leaves))
        return {name: value for name, value in metrics.items() if name.endswith("success_rate")}

    return evaluate


def rows_of(watch: Watch, epochs: int) -> Iterator[Row]:
    """The rows of all data sets, seeds, epsilons and codes of a batch that is trained for so many epochs."""
    batch, machine = watch.training.batch, describe_machine()
    learned = {name: value.reshape(-1, value.shape[-1]) for name, value in watch.columns().items()}
    for epsilon in EPSILONS:
        metrics = watch.evaluate(epsilon)
        for (place, _), run in batch.runs.items():
            for member, seed in enumerate(run.seeds):
                for code, suffix in (("sampled", ""), ("mean", "_mean_code")):
                    row = {
                        "task": watch.task,
                        "method": watch.method,
                        "data_set": run.goal_set,
                        "seed": seed,
                        "epsilon": epsilon,
                        "code": code,
                    }
                    for prefix in ("", "corrupted_"):
                        for group in GROUPS:
                            value = metrics.get(f"{prefix}{group}_goal{suffix}/success_rate")
                            row[f"{prefix}{group}"] = "" if value is None else f"{value[place, member]:.4g}"
                    row["updates"] = epochs * batch.config.updates_per_epoch
                    own = {name: f"{learned[name][place, member]:.4g}" for name in learned}
                    row["threshold"] = f"{batch.config.hyper.learner.beta_threshold:g}" if own else ""
                    row |= {name: own.get(name, "") for name in noise_numbers.LEARNED}
                    yield row | {"machine": machine}


def run(
    task: str,
    method: str,
    path: Path,
    deadline: float,
    stop: StopRequest,
    runs: list[Run],
    goal_images: Path | None = None,
):
    """Train and evaluate a method on data sets of a task, and write its file."""
    rows: list[Row] = []
    partial = path.with_suffix(".partial")
    settings = noise_numbers.settings_of(task, method)
    if runs[0].toy:
        settings = {name: value for name, value in settings.items() if name not in OF_SIZE}
    for batch in batches_on(runs, path.parent, settings, HALF if task in BY_HALVES else 1, goal_images):
        training = batches.begin(batch)
        watch = Watch(task, method, training, deadline, rows, partial)
        train_sweep(training.sweep, watch, stop)
        if not watch.ended:
            print(f"{watch.name}: no time was left", flush=True)
            break
    if rows and watch.ended:
        partial.rename(path)
        print(f"{task} {method}: written", flush=True)


def main():
    """Run what is not there yet, or merge it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--tasks", nargs="*", choices=DATA_SETS, default=list(DATA_SETS))
    parser.add_argument("--methods", nargs="*", help="left out: those of the task")
    parser.add_argument("--data-sets", nargs="*", type=int, help="numbers; left out: those of the study")
    parser.add_argument("--missing", action="store_true", help="leave out what the numbers have")
    parser.add_argument("--list", action="store_true", help="print what the numbers lack of this, and stop")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="of each method and data set")
    parser.add_argument("--goal-images", type=Path, metavar="FOLDER", help="further goal sets of Fetch")
    parser.add_argument("--minutes", type=float, default=1e6, help="stop after this time")
    parser.add_argument("--toy", action="store_true", help="at a size at which nothing is learned")
    parser.add_argument("--merge", type=Path, metavar="FOLDER", help="put the rows of this folder into the numbers")
    arguments = parser.parse_args()
    if arguments.merge is not None:
        print(f"{NUMBERS.name}: {', '.join(noise_numbers.merge(arguments.merge))}")
        return
    unknown = set(arguments.methods or ()) - {method for task in DATA_SETS for method in methods_of(task)}
    if unknown:
        parser.error(f"--methods {' '.join(sorted(unknown))}: no task has them")
    rows = noise_numbers.read() if arguments.missing or arguments.list else []
    asked = noise_numbers.missing(rows, arguments.tasks, arguments.methods or (), arguments.data_sets or ())
    if arguments.list:
        for task, method, sets in asked:
            print(task, method, *sets)
        return
    if arguments.out is None:
        parser.error("give --out FOLDER, --merge FOLDER or --list")
    use_compilation_cache()
    arguments.out.mkdir(parents=True, exist_ok=True)
    deadline = time.time() + 60 * arguments.minutes
    took: dict[str, float] = {}  # Seconds of the last run of each task, whatever the study.
    with stop_on_signal() as stop:
        for task, method, sets in asked:
            path = arguments.out / f"{'_'.join([task, method, *map(str, sets)])}.csv"
            with contextlib.suppress(BeingWrittenError), locked(path.with_suffix(".lock"), arguments.out):
                begun, plain = time.time(), task.partition("+")[0]
                if path.exists() or begun + HURRY * took.get(plain, 0.0) >= deadline or stop.requested:
                    continue
                try:
                    runs = [run_of(task, method, number, arguments.toy, arguments.seeds) for number in sets]
                    run(task, method, path, deadline, stop, runs, arguments.goal_images)
                    took[plain] = time.time() - begun
                except UserError as error:  # A part's own check refuses the task; the others go on.
                    print(f"{task} {method}: {error}", flush=True)


if __name__ == "__main__":
    main()
