"""The one loop over chunks of training: members that a compiled program trains side by side, evaluation by evaluation.

A member is one seed of one setting of the float hyperparameters in one environment. A run is a sweep over seeds, a
search one over settings and seeds, a row of Table I one over settings, seeds and goal sets. What differs between them,
what is kept on disk and when a sweep ends, is a `Callback`; what the program is made of, `Programs`.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.config import Hyperparameters, TrainConfig
from infogoal_jax.hyperparameters import values_of, with_values
from infogoal_jax.runner import distributed, memory
from infogoal_jax.runner.compilation import chunk_of, jit
from infogoal_jax.runner.distributed import epochs_over_seeds, over_seeds, placed, seed_mesh, shardings_of
from infogoal_jax.runs.tables import WATCHED
from infogoal_jax.stopping import StopRequest
from infogoal_jax.train.program import Train, TrainState


class States(NamedTuple):
    """The states of all members of this process: arrays that begin with the axes of the members.

    shapes: of these arrays.
    initial: () -> states, before the first epoch.
    placed: states of the host -> states on the devices.
    mesh: the devices, against whose memory the program is held.
    """

    shapes: Any
    initial: Callable[[], Any]
    placed: Callable[[Any], Any]
    mesh: jax.sharding.Mesh


class Programs(NamedTuple):
    """What a sweep is made of. Metrics begin with the axes of the members, as states do.

    states: where they come from.
    compiling: () -> wait; begins to compile, and wait() -> chunk(states, numbers [E]) -> (states, {name: [*members, E,
        ...]}, {name: [*members, ...]}): the epochs of these numbers with their metrics, and the evaluation after them.
        Raises `UserError` for a program that needs more memory than there is.
    check: () -> None; raises `UserError`, before anything is compiled, for sizes that no device has room for.
    """

    states: States
    compiling: Callable[[], Callable[[], Callable]]
    check: Callable[[], None]


@dataclasses.dataclass
class Sweep:
    """Members of one program while they are trained.

    config: has `num_evaluations`, `epochs_per_evaluation` and `updates_per_epoch`.
    states: of all members of this process; None before the first epoch.
    evaluations: how many there were.
    learned, scored: metrics of the last chunk, of its epochs {name: [*members, E, ...]} and of the evaluation after
        them {name: [*members, ...]}; of the members of all processes.
    chunk: the compiled program; None before it is compiled.
    prepare_seconds: what compiling and making the first states took in this process.
    run_seconds, last_seconds: of all chunks in this process, and of the last.
    """

    config: Any
    programs: Programs
    states: Any = None
    evaluations: int = 0
    learned: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    scored: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    chunk: Callable | None = None
    prepare_seconds: float = 0.0
    run_seconds: float = 0.0
    last_seconds: float = 0.0

    @property
    def finished(self) -> bool:
        """Whether there was the last evaluation."""
        return self.evaluations >= self.config.num_evaluations


class Callback:
    """What accompanies a sweep. Every method may be left as it is."""

    finishing = "this chunk of epochs, with a checkpoint"
    """What a signal waits for, once the program is compiled."""

    def going_on(self, sweep: Sweep) -> Sweep | None:
        """Before each chunk: the sweep that goes on, which may be one of fewer members; None when nothing is left."""
        return None if sweep.finished else sweep

    def compiling(self, sweep: Sweep) -> None:
        """The program is about to be compiled."""

    def compiled(self, sweep: Sweep) -> None:
        """The program is compiled, and states are there."""

    def has_time(self, sweep: Sweep) -> bool:
        """Whether there is time for another chunk."""
        return True

    def evaluated(self, sweep: Sweep) -> None:
        """A chunk is trained and evaluated."""

    def stopped(self, sweep: Sweep) -> None:
        """Training stops before its end, asked by a signal or by the clock."""


def train_sweep(sweep: Sweep, callback: Callback, stop: StopRequest) -> Sweep:
    """Train all members, chunk by chunk, to their end or until a signal or the clock says stop. Raises `Stopped` for a
    signal while the program is compiled, `UserError` for a program that needs more memory than there is."""
    outside = stop.finishing
    stop.finishing = callback.finishing
    try:
        while (following := callback.going_on(sweep)) is not None:
            sweep = following
            if distributed.any_process(stop.requested or not callback.has_time(sweep)):
                callback.stopped(sweep)
                break
            if sweep.chunk is None:
                stop.finishing = outside  # A compiler cannot be asked to stop: the process may.
                callback.compiling(sweep)
                prepare(sweep)
                distributed.check(stop)
                stop.finishing = callback.finishing
                callback.compiled(sweep)
            advance(sweep)
            callback.evaluated(sweep)
    finally:
        stop.finishing = outside
    return sweep


def prepare(sweep: Sweep) -> None:
    """Compile the program, and make the first states at the same time unless a checkpoint gave others."""
    started, states = time.perf_counter(), sweep.programs.states
    compiled = sweep.programs.compiling()
    sweep.states = states.initial() if sweep.states is None else states.placed(sweep.states)
    sweep.chunk = compiled()
    sweep.prepare_seconds = time.perf_counter() - started


def advance(sweep: Sweep) -> None:
    """Train until the next evaluation, and fetch its numbers."""
    started, length = time.perf_counter(), sweep.config.epochs_per_evaluation
    numbers = jnp.arange(length, dtype=jnp.int32) + sweep.evaluations * length
    sweep.states, *metrics = sweep.chunk(sweep.states, numbers)
    sweep.learned, sweep.scored = distributed.gathered(jax.device_get(tuple(metrics)))
    sweep.evaluations += 1
    sweep.last_seconds = time.perf_counter() - started
    sweep.run_seconds += sweep.last_seconds


def is_finite(learned: dict[str, np.ndarray]) -> np.ndarray:
    """Which members' epochs [*members, E] show no divergence, bool [*members]."""
    return np.logical_and.reduce([np.isfinite(learned[name]).all(-1) for name in WATCHED])


