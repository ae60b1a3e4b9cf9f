"""Trials: short, cheap experiments that decide what a method needs, several settings of floats and several seeds side
by side in one program.

    python benchmarks/paper/trials.py --list
    python benchmarks/paper/trials.py --out FOLDER [--trials cube_her cube_infogoal_her_window_1 ...] [--minutes 9]
    python benchmarks/paper/trials.py --merge FOLDER

`QUEUE` is the list of what is to be run, in order of what it would tell. A trial is a preset, what is changed in it,
and *lanes*: settings of the float hyperparameters that are trained in the same compiled program. Every evaluation of
every lane and seed is a row of FOLDER/TRIAL.csv, written as it comes, so that a run that is cut keeps what it found;
--minutes stops the last one in time. A trial whose file lies in FOLDER is not run again. --merge puts the files of
FOLDER into docs/results/trials/numbers.csv, in place of what was there of the same trials; `tables.py trials` then
writes the tables of docs/trials.md, which says what came of it. --list prints the queue, and how far each trial has
come in that file.
"""

import argparse
import csv
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trial_numbers
from trial_numbers import Row
from tuning_study import tuning_house

from infogoal_jax import compiled, jit, presets, use_compilation_cache
from infogoal_jax.config import TrainConfig
from infogoal_jax.data import questions
from infogoal_jax.envs.object_manipulation import ObjectManipulation
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.learners.learner import encode_all
from infogoal_jax.report.machine import describe_machine
from infogoal_jax.train.lanes import batched_hyper
from infogoal_jax.train.program import make_train

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
NUMBERS = Path(__file__).parents[2] / "docs" / "results" / "trials" / trial_numbers.FILE
TABLES = {
    "cube": (("object_manipulation",), ("degrees", 1)),
    "fetch": (presets.FETCH_TASKS, ("m", 3)),
    "house": (("object_search",), None),
    "shelf": (("embodied_qa",), None),
}
"""Tables of docs/trials.md: tasks, and the unit of the code's error with its decimals."""
ALL_GOALS_TABLES = {"house_goals": None, "cube_dqn": ("degrees", 1), "shelf_goals": None}
"""Tables of docs/all_goals.md: how the names of their trials begin, and the unit of the code's error."""


class Trial(NamedTuple):
    """task, method, relabelling: of the preset. settings: dotted fields that are changed in it. lanes: names and float
    hyperparameters of each.

    by_name: evaluate embodied question answering with the names of the objects in place of the questions about them.
    agent: another than the task's own.
    """

    task: str
    method: str
    relabelling: str | None
    settings: dict[str, Any]
    lanes: dict[str, dict[str, float]]
    seeds: int = 2
    by_name: bool = False
    agent: str | None = None


CUBE = {
    "env.generator_seed": 100,
    "env.goal_seed": 100,
    "env.episode_length": 100,
    "rollout_steps": 100,
    "num_envs": 128,
    "updates_per_epoch": 1000,
    "evaluation_starts": 2,
    "num_epochs": 60,
    "epochs_per_evaluation": 5,
}
"""The cube with episodes long enough for it: 60,000 updates."""

FETCH = {"num_epochs": 200, "epochs_per_evaluation": 20}
"""Fetch with 20,000 updates, on the goals that are shipped: settings are to be compared by their validation goals."""

SHELF = {"env.generator_seed": 100}
COMMANDS = {"": False, "_by_name": True}
"""Endings of the shelf's trials, and whether the evaluation commands names."""

HOUSE = {"num_epochs": 160, "epochs_per_evaluation": 20}
"""Object search in the house of the tuning, with its validation goals: 16,000 updates."""

