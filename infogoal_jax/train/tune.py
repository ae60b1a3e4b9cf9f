"""Random search over hyperparameters (Bergstra & Bengio 2012): every trial with every seed is a lane of one compiled
program.

Every method is searched alike: the same number of trials, seeds and updates, the same ranges, and the same draws for
the fields that methods share. Trial 0 is the preset. Scores are successes on validation goals, or on training goals
where a task has none; goals of the test are not even evaluated.

The best of many trials owes something to luck: in a final the preset and the best of a search run again, fewer trials
with more and other seeds.
"""

import dataclasses
import time
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval

from infogoal_jax import agents, envs, presets
from infogoal_jax.config import Hyperparameters, TrainConfig
from infogoal_jax.errors import UserError, nearest, require
from infogoal_jax.hyperparameters import Search, search_space, values_of, with_values
from infogoal_jax.train import devices, host
from infogoal_jax.train.combinations import check_combination, has_reward
from infogoal_jax.train.compilation import compiler_options
from infogoal_jax.train.program import Train, TrainState, make_train

FIRST_SEED = 1000
"""Seeds of tuning start here: reported runs have seeds 0, 1, 2, ..."""
BUDGET = ("num_epochs", "epochs_per_evaluation", "num_envs", "rollout_steps", "updates_per_epoch")


@dataclasses.dataclass(frozen=True)
class Trial:
    """One setting. number: in the search that drew it; values: of the fields searched; success, loss: [evaluations so
    far][seeds], of the scored goals and of the agent at that time; diverged: seeds whose loss or gradient stopped being
    finite."""

    number: int
    values: dict[str, float]
    success: list[list[float]]
    loss: list[list[float]]
    diverged: list[int]

    @property
    def score(self) -> float:
        """Success at the last evaluation, mean over seeds."""
        return float(np.mean(self.success[-1]))

    @property
    def order(self) -> tuple:
        """What trials are compared by: seeds that did not diverge, score, then how early there was success, then the
        preset first."""
        return -len(self.diverged), self.score, float(np.mean(self.success)), -self.number


@dataclasses.dataclass(frozen=True)
class TuneResult:
    """A search or final, as far as it came. group: of the goals that scores are of, `validation` or `train`; epochs: of
    the evaluations so far."""

    config: TrainConfig
    group: str
    fields: tuple[str, ...]
    seeds: list[int]
    epochs: list[int]
    trials: list[Trial]
    compile_seconds: float
    run_seconds: float
    description: dict[str, Any]

    @property
    def best(self) -> Trial:
        """The trial of the highest score; among equals the one that was good earliest, then the preset."""
        return max(self.trials, key=lambda trial: trial.order)

    def config_of(self, trial: Trial) -> TrainConfig:
        """The configuration with a trial's values."""
        return dataclasses.replace(self.config, hyper=with_values(self.config.hyper, trial.values))


@flax.struct.dataclass
class Lane:
    """One seed of one trial."""

    state: TrainState
    hyper: Hyperparameters


def same_budget(config: TrainConfig) -> TrainConfig:
    """The configuration with the epochs and steps that the task's preset has for the bare agent: as much for one method
    as for another."""
    bare = presets.load(config.task, "none", agent=agents.registry.name_of(config.agent))
    return dataclasses.replace(config, **{name: getattr(bare, name) for name in BUDGET})


def check_fields(fields: Sequence[str], space: dict[str, Search]) -> None:
    """Raise `UserError` for a field that the space does not have, or one given twice."""
    for field in fields:
        require(
            field in space, "fields", field, f"is not searched.{nearest(field, list(space))} Known: {', '.join(space)}"
        )
    require(len(set(fields)) == len(fields), "fields", tuple(fields), "give each once")


def check_seeds(seeds: Sequence[int], trials: int) -> None:
    """Raise `UserError` for seeds that reported runs have, or for nothing to run."""
    require(trials > 0, "trials", trials, "give at least 1")
    require(len(seeds) > 0, "seeds", len(seeds), "give at least 1")
    require(len(set(seeds)) == len(seeds), "seeds", list(seeds), "give different seeds")
    require(
        min(seeds) >= FIRST_SEED,
        "first_seed",
        min(seeds),
        f"reported runs have the seeds 0, 1, 2, ...: give {FIRST_SEED} or more",
    )
    require(max(seeds) < 2**32, "first_seed", max(seeds), "give seeds below 2^32")


