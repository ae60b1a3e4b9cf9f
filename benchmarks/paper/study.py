"""What studies share: training a configuration with the time that it took, the evaluation at which numbers are read,
and Markdown."""

import json
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import study_numbers
from study_numbers import Study, StudyRun

from infogoal_jax.report.machine import describe_machine
from infogoal_jax.report.statistics import mean_interval, paired_difference
from infogoal_jax.report.tables import Table
from infogoal_jax.reproduce import manifest
from infogoal_jax.train import host, memory
from infogoal_jax.train.evaluation import EVALUATION_SEED, evaluate, group_means, random_policy, shortest_path_policy
from infogoal_jax.train.listeners import make_listeners

CONVERGED = 0.99  # Success on training goals, twice in a row.
KINDS = {
    "train_goal": "training",
    "validation_goal": "validation",
    "test_goal": "test",
    "corrupted_test_goal": "corrupted test",
    "corrupted_train_goal": "corrupted training",
}
"""Kinds of goals as metrics name them, and in words."""
METHODS = manifest.METHODS | {"none": "bare agent"}
"""The methods of the paper's Table I, in its order."""


def title_of(method: str, task: str) -> str:
    """A method's name in a table: the bare agent has that of the task's agent, and `vae+her` is `VAE + HER`."""
    if method == "none":
        return {"object_search": "DQN", "embodied_qa": "CQL"}.get(task, "HRAC")
    return " + ".join(METHODS.get(part, part) for part in method.split("+"))


def train(config, seeds: int, out: Path, measure: Callable[[host.Sweep], dict] = lambda sweep: {}) -> None:
    """Train a configuration into the folder `out`, and write result.json beside it: machine, seconds, and what
    `measure` finds in the whole sweep.

    Seconds go from the first line to the last evaluation, with those of compiling apart. What is finished is not run
    again; what was stopped goes on.
    """
    if (out / "result.json").exists():
        return
    started = time.perf_counter()
    with make_listeners(out, config, seeds) as listeners:
        resume = (out / "config.json").exists()
        sweep = host.run(config, range(seeds), out, resume, listeners.progress, compiling=listeners.compiling)
    if sweep.stopped:
        sys.exit(130)
    result = {
        "machine": describe_machine(),
        "diverged": list(sweep.diverged),
        "updates": config.num_epochs * config.updates_per_epoch,
        "compile_seconds": sweep.compile_seconds,
        "run_seconds": sweep.run_seconds,
        "seconds": time.perf_counter() - started,
        "data_bytes": memory.bytes_of(sweep.train.env),
        "peak_bytes": (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use"),
    }
    (out / "result.json").write_text(json.dumps(result | measure(sweep)) + "\n")


def write_baselines(load: Callable[[], Any], path: Path, starts: int, seed: int = EVALUATION_SEED) -> None:
    """Write the scores of a random policy (`_random`) and of shortest paths (`_shortest`) in the environment of
    `load()`, unless they are there."""
    if path.exists():
        return
    env = load()
    scores = {}
    for name, policy in {"random": random_policy(env), "shortest": shortest_path_policy(env)}.items():
        found = jax.jit(lambda env, policy=policy: evaluate(policy, env, env.goals.evaluated, starts, seed))(env)
        for group, means in group_means(found, env.goals).items():
            scores |= {f"{group}_goal_{name}/{score}": float(mean) for score, mean in means.items()}
    path.write_text(json.dumps(scores) + "\n")


def finish(
    folder: Path, report: Callable[[Study], str], collect: Callable[[Path], Study] = study_numbers.collect
) -> Study:
    """Write FOLDER/numbers.npz and FOLDER/study.md of all runs that are there, and print the latter. Returns the
    study."""
    results = collect(folder)
    study_numbers.save(results, folder / study_numbers.FILE)
    (folder / "study.md").write_text(report(results))
    print(report(results))
    return results


def converged(evaluations: Table) -> int:
    """Position of the evaluation at which the agent has converged on the training goals; the last where it never
    has."""
    good = evaluations.values["train_goal/success_rate"].mean(0) >= CONVERGED
    twice = np.flatnonzero(good[1:] & good[:-1])
    return int(twice[0]) + 1 if len(twice) else len(good) - 1


def last(evaluations: Table) -> int:
    """Position of the last evaluation."""
    return -1


def success(run: StudyRun, kind: str, place: int) -> np.ndarray | None:
    """Success rates [seeds] on a kind of goals at this evaluation, or None where the task has no such goals."""
    values = run.evaluations.values.get(f"{kind}/success_rate")
    return None if values is None else values[:, place]


def cells(
    values: dict[str, np.ndarray], methods: Iterable[str], base: str = "none", compared: str = "infogoal"
) -> list[str]:
    """Mean and interval of each method, nothing for one that is missing, and of the paired difference `compared -
    base`."""
    shown = [mean_interval(values[method]).show(2) if method in values else "" for method in methods]
    return [
        *shown,
        paired_difference(values[compared], values[base]).show(2) if {base, compared} <= values.keys() else "",
    ]


def markdown(columns: list[str], rows: Iterable[list[str]]) -> str:
    """A table."""
    return "\n".join(
        [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns), *(f"| {' | '.join(row)} |" for row in rows)]
    )


def describe_run(run: StudyRun, title: str) -> str:
    """What a finished run was and what it took, as an entry of a list; with the beta and accuracy that its learner
    ended with, if it has them."""
    result, final = run.about["result"], run.evaluations.last()
    learned = {
        name.rpartition("/")[2]: mean_interval(final[name]).show(3)
        for name in study_numbers.learned_names(run.about)
        if name in final
    }
    amounts = [f"{len(run.evaluations.seeds)} seeds, {int(run.evaluations.epochs[-1])} epochs"]
    amounts += [f"{result['updates']:,} updates"] if "updates" in result else []
    amounts += (
        [f"{final['env_steps'].mean():,.0f} environment steps a seed"]
        if run.about["config"]["agent"]["name"] != "cql"
        else []
    )
    costs = [
        f"{result['seconds']:.0f} s in all, {result['compile_seconds']:.0f} of them compiling, "
        f"{result['run_seconds']:.0f} running"
    ]
    costs += [f"{result['data_bytes'] / 2**20:.0f} MiB of data"] if "data_bytes" in result else []
    costs += [f"{result['peak_bytes'] / 2**30:.1f} GiB of device memory"] if result["peak_bytes"] else []
    costs += [f"seeds {result['diverged']} diverged"] if result["diverged"] else []
    costs += [f"{name} {shown} at the end" for name, shown in (learned or run.about.get("learned", {})).items()]
    return f"- {title}: {', '.join(amounts)}; {', '.join(costs)}. {run.about['data']}. {result['machine']}"
