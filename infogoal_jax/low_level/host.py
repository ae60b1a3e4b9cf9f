"""`infogoal pretrain`: the tasks that a low level can be trained for, what that needs of a device's memory, and its
training with a progress line, a curve on disk and a clean stop; keeps the best of several seeds.

FOLDER/curve.csv, .jsonl   a line for each seed and epoch, written as it goes
FOLDER/low_level           actor and normalisation of the best seed, with what made them in its header
"""

import dataclasses
import datetime
import importlib.metadata
import math
import platform
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import infogoal_jax
from infogoal_jax.envs import object_manipulation
from infogoal_jax.errors import UserError, nearest, require
from infogoal_jax.keys import written_out
from infogoal_jax.low_level import fetch, joints
from infogoal_jax.low_level.fetch import FetchPretrainConfig
from infogoal_jax.low_level.joints import JointPretrainConfig
from infogoal_jax.low_level.trainer import COLLECT, EVALUATE, PretrainConfig, TargetAgent, Trainer, make_trainer, save
from infogoal_jax.runner import memory
from infogoal_jax.runner.compilation import jit, without_garbage_collection
from infogoal_jax.runner.host import checked_seeds
from infogoal_jax.runner.listeners import ProgressLine, progress_line
from infogoal_jax.runs import tables
from infogoal_jax.runs.folder import LOW_LEVEL, check_new, only_writer
from infogoal_jax.stopping import StopRequest, stop_on_signal

TASKS = (*fetch.PRESETS, JointPretrainConfig.task)


def preset(task: str, **changes: Any) -> PretrainConfig:
    """The tuned configuration of a task; `changes` replace its fields. Raises `UserError` for a task without a low
    level."""
    require(
        task in TASKS,
        "task",
        task,
        f"no low level can be trained for it.{nearest(task, list(TASKS))} Known: {', '.join(TASKS)}",
    )
    if task in fetch.PRESETS:
        return FetchPretrainConfig(**({"task": task} | fetch.PRESETS[task] | changes))
    return JointPretrainConfig(**changes)


def make_agent(config: PretrainConfig) -> TargetAgent:
    """The agent of a configuration. Raises `UserError` for a dataset that cannot be used."""
    if isinstance(config, JointPretrainConfig):
        return joints.make(config, object_manipulation.make(config.env))
    return fetch.make(config)


def check_fits(agent: TargetAgent, num_seeds: int) -> None:
    """Raise `UserError`, naming the field that is to blame, if the seeds need more memory than there is."""
    needed, room = num_seeds * seed_bytes(agent), memory.device_memory(jax.devices()[0])
    if needed <= room:
        return
    config = agent.config
    fields = [
        memory.Larger(
            name, value, usual, lambda name=name, usual=usual: num_seeds * bytes_with_usual(config, name, usual)
        )
        for name, value, usual in memory.larger_fields(config, preset(config.task))
    ]
    if num_seeds > 1:
        fields.insert(0, memory.Larger("seeds", num_seeds, 1, lambda: seed_bytes(agent)))
    needs = f"training the low level needs {needed / memory.GIB:,.1f} GiB at least"
    raise memory.refusal(fields, config.task, room, needs)


def seed_bytes(agent: TargetAgent) -> int:
    """Bytes that a seed needs at least: what is carried, and an epoch's episodes or its updates."""
    trainer, hyper, key = make_trainer(agent), agent.config.hyper, jax.random.key(0)
    state = jax.eval_shape(trainer.initial, key, hyper)
    low_level = jax.eval_shape(trainer.policy, state)
    run = jax.jit(agent.run).trace(low_level, key, jnp.bool(True), hyper)
    rows = jax.eval_shape(agent.run, low_level, key, jnp.bool(True), hyper)[0]
    learn = jax.jit(trainer.learn).trace(state, rows, jnp.int32(0), hyper)
    running = max(memory.peak_bytes(run.jaxpr), memory.bytes_of(rows) + memory.peak_bytes(learn.jaxpr))
    return memory.bytes_of(state) + running


def bytes_with_usual(config: PretrainConfig, name: str, usual: Any) -> float:
    """Bytes that a seed would need with the usual value of a field; none could be more where that makes no program."""
    try:
        return seed_bytes(make_agent(memory.with_field(config, name, usual)))
    except UserError:
        return math.inf


