"""The host loop: the training program in chunks, with progress, metrics, checkpoints and a clean stop between them."""

import dataclasses
import json
import math
import platform
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import infogoal_jax
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import UserError, require
from infogoal_jax.presets.saved import to_dict
from infogoal_jax.train import checkpoint, files
from infogoal_jax.train.compilation import compiler_options
from infogoal_jax.train.devices import (
    bytes_of,
    chunk_over_seeds,
    device_memory,
    over_seeds,
    seed_mesh,
    seeds_at_once,
    working_bytes,
)
from infogoal_jax.train.program import Train, make_train

WATCHED = ("agent/loss", "agent/gradient_norm")  # Metrics that stop being finite when a seed diverges.


@dataclasses.dataclass
class Progress:
    """What the loop tells its listeners after each chunk: numbers of this run, and the tables' new rows."""

    epoch: int
    num_epochs: int
    compile_seconds: float
    run_seconds: float
    env_steps_per_second: float
    updates_per_second: float
    epochs: list[dict]
    evaluations: list[dict]


Listener = Callable[[Progress], None]


@dataclasses.dataclass
class Sweep:
    """A finished or stopped run. diverged: seeds whose metrics stopped being finite, with the epoch; stopped: by Ctrl-C
    before the end."""

    folder: Path
    train: Train
    params: Any
    diverged: dict[int, int]
    stopped: bool
    compile_seconds: float
    run_seconds: float


class StopRequest:
    """Set by the first Ctrl-C or SIGTERM; a second one stops at once."""

    def __init__(self):
        self.requested = False

    def __call__(self, number, frame):
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        print("\nStopping after this chunk, with a checkpoint. Press Ctrl-C again to stop at once.", flush=True)