THRESHOLDS = {f"threshold {value}": {"learner.beta_threshold": value} for value in (0.96, 0.99, 0.999)}
MARGINS = {f"margin {value}": {"learner.beta_margin": value} for value in (0.0005, 0.002, 0.005, 0.02)}
RELATIVE = {"learner.beta_rule": "relative"}
UNCOMPRESSED = {"no compression": {"learner.beta_step": 0.0, "learner.beta_start": 0.0}}
NO_REWARD = {"no intrinsic reward": {"intrinsic_weight": 0.0, "learner.beta_threshold": 0.99}}
SEARCHING = {
    f"reward {weight}, beta {beta:.0e}": {"intrinsic_weight": weight, "learner.beta": beta}
    for weight in (0.0, 0.1, 1.0)
    for beta in (3e-5, 1e-3, 1e-2)
}
NO_EXPLORER = {"no explorer": {"explorer_weight": 0.0, "bonus_weight": 0.0}}
BONUSES = {f"weight 0.1, bonus {bonus}": {"explorer_weight": 0.1, "bonus_weight": bonus} for bonus in (0.0, 0.01, 0.3)}


FINE_CODES = {
    f"threshold 0.999, learner weight {weight}": {"learner.beta_threshold": 0.999, "learner_weight": weight}
    for weight in (1.0, 0.1)
}
"""A code as fine as the cube and the shelf ask for."""
LEARNER_WEIGHTS = {f"learner weight {weight}": {"learner_weight": weight} for weight in (1.0, 0.03, 0.001)}
"""The loss under all goals is a mean over goals, nearly all of which are far: it is smaller than that of one goal."""
CONSERVATIVE = {
    f"conservative weight {weight}": {"agent.conservative_weight": weight, "intrinsic_weight": 0.0}
    for weight in (0.002, 0.02, 0.2)
}
CUBE_HEAD = {
    "preset": {},
    "target rate 0.05": {"target_rate": 0.05},
    "target rate 0.05, discount 0.95": {"target_rate": 0.05, "discount": 0.95},
    "target rate 0.05, learning rate 0.0003": {"target_rate": 0.05, "learning_rate": 3e-4},
}
CUBE_LEARNER = {
    f"target rate 0.05, learner weight {weight}": {"target_rate": 0.05, "learner_weight": weight}
    for weight in (1.0, 0.03, 0.001)
}
PROTOCOLS = {"": {}, "_held_out": {"known_goals": "held_out"}}
"""Endings of the trials on all goals at once, and what they change: test and validation goals enter once they are
achieved, or never."""


def all_goals_trials(
    name: str,
    task: str,
    settings: dict[str, Any],
    lanes: dict[str, dict[str, dict[str, float]]],
    agent: str | None = None,
) -> dict[str, Trial]:
    """HER, LEO and the all-goals head with each learner, under both protocols. lanes: of each of them, else the
    preset."""
    methods = {"her": ("her", None), "leo": ("leo", None), "head": ("all_goals", None)} | {
        f"{learner}_head": (learner, "all_goals") for learner in ("infogoal", "infobot")
    }
    return {
        f"{name}_{short}{ending}": Trial(
            task, method, relabelling, settings | changed, lanes.get(short, {"preset": {}}), seeds=3, agent=agent
        )
        for ending, changed in PROTOCOLS.items()
        for short, (method, relabelling) in methods.items()
    }


def confirmation(dataset: int) -> dict[str, Any]:
    """The cube with 120,000 updates, on a dataset that results are shown on."""
    return CUBE | {
        "env.generator_seed": dataset,
        "env.goal_seed": dataset,
        "num_epochs": 120,
        "epochs_per_evaluation": 10,
    }


