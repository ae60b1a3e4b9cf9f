"""Settings and seeds of a search side by side: a lane of one compiled program each, with a checkpoint after each
evaluation."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.config import Hyperparameters
from infogoal_jax.errors import typed
from infogoal_jax.hyperparameters import search_space, values_of, with_values
from infogoal_jax.runner import host, memory
from infogoal_jax.runner.compilation import Chunk, chunk_of, jit
from infogoal_jax.runner.distributed import epochs_over_seeds, over_seeds, placed, seed_mesh, shardings_of
from infogoal_jax.runs import checkpoint
from infogoal_jax.runs.checkpoint import check_same
from infogoal_jax.runs.configuration import from_values
from infogoal_jax.runs.disk import Place, decode
from infogoal_jax.runs.folder import SEARCH, check_new, only_writer
from infogoal_jax.runs.search import Drawn, Plan, Trial, TuneResult, read_plan, write_plan
from infogoal_jax.stopping import NOTHING, StopRequest, stop_on_signal
from infogoal_jax.train.program import Train, TrainState


@flax.struct.dataclass
class Lane:
    """One seed of one trial."""

    state: TrainState
    hyper: Hyperparameters


class Watch(NamedTuple):
    """What accompanies a search. folder: where it leaves its files; command: of the command line that goes on with it;
    compiling: called before the program is compiled; evaluated: called after each evaluation."""

    folder: Path
    command: str = "tune"
    compiling: Callable[[], None] = lambda: None
    evaluated: Callable[[TuneResult], None] = lambda result: None


class Programs(NamedTuple):
    """Training of all lanes. starts: their keys and hyperparameters; shape: of all lanes."""

    initial: Callable
    chunk: Chunk
    starts: Any
    shared: Any
    shape: Any
    by_lane: jax.sharding.NamedSharding


@dataclasses.dataclass(frozen=True)
class Saved:
    """What the header of a checkpoint says beside the description: evaluations so far, and what each trial came to."""

    evaluations: int
    trials: list[Trial]


def batched_hyper(preset: Hyperparameters, values: list[dict[str, float]], seeds: int) -> Hyperparameters:
    """Hyperparameters of every lane, float32 [trials * seeds], trial by trial."""
    settings = [values_of(preset) | value for value in values]
    return with_values(
        preset,
        {
            name: jnp.repeat(jnp.asarray([setting[name] for setting in settings], jnp.float32), seeds)
            for name in settings[0]
        },
    )


def lane_programs(train: Train, group: str) -> tuple[Callable, Callable, Callable]:
    """How a lane begins, ((key, hyper), env) -> lane, goes on, (lane, numbers, env) -> (lane, {loss, finite}), and is
    evaluated, (lane, env) -> {success}."""

    def initial(start, env):
        return Lane(train.initial(*start, env), start[1])

    def epochs(lane, numbers, env):
        state, epochs = train.epochs(lane.state, numbers, lane.hyper, env)
        return Lane(state, lane.hyper), {"loss": epochs["agent/loss"][-1], "finite": host.is_finite(epochs)}

    def evaluation(lane, env):
        return {"success": train.evaluation(lane.state, lane.hyper, env)[f"{group}_goal/success_rate"]}

    return initial, epochs, evaluation


def programs_of(train: Train, group: str, trials: Sequence[Trial], seeds: Sequence[int]) -> Programs:
    """The programs of every lane, trial by trial. Raises `UserError` if the memory of the devices is too small."""
    count = len(trials) * len(seeds)
    mesh = seed_mesh(count)
    together = lanes_at_once(train, count)
    by_lane, everywhere = shardings_of(mesh)
    keys = jax.vmap(jax.random.key)(jnp.asarray(list(seeds) * len(trials), jnp.uint32))
    starts = keys, batched_hyper(train.config.hyper, [trial.values for trial in trials], len(seeds))
    initial, epochs, evaluation = lane_programs(train, group)
    begin = over_seeds(initial, count, together, mesh)
    chunk = chunk_of(epochs_over_seeds(epochs, count, together, mesh), over_seeds(evaluation, count, together, mesh))
    start = jit(begin, out_shardings=by_lane)
    shared = jax.device_put(train.env, everywhere)
    shape = placed(jax.eval_shape(start, starts, shared), by_lane)
    return Programs(start, chunk, starts, shared, shape, by_lane)


def lanes_at_once(train: Train, count: int) -> int:
    """How many of a device's lanes run beside each other. Raises `UserError` if not even one does."""
    return memory.at_once(train, count, seed_mesh(count), "trials x seeds")


def side_by_side(
    train: Train,
    group: str,
    trials: Sequence[Trial],
    seeds: Sequence[int],
    watch: Watch | None = None,
    resume: bool = False,
) -> TuneResult:
    """Train each of these settings with each of these seeds, to the end or until a signal comes.

    watch: what accompanies it; None leaves nothing on disk. resume: go on in its folder. Raises `UserError`, without a
    change on the disk, for a folder that holds something else.
    """
    seeds = list(host.checked_seeds(seeds))
    if watch is not None and not resume:
        check_new(watch.folder, SEARCH)
    with stop_on_signal() as stop:
        programs = programs_of(train, group, trials, seeds)
        about = host.describe(train.config, train.env, seeds)
        fields = tuple(trials[0].values)
        result = TuneResult(about.config, group, fields, seeds, [], list(trials), 0.0, 0.0, about)
        if not resume:
            check_fits(train, programs, len(trials) * len(seeds))
        if watch is None:
            return run_lanes(train, programs, result, None, stop)
        with only_writer(watch.folder, new=() if resume else SEARCH):
            lanes = None
            if resume:
                result, lanes = last_point(watch.folder, result, programs)
                check_fits(train, programs, len(trials) * len(seeds))
            if not resume or read_plan(watch.folder)[0] != about:
                write_plan(watch.folder, about, plan_of(result))
            return run_lanes(train, programs, result, lanes, stop, watch)


