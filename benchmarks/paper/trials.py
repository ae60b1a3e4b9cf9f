"""Trials: short, cheap experiments that decide what a method needs, several settings of floats and several seeds side by side in one program.

    python benchmarks/paper/trials.py --out FOLDER [--trials cube_her cube_infogoal_window_1 ...] [--list] [--minutes 9]

`QUEUE` is the list of what is to be run, in order of what it would tell. A trial is a preset, what is changed in it, and *lanes*: settings of
the float hyperparameters that are trained in the same compiled program. Every evaluation of every lane and seed is a row of FOLDER/TRIAL.csv,
written as it comes, so that a run that is cut keeps what it found; --minutes stops the last one in time. A finished trial is not run again.
"""

import argparse
import csv
import dataclasses
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import compiler_options, presets, use_compilation_cache
from infogoal_jax.config import Hyperparameters, TrainConfig
from infogoal_jax.learners.learner import encode_all
from infogoal_jax.train.program import make_train

KINDS = ("train_goal", "validation_goal", "test_goal", "corrupted_train_goal", "corrupted_test_goal", "train_goal_mean_code", "test_goal_mean_code")
EPOCH_METRICS = ("beta", "accuracy", "kl")


class Trial(NamedTuple):
    """task, method, relabelling: of the preset. settings: dotted fields that are changed in it. lanes: names and float hyperparameters of each."""

    task: str
    method: str
    relabelling: str | None
    settings: dict[str, Any]
    lanes: dict[str, dict[str, float]]
    seeds: int = 2


CUBE = {
    "env.generator_seed": 100, "env.goal_seed": 100, "env.episode_length": 100, "rollout_steps": 100, "num_envs": 128, "updates_per_epoch": 1000,
    "evaluation_starts": 2, "num_epochs": 60, "epochs_per_evaluation": 5,
}
"""The cube with episodes long enough for it: 60,000 updates."""

FETCH = {"num_epochs": 200, "epochs_per_evaluation": 20}
"""Fetch with 20,000 updates, on the goals that are shipped: settings are to be compared by their validation goals."""

THRESHOLDS = {f"threshold {value}": {"beta_threshold": value} for value in (0.96, 0.99, 0.999)}
UNCOMPRESSED = {"no compression": {"beta_step": 0.0, "beta_start": 0.0}}
NO_REWARD = {"no intrinsic reward": {"intrinsic_weight": 0.0, "beta_threshold": 0.99}}

QUEUE = {
    "cube_her": Trial("object_manipulation", "her", None, CUBE, {"preset": {}}, seeds=4),
    **{f"cube_infogoal_her_window_{window}": Trial("object_manipulation", "infogoal", "her", CUBE | {"learner.window": window},
                                                   THRESHOLDS | UNCOMPRESSED | NO_REWARD) for window in (1, 0, 3)},
    "cube_infogoal_her_small_subgoals": Trial("object_manipulation", "infogoal", "her", CUBE | {"learner.window": 1, "agent.subgoal_scale": 0.2618},
                                              THRESHOLDS | UNCOMPRESSED),
    "pick_and_place_her": Trial("fetch_pick_and_place", "her", None, FETCH, {"preset": {}}, seeds=3),
    "pick_and_place_infogoal": Trial("fetch_pick_and_place", "infogoal", None, FETCH, THRESHOLDS, seeds=3),
    "pick_and_place_infogoal_her": Trial("fetch_pick_and_place", "infogoal", "her", FETCH, THRESHOLDS, seeds=3),
    "pick_and_place_infogoal_her_window_1": Trial("fetch_pick_and_place", "infogoal", "her", FETCH | {"learner.window": 1}, THRESHOLDS, seeds=3),
    "pick_and_place_infogoal_her_corruption": Trial("fetch_pick_and_place", "infogoal", "her", FETCH | {"training_corruption": 0.4}, THRESHOLDS,
                                                    seeds=3),
    "reach_infogoal": Trial("fetch_reach", "infogoal", None, FETCH, THRESHOLDS, seeds=3),
    "reach_infogoal_her": Trial("fetch_reach", "infogoal", "her", FETCH, THRESHOLDS, seeds=3),
    "reach_infogoal_corruption": Trial("fetch_reach", "infogoal", None, FETCH | {"training_corruption": 0.4}, THRESHOLDS, seeds=3),
}
"""What is run, in order. The cube's seeds of dataset and goals are 100: results are shown on others."""


def with_settings(config: TrainConfig, settings: dict[str, Any]) -> TrainConfig:
    """The configuration with dotted fields changed, all at once: some are only right together."""
    changes: dict[str, Any] = {}
    for name, value in settings.items():
        part, _, field = name.rpartition(".")
        if part:
            changes[part] = dataclasses.replace(changes.get(part, getattr(config, part)), **{field: value})
        else:
            changes[field] = value
    return dataclasses.replace(config, **changes)