QUEUE = {
    "cube_her": Trial("object_manipulation", "her", None, CUBE, {"preset": {}}, seeds=4),
    **{
        f"cube_infogoal_her_window_{window}": Trial(
            "object_manipulation",
            "infogoal",
            "her",
            CUBE | {"learner.window": window},
            THRESHOLDS | UNCOMPRESSED | NO_REWARD,
        )
        for window in (1, 0, 3)
    },
    "cube_infogoal_her_small_subgoals": Trial(
        "object_manipulation",
        "infogoal",
        "her",
        CUBE | {"learner.window": 1, "agent.subgoal_scale": 0.2618},
        THRESHOLDS | UNCOMPRESSED,
    ),
    "pick_and_place_her": Trial("fetch_pick_and_place", "her", None, FETCH, {"preset": {}}, seeds=3),
    "pick_and_place_infogoal": Trial("fetch_pick_and_place", "infogoal", None, FETCH, THRESHOLDS, seeds=3),
    "pick_and_place_infogoal_her": Trial("fetch_pick_and_place", "infogoal", "her", FETCH, THRESHOLDS, seeds=3),
    "pick_and_place_infogoal_her_window_1": Trial(
        "fetch_pick_and_place", "infogoal", "her", FETCH | {"learner.window": 1}, THRESHOLDS, seeds=3
    ),
    "pick_and_place_infogoal_her_corruption": Trial(
        "fetch_pick_and_place", "infogoal", "her", FETCH | {"training_corruption": 0.4}, THRESHOLDS, seeds=3
    ),
    # Training on corrupted goals may be all that the trial before owes its corrupted test goals to: the same without
    # InfoGoal.
    "pick_and_place_her_corruption": Trial(
        "fetch_pick_and_place", "her", None, FETCH | {"training_corruption": 0.4}, {"preset": {}}, seeds=3
    ),
    "reach_infogoal": Trial("fetch_reach", "infogoal", None, FETCH, THRESHOLDS, seeds=3),
    "reach_infogoal_her": Trial("fetch_reach", "infogoal", "her", FETCH, THRESHOLDS, seeds=3),
    "reach_infogoal_corruption": Trial(
        "fetch_reach", "infogoal", None, FETCH | {"training_corruption": 0.4}, THRESHOLDS, seeds=3
    ),
    # What was found on the cube's dataset 100 with two seeds has to hold on others, with five and for longer, before it
    # can become the preset.
    **{
        f"cube_{dataset}_her": Trial("object_manipulation", "her", None, confirmation(dataset), {"preset": {}}, seeds=5)
        for dataset in (0, 1, 2)
    },
    **{
        f"cube_{dataset}_infogoal_her_window_1": Trial(
            "object_manipulation",
            "infogoal",
            "her",
            confirmation(dataset) | {"learner.window": 1},
            {"threshold 0.999": THRESHOLDS["threshold 0.999"]},
            seeds=5,
        )
        for dataset in (0, 1, 2)
    },
    # The same without HER, as in the paper: is it the code or the relabelling that test poses need?
    "cube_infogoal_window_1": Trial("object_manipulation", "infogoal", None, CUBE | {"learner.window": 1}, THRESHOLDS),
    # Test questions of the shelf: is the loss in the way from a question to its object, or in the policy? Commanding
    # names leaves only the policy.
    **{
        f"shelf_infogoal{ending}": Trial(
            "embodied_qa", "infogoal", None, SHELF, THRESHOLDS | UNCOMPRESSED, seeds=3, by_name=by_name
        )
        for ending, by_name in COMMANDS.items()
    },
    **{
        f"shelf_cql{ending}": Trial("embodied_qa", "none", None, SHELF, {"preset": {}}, seeds=3, by_name=by_name)
        for ending, by_name in COMMANDS.items()
    },
    # A threshold of 0.999 was best on shelf 100: five seeds on the shelves that results are shown on.
    **{
        f"shelf_{dataset}_{name}": Trial("embodied_qa", method, None, {"env.generator_seed": dataset}, lanes, seeds=5)
        for dataset in (0, 1, 2)
        for name, method, lanes in (
            ("infogoal", "infogoal", {name: THRESHOLDS[name] for name in ("threshold 0.99", "threshold 0.999")}),
            ("cql", "none", {"preset": {}}),
        )
    },
    # The best threshold lies just below the accuracy that can be had without compression: does following that do on
    # every task what a threshold of its own does on each?
    "reach_infogoal_her_relative": Trial("fetch_reach", "infogoal", "her", FETCH | RELATIVE, MARGINS, seeds=3),
    "pick_and_place_infogoal_her_relative": Trial(
        "fetch_pick_and_place", "infogoal", "her", FETCH | RELATIVE, MARGINS, seeds=3
    ),
    "cube_infogoal_her_window_1_relative": Trial(
        "object_manipulation", "infogoal", "her", CUBE | RELATIVE | {"learner.window": 1}, MARGINS
    ),
    "shelf_infogoal_relative": Trial("embodied_qa", "infogoal", None, SHELF | RELATIVE, MARGINS, seeds=3),
    # InfoBot claims that its reward leads to where decisions are made. Its authors' beta of 0.01 is beside rewards of
    # 10; the preset's is 3e-5.
    "house_infobot": Trial("object_search", "infobot", None, HOUSE, SEARCHING),
    # SSE-DB changes nothing with the preset's weights (0.01 of its loss, 0.05 of its bonus): does more of its loss
    # help, and is it loss or bonus?
    "house_sse_db": Trial("object_search", "sse_db", None, HOUSE, {"preset": {}} | NO_EXPLORER | BONUSES),
    # Learning from every transition under all goals at once: LEO, whose values belong to goals that training achieved,
    # and the head that values a goal through its code.
    **all_goals_trials(
        "house_goals",
        "object_search",
        HOUSE | {"epochs_per_evaluation": 10},
        {"infogoal_head": LEARNER_WEIGHTS | FINE_CODES, "infobot_head": LEARNER_WEIGHTS},
    ),
    **all_goals_trials(
        "cube_dqn",
        "object_manipulation",
        CUBE,
        {"leo": CUBE_HEAD, "head": CUBE_HEAD, "infogoal_head": CUBE_LEARNER | FINE_CODES, "infobot_head": CUBE_LEARNER},
        agent="dqn",
    ),
    # What of it is the head, and what the goals: the head, trained under one hindsight goal a transition.
    "house_goals_her_product": Trial(
        "object_search",
        "her",
        None,
        HOUSE | {"epochs_per_evaluation": 10, "agent.head": "product", "agent.bounded": True},
        {"preset": {}},
        seeds=3,
    ),
    "cube_dqn_leo_every_goal": Trial(
        "object_manipulation", "leo", None, CUBE | {"relabelling.num_goals": 0}, {"preset": {}}, seeds=3, agent="dqn"
    ),
    **{
        f"cube_dqn_{short}_corruption": Trial(
            "object_manipulation",
            method,
            relabelling,
            CUBE | {"training_corruption": 0.4, "learner.standardise_images": True},
            lanes,
            seeds=3,
            agent="dqn",
        )
        for short, method, relabelling, lanes in (
            ("her", "her", None, {"preset": {}}),
            ("head", "all_goals", None, CUBE_HEAD),
            ("infogoal_head", "infogoal", "all_goals", CUBE_LEARNER | FINE_CODES),
        )
    },
    # A test question enters no training of the shelf; what is achieved are names of objects, under both protocols.
    **{
        name: trial
        for name, trial in all_goals_trials(
            "shelf_goals",
            "embodied_qa",
            SHELF,
            {"leo": CONSERVATIVE, "head": CONSERVATIVE, "infogoal_head": CONSERVATIVE, "infobot_head": CONSERVATIVE},
        ).items()
        if not name.endswith("held_out")
    },
}
"""What is run, in order. Settings are looked for on dataset 100 of the cube and the shelf, in house 100: results are
shown on others."""

