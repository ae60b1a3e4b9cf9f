"""Several runs in one compiled program: goal sets, settings of floats and seeds side by side.

The environments of the goal sets are stacked where their arrays differ, and each is held once for all its members.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.config import Hyperparameters, TrainConfig
from infogoal_jax.hyperparameters import values_of, with_values
from infogoal_jax.loading import load_environment, make_train
from infogoal_jax.runner import memory
from infogoal_jax.runner.compilation import jit
from infogoal_jax.runner.distributed import seed_mesh
from infogoal_jax.runner.sweep import (
    Member,
    Programs,
    States,
    Sweep,
    batched_hyper,
    is_finite,
    programs_from,
    side_by_side,
)
from infogoal_jax.train.program import Train
from infogoal_paper import measure
from infogoal_paper.manifest import PRESET, Run, Setting
from infogoal_paper.plan import ONE_SET_AT_A_TIME, build_data, config_of, with_one_shape

WORDS = {"source", "names", "region_names", "low_level_name", "goal_objects"}
"""Static fields of environments that no program depends on."""
LEARNED = ("beta", "accuracy", "kl")
"""Metrics of a learner that are kept, those of the last epoch before each evaluation."""


@dataclasses.dataclass(frozen=True)
class Batch:
    """Runs with the same settings and seeds on each of their goal sets.

    config: of the first.
    envs: of the goal sets.
    members: (setting, seed) of each, in every goal set.
    runs: by (goal set's place, setting).

    Arrays of all members begin with the axes [goal sets, members], or with [members] where there is one goal set.
    """

    config: TrainConfig
    envs: tuple[Any, ...]
    members: tuple[tuple[Setting, int], ...]
    runs: dict[tuple[int, Setting], Run]

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the members."""
        return (len(self.members),) if len(self.envs) == 1 else (len(self.envs), len(self.members))

    @property
    def places(self) -> dict[Run, tuple[int, slice]]:
        """Where the seeds of each run stand: goal set's place, members."""
        found = {}
        for (place, setting), run in self.runs.items():
            first = [each for each, _ in self.members].index(setting)
            found[run] = place, slice(first, first + len(run.seeds))
        return found

    def index(self, run: Run) -> tuple:
        """Where the seeds of a run stand in arrays of all members."""
        place, members = self.places[run]
        return (members,) if len(self.envs) == 1 else (place, members)


def part(values: Any, axes: int, places: list[int], members: list[int]) -> Any:
    """Of an array of all members those of these goal sets and places, as a batch has them that is of these. axes: those
    of goal sets and members, 1 where there is one goal set."""
    if axes == 1:
        return values[np.asarray(members)]
    own = values[np.asarray(places)][:, np.asarray(members)]
    return own[0] if len(places) == 1 else own


@dataclasses.dataclass
class Training:
    """A batch while it is trained.

    sweep: the members, and the program.
    hyper: of each member.
    share: `measure.learner_share`, which compiles at its first call; None for a learner without a loss.
    finite: which members have not diverged, bool [members].
    started: seconds of `time.time()`.
    history: of each metric a list of arrays [members, ...], one an evaluation.
    spans: from when to when earlier processes worked on it.
    costs: by name of each run that has ended, what its file says of the program, the same for all that ended at one
        evaluation.
    compile_seconds, run_seconds: of the runs that go on, those of earlier processes too.
    idle_seconds: of members that ended.
    """

    batch: Batch
    train: Train
    sweep: Sweep
    hyper: Any
    share: Callable | None
    finite: np.ndarray
    started: float
    compile_seconds: float = 0.0
    history: dict[str, list[np.ndarray]] = dataclasses.field(default_factory=dict)
    run_seconds: float = 0.0
    spans: list[list[float]] = dataclasses.field(default_factory=list)
    costs: dict[str, dict[str, Any]] = dataclasses.field(default_factory=dict)
    idle_seconds: float = 0.0

    @property
    def evaluations(self) -> int:
        """How many there were."""
        return self.sweep.evaluations

    @property
    def states(self) -> Any:
        """Of all members; None before the first epoch."""
        members = self.sweep.states
        return members.state if isinstance(members, Member) else members

    @property
    def shapes(self) -> Any:
        """Of the states of all members."""
        members = self.sweep.programs.states.shapes
        return members.state if isinstance(members, Member) else members

    def spans_until_now(self) -> list[list[float]]:
        """From when to when processes worked on it, seconds of `time.time()`; the last one until now."""
        return [*self.spans, [round(self.started), round(time.time())]]

    def go_on_with(self, states: Any, evaluations: int) -> None:
        """Let these be the states of all members, after so many evaluations."""
        one_set = len(self.batch.envs) == 1
        self.sweep.states = Member(states, self.hyper) if one_set else states
        self.sweep.evaluations = evaluations

    def note(self) -> None:
        """Keep the numbers of the last evaluation."""
        learned, name = self.sweep.learned, self.train.parts.name
        kept = {
            f"{name}/{metric}": learned[f"{name}/{metric}"][..., -1]
            for metric in LEARNED
            if f"{name}/{metric}" in learned
        }
        self.finite &= is_finite(learned)
        for metric, value in (kept | self.sweep.scored).items():
            self.history.setdefault(metric, []).append(np.asarray(value))
        self.run_seconds += self.sweep.last_seconds


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


def batches_of(
    runs: list[Run], goal_images: Path | None, most_members: int, changes: dict[str, Any] | None = None
) -> list[Batch]:
    """The runs of one program, with these changes of the preset, as batches: goal sets whose arrays have the same
    shapes and which need the same settings go together, but for `ONE_SET_AT_A_TIME`. As many members at once as fit
    into the device's memory, `most_members` at most; the seeds of a run are never cut."""
    sets = sorted({run.goal_set for run in runs})
    by_set = {number: tuple(run for run in runs if run.goal_set == number) for number in sets}
    configs, envs = {}, {}
    for number in sets:
        build_data(by_set[number][0])
        # A setting says what differs from the preset: the first one's floats are not those of the others.
        preset = config_of(dataclasses.replace(by_set[number][0], setting=Setting(*PRESET)), goal_images)
        configs[number] = with_values(preset, changes or {})
        envs[number] = load_environment(configs[number])
    envs = dict(zip(envs, with_one_shape(list(envs.values())), strict=True))
    together: dict[Any, list[int]] = {}
    for number in sets:
        needed = tuple((run.setting, run.seeds) for run in by_set[number])
        together.setdefault((needed, shape_of(envs[number])), []).append(number)
    found = []
    for (needed, _), alike in together.items():
        config, seeds = configs[alike[0]], [len(each) for _, each in needed]
        most = min(most_members, fitting(config, envs[alike[0]], sum(seeds) * len(alike)))
        at_once = 1 if config.task in ONE_SET_AT_A_TIME else max(1, most // max(seeds))
        beside = [alike[first : first + at_once] for first in range(0, len(alike), at_once)]
        for numbers, part in ((each, part) for each in beside for part in parts_of(needed, max(1, most // len(each)))):
            members = {
                (place, run.setting): run
                for place, number in enumerate(numbers)
                for run in by_set[number]
                if (run.setting, run.seeds) in part
            }
            flat = tuple((setting, seed) for setting, seeds in part for seed in seeds)
            found.append(Batch(config, tuple(envs[number] for number in numbers), flat, members))
    return found


def floats_of(batch: Batch) -> list[dict[str, float]]:
    """The floats of each member by dotted name: the preset's, but for those that its setting changes."""
    return [values_of(batch.config.hyper) | dict(setting.values) for setting, _ in batch.members]


def parts_of(needed: tuple, most: int) -> list[list]:
    """Settings with their seeds in parts of at most so many seeds together; a setting is never cut."""
    parts: list[list] = [[]]
    for setting, seeds in needed:
        if parts[-1] and sum(len(each) for _, each in parts[-1]) + len(seeds) > most:
            parts.append([])
        parts[-1].append((setting, seeds))
    return parts


def fitting(config: TrainConfig, env: Any, count: int) -> int:
    """How many members of `count` fit into the device's memory side by side, a batch alone. Raises `UserError` for
    none."""
    train, room = make_train(config, env), memory.device_memory(jax.devices()[0])
    sizes = memory.state_bytes(train), memory.working_bytes(train), memory.bytes_of(env)
    fits = (number for number in range(count, 1, -1) if memory.fit_at_once(*sizes, number, room))
    return next(fits, 0) or memory.seeds_at_once(*sizes, 1, room)


def stacked(envs: Sequence[Any]) -> tuple[list[jax.Array], list[int | None]]:
    """The leaves of environments of one shape, and the axis of the environments in each: a leaf that all share is held
    once, and has none."""
    leaves, axes = [], []
    for each in zip(*(jax.tree.leaves(env) for env in envs), strict=True):
        alike = all(leaf is each[0] or np.array_equal(leaf, each[0]) for leaf in each[1:])
        axes.append(None if alike else 0)
        leaves.append(each[0] if alike else jnp.stack(each))
    return leaves, axes


def over_environments(whole: Any, axes: list[int | None], function: Callable, member_axes: tuple) -> Callable:
    """The function (*member, env) for all members of all environments: (*members, leaves).

    whole: the structure of an environment; axes: of the environments in each of its leaves, as `stacked` gives them;
    member_axes: of the members of an environment in each argument before it; None for one that all share.
    """

    def of_one(*arguments):
        *member, own = arguments
        env = jax.tree.unflatten(whole, own)
        return jax.vmap(lambda *each: function(*each, env), in_axes=member_axes)(*member)

    return jax.vmap(of_one, in_axes=(*(None if axis is None else 0 for axis in member_axes), axes))


def in_several(train: Train, envs: Sequence[Any], seeds: Sequence[int], hyper: Hyperparameters) -> Programs:
    """The programs of the same members in each of several environments of one shape, [environments, members].

    Args:
        envs: whose arrays are stacked where they differ; what is written in them stands for all.
        seeds: of each member of an environment.
        hyper: of each member, [environments, members].
    """
    leaves, axes = stacked(envs)
    over, config = functools.partial(over_environments, jax.tree.structure(envs[0]), axes), train.config
    shape = len(envs), len(seeds)
    numbered = jnp.broadcast_to(jnp.asarray(list(seeds), jnp.uint32), shape)
    initial = jit(over(lambda seed, own, env: train.initial(jax.random.key(seed), own, env), (0, 0)))
    return programs_from(
        config,
        over(lambda state, numbers, own, env: train.epochs(state, numbers, own, env), (0, None, 0)),
        over(train.evaluation, (0, 0)),
        (hyper, leaves),
        States(
            jax.eval_shape(initial, numbered, hyper, leaves),
            lambda: initial(numbered, hyper, leaves),
            jax.device_put,
            seed_mesh(1),
        ),
    )


def begin(batch: Batch) -> Training:
    """A batch before its first epoch, neither compiled nor with states: a checkpoint may have them, or show that
    nothing is left to train."""
    began, started = time.time(), time.perf_counter()
    train, seeds = make_train(batch.config, batch.envs[0]), [seed for _, seed in batch.members]
    hyper = batched_hyper(batch.config.hyper, [dict(setting.values) for setting, _ in batch.members], batch.shape[:-1])
    if len(batch.envs) == 1:
        programs = side_by_side(train, seeds, hyper, "vmap_size")
    else:
        programs = in_several(train, batch.envs, seeds, hyper)
    share = measure.learner_share(train)
    return Training(
        batch,
        train,
        Sweep(batch.config, programs),
        hyper,
        share and jit(share),
        np.ones(batch.shape, bool),
        began,
        compile_seconds=time.perf_counter() - started,
    )


def without_ended(training: Training, ended: set[Run]) -> Training:
    """Before an evaluation: the training of the goal sets and members on which a run goes on, not yet compiled. The
    same one where these are all, or where members that have ended have not cost yet what compiling anew would; if not,
    its states are given up."""
    batch = training.batch
    runs = {key: run for key, run in batch.runs.items() if run not in ended}
    places = sorted({place for place, _ in runs})
    which = [number for number, (setting, _) in enumerate(batch.members) if any(setting == each for _, each in runs)]
    idle = 1 - len(places) * len(which) / training.finite.size
    if not idle or training.idle_seconds < training.sweep.prepare_seconds:
        training.idle_seconds += idle * training.sweep.last_seconds
        return training

    axes = len(batch.shape)

    def moved(leaf: jax.Array) -> jax.Array:
        own = part(leaf, axes, places, which)
        leaf.delete()  # The device's memory may not hold both.
        return own

    runs = {(places.index(place), setting): run for (place, setting), run in runs.items()}
    envs, flat = tuple(batch.envs[place] for place in places), tuple(batch.members[number] for number in which)
    smaller = begin(Batch(batch.config, envs, flat, runs))
    smaller.go_on_with(jax.tree.map(moved, training.states), training.evaluations)
    smaller.history = {
        name: [part(value, axes, places, which) for value in values] for name, values in training.history.items()
    }
    smaller.finite = part(training.finite, axes, places, which)
    smaller.started, smaller.spans = training.started, training.spans
    smaller.sweep.last_seconds = training.sweep.last_seconds
    smaller.compile_seconds += training.compile_seconds
    smaller.run_seconds = training.run_seconds
    return smaller
