"""The study of the README: InfoGoal against bare DQN on three synthetic houses, five seeds each, beside a random policy and the shortest path.

    python benchmarks/house_study.py --out FOLDER [--houses 0 1 2] [--seeds 5]

House 0 is the one that the project ships; the others are built from their seeds. No house of this study was used for tuning. Every run stays in
FOLDER with the curve of every seed; FOLDER/study.json holds the numbers and FOLDER/study.md the table. The share of random actions in
evaluation is chosen for each method and house on training goals alone.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
from machine import describe_machine

from infogoal_jax import presets
from infogoal_jax.data.house import build_house
from infogoal_jax.report.statistics import mean_interval, paired_difference
from infogoal_jax.train import host
from infogoal_jax.train.evaluation import evaluate, oracle_policy, random_policy
from infogoal_jax.train.listeners import make_listeners

METHODS = ("none", "infogoal")
EPSILONS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3)
STARTS, START_SEED = 50, 1
SCORES = ("success_rate", "spl")


def house_config(method: str, house: int, folder: Path):
    """The preset of a method on this house, built first if it is not the shipped one."""
    config = presets.load("object_search", method)
    if house == 0:
        return config
    path = folder / f"house_{house}" / "dataset"
    if not path.exists():
        build_house(path, seed=house)
    return dataclasses.replace(config, env=dataclasses.replace(config.env, dataset=str(path)))


def scores_by_epsilon(sweep: host.Sweep) -> dict[str, np.ndarray]:
    """Every score of the last parameters at every epsilon: {"{group}_goal{epsilon suffix}/{score}": [seeds]}, and with the mean code at 0."""
    train = sweep.train

    def one_seed(params, env):
        policies = {f"@{epsilon}": train.policy(params, epsilon, env) for epsilon in EPSILONS}
        policies["@mean"] = train.policy(params, 0.0, env, use_mean=True)
        return evaluate(env, policies, STARTS, START_SEED)

    return jax.device_get(jax.jit(jax.vmap(one_seed, in_axes=(0, None)))(sweep.params, train.env))


def study_house(house: int, seeds: int, folder: Path) -> dict:
    """Numbers of one house: random policy, shortest path, and for each method its scores at the epsilon chosen on training goals."""
    result: dict = {"house": house}
    for method in METHODS:
        config, out = house_config(method, house, folder), folder / f"house_{house}" / method
        with make_listeners(out, config, seeds) as listeners:
            sweep = host.run(config, list(range(seeds)), out, resume=(out / "checkpoint").exists(), listeners=listeners)
        env = sweep.train.env
        scores = scores_by_epsilon(sweep)
        chosen = max(EPSILONS, key=lambda epsilon: scores[f"train_goal@{epsilon}/success_rate"].mean())
        result["data"] = env.source
        result[method] = {
            "epochs": config.num_epochs, "chosen_epsilon": chosen, "diverged": sweep.diverged,
            "compile_seconds": sweep.compile_seconds, "run_seconds": sweep.run_seconds,
            "scores": {name: value.tolist() for name, value in scores.items() if name != "first_reached"},
        }
    baselines = jax.device_get(jax.jit(lambda env: evaluate(env, {"@random": random_policy(env), "@oracle": oracle_policy(env)}, STARTS, START_SEED))(env))
    result["baselines"] = {name: float(value) for name, value in baselines.items() if name != "first_reached"}
    return result


def chosen_scores(result: dict, method: str, group: str, score: str) -> list[float]:
    """A method's score of each seed at its chosen epsilon."""
    numbers = result[method]
    return numbers["scores"][f"{group}_goal@{numbers['chosen_epsilon']}/{score}"]


def table(results: list[dict], seeds: int) -> str:
    """The study as Markdown."""
    lines = [
        f"{seeds} seeds a cell, mean ± 95 % interval (Student t; of the paired difference in the last column); {STARTS} starts for each goal. "
        "Paper: InfoGoal 0.93, DQN 0.18.", describe_machine(), "",
        "| house (stand-in) | goals | score | random | shortest path | DQN (test epsilon) | InfoGoal (test epsilon) | InfoGoal - DQN |", "|" + "---|" * 8,
    ]
    for result in results:
        for group in ("train", "test"):
            for score in SCORES:
                cells = {method: chosen_scores(result, method, group, score) for method in METHODS}
                shown = [f"{mean_interval(np.asarray(cells[method])).show(2)} ({result[method]['chosen_epsilon']})" for method in METHODS]
                difference = paired_difference(np.asarray(cells["infogoal"]), np.asarray(cells["none"])).show(2)
                baselines = [f"{result['baselines'][f'{group}_goal@{name}/{score}']:.2f}" for name in ("random", "oracle")]
                lines.append("| " + " | ".join([f"seed {result['house']}", group, score.replace("_", " "), *baselines, *shown, difference]) + " |")
    lines += ["", *(f"House {result['house']}: {result['data']}." for result in results)]
    return "\n".join(lines) + "\n"


def main():
    """Run what is not there yet, then write study.json and study.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--houses", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    results = [study_house(house, arguments.seeds, arguments.out) for house in arguments.houses]
    (arguments.out / "study.json").write_text(json.dumps({"machine": describe_machine(), "seeds": arguments.seeds, "houses": results}, indent=1) + "\n")
    (arguments.out / "study.md").write_text(table(results, arguments.seeds))
    print(table(results, arguments.seeds))


if __name__ == "__main__":
    main()
