"""`infogoal pretrain`: the low level's training with a progress line, a curve on disk and a clean stop; keeps the best
of several seeds.

FOLDER/curve.csv, .jsonl   a line for each seed and epoch, written as it goes
FOLDER/low_level           actor and normalisation of the best seed, with what made them in its header
"""

import dataclasses
import datetime
import importlib.metadata
import platform
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

import infogoal_jax
from infogoal_jax.errors import UserError, require
from infogoal_jax.train import files
from infogoal_jax.train.compilation import compiler_options
from infogoal_jax.train.host import stop_on_signal
from infogoal_jax.train.low_level import file as low_level_file
from infogoal_jax.train.low_level.presets import make_agent
from infogoal_jax.train.low_level.trainer import COLLECT, EVALUATE, PretrainConfig, TargetAgent, Trainer, make_trainer

MILESTONES = (0.9, 0.95, 0.99)
"""Success rates of which it is recorded when a seed first had them."""
CHOICE = (
    "highest success on target states over fresh episodes: the low level's own task, no goal of the high level "
    "is "
    "looked at"
)


@dataclasses.dataclass
class Pretrained:
    """A finished or stopped training. seeds: what each reached; stopped: by Ctrl-C before the end."""

    agent: TargetAgent
    folder: Path
    seeds: list[dict[str, Any]]
    kept: dict[str, Any]
    stopped: bool
    compile_seconds: float
    run_seconds: float


@contextmanager
def progress_line(config: PretrainConfig, num_seeds: int) -> Iterator[Any]:
    """A function that shows how far training is: a moving bar in a terminal, a line for each epoch in a log file."""
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[numbers]}"),
        console=Console(),
        refresh_per_second=2,
    )
    line = bar.add_task(f"{config.task} low level x {num_seeds}", total=config.num_epochs, numbers="compiling")

    def advance(epoch: int, seconds: float, success: np.ndarray):
        numbers = f"{seconds:.1f} s  success " + " ".join(f"{rate:.2f}" for rate in success)
        bar.update(line, completed=epoch, numbers=numbers)
        if not bar.console.is_terminal:
            bar.console.print(f"epoch {epoch}/{config.num_epochs}  {numbers}", soft_wrap=True)

    if bar.console.is_terminal:
        with bar:
            yield advance
    else:
        yield advance


def compiled_functions(trainer: Trainer, keys: jax.Array, hyper: Any):
    """`initial`, `policy`, `run` and `learn` over all seeds, compiled side by side. One program simulates the robot in
    training and evaluation."""
    options, explores, number = compiler_options(), jnp.bool(True), jnp.int32(0)
    initial = jax.jit(jax.vmap(trainer.initial, in_axes=(0, None)), compiler_options=options)
    policy = jax.jit(jax.vmap(trainer.policy), compiler_options=options)
    run = jax.jit(jax.vmap(trainer.agent.run, in_axes=(0, 0, None, None)), compiler_options=options)
    learn = jax.jit(jax.vmap(trainer.learn, in_axes=(0, 0, None, None)), donate_argnums=0, compiler_options=options)
    states = jax.eval_shape(initial, keys, hyper)
    low_levels = jax.eval_shape(policy, states)
    rows = jax.eval_shape(run, low_levels, keys, explores, hyper)[0]
    calls = (
        (initial, (keys, hyper)),
        (policy, (states,)),
        (run, (low_levels, keys, explores, hyper)),
        (learn, (states, rows, number, hyper)),
    )
    with ThreadPoolExecutor() as pool:
        return list(pool.map(lambda call: call[0].lower(*call[1]).compile(), calls))


