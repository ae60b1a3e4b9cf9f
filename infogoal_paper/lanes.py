"""Training of several runs in one compiled program: goal sets, settings of floats and seeds side by side.

The environments of the goal sets are stacked where their arrays differ, and each is held once for all its lanes.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.config import TrainConfig
from infogoal_jax.hyperparameters import values_of, with_values
from infogoal_jax.runner import host, memory
from infogoal_jax.runner.compilation import chunk_of, jit
from infogoal_jax.train.parts import load_environment
from infogoal_jax.train.program import Train, make_train
from infogoal_paper import measure
from infogoal_paper.manifest import PRESET, Lane, Run
from infogoal_paper.plan import ONE_SET_AT_A_TIME, build_data, config_of, with_one_shape

WORDS = {"source", "names", "region_names", "low_level_name", "goal_objects"}
"""Static fields of environments that no program depends on."""
LEARNED = ("beta", "accuracy", "kl")
"""Metrics of a learner that are kept, those of the last epoch before each evaluation."""


@dataclasses.dataclass(frozen=True)
class Batch:
    """Runs with the same lanes on each of their goal sets. config: of the first; envs: of the goal sets; lanes: (lane,
    seed) of each goal set; runs: by (goal set's place, lane)."""

    config: TrainConfig
    envs: tuple[Any, ...]
    lanes: tuple[tuple[Lane, int], ...]
    runs: dict[tuple[int, Lane], Run]

    @property
    def places(self) -> dict[Run, tuple[int, slice]]:
        """Where the seeds of each run stand: goal set's place, lanes."""
        found = {}
        for (place, lane), run in self.runs.items():
            first = [each for each, _ in self.lanes].index(lane)
            found[run] = place, slice(first, first + len(run.seeds))
        return found


@dataclasses.dataclass
class Training:
    """A batch while it is trained. initial: makes the first states; compiling: begins to compile the program, and
    returns what waits for it; share: `measure.learner_share`, which compiles at its first call; states: [goal sets,
    lanes, ...], their shapes before `prepare` or a checkpoint gives them; finite: bool [goal sets, lanes]; started:
    seconds of `time.time()`; prepare_seconds: that `prepare` took; chunk: the program, None before it; history: of each
    metric a list of arrays [goal sets, lanes, ...], one an evaluation; spans: from when to when earlier processes
    worked on it; costs: by name of each run that has ended, what its file says of the program, the same for all that
    ended at one evaluation; compile_seconds, run_seconds: of those that go on; idle_seconds: of lanes that ended."""

    batch: Batch
    train: Train
    hyper: Any
    leaves: list
    initial: Callable[[], Any]
    compiling: Callable[[], Callable[[], Callable]]
    share: Callable | None
    states: Any
    finite: np.ndarray
    started: float
    compile_seconds: float = 0.0
    prepare_seconds: float = 0.0
    chunk: Callable | None = None
    history: dict[str, list[np.ndarray]] = dataclasses.field(default_factory=dict)
    run_seconds: float = 0.0
    last_seconds: float = 0.0
    spans: list[list[float]] = dataclasses.field(default_factory=list)
    costs: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    idle_seconds: float = 0.0

    @property
    def evaluations(self) -> int:
        """How many there were."""
        return len(self.history["train_goal/success_rate"]) if self.history else 0

    def spans_until_now(self) -> list[list[float]]:
        """From when to when processes worked on it, seconds of `time.time()`; the last one until now."""
        return [*self.spans, [round(self.started), round(time.time())]]


def without_words(env: Any) -> Any:
    """The environment with empty words, which differ between goal sets that one program can be run on."""
    changes = {}
    for field in dataclasses.fields(env):
        value = getattr(env, field.name)
        if field.name in WORDS:
            changes[field.name] = "" if isinstance(value, str) else ("",) * len(value)
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            changes[field.name] = without_words(value)
    return env.replace(**changes) if hasattr(env, "replace") and changes else env


def shape_of(env: Any) -> tuple:
    """What has to agree for one program to be run on two environments."""
    leaves, tree = jax.tree.flatten(without_words(env))
    return tree, tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)