def scored_goals_only(env) -> tuple[Any, str]:
    """The environment with no other goals evaluated than those that trials are scored on, and their group."""
    group = "validation" if "validation" in env.goals.groups else "train"
    scored = np.flatnonzero(getattr(env.goals, f"{group}_mask"))
    return env.with_goals(env.goals.replace(evaluated=jnp.asarray(scored, jnp.int32), groups=(group,))), group


def fields_that_matter(train: Train) -> tuple[str, ...]:
    """Fields of the space that anything of a run depends on.

    The traced program says so itself: a learner without a loss does not read the weight of one. Only the intrinsic
    reward is a constant 0 where there is none, which the program multiplies all the same.
    """
    hyper = jax.tree.map(jnp.float32, train.config.hyper)
    state = jax.eval_shape(train.initial, jax.random.key(0), hyper, train.env)
    program = jax.make_jaxpr(train.chunk)(state, jnp.arange(1), hyper, train.env).jaxpr
    _, read = partial_eval.dce_jaxpr(program, [True] * len(program.outvars))
    before = len(jax.tree.leaves(state)) + 1
    read = dict(zip(values_of(hyper), read[before:], strict=False))
    read["intrinsic_weight"] &= has_reward(train.parts.learner)
    return tuple(name for name in search_space(hyper) if read[name])


def draw(key: jax.Array, preset: Hyperparameters, fields: Sequence[str], trials: int) -> list[dict[str, float]]:
    """The values of each trial: the preset's, then draws from the space. Those of a field depend on nothing but the
    key, the field and the trial."""
    space, values = search_space(preset), values_of(preset)
    shares = {
        field: np.asarray(jax.random.uniform(jax.random.fold_in(key, zlib.crc32(field.encode())), (trials,)), float)
        for field in fields
    }
    drawn = [{field: space[field].at(shares[field][number]) for field in fields} for number in range(1, trials)]
    return [{field: float(values[field]) for field in fields}, *drawn]


def finalists(trials: Sequence[Trial], count: int) -> list[Trial]:
    """The preset and the best others of a search, `count` in all, to be run again; of equal settings one. Raises
    `UserError` if there are fewer."""
    require(count > 1, "trials", count, "a final has at least 2: the preset, and others")
    chosen = [trials[0]]
    for trial in sorted(trials, key=lambda trial: trial.order, reverse=True):
        if len(chosen) < count and all(trial.values != other.values for other in chosen):
            chosen.append(trial)
    require(len(chosen) == count, "trials", count, f"the search has {len(chosen)} different settings; give no more")
    return [Trial(trial.number, trial.values, [], [], []) for trial in chosen]


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


def lane_programs(train: Train, group: str) -> tuple[Callable, Callable]:
    """How a lane begins, ((key, hyper), env) -> lane, and goes on, (lane, numbers, env) -> (lane, {success, loss,
    finite})."""

    def initial(start, env):
        return Lane(train.initial(*start, env), start[1])

    def chunk(lane, numbers, env):
        state, epochs, metrics = train.chunk(lane.state, numbers, lane.hyper, env)
        finite = jnp.stack([jnp.isfinite(epochs[name]).all() for name in host.WATCHED]).all()
        seen = {"success": metrics[f"{group}_goal/success_rate"], "loss": epochs["agent/loss"][-1], "finite": finite}
        return Lane(state, lane.hyper), seen

    return initial, chunk