def batched_hyper(preset: Hyperparameters, settings: Sequence[dict[str, float]], shape: Sequence[int] = ()) -> Any:
    """Hyperparameters of every member, float32 [*shape, settings]. settings: of each, the floats by dotted name that
    differ from the preset's."""
    values = [values_of(preset) | setting for setting in settings]
    shape = (*shape, len(values))
    return with_values(
        preset,
        {
            name: jnp.broadcast_to(jnp.asarray([value[name] for value in values], jnp.float32), shape)
            for name in values[0]
        },
    )


@flax.struct.dataclass
class Member:
    """One seed of one setting. hyper: None where all members have the configuration's, which then is an argument
    without an axis of members: batched floats would make another program, of other bits."""

    state: TrainState
    hyper: Hyperparameters | None


def side_by_side(
    train: Train, seeds: Sequence[int], hyper: Hyperparameters | None = None, name: str = "seeds"
) -> Programs:
    """The programs of members in one environment. Of several processes each has its own seeds.

    hyper: of each member, as `batched_hyper` makes them; None: the configuration's, of all.
    name: of the number of members, for a refusal.
    Raises `UserError` if the memory of the devices is too small for the states of all and one that runs.
    """
    count, config = len(seeds), train.config
    mesh = seed_mesh(count)
    by_member, everywhere = shardings_of(mesh)
    at_once = memory.at_once(train, count, mesh, name)
    shared = jax.device_put((config.hyper if hyper is None else None, train.env), everywhere)

    def floats_of(member, common):
        return common if member.hyper is None else member.hyper

    def begin(start, common, env):
        key, own = start
        return Member(train.initial(key, common if own is None else own, env), own)

    def epochs(member, numbers, common, env):
        state, metrics = train.epochs(member.state, numbers, floats_of(member, common), env)
        return Member(state, member.hyper), metrics

    def evaluation(member, common, env):
        return train.evaluation(member.state, floats_of(member, common), env)

    initial = jit(over_seeds(begin, count, at_once, mesh), out_shardings=by_member)
    keys = jax.ShapeDtypeStruct((count,), jax.random.key(0).dtype)
    starts = placed((keys, hyper), by_member)  # As what is given later, or all would be traced a second time.
    shapes = placed(jax.eval_shape(initial, starts, *shared), by_member)

    def first():
        keys = jax.vmap(jax.random.key)(jnp.asarray(list(seeds), jnp.uint32))
        return initial(jax.device_put((keys, hyper), by_member), *shared)

    return programs_from(
        config,
        epochs_over_seeds(epochs, count, at_once, mesh),
        over_seeds(evaluation, count, at_once, mesh),
        shared,
        States(shapes, first, lambda states: jax.device_put(states, by_member), mesh),
    )


def programs_from(
    config: TrainConfig, epochs: Callable, evaluation: Callable, shared: tuple, states: States
) -> Programs:
    """The programs of members side by side, by epochs (states, numbers of epochs, *shared) -> (states, metrics) and an
    evaluation (states, *shared) -> metrics."""
    chunk = chunk_of(epochs, evaluation)
    given = states.shapes, jax.ShapeDtypeStruct((config.epochs_per_evaluation,), jnp.int32), *shared
    room = memory.mesh_memory(states.mesh)

    def usual():
        return memory.preset_of(config)

    return Programs(
        states=states,
        compiling=lambda: chunk.compiling(
            *given, check=lambda *found: memory.check_compiled(found, config, usual, room)
        ),
        check=lambda: memory.check_traced(
            [program.jaxpr for program in chunk.trace(*given)], config, usual, room * states.mesh.size
        ),
    )