def batches_of(runs: list[Run], goal_images: Path | None, most_lanes: int) -> list[Batch]:
    """The runs of one program as batches: goal sets whose arrays have the same shapes and which need the same lanes go
    together, but for `ONE_SET_AT_A_TIME`. As many lanes at once as fit into the device's memory, `most_lanes` at most;
    the seeds of a run are never cut."""
    sets = sorted({run.goal_set for run in runs})
    lanes = {number: tuple(run for run in runs if run.goal_set == number) for number in sets}
    configs, envs = {}, {}
    for number in sets:
        build_data(lanes[number][0])
        # A lane says what differs from the preset: the first one's floats are not those of the others.
        configs[number] = config_of(dataclasses.replace(lanes[number][0], lane=Lane(*PRESET)), goal_images)
        envs[number] = load_environment(configs[number])
    envs = dict(zip(envs, with_one_shape(list(envs.values())), strict=True))
    together: dict[Any, list[int]] = {}
    for number in sets:
        needed = tuple((run.lane, run.seeds) for run in lanes[number])
        together.setdefault((needed, shape_of(envs[number])), []).append(number)
    found = []
    for (needed, _), alike in together.items():
        config, seeds = configs[alike[0]], [len(each) for _, each in needed]
        most = min(most_lanes, fitting(config, envs[alike[0]], sum(seeds) * len(alike)))
        at_once = 1 if config.task in ONE_SET_AT_A_TIME else max(1, most // max(seeds))
        beside = [alike[first : first + at_once] for first in range(0, len(alike), at_once)]
        for numbers, part in ((each, part) for each in beside for part in parts_of(needed, max(1, most // len(each)))):
            members = {
                (place, run.lane): run
                for place, number in enumerate(numbers)
                for run in lanes[number]
                if (run.lane, run.seeds) in part
            }
            flat = tuple((lane, seed) for lane, seeds in part for seed in seeds)
            found.append(Batch(config, tuple(envs[number] for number in numbers), flat, members))
    return found


def floats_of(batch: Batch) -> list[dict[str, float]]:
    """The floats of each lane by dotted name: the preset's, but for those that the lane sets."""
    return [values_of(batch.config.hyper) | dict(lane.values) for lane, _ in batch.lanes]


def parts_of(needed: tuple, most: int) -> list[list]:
    """Lanes with their seeds in parts of at most so many seeds together; a lane is never cut."""
    parts: list[list] = [[]]
    for lane, seeds in needed:
        if parts[-1] and sum(len(each) for _, each in parts[-1]) + len(seeds) > most:
            parts.append([])
        parts[-1].append((lane, seeds))
    return parts


def fitting(config: TrainConfig, env: Any, count: int) -> int:
    """How many lanes of `count` fit into the device's memory side by side. Raises `UserError` for none."""
    train = make_train(config, env)
    sizes = memory.state_bytes(train), memory.working_bytes(train), memory.bytes_of(env)
    return memory.seeds_at_once(*sizes, count, memory.device_memory(jax.devices()[0]))


def begin(batch: Batch) -> Training:
    """A batch before its first epoch, neither compiled nor with states: a checkpoint may have them, or show that
    nothing is left to train."""
    began, started = time.time(), time.perf_counter()
    train = make_train(batch.config, batch.envs[0])
    flat = [jax.tree.leaves(env) for env in batch.envs]
    whole = jax.tree.structure(batch.envs[0])  # Its words stand for those of all goal sets.
    axes, leaves = [], []
    for each in zip(*flat, strict=True):
        alike = all(leaf is each[0] or np.array_equal(leaf, each[0]) for leaf in each[1:])
        axes.append(None if alike else 0)
        leaves.append(each[0] if alike else jnp.stack(each))

    def over_lanes(function: Callable, lane_axes: tuple) -> Callable:
        """The function (*lane, env) for all lanes of all goal sets: (*lanes [goal sets, lanes], leaves)."""

        def of_set(*arguments):
            *lane, own = arguments
            env = jax.tree.unflatten(whole, own)
            return jax.vmap(lambda *each: function(*each, env), in_axes=lane_axes)(*lane)

        in_axes = (*(None if axis is None else 0 for axis in lane_axes), axes)
        if len(batch.envs) > 1:
            return jax.vmap(of_set, in_axes=in_axes)

        def of_one(*arguments):
            """Without the axis of goal sets, which would make every operation of the program one of a batch of one."""
            *lane, own = arguments
            alone = [
                each if axis is None else jax.tree.map(lambda leaf: leaf[0], each)
                for each, axis in zip(lane, lane_axes, strict=True)
            ]
            return jax.tree.map(lambda leaf: leaf[None], of_set(*alone, own))

        return of_one

    settings = floats_of(batch)
    shape = len(batch.envs), len(batch.lanes)
    hyper = with_values(
        batch.config.hyper,
        {
            name: jnp.broadcast_to(jnp.asarray([setting[name] for setting in settings], jnp.float32), shape)
            for name in settings[0]
        },
    )
    seeds = jnp.broadcast_to(jnp.asarray([seed for _, seed in batch.lanes], jnp.uint32), shape)
    initial = jit(over_lanes(lambda seed, hyper, env: train.initial(jax.random.key(seed), hyper, env), (0, 0)))

    def step(state, numbers, hyper, env):
        state, epochs = train.epochs(state, numbers, hyper, env)
        learned = {name: epochs[name][-1] for name in learned_names(train, epochs)}
        return state, learned | {"finite": host.is_finite(epochs)}

    numbers = jnp.arange(batch.config.epochs_per_evaluation, dtype=jnp.int32)
    shapes = jax.eval_shape(initial, seeds, hyper, leaves)
    chunk = chunk_of(over_lanes(step, (0, None, 0)), over_lanes(train.evaluation, (0, 0)))
    share, finite = measure.learner_share(train), np.ones(shape, bool)
    return Training(
        batch,
        train,
        hyper,
        leaves,
        lambda: initial(seeds, hyper, leaves),
        lambda: chunk.compiling(shapes, numbers, hyper, leaves),
        share and jit(share),
        shapes,
        finite,
        began,
        compile_seconds=time.perf_counter() - started,
    )


def prepare(training: Training) -> None:
    """Make the first states, unless a checkpoint gave others, and compile the program at the same time."""
    started = time.perf_counter()
    compiled = training.compiling()
    if not training.evaluations:
        training.states = training.initial()
    training.chunk = compiled()
    training.prepare_seconds = time.perf_counter() - started
    training.compile_seconds += training.prepare_seconds


def learned_names(train: Train, epochs: dict) -> list[str]:
    """The metrics of `LEARNED` that the learner has."""
    return [f"{train.parts.name}/{name}" for name in LEARNED if f"{train.parts.name}/{name}" in epochs]


def go_on(training: Training) -> None:
    """Train until the next evaluation and keep its numbers."""
    if training.chunk is None:
        prepare(training)
    started, length = time.perf_counter(), training.batch.config.epochs_per_evaluation
    numbers = jnp.arange(length, dtype=jnp.int32) + training.evaluations * length
    training.states, learned, scored = training.chunk(training.states, numbers, training.hyper, training.leaves)
    metrics = jax.device_get(learned | scored)
    training.finite &= metrics.pop("finite")
    for name, value in metrics.items():
        training.history.setdefault(name, []).append(np.asarray(value))
    training.last_seconds = time.perf_counter() - started
    training.run_seconds += training.last_seconds


def without_ended(training: Training, ended: set[Run]) -> Training:
    """Before an evaluation: the training of the goal sets and lanes on which a run goes on, not yet compiled. The same
    one where these are all, or where lanes that have ended have not cost yet what compiling anew would; if not, its
    states are given up."""
    batch = training.batch
    runs = {key: run for key, run in batch.runs.items() if run not in ended}
    places = sorted({place for place, _ in runs})
    which = [number for number, (lane, _) in enumerate(batch.lanes) if any(lane == each for _, each in runs)]
    idle = 1 - len(places) * len(which) / training.finite.size
    if not idle or training.idle_seconds < training.prepare_seconds:
        training.idle_seconds += idle * training.last_seconds
        return training

    def part(values: Any) -> Any:
        return values[np.asarray(places)][:, np.asarray(which)]

    def moved(leaf: jax.Array) -> jax.Array:
        own = part(leaf)
        leaf.delete()  # The device's memory may not hold both.
        return own

    runs = {(places.index(place), lane): run for (place, lane), run in runs.items()}
    envs, flat = tuple(batch.envs[place] for place in places), tuple(batch.lanes[number] for number in which)
    smaller = begin(Batch(batch.config, envs, flat, runs))
    smaller.states = jax.tree.map(moved, training.states)
    smaller.history = {name: [part(value) for value in values] for name, values in training.history.items()}
    smaller.finite = part(training.finite)
    smaller.started, smaller.spans, smaller.last_seconds = training.started, training.spans, training.last_seconds
    smaller.compile_seconds += training.compile_seconds
    smaller.run_seconds = training.run_seconds
    return smaller
