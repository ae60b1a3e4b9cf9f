"""`infogoal pretrain`: the tasks that a low level can be trained for, what that needs of a device's memory, and its
training with a progress line, a curve on disk and a clean stop; keeps the best of several seeds.

FOLDER/curve.csv, .jsonl   a line for each seed and epoch, written as it goes
FOLDER/low_level           actor and normalisation of the best seed, with what made them in its header
"""

import dataclasses
import datetime
import importlib.metadata
import platform
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import infogoal_jax
from infogoal_jax.envs import object_manipulation
from infogoal_jax.errors import nearest, require
from infogoal_jax.keys import from_seed
from infogoal_jax.low_level import fetch, joints
from infogoal_jax.low_level.fetch import FetchPretrainConfig
from infogoal_jax.low_level.joints import JointPretrainConfig
from infogoal_jax.low_level.trainer import COLLECT, EVALUATE, PretrainConfig, TargetAgent, make_trainer, save
from infogoal_jax.runner import memory
from infogoal_jax.runner.compilation import jit, without_garbage_collection
from infogoal_jax.runner.progress import ProgressLine, progress_line
from infogoal_jax.runner.sweep import Callback, Programs, Sweep, train_sweep
from infogoal_jax.runner.training import checked_seeds
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
    """Raise `UserError`, naming the field that is to blame, if the seeds need more memory than there is: for what they
    carry, and for the largest array of an epoch's episodes or updates."""
    config, room = agent.config, memory.device_memory(jax.devices()[0])
    trainer, hyper, key = make_trainer(agent), config.hyper, jax.random.key(0)
    state = jax.eval_shape(trainer.initial, key, hyper)
    low_level = jax.eval_shape(trainer.policy, state)
    run = jax.jit(agent.run).trace(low_level, key, jnp.bool(True), hyper)
    rows = jax.eval_shape(agent.run, low_level, key, jnp.bool(True), hyper)[0]
    learn = jax.jit(trainer.learn).trace(state, rows, jnp.int32(0), hyper)
    carried = memory.bytes_of(state) + memory.bytes_of(rows)
    alone = carried + max(memory.largest_array(run.jaxpr), memory.largest_array(learn.jaxpr))
    if alone > room:
        raise memory.too_large(config, preset(config.task), alone, room)
    require(
        num_seeds * carried <= room,
        "seeds",
        num_seeds,
        f"each takes {carried / memory.GIB:,.3f} GiB, {memory.room_in_words(room)}: give at most {room // carried}",
    )


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


class Functions(NamedTuple):
    """`policy` and `run` over all seeds, compiled."""

    policy: Callable
    run: Callable


def programs_of(agent: TargetAgent, keys: jax.Array, found: dict[str, Any]) -> Programs:
    """The programs of all seeds, compiled side by side: one simulates the robot in training and when it is measured.

    keys: of the seeds [S]. found: gets the compiled `Functions` under "functions".
    """
    trainer, hyper = make_trainer(agent), jax.device_put(agent.config.hyper)
    explores, number = jnp.bool(True), jnp.int32(0)
    initial, policy = jit(jax.vmap(trainer.initial, in_axes=(0, None))), jit(jax.vmap(trainer.policy))
    run = jit(jax.vmap(agent.run, in_axes=(0, 0, None, None)))
    learn = jit(jax.vmap(trainer.learn, in_axes=(0, 0, None, None)), donate_argnums=0)
    shapes = jax.eval_shape(initial, keys, hyper)
    low_levels = jax.eval_shape(policy, shapes)
    rows = jax.eval_shape(run, low_levels, keys, explores, hyper)[0]
    calls = (policy, (shapes,)), (run, (low_levels, keys, explores, hyper)), (learn, (shapes, rows, number, hyper))

    def compiling():
        pool = ThreadPoolExecutor()
        with without_garbage_collection():
            compiled = [pool.submit(function.lower(*arguments).compile) for function, arguments in calls]
        pool.shutdown(wait=False)

        def wait():
            policy, run, learn = (each.result() for each in compiled)
            found["functions"] = Functions(policy, run)

            def chunk(states, numbers):
                (number,) = numbers
                rows, seen = run(policy(states), keys_for(agent, keys, COLLECT, number), explores, hyper)
                states, metrics = learn(states, rows, number, hyper)
                return states, jax.tree.map(lambda value: value[:, None], metrics | seen), {}

            return chunk

        return wait

    return Programs(
        shapes=shapes,
        initial=lambda: initial(keys, hyper),
        compiling=compiling,
        placed=jax.device_put,
        check=lambda: check_fits(agent, len(keys)),
    )


