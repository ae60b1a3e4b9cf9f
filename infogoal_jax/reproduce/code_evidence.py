"""The tests that decide what the paper says of codes and of the intrinsic reward: a number of each seed."""

from collections.abc import Callable

import numpy as np

from infogoal_jax.reproduce import codes
from infogoal_jax.reproduce.effects import (
    LEAST_SEEDS,
    Finding,
    Paired,
    by_seed,
    by_task,
    difference,
    faults_of,
    finding,
    left_out_words,
    of_row,
    pair_words,
)
from infogoal_jax.reproduce.files import Result
from infogoal_jax.reproduce.measure import WEIGHTS
from infogoal_jax.reproduce.needs import PICTURED
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.scores import TITLES, row_of

CORRUPTION = 1 + WEIGHTS.index(0.4)
"""The view of the goals under Table I's corruption."""


def closeness(view: int) -> Callable[[Result], dict[int, float]]:
    """`codes.closeness` in a view of the goals by seed; of a run that was made before all seeds were looked at, that of
    the one seed of its picture."""

    def find(result: Result) -> dict[int, float]:
        if "codes/closeness" in result.arrays:
            found = result.arrays["codes/closeness"]
            return by_seed(result, found[:, view]) if view < found.shape[1] else {}
        if "picture/code_mean" not in result.arrays or view >= len(result.arrays["picture/code_mean"]):
            return {}
        mean, region, use = (result.arrays[f"picture/code_{name}"] for name in ("mean", "region", "use"))
        return {result.run.seeds[0]: codes.closeness(mean[view], region, use)}

    return find


def reward_near(result: Result) -> dict[int, float]:
    """`codes.reward_by_distance` by seed, mean over training goals; or that of the one seed of the run's picture."""
    if "codes/reward" in result.arrays:
        return by_seed(result, result.arrays["codes/reward"])
    if "picture/reward" not in result.arrays:
        return {}
    place, goals = result.arrays["picture/place"], result.arrays["picture/reward_way_goal"]
    rewards = result.arrays["picture/reward"].astype(float)
    found = [codes.reward_by_distance(*each) for each in zip(rewards, [place] * len(goals), goals, strict=True)]
    return {result.run.seeds[0]: float(np.mean(found))}


def enough(tasks: dict[str, Paired]) -> dict[str, Paired]:
    """The goal sets with enough seeds, where there are such; else all."""
    kept = {
        task: {place: seeds for place, seeds in sets.items() if len(seeds) >= LEAST_SEEDS}
        for task, sets in tasks.items()
    }
    kept = {task: sets for task, sets in kept.items() if sets}
    return kept or tasks


def grouped(view: int = 0) -> Callable[[Results], Finding]:
    """The silhouette of InfoGoal's codes by region minus that of the bare agent's, in a view of the goals."""

    def find(results: Results) -> Finding:
        tasks, left_out, counted = {}, [], []
        for task in PICTURED:
            rows = [row_of(results, "paper", task, method) for method in ("infogoal", "none")]
            if None in rows:
                continue
            own = difference(*(of_row(row, closeness(view)) for row in rows))
            if own and faults_of(*rows):
                left_out.append(pair_words("infogoal", "none", task))
            elif own:
                tasks[task] = own
                counted += rows
        without = left_out_words(left_out)
        if not tasks:
            return Finding(None, f"no runs that count{without}")
        tasks = enough(tasks)
        return finding(tasks, f"silhouette by region, {by_task(tasks)}{without}", counted)

    return find


def reward_near_goal(results: Results) -> Finding:
    """Minus the rank correlation of the intrinsic reward with the distance to where the goal is in view, mean over
    training goals."""
    tasks, left_out = {}, []
    for task in ("object_search", "embodied_qa"):
        row = row_of(results, "paper", task, "infogoal")
        own = of_row(row, reward_near) if row is not None else {}
        if own and faults_of(row):
            left_out.append(f"InfoGoal on {TITLES[task]}")
        elif own:
            tasks[task] = own
    without = left_out_words(left_out)
    if not tasks:
        return Finding(None, f"no runs that count{without}")
    tasks = enough(tasks)
    words = f"minus Spearman's correlation with the distance, {by_task(tasks)}{without}"
    return finding(tasks, words)