@contextmanager
def stop_on_signal() -> Iterator[StopRequest]:
    """Turn Ctrl-C and SIGTERM into a request that the loop reads between chunks. Outside the main thread nothing is
    changed."""
    request = StopRequest()
    try:
        before = {number: signal.signal(number, request) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # Not the main thread: Python keeps signals there.
        before = {}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def describe(config: TrainConfig, env: Any, seeds: list[int]) -> dict[str, Any]:
    """What config.json says beside the configuration: seeds, data and versions."""
    return {
        "config": to_dict(config),
        "seeds": seeds,
        "data": env.source,
        "versions": {
            "infogoal_jax": infogoal_jax.__version__,
            "jax": jax.__version__,
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "device": str(jax.devices()[0].device_kind),
    }


def rows_of(epoch_numbers, seeds: list[int], metrics: dict[str, np.ndarray]) -> list[dict]:
    """Metrics {name: [seeds, epochs, ...]} as rows: seed and epoch first, then every name; arrays become lists."""
    names = sorted(metrics)
    return [
        {"seed": seed, "epoch": int(number)} | {name: metrics[name][i, j].tolist() for name in names}
        for j, number in enumerate(epoch_numbers)
        for i, seed in enumerate(seeds)
    ]


def diverged_seeds(rows: Iterable[dict]) -> dict[int, int]:
    """Seeds whose watched metrics stopped being finite, with the first such epoch, from the rows of the table
    `epochs`."""
    diverged: dict[int, int] = {}
    for row in rows:
        if any(not math.isfinite(row[name]) for name in WATCHED):
            diverged.setdefault(row["seed"], row["epoch"])
    return dict(sorted(diverged.items()))


def differences(first: dict, second: dict, prefix: str = "") -> list[str]:
    """The fields in which two nested dictionaries differ, as `field: first value, now second value`."""
    found = []
    for name in sorted(first.keys() | second.keys()):
        left, right = first.get(name), second.get(name)
        if isinstance(left, dict) and isinstance(right, dict):
            found += differences(left, right, f"{prefix}{name}.")
        elif json.dumps(left) != json.dumps(right):
            found.append(f"{prefix}{name} was {left!r}, now {right!r}")
    return found


def run(
    config: TrainConfig,
    seeds: list[int],
    folder: Path,
    resume: bool = False,
    listeners: tuple[Listener, ...] = (),
    env: Any = None,
) -> Sweep:
    """Train these seeds in one program and leave the run in `folder`. With `resume`, go on from its checkpoint.

    Raises `UserError` before any compilation for a folder that holds another run, a damaged checkpoint, or one of
    another configuration.
    """
    require(len(seeds) > 0, "seeds", len(seeds), "give at least 1")
    require(len(set(seeds)) == len(seeds), "seeds", seeds, "give different seeds")
    require(
        min(seeds) >= 0 and max(seeds) < 2**32,
        "seeds",
        f"{min(seeds)} to {max(seeds)}",
        "give seeds from 0 to below 2^32 (--first-seed)",
    )
    saved = folder / "checkpoint"
    if not resume and (saved.exists() or (folder / "policy").exists()):
        raise UserError(
            f"out = {str(folder)!r}: holds a run already; go on with --resume {folder}, or give another folder"
        )
    train = make_train(config, env)
    mesh = seed_mesh(len(seeds))
    by_seed, everywhere = (
        jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(*axes)) for axes in (("seeds",), ())
    )
    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))
    one_seed = jax.eval_shape(train.initial, jax.random.key(0), config.hyper, train.env)
    memory = min(device_memory(device) for device in mesh.devices.flat)
    at_once = seeds_at_once(
        bytes_of(one_seed), working_bytes(train), bytes_of(train.env), len(seeds) // mesh.size, memory, mesh.size
    )
    states_shape = jax.eval_shape(jax.vmap(lambda key: train.initial(key, config.hyper, train.env)), keys)
    description = describe(config, train.env, seeds)
    done, states = 0, None
    if resume:
        header, states = resume_from(saved, states_shape, description)
        done = header["epoch"]
        states = jax.device_put(states, by_seed)
    files.make_folder(folder)
    files.cut_back(folder, done)
    files.write_atomically(
        folder / "config.json", lambda file: file.write((json.dumps(description, indent=2) + "\n").encode())
    )

    started = time.perf_counter()
    shared = jax.device_put((config.hyper, train.env), everywhere)
    if states is None:
        initial = jax.jit(
            over_seeds(train.initial, len(seeds), at_once, mesh),
            out_shardings=by_seed,
            compiler_options=compiler_options(),
        )
        states = initial(jax.device_put(keys, by_seed), *shared)

    numbers = jnp.arange(config.epochs_per_evaluation, dtype=jnp.int32)
    if done < config.num_epochs:
        chunk = jax.jit(
            chunk_over_seeds(train.chunk, len(seeds), at_once, mesh),
            donate_argnums=0,
            compiler_options=compiler_options(),
        )
        compiled = chunk.lower(states, numbers, *shared).compile()
    compile_seconds, run_seconds, this_session = time.perf_counter() - started, 0.0, 0
    steps_before = int(jax.device_get(states.env_steps).sum())
    with stop_on_signal() as stop:
        while done < config.num_epochs and not stop.requested:
            started = time.perf_counter()
            states, epoch_metrics, metrics = compiled(states, numbers + done, *shared)
            epoch_metrics, metrics = jax.device_get((epoch_metrics, metrics))
            run_seconds += time.perf_counter() - started
            epochs = rows_of(range(done + 1, done + len(numbers) + 1), seeds, epoch_metrics)
            done, this_session = done + len(numbers), this_session + len(numbers)
            evaluations = rows_of([done], seeds, {name: value[:, None] for name, value in metrics.items()})
            files.append_rows(folder, "epochs", epochs)
            files.append_rows(folder, "evaluations", evaluations)
            checkpoint.save(saved, {"epoch": done, **description}, states)
            checkpoint.save(folder / "policy", {"epoch": done, **description}, states.params)
            timing = {
                "compile_seconds": compile_seconds,
                "run_seconds": run_seconds,
                "env_steps_per_second": (int(metrics["env_steps"].sum()) - steps_before) / run_seconds,
                "updates_per_second": this_session * config.updates_per_epoch * len(seeds) / run_seconds,
            }
            files.write_atomically(
                folder / "timing.json", lambda file, timing=timing: file.write((json.dumps(timing) + "\n").encode())
            )
            for listener in listeners:
                listener(
                    Progress(epoch=done, num_epochs=config.num_epochs, epochs=epochs, evaluations=evaluations, **timing)
                )
        stopped = done < config.num_epochs
    # Again, if a kill came between the two files.
    checkpoint.save(folder / "policy", {"epoch": done, **description}, states.params)
    diverged = diverged_seeds(files.read_table(folder, "epochs"))
    return Sweep(folder, train, jax.device_get(states.params), diverged, stopped, compile_seconds, run_seconds)


def resume_from(saved: Path, states_shape: Any, description: dict[str, Any]) -> tuple[dict, Any]:
    """The header and states of a checkpoint, if it is of this configuration; a longer `num_epochs` is all that may
    differ."""
    header, _ = checkpoint.read_header(saved)
    described = (header, json.loads(json.dumps(description)))
    then, now = ({"seeds": of["seeds"], "data": of["data"], **of["config"], "num_epochs": None} for of in described)
    unknown = sorted(now.keys() - then.keys())
    if unknown:
        raise UserError(
            f"{saved}: written by an earlier version, which has no {', '.join(unknown)}; it cannot be resumed: start a "
            "new run"
        )
    different = differences(then, now)
    if different:
        raise UserError(
            f"{saved}: this checkpoint is of another configuration: {'; '.join(different)}. Give the same values, or "
            "start a new run"
        )
    if header["epoch"] > description["config"]["num_epochs"]:
        raise UserError(
            f"num_epochs = {description['config']['num_epochs']}: the run is already at epoch {header['epoch']}; give "
            "at least that"
        )
    return checkpoint.load(saved, states_shape)
