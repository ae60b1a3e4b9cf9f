"""Trials: short, cheap experiments that decide what a method needs, several settings of floats and several seeds side
by side in one program.

    python -m infogoal_paper.trials --list
    python -m infogoal_paper.trials --table [cube fetch ...]
    python -m infogoal_paper.trials --out FOLDER [--trials cube_her cube_infogoal_her_window_1 ...] [--minutes 9]
    python -m infogoal_paper.trials --merge FOLDER

`trial_queue.py` and `all_goals_queue.py` have the list of what is to be run. A trial is a preset, what is changed in
it, and *settings* of the float hyperparameters that are trained in the same compiled program. Every evaluation of every
setting and seed is a row of FOLDER/TRIAL.csv, written as it comes, so that a run that is cut keeps what it found;
--minutes stops the last one in time. A trial whose file lies in FOLDER is not run again. --merge puts the files of
FOLDER into docs/results/trials/numbers.csv.xz, in place of what was there of the same trials; --table prints the tables
of that file, of which docs/research/trials.md says what came. --list prints the queue, and how far each trial has come
in that file.
"""

import argparse
import csv
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import presets, use_compilation_cache
from infogoal_jax.config import TrainConfig
from infogoal_jax.data import splits
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.loading import make_train
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.runner.sweep import Callback, Sweep, batched_hyper, side_by_side, train_sweep
from infogoal_jax.stopping import stop_on_signal
from infogoal_jax.train.evaluation import near_and_far
from infogoal_jax.train.program import Train
from infogoal_paper import all_goals_queue, table_formats, trial_numbers, trial_queue
from infogoal_paper.trial_numbers import Row, code_errors
from infogoal_paper.trial_queue import Trial
from infogoal_paper.tuning import tuning_house

QUEUE = trial_queue.QUEUE | all_goals_queue.QUEUE
TABLES = {
    "cube": (("object_manipulation",), ("degrees", 1)),
    "fetch": (presets.FETCH_TASKS, ("m", 3)),
    "house": (("object_search",), None),
    "shelf": (("embodied_qa",), None),
}
"""Tables of docs/research/trials.md: tasks, and the unit of the code's error with its decimals."""
NAMED_TABLES = {"house_goals": None, "cube_dqn": ("degrees", 1), "cube_hrac": ("degrees", 1), "shelf_goals": None}
"""Tables of docs/research/all_goals.md: how the names of their trials begin, and the unit of the code's error."""
WITHOUT_TABLE = ("cube_carries", "calibration")
"""Trials that have no line for each setting: of the first noise.py measured the same at equal noise, on more cubes; the
others have a table of their own."""
OF_NORMALISED = ("cube_dqn", "shelf_goals")
"""Of these, tables that show trials with normalised layers alone, as the presets have: without them units die, and
which seeds learn is chance."""
PROBED = ("fetch_reach", "fetch_pick_and_place")
"""The tasks of which the probe is shown: on the others no question rests on it."""


def first_occurrence(*tasks: str) -> list[tuple]:
    """GHRL with goals at their first occurrence, and with the one that an episode demonstrates best, on these tasks."""
    return [((f"{task}_ghrl_first_occurrence", "preset"), (f"{task}_ghrl", "preset")) for task in tasks]


COMPARISONS = {
    "cube_comparisons": [
        ((f"cube_{dataset}_infogoal_her_window_1", "threshold 0.999"), (f"cube_{dataset}_her", "preset"))
        for dataset in (0, 1, 2)
    ]
    + [
        tuple((trial, setting) for setting in ("found", "preset"))
        for trial in trial_queue.QUEUE
        if trial.endswith("_found")
    ]
    + [
        (("cube_gcb_grounded", "preset"), ("cube_gcb", "preset")),
        (("cube_gcb_her_grounded", "found"), ("cube_gcb_her_found", "found")),
        *first_occurrence("cube"),
    ],
    "fetch_comparisons": [
        tuple((f"{short}_infogoal{relabelling}", f"threshold {threshold}") for threshold in (finer, 0.96))
        for short, finer in (("pick_and_place", 0.99), ("push", 0.999))
        for relabelling in ("", "_her")
    ]
    + [
        tuple((trial, setting) for setting in ("HER's settings", "preset"))
        for trial in trial_queue.QUEUE
        if trial.endswith("_her_settings")
    ]
    + first_occurrence("reach", "push", "pick_and_place"),
    "shelf_comparisons": [
        ((f"shelf_{dataset}_infogoal", f"threshold {threshold}"), (f"shelf_{dataset}_cql", "preset"))
        for dataset in (0, 1, 2)
        for threshold in (0.99, 0.999)
    ]
    + [
        (("shelf_infogoal_gathered", f"threshold {value}"), ("shelf_cql_gathered", "preset")) for value in (0.96, 0.999)
    ],
    "house_comparisons": first_occurrence("house"),
}
"""Settings of trials whose difference is shown, seed by seed: the second is the first without what is asked about."""
NAMES = (*TABLES, *NAMED_TABLES, *COMPARISONS, "probe", "calibration")
"""Of all tables."""

