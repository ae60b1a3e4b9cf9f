"""What studies share: training a configuration with the time that it took, and the evaluation at which numbers are read."""

import json
import sys
import time
from pathlib import Path

import jax
import numpy as np

from infogoal_jax.report import tables
from infogoal_jax.report.machine import describe_machine
from infogoal_jax.report.statistics import mean_interval
from infogoal_jax.train import host
from infogoal_jax.train.listeners import make_listeners

CONVERGED = 0.99  # Success on training goals, twice in a row.


def train(config, seeds: int, out: Path) -> None:
    """Train a configuration into the folder `out`, and write beside it how long it took: from the first line to the last evaluation, compiling apart.

    What is finished is not run again; what was stopped goes on.
    """
    if (out / "result.json").exists():
        return
    started = time.perf_counter()
    with make_listeners(out, config, seeds) as listeners:
        sweep = host.run(config, list(range(seeds)), out, resume=(out / "checkpoint").exists(), listeners=listeners)
    if sweep.stopped:
        sys.exit(130)
    env = sweep.train.env
    result = {
        "machine": describe_machine(), "data": env.source, "seeds": seeds, "diverged": list(sweep.diverged), "epochs": config.num_epochs,
        "updates": config.num_epochs * config.updates_per_epoch, "compile_seconds": sweep.compile_seconds, "run_seconds": sweep.run_seconds,
        "seconds": time.perf_counter() - started, "data_bytes": host.bytes_of(env),
        "peak_bytes": (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use"),
    }
    (out / "result.json").write_text(json.dumps(result) + "\n")


def converged(values: dict[str, np.ndarray]) -> int:
    """Position of the evaluation at which the agent has converged on the training goals; the last where it never has. values: {name: [seeds, E]}."""
    good = values["train_goal/success_rate"].mean(0) >= CONVERGED
    twice = np.flatnonzero(good[1:] & good[:-1])
    return int(twice[0]) + 1 if len(twice) else len(good) - 1


def describe_run(path: Path, title: str, learner: str = "") -> str:
    """What a finished run was and what it took, as an entry of a list; with the beta and accuracy that this learner ended with, if it has them."""
    result, table = json.loads((path / "result.json").read_text()), tables.read(path, "epochs")
    epochs = table.last()
    learned = {name: epochs[f"{learner}/{name}"] for name in ("beta", "accuracy") if f"{learner}/{name}" in epochs}
    beta = "".join(f", {name} {mean_interval(values).show(3)} at the end" for name, values in learned.items())
    memory = f", {result['peak_bytes'] / 2**30:.1f} GiB of device memory" if result["peak_bytes"] else ""
    lost = f", seeds {result['diverged']} diverged" if result["diverged"] else ""
    return (
        f"- {title}: {result['seeds']} seeds, {int(table.epochs[-1])} epochs, {epochs['env_steps'].mean():,.0f} environment steps a seed; "
        f"{result['seconds']:.0f} s in all, {result['compile_seconds']:.0f} of them compiling, {result['run_seconds']:.0f} running"
        f"{memory}{lost}{beta}. {result['data']}. {result['machine']}"
    )
