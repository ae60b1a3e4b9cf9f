"""The host loop: the training program in chunks, with progress, metrics, checkpoints and a clean stop between them."""

import contextlib
import dataclasses
import math
import platform
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import infogoal_jax
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import require, typed
from infogoal_jax.runner import distributed
from infogoal_jax.runner.compilation import Chunk, chunk_of, jit
from infogoal_jax.runner.distributed import epochs_over_seeds, over_seeds, placed, seed_mesh, shardings_of
from infogoal_jax.runner.memory import at_once as seeds_at_once
from infogoal_jax.runner.memory import check_program
from infogoal_jax.runs import checkpoint, configuration, tables
from infogoal_jax.runs.checkpoint import BEGINNING, Point, last_point
from infogoal_jax.runs.configuration import MOST_SEEDS, Description
from infogoal_jax.runs.folder import RUN, check_new, only_writer
from infogoal_jax.runs.tables import Timing
from infogoal_jax.stopping import StopRequest, stop_on_signal
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
    """A finished or stopped run. diverged: seeds whose metrics stopped being finite, with the epoch; stopped: by a
    signal before the end."""

    folder: Path
    train: Train
    params: Any
    diverged: dict[int, int]
    stopped: bool


@dataclasses.dataclass(frozen=True)
class Programs:
    """Training of all seeds side by side. initial: (keys, hyper, env) -> states; chunk: of (states, epochs [E], hyper,
    env); shared: hyper and env on every device; states_shape: shapes of all seeds' states; count: of seeds."""

    initial: Callable
    chunk: Chunk
    shared: Any
    states_shape: Any
    by_seed: jax.sharding.NamedSharding
    count: int


def describe(config: TrainConfig, env: Any, seeds: list[int]) -> Description:
    """What config.json says of a run with these seeds, which is to be found again from any folder."""
    versions = {
        "infogoal_jax": infogoal_jax.__version__,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }
    return Description(configuration.located(config), seeds, env.source, versions, str(jax.devices()[0].device_kind))


def rows_of(epoch_numbers, seeds: list[int], metrics: dict[str, np.ndarray]) -> list[dict]:
    """Metrics {name: [seeds, epochs, ...]} as rows: seed and epoch first, then every name; arrays become lists."""
    names = sorted(metrics)
    return [
        {"seed": seed, "epoch": int(number)} | {name: metrics[name][i, j].tolist() for name in names}
        for j, number in enumerate(epoch_numbers)
        for i, seed in enumerate(seeds)
    ]


def is_finite(epochs: dict[str, jax.Array]) -> jax.Array:
    """Whether these epochs' metrics show no divergence, bool []."""
    return jnp.stack([jnp.isfinite(epochs[name]).all() for name in WATCHED]).all()


def diverged_seeds(rows: Iterable[dict]) -> dict[int, int]:
    """Seeds whose watched metrics stopped being finite, with the first such epoch, from the rows of the table
    `epochs`."""
    diverged: dict[int, int] = {}
    for row in rows:
        if any(not math.isfinite(row[name]) for name in WATCHED):
            diverged.setdefault(row["seed"], row["epoch"])
    return dict(sorted(diverged.items()))


def checked_seeds(seeds: Sequence[int]) -> Sequence[int]:
    """The seeds, those of NumPy as numbers of Python. Raises `UserError` for what cannot be used. A range of them is
    not looked at one by one."""
    if not isinstance(seeds, range):
        given = np.asarray(seeds)
        whole = given.ndim == 1 and (given.size == 0 or np.issubdtype(given.dtype, np.integer))
        require(whole, "seeds", seeds, "give a list of whole numbers, such as range(3)")
        seeds = given.tolist()
        require(len(set(seeds)) == len(seeds), "seeds", seeds, "give different seeds")
    require(len(seeds) > 0, "seeds", len(seeds), "give at least 1")
    first, last = (seeds[0], seeds[-1]) if isinstance(seeds, range) else (min(seeds), max(seeds))
    require(
        first >= 0 and last < MOST_SEEDS,
        "seeds",
        f"{first} to {last}",
        "give seeds from 0 to below 2^32 (--first-seed)",
    )
    return seeds


def run(
    config: TrainConfig,
    seeds: Sequence[int],
    folder: str | Path,
    resume: bool = False,
    listeners: tuple[Listener, ...] = (),
    env: Any = None,
    compiling: Callable[[], None] = lambda: None,
) -> Sweep:
    """Train these seeds in one program and leave the run in `folder`. With `resume`, go on from its last checkpoint, or
    from the beginning if it was stopped before there was one. Of several processes (`distributed.join`) each trains its
    share, and the first alone writes and has listeners; to go on, all have to see the folder.

    compiling: called before the program is compiled. Raises `UserError` before any compilation, and without a change on
    the disk, for a folder that holds another run or is being written, a damaged checkpoint, or one of another
    configuration. Raises `Stopped` if a signal asked for it before the first checkpoint.
    """
    folder, seeds = Path(folder), checked_seeds(seeds)
    writes = distributed.is_writer()
    if writes and not resume:
        check_new(folder, RUN)
    with stop_on_signal() as stop, distributed.noted(stop):
        train = make_train(config, env)
        programs = programs_of(train, distributed.share(seeds))
        now = describe(config, train.env, list(seeds))
        if not resume:
            check_fits(train, programs)  # So that a refusal leaves no folder behind.
        with only_writer(folder, new=() if resume else RUN) if writes else contextlib.nullcontext():
            point = last_point(folder, now, distributed.of_all(programs.states_shape)) if resume else BEGINNING
            if resume:
                check_fits(train, programs)
            distributed.any_process(False)  # Nobody changes what another one is still reading.
            if writes:
                for table, rows in point.rows.items():
                    tables.replace_table(folder, table, rows)
                if not resume or configuration.read(folder) != now:
                    configuration.write(folder, now)
            stop.advice = how_to_go_on(folder, point.epoch)
            distributed.check(stop)
            compiling()
            return train_on(train, programs, point, now, folder, listeners, stop)