def lanes_at_once(train: Train, count: int, mesh: jax.sharding.Mesh) -> int:
    """How many of a device's lanes run beside each other in its memory. Raises `UserError` if they do not fit."""
    one = jax.eval_shape(train.initial, jax.random.key(0), train.config.hyper, train.env)
    memory = min(devices.device_memory(device) for device in mesh.devices.flat)
    try:
        state, working, data = devices.bytes_of(one), devices.working_bytes(train), devices.bytes_of(train.env)
        return devices.seeds_at_once(state, working, data, count // mesh.size, memory, mesh.size)
    except UserError as error:
        raise UserError(f"trials x {error}") from error


def tune(
    config: TrainConfig,
    trials: int,
    seeds: Sequence[int],
    key: jax.Array,
    fields: Sequence[str] = (),
    env: Any = None,
    watch: Callable[[TuneResult], None] = lambda result: None,
) -> TuneResult:
    """Draw `trials` settings and train each with each of these seeds. Raises `UserError` before anything is compiled.

    key: of the draws; fields: those to search, empty for all that matter to the method; env: one already loaded; watch:
    called after each evaluation.
    """
    check_fields(fields, search_space(config.hyper))
    train, group = scored_training(config, trials, seeds, env)
    matter = fields_that_matter(train)
    for field in fields:
        require(
            field in matter,
            "fields",
            field,
            f"changes nothing about {presets.name_of(config)} on {config.task}. What does: {', '.join(matter)}",
        )
    drawn = draw(
        key,
        config.hyper,
        tuple(fields) or tuple(name for name in matter if search_space(config.hyper)[name].always),
        trials,
    )
    return side_by_side(
        train, group, [Trial(number, values, [], [], []) for number, values in enumerate(drawn)], seeds, watch
    )


def final(
    config: TrainConfig,
    trials: Sequence[Trial],
    seeds: Sequence[int],
    env: Any = None,
    watch: Callable[[TuneResult], None] = lambda result: None,
) -> TuneResult:
    """Train `finalists` of a search of this configuration with each of these seeds, which should be others. Otherwise
    as `tune`."""
    check_fields(tuple(trials[0].values), search_space(config.hyper))
    train, group = scored_training(config, len(trials), seeds, env)
    return side_by_side(train, group, trials, seeds, watch)


def scored_training(config: TrainConfig, trials: int, seeds: Sequence[int], env: Any) -> tuple[Train, str]:
    """Training that evaluates nothing but the goals that trials are scored on, and their group. Raises `UserError` for
    what cannot be run."""
    check_seeds(seeds, trials)
    check_combination(config, env)
    env, group = scored_goals_only(envs.load(config.task, config.env) if env is None else env)
    return make_train(config, env), group


def side_by_side(
    train: Train, group: str, trials: Sequence[Trial], seeds: Sequence[int], watch: Callable[[TuneResult], None]
) -> TuneResult:
    """Train each of these settings with each of these seeds, a lane each."""
    started, config, count = time.perf_counter(), train.config, len(trials) * len(seeds)
    mesh = devices.seed_mesh(count)
    at_once = lanes_at_once(train, count, mesh)
    by_lane, everywhere = (
        jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(*axes)) for axes in (("seeds",), ())
    )
    keys = jax.vmap(jax.random.key)(jnp.asarray(list(seeds) * len(trials), jnp.uint32))
    starts = jax.device_put(
        (keys, batched_hyper(config.hyper, [trial.values for trial in trials], len(seeds))), by_lane
    )
    shared, numbers = jax.device_put(train.env, everywhere), jnp.arange(config.epochs_per_evaluation, dtype=jnp.int32)
    initial, chunk = lane_programs(train, group)
    options = compiler_options()
    lanes = jax.jit(devices.over_seeds(initial, count, at_once, mesh), out_shardings=by_lane, compiler_options=options)(
        starts, shared
    )
    compiled = (
        jax.jit(devices.chunk_over_seeds(chunk, count, at_once, mesh), donate_argnums=0)
        .lower(lanes, numbers, shared)
        .compile(options)
    )
    result = TuneResult(
        config,
        group,
        tuple(trials[0].values),
        list(seeds),
        [],
        list(trials),
        time.perf_counter() - started,
        0.0,
        host.describe(config, train.env, list(seeds)),
    )
    for evaluation in range(config.num_evaluations):
        started = time.perf_counter()
        done = evaluation * config.epochs_per_evaluation
        lanes, seen = compiled(lanes, numbers + done, shared)
        seen = jax.tree.map(
            lambda leaf: np.asarray(leaf).reshape(len(trials), len(seeds)).tolist(), jax.device_get(seen)
        )
        result = dataclasses.replace(
            result,
            epochs=[*result.epochs, done + len(numbers)],
            run_seconds=result.run_seconds + time.perf_counter() - started,
            trials=[
                continued(trial, result.seeds, *(seen[name][place] for name in ("success", "loss", "finite")))
                for place, trial in enumerate(result.trials)
            ],
        )
        watch(result)
    return result


def continued(trial: Trial, seeds: list[int], success: list[float], loss: list[float], finite: list[bool]) -> Trial:
    """The trial after another evaluation; each list has a number for each seed."""
    lost = {seed for seed, good in zip(seeds, finite, strict=True) if not good}
    return dataclasses.replace(
        trial, success=[*trial.success, success], loss=[*trial.loss, loss], diverged=sorted(lost.union(trial.diverged))
    )