MILESTONES = (0.9, 0.95, 0.99)
"""Success rates of which it is recorded when a seed first had them."""
CHOICE = (
    "highest success on target states over fresh episodes: the low level's own task, no goal of the high level is "
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


def compiled_functions(trainer: Trainer, keys: jax.Array, hyper: Any):
    """`initial`, `policy`, `run` and `learn` over all seeds, compiled side by side. One program simulates the robot in
    training and evaluation."""
    explores, number = jnp.bool(True), jnp.int32(0)
    initial, policy = jit(jax.vmap(trainer.initial, in_axes=(0, None))), jit(jax.vmap(trainer.policy))
    run = jit(jax.vmap(trainer.agent.run, in_axes=(0, 0, None, None)))
    learn = jit(jax.vmap(trainer.learn, in_axes=(0, 0, None, None)), donate_argnums=0)
    states = jax.eval_shape(initial, keys, hyper)
    low_levels = jax.eval_shape(policy, states)
    rows = jax.eval_shape(run, low_levels, keys, explores, hyper)[0]
    calls = (
        (initial, (keys, hyper)),
        (policy, (states,)),
        (run, (low_levels, keys, explores, hyper)),
        (learn, (states, rows, number, hyper)),
    )
    with without_garbage_collection(), ThreadPoolExecutor() as pool:
        return list(pool.map(lambda call: call[0].lower(*call[1]).compile(), calls))


def pretrain(
    config: PretrainConfig, seeds: Sequence[int], folder: str | Path, evaluation_episodes: int = 2000, command: str = ""
) -> Pretrained:
    """Train the low level of a task with these seeds in one program, and leave the best one in `folder`.

    Raises `UserError` before any compilation for a folder that holds one already or is being written, for seeds that
    cannot be used, and for sizes that need more memory than there is.
    """
    folder, seeds = Path(folder), checked_seeds(seeds)
    require(evaluation_episodes > 0, "evaluation_episodes", evaluation_episodes, "give a whole number greater than 0")
    check_new(folder, LOW_LEVEL)
    agent, words = make_agent(config), f"{config.task} low level x {len(seeds)}"
    check_fits(agent, len(seeds))
    with stop_on_signal() as stop, only_writer(folder, new=LOW_LEVEL), progress_line(words, config.num_epochs) as line:
        stop.advice = f"{folder} holds no low level; start again"
        line.compiling()
        return pretrain_in(config, agent, seeds, folder, evaluation_episodes, command, stop, line)


def pretrain_in(
    config: PretrainConfig,
    agent: TargetAgent,
    seeds: Sequence[int],
    folder: Path,
    evaluation_episodes: int,
    command: str,
    stop: StopRequest,
    line: ProgressLine,
) -> Pretrained:
    """Train to the end or until a signal comes, and write the curve and the best low level."""
    hyper = jax.device_put(config.hyper)
    trainer, keys = make_trainer(agent), written_out(jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32)))

    def keys_of(purpose: int, number: int) -> jax.Array:
        return jax.vmap(lambda key: agent.key(key, purpose, jnp.int32(number)))(keys)

    started = time.perf_counter()
    initial, policy, run, learn = compiled_functions(trainer, keys, hyper)
    states = initial(keys, hyper)
    jax.block_until_ready((policy(states), keys_of(COLLECT, 0)))
    compile_seconds = time.perf_counter() - started
    stop.check()

    curve, done, env_steps = [], 0, np.zeros(len(seeds), np.int64)
    started = time.perf_counter()
    stop.finishing = "this epoch, with what was learned"
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
        tables.append_rows(folder, "curve", curve[-len(seeds) :])
        line.advance(done, f"success {' '.join(f'{rate:.2f}' for rate in metrics['success_rate'])}")
    run_seconds, stopped = time.perf_counter() - started, done < config.num_epochs

    low_levels = policy(states)
    stop.finishing = "this round of episodes, with what was learned"
    measured: list[dict[str, np.ndarray]] = []
    while not measured or (not stop.requested and len(measured) * agent.num_measured < evaluation_episodes):
        _, found = run(low_levels, keys_of(EVALUATE, len(measured)), jnp.bool(False), hyper)
        measured.append(jax.device_get(found))
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
        "evaluation_episodes": len(measured) * agent.num_measured,
        "compile_seconds": round(compile_seconds, 1),
        "run_seconds": round(run_seconds, 1),
        "versions": versions(),
        "device": jax.devices()[0].device_kind,
        "date": datetime.date.today().isoformat(),
        **agent.header,
    }
    save(folder / "low_level", header, jax.device_get(jax.tree.map(lambda leaf: leaf[best], low_levels)))
    stop.finishing = ""
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