KINDS = (
    "train_goal",
    "validation_goal",
    "test_goal",
    "corrupted_train_goal",
    "corrupted_test_goal",
    "train_goal_mean_code",
    "test_goal_mean_code",
)
EPOCH_METRICS = ("beta", "accuracy", "kl")
NUMBERS = Path(__file__).parents[1] / "docs" / "results" / "trials" / trial_numbers.FILE


def configuration(trial: Trial, folder: Path) -> TrainConfig:
    """What is trained. Object search is in the house of the tuning, which is built in FOLDER unless it is there."""
    changes = trial.changes
    if trial.task == "object_search":
        _, dataset, _, split = tuning_house(folder)
        changes = {"env.dataset": dataset, "env.split": split} | changes
    return preset_of(trial._replace(changes=changes))


def preset_of(trial: Trial) -> TrainConfig:
    """The preset of a trial with its changes."""
    return with_values(presets.load(trial.task, trial.method, agent=trial.agent), trial.changes)


def asked_by_name(env):
    """Embodied question answering in which questions of validation and test sound like the name of their object. (They
    take part in no training.)"""
    asked = splits.load_questions(splits.SHIPPED_QUESTIONS).goals()
    names = {goal.text: number for number, goal in enumerate(asked)}
    rows = jnp.asarray([names[goal.object] for goal in asked])
    heard = env.goals.inputs[jnp.where(env.goals.train_mask, jnp.arange(len(asked)), rows)]
    return env.replace(goals=env.goals.replace(inputs=heard))


class TrialFile(Callback):
    """The file of a trial: a row for each evaluation of each setting and seed."""

    def __init__(self, name: str, trial: Trial, train: Train, env: Any, path: Path, deadline: float):
        self.name, self.trial, self.train, self.env, self.deadline = name, trial, train, env, deadline
        self.members = [(label, seed) for label in trial.settings for seed in range(trial.seeds)]
        self.file = open(path, "w", newline="")  # noqa: SIM115 (closed when the trial ends)
        self.table: csv.DictWriter | None = None
        self.machine, self.started = describe_machine(), time.time()
        self.errors = jax.jit(jax.vmap(lambda params, goals: code_errors(train, params, goals), in_axes=(0, None)))
        masks = {"train_goal": env.goals.train_mask, "test_goal": env.goals.test_mask}
        posed = env.goal_positions is not None
        self.posed = {group: jnp.flatnonzero(mask) for group, mask in masks.items()} if posed else {}

    def compiled(self, sweep: Sweep) -> None:
        """Say how long it took."""
        print(f"{self.name}: {len(self.members)} members compiled in {sweep.prepare_seconds:.0f} s", flush=True)

    def has_time(self, sweep: Sweep) -> bool:
        """Whether the clock allows another evaluation."""
        return time.time() + 1.2 * sweep.last_seconds <= self.deadline

    def evaluated(self, sweep: Sweep) -> None:
        """Write the rows of this evaluation."""
        metrics, config = self.metrics_of(sweep), self.train.config
        epochs = sweep.evaluations * config.epochs_per_evaluation
        for place, (label, seed) in enumerate(self.members):
            row = {
                "trial": self.name,
                "lane": label,
                "seed": seed,
                "known_goals": config.known_goals,
                "updates": epochs * config.updates_per_epoch,
            }
            row |= {metric: f"{value[place]:.4g}" for metric, value in metrics.items()}
            row |= {"seconds": f"{time.time() - self.started:.0f}", "machine": self.machine}
            self.table = self.table or csv.DictWriter(self.file, row)
            if not self.file.tell():
                self.table.writeheader()
            self.table.writerow(row)
        self.file.flush()
        shown = {
            kind: np.round(metrics[f"{kind}/success_rate"].reshape(len(self.trial.settings), -1).mean(1), 2).tolist()
            for kind in KINDS
            if f"{kind}/success_rate" in metrics
        }
        rate = len(self.members) * config.epochs_per_evaluation * config.updates_per_epoch / sweep.last_seconds
        print(f"{self.name} {row['updates']} updates, {rate:.0f}/s in all: {json.dumps(shown)}", flush=True)

    def metrics_of(self, sweep: Sweep) -> dict[str, np.ndarray]:
        """The columns of a trial: success of each kind, the learner's numbers, and errors of the code."""
        scored, name = sweep.scored, self.train.parts.name
        metrics = near_and_far(self.env, scored["first_reached"])
        metrics |= {
            f"{kind}/success_rate": scored[f"{kind}/success_rate"] for kind in KINDS if f"{kind}/success_rate" in scored
        }
        metrics |= {
            f"learner/{part}": sweep.learned[f"{name}/{part}"][:, -1]
            for part in EPOCH_METRICS
            if f"{name}/{part}" in sweep.learned
        }
        for group, goals in self.posed.items():
            for error, values in self.errors(sweep.states.state.params, goals).items():
                prefix = "corrupted_" if error.startswith("corrupted_") else ""
                metrics[f"{prefix}{group}/{error.removeprefix(prefix)}"] = np.asarray(values).mean(1)
        return metrics


