"""`infogoal pretrain`: the low level's training with a progress line, a curve on disk and a clean stop; keeps the best of several seeds.

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
from infogoal_jax.train import files, low_level_file
from infogoal_jax.train.compilation import compiler_options
from infogoal_jax.train.host import stop_on_signal
from infogoal_jax.train.pretrain import COLLECT, EVALUATE, Pretrain, PretrainConfig, PretrainState, make_pretrain, numbered

MILESTONES = (0.9, 0.95, 0.99)
"""Success rates of which it is recorded when a seed first had them."""
CHOICE = "highest success on target states over fresh episodes: the low level's own task, no goal of the high level is looked at"
CURVE = ("env_steps", "success_rate", "success_any", "value", "td_error")


@dataclasses.dataclass
class Pretrained:
    """A finished or stopped training. seeds: what each reached; stopped: by Ctrl-C before the end."""

    folder: Path
    seeds: list[dict[str, Any]]
    kept: dict[str, Any]
    stopped: bool
    compile_seconds: float
    run_seconds: float


@contextmanager
def progress_line(config: PretrainConfig, num_seeds: int) -> Iterator[Any]:
    """A function that shows how far training is: a moving bar in a terminal, a line for each epoch in a log file."""
    bar = Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.fields[numbers]}"),
                   console=Console(), refresh_per_second=2)
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


def compiled_functions(program: Pretrain, states: PretrainState, hyper: Any):
    """`run` and `learn` over all seeds, compiled side by side; and `policy`. The robot is simulated by one program, in training and evaluation."""
    options = compiler_options()
    policy = jax.jit(jax.vmap(program.policy), compiler_options=options)
    run = jax.jit(jax.vmap(program.run, in_axes=(0, 0, None, None)), compiler_options=options)
    learn = jax.jit(jax.vmap(program.learn, in_axes=(0, 0, None, None)), donate_argnums=0, compiler_options=options)
    low_levels = jax.eval_shape(policy, states)
    rows = jax.eval_shape(run, low_levels, states.key, jnp.bool(True), hyper)[0]
    with ThreadPoolExecutor() as pool:
        jobs = [pool.submit(lambda: run.lower(low_levels, states.key, jnp.bool(True), hyper).compile()),
                pool.submit(lambda: learn.lower(states, rows, jnp.int32(0), hyper).compile())]
        return policy, *(job.result() for job in jobs)


def pretrain(config: PretrainConfig, seeds: list[int], folder: Path, evaluation_episodes: int = 2000, command: str = "") -> Pretrained:
    """Train the low level of a task with these seeds in one program, and leave the best one in `folder`.

    Raises `UserError` before any compilation for a folder that holds one already, or seeds that cannot be used.
    """
    require(len(seeds) > 0, "seeds", len(seeds), "give at least 1")
    require(min(seeds) >= 0 and max(seeds) < 2**32, "seeds", f"{min(seeds)} to {max(seeds)}", "give seeds from 0 to below 2^32 (--first-seed)")
    require(evaluation_episodes > 0, "evaluation_episodes", evaluation_episodes, "give a whole number greater than 0")
    for name in ("low_level", "curve.csv", "curve.jsonl"):
        if (folder / name).exists():
            raise UserError(f"out = {str(folder)!r}: holds a low level or its curve already; give another folder")
    program, hyper = make_pretrain(config), jax.device_put(config.hyper)
    files.make_folder(folder)
    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))
    folded = jax.vmap(numbered, in_axes=(0, None, None))
    started = time.perf_counter()
    states = jax.jit(jax.vmap(program.initial, in_axes=(0, None)))(keys, hyper)
    policy, run, learn = compiled_functions(program, states, hyper)
    jax.block_until_ready((policy(states), folded(keys, COLLECT, jnp.int32(0))))
    compile_seconds = time.perf_counter() - started

    curve, done, env_steps = [], 0, np.zeros(len(seeds), np.int64)
    started = time.perf_counter()
    with stop_on_signal() as stop, progress_line(config, len(seeds)) as advance:
        while done < config.num_epochs and not stop.requested:
            number = jnp.int32(done)
            rows, success = run(policy(states), folded(keys, COLLECT, number), jnp.bool(True), hyper)
            states, metrics = learn(states, rows, number, hyper)
            metrics = jax.device_get(metrics | success)
            done, seconds = done + 1, time.perf_counter() - started
            env_steps = env_steps + metrics["env_steps"]
            shown = {name: metrics[name] for name in CURVE} | {"env_steps": env_steps}
            curve += [{"seed": seed, "epoch": done, "seconds": round(seconds, 3)} | {name: value[i].item() for name, value in shown.items()}
                      for i, seed in enumerate(seeds)]
            files.append_rows(folder, "curve", curve[-len(seeds):])
            advance(done, seconds, metrics["success_rate"])
    run_seconds, stopped = time.perf_counter() - started, done < config.num_epochs

    low_levels = policy(states)
    rounds = 1 if stopped else -(-evaluation_episodes // (config.num_envs // 2))  # Half of the episodes have targets that stay.
    measured = [jax.device_get(run(low_levels, folded(keys, EVALUATE, jnp.int32(i)), jnp.bool(False), hyper)[1]) for i in range(rounds)]
    reports = [
        {"seed": seed} | {name: round(float(np.mean([each[name][i] for each in measured])), 5) for name in measured[0]}
        | {"seconds_to": {str(rate): first_time(curve, seed, rate) for rate in MILESTONES}}
        for i, seed in enumerate(seeds)
    ]
    best = max(range(len(seeds)), key=lambda i: (reports[i]["success_rate"], reports[i]["following_rate"]))
    header = {
        "task": config.task, "command": command, "config": dataclasses.asdict(config), "epochs": done, "stopped": stopped,
        "kept": seeds[best], "chosen_by": CHOICE, "seeds": reports, "evaluation_episodes": rounds * (config.num_envs // 2),
        "compile_seconds": round(compile_seconds, 1), "run_seconds": round(run_seconds, 1), "versions": versions(),
        "device": jax.devices()[0].device_kind, "date": datetime.date.today().isoformat(),
    }
    low_level_file.save(folder / "low_level", header, jax.device_get(jax.tree.map(lambda leaf: leaf[best], low_levels)))
    return Pretrained(folder, reports, reports[best], stopped, compile_seconds, run_seconds)


def print_result(result: Pretrained) -> None:
    """What each seed reached and when, and where the best one is."""
    for report in result.seeds:
        times = ", ".join(f"{rate} after {'never' if seconds is None else f'{seconds:.1f} s'}" for rate, seconds in report["seconds_to"].items())
        success = f"target states {report['success_rate']:.4f}, moving ahead to the goal {report['following_rate']:.4f}"
        print(f"seed {report['seed']:<6} {success}; {times}")
    print(f"compiling   {result.compile_seconds:.1f} s, running {result.run_seconds:.1f} s")
    print(f"low level   {result.folder / 'low_level'}, seed {result.kept['seed']}{', stopped before the end' if result.stopped else ''}")


def first_time(curve: list[dict], seed: int, rate: float) -> float | None:
    """Seconds until the success rate of a seed was first this high; None if it never was."""
    return next((row["seconds"] for row in curve if row["seed"] == seed and row["success_rate"] >= rate), None)


def versions() -> dict[str, str]:
    """Versions of what the weights depend on."""
    packages = {name: importlib.metadata.version(name) for name in ("jax", "mujoco", "mujoco-mjx", "flax", "optax", "numpy")}
    return {"infogoal_jax": infogoal_jax.__version__, "python": platform.python_version(), **packages}