def how_to_go_on(folder: Path, epoch: int) -> str:
    """What is on disk after this epoch, in words, and the command that goes on with it."""
    there = f"{folder} has a checkpoint of epoch {epoch}" if epoch else f"{folder} has no checkpoint yet"
    return f"{there}; go on with: infogoal train --resume {typed(folder)}"


def programs_of(train: Train, seeds: Sequence[int]) -> Programs:
    """The programs of all seeds. Raises `UserError` if the memory of the devices is too small for them."""
    mesh = seed_mesh(len(seeds))
    by_seed, everywhere = shardings_of(mesh)
    together = seeds_at_once(train, len(seeds), mesh)
    initial = jit(over_seeds(train.initial, len(seeds), together, mesh), out_shardings=by_seed)
    chunk = chunk_of(
        epochs_over_seeds(train.epochs, len(seeds), together, mesh),
        over_seeds(train.evaluation, len(seeds), together, mesh),
    )
    shared = jax.device_put((train.config.hyper, train.env), everywhere)
    keys = jax.ShapeDtypeStruct((len(seeds),), jax.random.key(0).dtype)
    states_shape = placed(jax.eval_shape(initial, keys, *shared), by_seed)
    return Programs(initial, chunk, shared, states_shape, by_seed, len(seeds))


def check_fits(train: Train, programs: Programs) -> None:
    """Raise `UserError`, naming the field that is to blame, if all seeds need more memory than there is."""
    states, mesh = programs.states_shape, programs.by_seed.mesh
    check_program(programs.chunk, states, programs.shared, train, programs.count, mesh)


def train_on(
    train: Train,
    programs: Programs,
    point: Point,
    now: Description,
    folder: Path,
    listeners: tuple[Listener, ...],
    stop: StopRequest,
) -> Sweep:
    """Train from this point to the end or until a signal comes, and write the files of the run after each chunk."""
    config, seeds, (done, states, _) = now.config, now.seeds, point
    started = time.perf_counter()
    shared, numbers = programs.shared, jnp.arange(config.epochs_per_evaluation, dtype=jnp.int32)
    if done < config.num_epochs:
        compiled = programs.chunk.compiling(programs.states_shape, numbers, *shared)
    if states is None:
        keys = jax.vmap(jax.random.key)(jnp.asarray(distributed.share(seeds), jnp.uint32))
        states = programs.initial(jax.device_put(keys, programs.by_seed), *shared)
    else:
        mine = jax.tree.map(lambda leaf: leaf[distributed.share_of(len(seeds))], states)
        states = jax.device_put(mine, programs.by_seed)
    if done < config.num_epochs:
        chunk = compiled()
    compile_seconds, run_seconds, this_session = time.perf_counter() - started, 0.0, 0
    steps_before = int(np.sum(distributed.gathered(jax.device_get(states.env_steps))))
    if done == 0:
        distributed.check(stop)
    stop.finishing = "this chunk of epochs, with a checkpoint"
    try:
        while done < config.num_epochs and not distributed.any_process(stop.requested):
            started = time.perf_counter()
            states, *metrics = chunk(states, numbers + done, *shared)
            epoch_metrics, metrics = distributed.gathered(jax.device_get(metrics))
            run_seconds += time.perf_counter() - started
            epochs = rows_of(range(done + 1, done + len(numbers) + 1), seeds, epoch_metrics)
            done, this_session = done + len(numbers), this_session + len(numbers)
            evaluations = rows_of([done], seeds, {name: value[:, None] for name, value in metrics.items()})
            timing = Timing(
                compile_seconds=compile_seconds,
                run_seconds=run_seconds,
                env_steps_per_second=(int(metrics["env_steps"].sum()) - steps_before) / run_seconds,
                updates_per_second=this_session * config.updates_per_epoch * len(seeds) / run_seconds,
            )
            whole = distributed.gathered_by_writer(states)
            if not distributed.is_writer():
                continue
            tables.append_rows(folder, "epochs", epochs)
            tables.append_rows(folder, "evaluations", evaluations)
            checkpoint.save(folder / "checkpoint", {"epoch": done, **now.values()}, whole)
            checkpoint.save(folder / "policy", {"epoch": done, **now.values()}, whole.params)
            tables.write_timing(folder, timing)
            stop.advice = how_to_go_on(folder, done)
            progress = Progress(
                done, config.num_epochs, epochs=epochs, evaluations=evaluations, **dataclasses.asdict(timing)
            )
            for listener in listeners:
                listener(progress)
    finally:
        stop.finishing = ""
    params, diverged = jax.device_get(distributed.gathered(states.params)), {}
    if distributed.is_writer():
        # Again, if a kill came between the two files.
        checkpoint.save(folder / "policy", {"epoch": done, **now.values()}, params)
        diverged = diverged_seeds(tables.read_table(folder, "epochs"))
    return Sweep(folder, train, params, diverged, stopped=done < config.num_epochs)