def run(name: str, trial: Trial, folder: Path, deadline: float) -> None:
    """Train every setting and seed of a trial, one row for each evaluation of each."""
    config = configuration(trial, folder)
    train = make_train(config)
    if trial.by_name:
        train = dataclasses.replace(train, env=asked_by_name(train.env))
    hyper = batched_hyper(config.hyper, [values for values in trial.settings.values() for _ in range(trial.seeds)])
    programs = side_by_side(train, list(range(trial.seeds)) * len(trial.settings), hyper)
    path = folder / f"{name}.csv"
    rows = TrialFile(name, trial, train, train.env, path.with_suffix(".partial"), deadline)
    with rows.file, stop_on_signal() as stop:
        train_sweep(Sweep(config, programs), rows, stop)
        stop.check()  # Of a trial that was stopped the rows stay in its partial file.
    path.with_suffix(".partial").rename(path)


def tables(rows: list[Row]) -> dict[str, str]:
    """Every table of trials: of each group of tasks the trials that were run, and differences. A trial all of whose
    settings are compared stands in the table of differences alone."""
    done = {row["trial"] for row in rows}
    compared = {setting for pairs in COMPARISONS.values() for pair in pairs for setting in pair}
    named = [trial for trial in QUEUE if trial.startswith(tuple(NAMED_TABLES))]
    others = [trial for trial in QUEUE if trial not in named and not trial.startswith(WITHOUT_TABLE)]
    grouped = {
        name: (
            [
                trial
                for trial in others
                if QUEUE[trial].task in tasks
                and any((trial, setting) not in compared for setting in QUEUE[trial].settings)
            ],
            error,
        )
        for name, (tasks, error) in TABLES.items()
    } | {
        name: (
            [
                trial
                for trial in named
                if trial.startswith(name) and (name not in OF_NORMALISED or trial.endswith("_norm"))
            ],
            error,
        )
        for name, error in NAMED_TABLES.items()
    }
    found = {}
    for name, (trials, error) in grouped.items():
        own = [row for row in rows if row["trial"] in trials]
        if own:
            ran = {row["trial"] for row in own}
            found[name] = trial_numbers.table(own, [trial for trial in trials if trial in ran], error)
    probed = {row["trial"] for row in rows if row.get("test_goal/readout_error")}
    units = {trial: TABLES["fetch"][1] for trial in others if trial in probed and QUEUE[trial].task in PROBED}
    if units:
        found["probe"] = trial_numbers.probe_table(rows, units)
    if done & trial_queue.WORLDS.keys():
        found["calibration"] = calibration_table(rows)
    for name, pairs in COMPARISONS.items():
        ran = [pair for pair in pairs if all(trial in done for trial, _ in pair)]
        if ran:
            found[name] = trial_numbers.differences(rows, ran)
    return found