COMPARISONS = {
    "cube_comparisons": [
        ((f"cube_{dataset}_infogoal_her_window_1", "threshold 0.999"), (f"cube_{dataset}_her", "preset"))
        for dataset in (0, 1, 2)
    ],
    "shelf_comparisons": [
        ((f"shelf_{dataset}_infogoal", f"threshold {threshold}"), (f"shelf_{dataset}_cql", "preset"))
        for dataset in (0, 1, 2)
        for threshold in (0.99, 0.999)
    ],
}
"""Lanes of trials whose difference is shown, seed by seed: the second is the first without what is asked about."""


def configuration(trial: Trial, folder: Path) -> TrainConfig:
    """What is trained. Object search is in the house of the tuning, which is built in FOLDER unless it is there."""
    settings = trial.settings
    if trial.task == "object_search":
        _, dataset, _, split = tuning_house(folder)
        settings = {"env.dataset": dataset, "env.split": split} | settings
    return preset_of(trial._replace(settings=settings))


def preset_of(trial: Trial) -> TrainConfig:
    """The preset of a trial with its settings."""
    return with_values(
        presets.load(trial.task, trial.method, relabelling=trial.relabelling, agent=trial.agent), trial.settings
    )


def commanded_by_name(env):
    """Embodied question answering in which questions of validation and test sound like the name of their object. (They
    take part in no training.)"""
    asked = questions.load(questions.SHIPPED).goals()
    names = {goal.text: number for number, goal in enumerate(asked)}
    rows = jnp.asarray([names[goal.object] for goal in asked])
    heard = env.goals.inputs[jnp.where(env.goals.train_mask, jnp.arange(len(asked)), rows)]
    return env.replace(goals=env.goals.replace(inputs=heard))