def keys_for(agent: TargetAgent, keys: jax.Array, purpose: int, number: jax.Array) -> jax.Array:
    """The keys of all seeds [S] for a purpose and a number, such as that of the epoch."""
    return jax.vmap(lambda key: agent.key(key, purpose, number))(keys)


@dataclasses.dataclass(frozen=True)
class Schedule:
    """How `train_sweep` goes through the epochs of a low level: its curve has a row for each."""

    num_evaluations: int
    epochs_per_evaluation: int = 1


class Curve(Callback):
    """The curve of a low level's training, a row for each seed and epoch."""

    finishing = "this epoch, with what was learned"

    def __init__(self, agent: TargetAgent, seeds: Sequence[int], folder: Path, line: ProgressLine):
        self.agent, self.seeds, self.folder, self.line = agent, seeds, folder, line
        self.rows: list[dict[str, Any]] = []
        self.env_steps = np.zeros(len(seeds), np.int64)

    def compiling(self, sweep: Sweep) -> None:
        """Tell whoever waits."""
        self.line.compiling()

    def evaluated(self, sweep: Sweep) -> None:
        """Write the rows of the epoch."""
        metrics = {name: value[:, 0] for name, value in sweep.learned.items()}
        if "env_steps" in metrics:
            metrics["env_steps"] = self.env_steps = self.env_steps + metrics["env_steps"]
        rows = [
            {"seed": seed, "epoch": sweep.evaluations, "seconds": round(sweep.run_seconds, 3)}
            | {name: metrics[name][i].item() for name in self.agent.curve}
            for i, seed in enumerate(self.seeds)
        ]
        self.rows += rows
        tables.append_rows(self.folder, "curve", rows)
        rates = " ".join(f"{rate:.2f}" for rate in metrics["success_rate"])
        self.line.advance(sweep.evaluations, f"success {rates}")


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
    keys = jax.vmap(from_seed)(jnp.asarray(seeds, jnp.uint32))
    found: dict[str, Any] = {}
    programs = programs_of(agent, keys, found)
    with stop_on_signal() as stop, only_writer(folder, new=LOW_LEVEL), progress_line(words, config.num_epochs) as line:
        stop.advice = f"{folder} holds no low level; start again"
        curve = Curve(agent, seeds, folder, line)
        sweep = train_sweep(Sweep(Schedule(config.num_epochs), programs), curve, stop)
        if not sweep.evaluations:
            stop.check()
        stop.finishing = "this round of episodes, with what was learned"
        try:
            return measured(sweep, curve, found["functions"], keys, evaluation_episodes, command, stop)
        finally:
            stop.finishing = ""


def measured(
    sweep: Sweep,
    curve: Curve,
    functions: Functions,
    keys: jax.Array,
    evaluation_episodes: int,
    command: str,
    stop: StopRequest,
) -> Pretrained:
    """Measure every seed on fresh episodes, and write the best low level."""
    agent, seeds, folder = curve.agent, curve.seeds, curve.folder
    config, low_levels = agent.config, functions.policy(sweep.states)
    hyper, rounds = jax.device_put(config.hyper), []
    while not rounds or (not stop.requested and len(rounds) * agent.num_measured < evaluation_episodes):
        own = keys_for(agent, keys, EVALUATE, jnp.int32(len(rounds)))
        _, seen = functions.run(low_levels, own, jnp.bool(False), hyper)
        rounds.append(jax.device_get(seen))
    reports = [
        {"seed": seed}
        | {name: round(float(np.mean([each[name][i] for each in rounds])), 5) for name in agent.measured}
        | {"seconds_to": {str(rate): first_time(curve.rows, seed, rate) for rate in MILESTONES}}
        for i, seed in enumerate(seeds)
    ]
    best = max(range(len(seeds)), key=lambda i: [reports[i][name] for name in agent.compared])
    header = {
        "task": config.task,
        "command": command,
        "config": dataclasses.asdict(config),
        "epochs": sweep.evaluations,
        "stopped": not sweep.finished,
        "kept": seeds[best],
        "chosen_by": CHOICE,
        "seeds": reports,
        "evaluation_episodes": len(rounds) * agent.num_measured,
        "compile_seconds": round(sweep.prepare_seconds, 1),
        "run_seconds": round(sweep.run_seconds, 1),
        "versions": versions(),
        "device": jax.devices()[0].device_kind,
        "date": datetime.date.today().isoformat(),
        **agent.header,
    }
    save(folder / "low_level", header, jax.device_get(jax.tree.map(lambda leaf: leaf[best], low_levels)))
    return Pretrained(
        agent, folder, reports, reports[best], not sweep.finished, sweep.prepare_seconds, sweep.run_seconds
    )


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