def check_fits(train: Train, programs: Programs, count: int) -> None:
    """Raise `UserError`, naming the field that is to blame, if all lanes need more memory than there is."""
    mesh = programs.by_lane.mesh
    memory.check_program(programs.chunk, programs.shape, (programs.shared,), train, count, mesh, "trials x seeds")


def plan_of(result: TuneResult) -> Plan:
    """What a search is to run."""
    space = search_space(result.config.hyper)
    return Plan(
        trials=len(result.trials),
        space={field: search._asdict() for field, search in space.items() if field in result.fields},
        drawn=[Drawn(trial.number, trial.values) for trial in result.trials],
    )


def run_lanes(
    train: Train,
    programs: Programs,
    result: TuneResult,
    lanes: Lane | None,
    stop: StopRequest,
    watch: Watch | None = None,
) -> TuneResult:
    """Train all lanes from where they are; with `watch`, keep a checkpoint of them after each evaluation."""
    chunk, shape = train.config.epochs_per_evaluation, (len(result.trials), len(result.seeds))
    stop.advice = how_to_go_on(watch, result)
    stop.check()
    if watch is not None:
        watch.compiling()
    started = time.perf_counter()
    shared, numbers = programs.shared, jnp.arange(chunk, dtype=jnp.int32)
    if not result.finished:
        compiled = programs.chunk.compiling(programs.shape, numbers, shared)
    if lanes is None:
        lanes = programs.initial(jax.device_put(programs.starts, programs.by_lane), shared)
    else:
        lanes = jax.device_put(lanes, programs.by_lane)
    if not result.finished:
        run_chunk = compiled()
    result = dataclasses.replace(result, compile_seconds=time.perf_counter() - started)
    if not result.epochs:
        stop.check()
    stop.finishing = "this chunk of epochs and its evaluation"
    try:
        while not result.finished and not stop.requested:
            started, done = time.perf_counter(), len(result.epochs) * chunk
            lanes, learned, scored = run_chunk(lanes, numbers + done, shared)
            seen = jax.tree.map(lambda leaf: np.asarray(leaf).reshape(shape).tolist(), jax.device_get(learned | scored))
            result = dataclasses.replace(
                result,
                epochs=[*result.epochs, done + chunk],
                run_seconds=result.run_seconds + time.perf_counter() - started,
                trials=[
                    continued(trial, result.seeds, *(seen[name][place] for name in ("success", "loss", "finite")))
                    for place, trial in enumerate(result.trials)
                ],
            )
            if watch is not None:
                watch.evaluated(result)
                save(watch.folder / "checkpoint", result, lanes)
                stop.advice = how_to_go_on(watch, result)
    finally:
        stop.finishing = ""
    return result


def how_to_go_on(watch: Watch | None, result: TuneResult) -> str:
    """What is on disk, in words, and the command that goes on with it."""
    if watch is None:
        return NOTHING
    there = f"the scores until epoch {result.epochs[-1]}" if result.epochs else "no scores yet"
    return f"{watch.folder} holds {there}; go on with: infogoal {watch.command} --resume {typed(watch.folder)}"


def save(path: Path, result: TuneResult, lanes: Lane) -> None:
    """Write what a search goes on from."""
    saved = Saved(len(result.epochs), result.trials)
    checkpoint.save(path, result.about.values() | dataclasses.asdict(saved), lanes)


def last_point(folder: Path, start: TuneResult, programs: Programs) -> tuple[TuneResult, Lane | None]:
    """Where the search in this folder goes on: its result and its lanes, or the start if it was stopped before the
    first evaluation.

    Raises `UserError`, and changes nothing, for another search, or a file that is not what was written.
    """
    about, plan = read_plan(folder)
    check_same(folder / "config.json", about, start.about, longer=False)
    path = folder / "checkpoint"
    if plan != plan_of(start):
        raise Place(folder / "config.json").refusal("its trials are others than those that are to go on")
    if not path.exists():
        return start, None
    header, payload = checkpoint.read_header(path)
    place = Place(path, remedy=checkpoint.REMEDY)
    check_same(path, from_values(header, place), start.about, longer=False)
    saved = decode(Saved, header, place)
    alike = [(trial.number, trial.values) for trial in saved.trials] == [
        (trial.number, trial.values) for trial in start.trials
    ]
    whole = all(len(trial.success) == len(trial.loss) == saved.evaluations for trial in saved.trials)
    if not alike or not whole or not 0 < saved.evaluations <= start.config.num_evaluations:
        raise place.refusal("its trials are not those of config.json")
    chunk = start.config.epochs_per_evaluation
    epochs = [chunk * number for number in range(1, saved.evaluations + 1)]
    return dataclasses.replace(start, epochs=epochs, trials=saved.trials), checkpoint.arrays(
        path, payload, programs.shape
    )


def continued(trial: Trial, seeds: list[int], success: list[float], loss: list[float], finite: list[bool]) -> Trial:
    """The trial after another evaluation; each list has a number for each seed."""
    lost = {seed for seed, good in zip(seeds, finite, strict=True) if not good}
    return dataclasses.replace(
        trial, success=[*trial.success, success], loss=[*trial.loss, loss], diverged=sorted(lost.union(trial.diverged))
    )