def code_errors(train, params, goals: jax.Array) -> jax.Array:
    """How far each of these goals [M] lies from the one whose mean code is nearest to a code drawn for it, in degrees
    or metres.

    That is the resolution of the code, to be held beside the tolerance of success: 10 degrees, 5 cm.
    """
    env, learner = train.env, train.parts.learner
    table = encode_all(learner, params["goal"], env.goals).mean
    drawn = learner.encode(params["goal"], env.goals.inputs_of(goals)).sample(jax.random.key(0))
    nearest = jax.lax.map(lambda code: jnp.abs(table - code).mean(-1).argmin(), drawn)
    if not isinstance(env.unwrapped, ObjectManipulation):
        return jnp.linalg.norm(env.goal_positions[goals] - env.goal_positions[nearest], axis=-1)
    pose = env.unwrapped.goal_quaternion
    cosine_of_half = jnp.abs((pose[goals] * pose[nearest]).sum(-1))
    return jnp.degrees(2 * jnp.arccos(jnp.minimum(cosine_of_half, 1.0)))


def run(name: str, trial: Trial, folder: Path, deadline: float) -> None:
    """Train every lane and seed of a trial, one row for each evaluation of each."""
    config = configuration(trial, folder)
    train = make_train(config)
    env = commanded_by_name(train.env) if trial.by_name else train.env
    lanes = [(lane, seed) for lane in trial.lanes for seed in range(trial.seeds)]
    hyper = batched_hyper(config.hyper, list(trial.lanes.values()), trial.seeds)
    machine = describe_machine()
    keys = jnp.stack([jax.random.fold_in(jax.random.key(0), seed) for _, seed in lanes])
    started = time.time()
    states = jit(jax.vmap(train.initial, in_axes=(0, 0, None)))(keys, hyper, env)
    chunk, numbers = jax.vmap(train.chunk, in_axes=(0, None, 0, None)), jnp.arange(config.epochs_per_evaluation)
    chunk = compiled(chunk, states, numbers, hyper, env, donate_argnums=0)
    errors = jax.jit(jax.vmap(lambda params, goals: code_errors(train, params, goals), in_axes=(0, None)))
    print(f"{name}: {len(lanes)} lanes compiled in {time.time() - started:.0f} s", flush=True)
    path, masks = folder / f"{name}.csv", {"train_goal": env.goals.train_mask, "test_goal": env.goals.test_mask}
    posed = {group: jnp.flatnonzero(mask) for group, mask in masks.items()} if env.goal_positions is not None else {}
    with open(path.with_suffix(".partial"), "w", newline="") as file:
        table = None
        for number in range(config.num_evaluations):
            before = time.time()
            states, epochs, metrics = chunk(
                states, number * config.epochs_per_evaluation + jnp.arange(config.epochs_per_evaluation), hyper, env
            )
            metrics = {
                f"{kind}/success_rate": np.asarray(metrics[f"{kind}/success_rate"])
                for kind in KINDS
                if f"{kind}/success_rate" in metrics
            }
            metrics |= {
                f"learner/{part}": np.asarray(epochs[f"{train.parts.name}/{part}"])[:, -1]
                for part in EPOCH_METRICS
                if f"{train.parts.name}/{part}" in epochs
            }
            seconds = time.time() - before
            for group, goals in posed.items():
                metrics[f"{group}/code_error"] = np.asarray(errors(states.params, goals)).mean(1)
            for lane, (label, seed) in enumerate(lanes):
                row = {
                    "trial": name,
                    "lane": label,
                    "seed": seed,
                    "known_goals": config.known_goals,
                    "updates": (number + 1) * config.epochs_per_evaluation * config.updates_per_epoch,
                }
                row |= {metric: f"{value[lane]:.4g}" for metric, value in metrics.items()} | {"machine": machine}
                table = table or csv.DictWriter(file, row)
                if not file.tell():
                    table.writeheader()
                table.writerow(row)
            file.flush()
            shown = {
                kind: np.round(metrics[f"{kind}/success_rate"].reshape(len(trial.lanes), -1).mean(1), 2).tolist()
                for kind in KINDS
                if f"{kind}/success_rate" in metrics
            }
            rate = len(lanes) * config.epochs_per_evaluation * config.updates_per_epoch / seconds
            print(f"{name} {row['updates']} updates, {rate:.0f}/s in all: {json.dumps(shown)}", flush=True)
            if time.time() + 1.2 * seconds > deadline:
                break
    path.with_suffix(".partial").rename(path)