def calibration_table(rows: list[Row]) -> str:
    """A row for each range of the joints, a column for each length of an episode: success of the bare agent on training
    and on test poses, `1.00, 0.01 ± 0.02`."""
    cells, lasts, shown = {}, set(), []
    for name, world in trial_queue.WORLDS.items():
        for _, last, updates in trial_numbers.last_of_settings([row for row in rows if row["trial"] == name]):
            training, test = (trial_numbers.seed_means(last, f"{kind}_goal/success_rate") for kind in ("train", "test"))
            cells[tuple(world.values())] = ", ".join(
                [trial_numbers.show(training, 2), trial_numbers.show(test, 2, interval=True)]
            )
            lasts.add(f"{len(test)} seeds, {updates} updates")
            shown += last
    ranges, lengths = (list(dict.fromkeys(values)) for values in zip(*cells, strict=True))
    lines = [[f"{degrees:g}°", *(cells.get((degrees, steps), "") for steps in lengths)] for degrees in ranges]
    lines = table_formats.markdown_lines(["joints within", *(f"{steps:,} steps" for steps in lengths)], lines)
    machines = table_formats.machines_in_words(row["machine"] for row in shown)
    return f"{lines}\n\n{'; '.join(sorted(lasts))}; {machines}."


def progress_of(trial: Trial, updates: int, ran: dict[str, tuple[int, int]]) -> str:
    """How far a trial has come, in words. updates: that each seed of it should make; ran: `trial_numbers.settings_of`
    it.

    A setting of other floats is another setting: what ran counts only under the names and seeds that the queue has.
    """
    others = [setting for setting in ran if setting not in trial.settings]
    lacking = [setting for setting in trial.settings if ran.get(setting, (0, 0))[0] < trial.seeds]
    made = min((ran[setting][1] for setting in trial.settings if setting in ran), default=0)
    if len(lacking) == len(trial.settings):
        words = "to be run"
    elif lacking:
        words = f"without {', '.join(lacking)}"
    else:
        words = "done" if made >= updates else f"{made:,} of {updates:,} updates"
    return f"{words}; the numbers have other settings: {', '.join(others)}" if others else words


def list_queue() -> None:
    """Print the queue, and how far each trial has come in the numbers that are kept."""
    ran = trial_numbers.settings_of(trial_numbers.kept(NUMBERS))
    for name, trial in QUEUE.items():
        config = preset_of(trial)
        updates = config.num_epochs * config.updates_per_epoch
        print(
            f"{name}: {trial.task}, {presets.name_of(config)}, known goals {config.known_goals}, "
            f"{len(trial.settings)} setting(s) of {trial.seeds} seeds: {progress_of(trial, updates, ran.get(name, {}))}"
        )


def print_tables(names: list[str]) -> None:
    """Print these tables with every setting that was run; without names all of them."""
    found = tables(trial_numbers.read(NUMBERS))
    for name in names or found:
        print(f"{name}\n\n{found[name]}\n")


def main():
    """Run what is not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--trials", nargs="*", choices=QUEUE, default=list(QUEUE))
    parser.add_argument("--list", action="store_true", help="print the queue, how far each trial has come, and stop")
    parser.add_argument(
        "--table", nargs="*", choices=NAMES, metavar="NAME", help="print these tables with every setting, and stop"
    )
    parser.add_argument(
        "--merge", type=Path, metavar="FOLDER", help="put the trials of this folder into docs/results/trials, and stop"
    )
    parser.add_argument("--minutes", type=float, default=1e6, help="stop after this time")
    parser.add_argument(
        "--set", nargs="*", default=[], metavar="FIELD=JSON", help="further fields, for a try at a small size"
    )
    arguments = parser.parse_args()
    if arguments.merge is not None:
        print(f"{NUMBERS.name}: {', '.join(trial_numbers.merge(arguments.merge, NUMBERS, QUEUE))}")
        return
    if arguments.table is not None:
        print_tables(arguments.table)
        return
    if arguments.list or arguments.out is None:
        list_queue()
        return
    use_compilation_cache()
    arguments.out.mkdir(parents=True, exist_ok=True)
    deadline = time.time() + 60 * arguments.minutes
    further = {field: json.loads(value) for field, _, value in (item.partition("=") for item in arguments.set)}
    for name in arguments.trials:
        if not (arguments.out / f"{name}.csv").exists() and time.time() < deadline:
            trial = QUEUE[name]
            run(name, trial._replace(changes=trial.changes | further), arguments.out, deadline)


if __name__ == "__main__":
    main()