def code_errors(train, params, goals: jax.Array) -> jax.Array:
    """How far each of these goals [M] lies from the one whose mean code is nearest to a code drawn for it, in degrees or metres.

    That is the resolution of the code, to be held beside the tolerance of success: 10 degrees, 5 cm.
    """
    env, learner = train.env, train.parts.learner
    table = encode_all(learner, params["goal"], env.goals).mean
    drawn = learner.encode(params["goal"], env.goals.inputs_of(goals)).sample(jax.random.key(0))
    nearest = jax.lax.map(lambda code: jnp.abs(table - code).mean(-1).argmin(), drawn)
    if not hasattr(env, "goal_quaternion"):
        return jnp.linalg.norm(env.goal_positions[goals] - env.goal_positions[nearest], axis=-1)
    cosine_of_half = jnp.abs((env.goal_quaternion[goals] * env.goal_quaternion[nearest]).sum(-1))
    return jnp.degrees(2 * jnp.arccos(jnp.minimum(cosine_of_half, 1.0)))


def run(name: str, trial: Trial, folder: Path, deadline: float) -> None:
    """Train every lane and seed of a trial, one row for each evaluation of each."""
    config = with_settings(presets.load(trial.task, trial.method, relabelling=trial.relabelling), trial.settings)
    train = make_train(config)
    env, lanes = train.env, [(lane, seed) for lane in trial.lanes for seed in range(trial.seeds)]
    values = [dataclasses.asdict(config.hyper) | trial.lanes[lane] for lane, _ in lanes]
    hyper = Hyperparameters(**{field: jnp.asarray([value[field] for value in values], jnp.float32) for field in values[0]})
    keys = jnp.stack([jax.random.fold_in(jax.random.key(0), seed) for _, seed in lanes])
    started = time.time()
    states = jax.jit(jax.vmap(train.initial, in_axes=(0, 0, None)), compiler_options=compiler_options())(keys, hyper, env)
    chunk = jax.jit(jax.vmap(train.chunk, in_axes=(0, None, 0, None)), donate_argnums=0).lower(
        states, jnp.arange(config.epochs_per_evaluation), hyper, env).compile(compiler_options())
    errors = jax.jit(jax.vmap(lambda params, goals: code_errors(train, params, goals), in_axes=(0, None)))
    print(f"{name}: {len(lanes)} lanes compiled in {time.time() - started:.0f} s", flush=True)
    path, masks = folder / f"{name}.csv", {"train_goal": env.goals.train_mask, "test_goal": env.goals.test_mask}
    posed = {group: jnp.flatnonzero(mask) for group, mask in masks.items()} if env.goal_positions is not None else {}
    with open(path.with_suffix(".partial"), "w", newline="") as file:
        table = None
        for number in range(config.num_evaluations):
            before = time.time()
            states, epochs, metrics = chunk(states, number * config.epochs_per_evaluation + jnp.arange(config.epochs_per_evaluation), hyper, env)
            metrics = {f"{kind}/success_rate": np.asarray(metrics[f"{kind}/success_rate"]) for kind in KINDS if f"{kind}/success_rate" in metrics}
            metrics |= {f"learner/{part}": np.asarray(epochs[f"{train.parts.name}/{part}"])[:, -1] for part in EPOCH_METRICS
                        if f"{train.parts.name}/{part}" in epochs}
            seconds = time.time() - before
            for group, goals in posed.items():
                metrics[f"{group}/code_error"] = np.asarray(errors(states.params, goals)).mean(1)
            for lane, (label, seed) in enumerate(lanes):
                row = {"trial": name, "lane": label, "seed": seed, "updates": (number + 1) * config.epochs_per_evaluation * config.updates_per_epoch}
                row |= {metric: f"{value[lane]:.4g}" for metric, value in metrics.items()}
                table = table or csv.DictWriter(file, row)
                if not file.tell():
                    table.writeheader()
                table.writerow(row)
            file.flush()
            shown = {kind: np.round(metrics[f"{kind}/success_rate"].reshape(len(trial.lanes), -1).mean(1), 2).tolist() for kind in KINDS
                     if f"{kind}/success_rate" in metrics}
            rate = len(lanes) * config.epochs_per_evaluation * config.updates_per_epoch / seconds
            print(f"{name} {row['updates']} updates, {rate:.0f}/s in all: {json.dumps(shown)}", flush=True)
            if time.time() + 1.2 * seconds > deadline:
                break
    path.with_suffix(".partial").rename(path)


def main():
    """Run what is not there yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--trials", nargs="*", choices=QUEUE, default=list(QUEUE))
    parser.add_argument("--list", action="store_true", help="print the queue and stop")
    parser.add_argument("--minutes", type=float, default=1e6, help="stop after this time")
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=JSON", help="further fields, for a try at a small size")
    arguments = parser.parse_args()
    if arguments.list or arguments.out is None:
        for name, trial in QUEUE.items():
            print(f"{name}: {trial.task}, {trial.method}, {len(trial.lanes)} lanes of {trial.seeds} seeds")
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