def load(path: Path) -> list[Row]:
    """What is kept of the trials."""
    return trial_numbers.read(path)


def tables(rows: list[Row]) -> dict[str, str]:
    """The tables that docs/trials.md shows: of each group of tasks the trials that were run."""
    done = {row["trial"] for row in rows}
    all_goals = [trial for trial in QUEUE if trial.startswith(tuple(ALL_GOALS_TABLES))]
    others = [trial for trial in QUEUE if trial not in all_goals]
    grouped = {
        name: ([trial for trial in others if QUEUE[trial].task in tasks], error)
        for name, (tasks, error) in TABLES.items()
    } | {
        name: ([trial for trial in all_goals if trial.startswith(name)], error)
        for name, error in ALL_GOALS_TABLES.items()
    }
    shown = {}
    for name, (trials, error) in grouped.items():
        if run := [trial for trial in trials if trial in done]:
            shown[name] = trial_numbers.table(rows, run, error)
    for name, pairs in COMPARISONS.items():
        if compared := [pair for pair in pairs if all(trial in done for trial, _ in pair)]:
            shown[name] = trial_numbers.differences(rows, compared)
    return shown


def list_queue() -> None:
    """Print the queue, and how many of its updates each trial has made in the numbers that are kept."""
    done = trial_numbers.updates_of(load(NUMBERS)) if NUMBERS.exists() else {}
    for name, trial in QUEUE.items():
        config = preset_of(trial)
        updates = (
            f"{done.get(name, 0):,} of {config.num_epochs * config.updates_per_epoch:,} updates"
            if name in done
            else "to be run"
        )
        print(
            f"{name}: {trial.task}, {presets.name_of(config)}, known goals {config.known_goals}, "
            f"{len(trial.lanes)} lane(s) of {trial.seeds} seeds; "
            f"{updates}"
        )


def main():
    """Run what is not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--trials", nargs="*", choices=QUEUE, default=list(QUEUE))
    parser.add_argument("--list", action="store_true", help="print the queue, how far each trial has come, and stop")
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
            run(name, trial._replace(settings=trial.settings | further), arguments.out, deadline)


if __name__ == "__main__":
    main()