def pretrain(
    config: PretrainConfig, seeds: list[int], folder: Path, evaluation_episodes: int = 2000, command: str = ""
) -> Pretrained:
    """Train the low level of a task with these seeds in one program, and leave the best one in `folder`.

    Raises `UserError` before any compilation for a folder that holds one already, or seeds that cannot be used.
    """
    require(len(seeds) > 0, "seeds", len(seeds), "give at least 1")
    require(
        min(seeds) >= 0 and max(seeds) < 2**32,
        "seeds",
        f"{min(seeds)} to {max(seeds)}",
        "give seeds from 0 to below 2^32 (--first-seed)",
    )
    require(evaluation_episodes > 0, "evaluation_episodes", evaluation_episodes, "give a whole number greater than 0")
    for name in ("low_level", "curve.csv", "curve.jsonl"):
        if (folder / name).exists():
            raise UserError(f"out = {str(folder)!r}: holds a low level or its curve already; give another folder")
    agent, hyper = make_agent(config), jax.device_put(config.hyper)
    files.make_folder(folder)
    trainer, keys = make_trainer(agent), jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))

    def keys_of(purpose: int, number: int) -> jax.Array:
        return jax.vmap(lambda key: agent.key(key, purpose, jnp.int32(number)))(keys)

    started = time.perf_counter()
    initial, policy, run, learn = compiled_functions(trainer, keys, hyper)
    states = initial(keys, hyper)
    jax.block_until_ready((policy(states), keys_of(COLLECT, 0)))
    compile_seconds = time.perf_counter() - started

    curve, done, env_steps = [], 0, np.zeros(len(seeds), np.int64)
    started = time.perf_counter()
    with stop_on_signal() as stop, progress_line(config, len(seeds)) as advance:
        while done < config.num_epochs and not stop.requested:
            rows, found = run(policy(states), keys_of(COLLECT, done), jnp.bool(True), hyper)
            states, metrics = learn(states, rows, jnp.int32(done), hyper)
            metrics = jax.device_get(metrics | found)
            done, seconds = done + 1, time.perf_counter() - started
            if "env_steps" in metrics:
                metrics["env_steps"] = env_steps = env_steps + metrics["env_steps"]
            curve += [
                {"seed": seed, "epoch": done, "seconds": round(seconds, 3)}
                | {name: metrics[name][i].item() for name in agent.curve}
                for i, seed in enumerate(seeds)
            ]
            files.append_rows(folder, "curve", curve[-len(seeds) :])
            advance(done, seconds, metrics["success_rate"])
    run_seconds, stopped = time.perf_counter() - started, done < config.num_epochs

    low_levels = policy(states)
    rounds = 1 if stopped else -(-evaluation_episodes // agent.num_measured)
    measured = [
        jax.device_get(run(low_levels, keys_of(EVALUATE, number), jnp.bool(False), hyper)[1])
        for number in range(rounds)
    ]
    reports = [
        {"seed": seed}
        | {name: round(float(np.mean([each[name][i] for each in measured])), 5) for name in agent.measured}
        | {"seconds_to": {str(rate): first_time(curve, seed, rate) for rate in MILESTONES}}
        for i, seed in enumerate(seeds)
    ]
    best = max(range(len(seeds)), key=lambda i: [reports[i][name] for name in agent.compared])
    header = {
        "task": config.task,
        "command": command,
        "config": dataclasses.asdict(config),
        "epochs": done,
        "stopped": stopped,
        "kept": seeds[best],
        "chosen_by": CHOICE,
        "seeds": reports,
        "evaluation_episodes": rounds * agent.num_measured,
        "compile_seconds": round(compile_seconds, 1),
        "run_seconds": round(run_seconds, 1),
        "versions": versions(),
        "device": jax.devices()[0].device_kind,
        "date": datetime.date.today().isoformat(),
        **agent.header,
    }
    low_level_file.save(folder / "low_level", header, jax.device_get(jax.tree.map(lambda leaf: leaf[best], low_levels)))
    return Pretrained(agent, folder, reports, reports[best], stopped, compile_seconds, run_seconds)


def print_result(result: Pretrained) -> None:
    """What each seed reached and when, and where the best one is."""
    for report in result.seeds:
        times = ", ".join(
            f"{rate} after {'never' if seconds is None else f'{seconds:.1f} s'}"
            for rate, seconds in report["seconds_to"].items()
        )
        print(f"seed {report['seed']:<6} {result.agent.describe(report)}; {times}")
    print(f"compiling   {result.compile_seconds:.1f} s, running {result.run_seconds:.1f} s")
    print(
        f"low level   {result.folder / 'low_level'}, seed "
        f"{result.kept['seed']}{', stopped before the end' if result.stopped else ''}"
    )


def first_time(curve: list[dict], seed: int, rate: float) -> float | None:
    """Seconds until the success rate of a seed was first this high; None if it never was."""
    return next((row["seconds"] for row in curve if row["seed"] == seed and row["success_rate"] >= rate), None)


def versions() -> dict[str, str]:
    """Versions of what the weights depend on."""
    packages = {
        name: importlib.metadata.version(name) for name in ("jax", "mujoco", "mujoco-mjx", "flax", "optax", "numpy")
    }
    return {"infogoal_jax": infogoal_jax.__version__, "python": platform.python_version(), **packages}
