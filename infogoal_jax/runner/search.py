"""Random search over hyperparameters (Bergstra & Bengio 2012): every trial with every seed is a member of one sweep,
with a checkpoint after each evaluation.

Every method is searched alike: the same number of trials, seeds and updates, the same ranges, and the same draws for
the fields that methods share. Trial 0 is the preset. Scores are successes on validation goals, or on training goals
where a task has none; goals of the test are not even evaluated.

The best of many trials owes something to luck: in a final the preset and the best of a search run again, fewer trials
with more and other seeds.
"""

import contextlib
import dataclasses
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval

from infogoal_jax import agents, envs, presets
from infogoal_jax.config import Hyperparameters, TrainConfig
from infogoal_jax.errors import require, require_known
from infogoal_jax.hyperparameters import Search, search_space, values_of
from infogoal_jax.imports import typed_command
from infogoal_jax.learners.learner import has_reward
from infogoal_jax.loading import check_combination, make_train
from infogoal_jax.runner import memory
from infogoal_jax.runner.distributed import seed_mesh
from infogoal_jax.runner.sweep import (
    Callback,
    Member,
    Programs,
    Sweep,
    batched_hyper,
    is_finite,
    side_by_side,
    train_sweep,
)
from infogoal_jax.runner.training import checked_seeds, describe
from infogoal_jax.runs import checkpoint
from infogoal_jax.runs.checkpoint import check_same
from infogoal_jax.runs.configuration import from_values
from infogoal_jax.runs.disk import Place, decode_value
from infogoal_jax.runs.folder import SEARCH, check_new, only_writer
from infogoal_jax.runs.search import Trial, TuneResult, check_trials, read_plan, write_plan
from infogoal_jax.stopping import NOTHING, Stopped, StopRequest, stop_on_signal
from infogoal_jax.train.contracts import check_simulated
from infogoal_jax.train.program import Train

NUMBER = "trials x seeds"
"""What is to be smaller where the members of a search do not fit."""
FIRST_SEED = 1000
"""Seeds of tuning start here: reported runs have seeds 0, 1, 2, ..."""
FINALISTS = 4
"""Settings of a final where nobody says how many."""
BUDGET = ("num_epochs", "epochs_per_evaluation", "num_envs", "rollout_steps", "updates_per_epoch")


class Watch(NamedTuple):
    """What accompanies a search.

    folder: where it leaves its files.
    command: of the command line that goes on with it.
    compiling: called before the program is compiled.
    evaluated: called after each evaluation.
    """

    folder: Path
    command: str = "tune"
    compiling: Callable[[], None] = lambda: None
    evaluated: Callable[[TuneResult], None] = lambda result: None


def same_budget(config: TrainConfig) -> TrainConfig:
    """The configuration with the epochs and steps that the task's preset has for the bare agent: as much for one method
    as for another."""
    bare = presets.load(config.task, "none", agent=agents.registry.name_of(config.agent))
    return dataclasses.replace(config, **{name: getattr(bare, name) for name in BUDGET})


def check_fields(fields: Sequence[str], space: dict[str, Search]) -> None:
    """Raise `UserError` for a field that the space does not have, or one given twice."""
    for field in fields:
        require_known("fields", field, space, "is not searched")
    require(len(set(fields)) == len(fields), "fields", tuple(fields), "give each once")


def check_seeds(seeds: Sequence[int], trials: int) -> None:
    """Raise `UserError` for seeds that reported runs have, or for nothing to run."""
    require(trials > 0, "trials", trials, "give at least 1")
    checked_seeds(seeds)
    first = seeds[0] if isinstance(seeds, range) else min(seeds)
    require(
        first >= FIRST_SEED,
        "first_seed",
        first,
        f"reported runs have the seeds 0, 1, 2, ...: give {FIRST_SEED} or more",
    )


def scored_goals_only(env) -> tuple[Any, str]:
    """The environment with no other goals evaluated than those that trials are scored on, and their group."""
    group = "validation" if "validation" in env.goals.groups else "train"
    return env.with_goals(env.goals.only(group)), group


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
    fractions = {
        field: np.asarray(jax.random.uniform(jax.random.fold_in(key, zlib.crc32(field.encode())), (trials,)), float)
        for field in fields
    }
    drawn = [{field: space[field].at(fractions[field][number]) for field in fields} for number in range(1, trials)]
    return [{field: float(values[field]) for field in fields}, *drawn]


def finalists(trials: Sequence[Trial], count: int | None = None) -> list[Trial]:
    """The preset and the best others of a search, `count` in all, to be run again; of equal settings one. None: 4, or
    all where there are fewer. Raises `UserError` if there are fewer than `count`, or only the preset."""
    chosen = [trials[0]]
    for trial in sorted(trials, key=lambda trial: trial.order, reverse=True):
        if all(trial.values != other.values for other in chosen):
            chosen.append(trial)
    known = len(chosen)
    count = min(known, FINALISTS) if count is None else count
    require(count > 1, "trials", count, "a final has at least 2: the preset, and others")
    require(count <= known, "trials", count, f"the search has {known} different settings; give no more")
    chosen = chosen[:count]
    return [Trial(trial.trial, trial.values) for trial in chosen]


def tune(
    config: TrainConfig,
    trials: int,
    seeds: Sequence[int],
    key: jax.Array,
    fields: Sequence[str] = (),
    env: Any = None,
    watch: Watch | None = None,
) -> TuneResult:
    """Draw `trials` settings and train each with each of these seeds. Raises `UserError` before anything is compiled.

    key: of the draws; fields: those to search, empty for all that matter to the method; env: one already loaded; watch:
    what accompanies the search; None leaves nothing on disk.
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
    return train_trials(train, group, list(map(Trial, range(trials), drawn)), seeds, watch)


def final(
    config: TrainConfig,
    trials: Sequence[Trial],
    seeds: Sequence[int],
    env: Any = None,
    watch: Watch | None = None,
    resume: bool = False,
) -> TuneResult:
    """Train `finalists` of a search of this configuration with each of these seeds, which should be others. Otherwise
    as `tune`.

    resume: these are all trials of a search or a final that was stopped, which goes on in the folder of `watch`.
    """
    check_fields(tuple(trials[0].values), search_space(config.hyper))
    train, group = scored_training(config, len(trials), seeds, env)
    return train_trials(train, group, trials, seeds, watch, resume)


def scored_training(config: TrainConfig, trials: int, seeds: Sequence[int], env: Any) -> tuple[Train, str]:
    """Training that evaluates nothing but the goals that trials are scored on, and their group. Raises `UserError` for
    what cannot be run."""
    check_seeds(seeds, trials)
    check_combination(config, env)
    env = envs.load(config.task, config.env) if env is None else env
    check_simulated(env, "task", config.task)
    env, group = scored_goals_only(env)
    train = make_train(config, env)
    count = trials * len(seeds)
    memory.at_once(train, count, seed_mesh(count), NUMBER)  # Before the settings are drawn.
    return train, group


def train_trials(
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
    seeds = list(checked_seeds(seeds))
    if watch is not None and not resume:
        check_new(watch.folder, SEARCH)
    with stop_on_signal() as stop:
        hyper = batched_hyper(train.config.hyper, [trial.values for trial in trials for _ in seeds])
        programs = side_by_side(train, seeds * len(trials), hyper, NUMBER)
        result = TuneResult(describe(train.config, train.env, seeds), group, list(trials))
        if not resume:
            programs.check()
        new = () if resume else SEARCH
        with contextlib.nullcontext() if watch is None else only_writer(watch.folder, new):
            members = None
            if resume:
                result, members = last_point(watch.folder, result, programs)
                programs.check()
            if watch is not None and not (resume and read_plan(watch.folder)[0] == result.about):
                write_plan(watch.folder, result)
            scores = Scores(result, watch, stop)
            stop.check()
            sweep = train_sweep(Sweep(result.config, programs, members, len(result.epochs)), scores, stop)
            if sweep.states is None:
                raise Stopped(stop.advice)
            return dataclasses.replace(scores.result, compile_seconds=sweep.prepare_seconds)


class Scores(Callback):
    """What the trials of a search come to; with `watch`, with a checkpoint of its members after each evaluation."""

    finishing = "this chunk of epochs and its evaluation"

    def __init__(self, result: TuneResult, watch: Watch | None, stop: StopRequest):
        self.result, self.watch, self.stop = result, watch, stop
        stop.advice = how_to_go_on(watch, result)

    def compiling(self, sweep: Sweep) -> None:
        if self.watch is not None:
            self.watch.compiling()

    def evaluated(self, sweep: Sweep) -> None:
        """Add what each trial came to, and keep it."""
        shape = len(self.result.trials), len(self.result.seeds)
        success = sweep.scored[f"{self.result.group}_goal/success_rate"].reshape(shape).tolist()
        loss, finite = sweep.learned["agent/loss"][:, -1].reshape(shape).tolist(), is_finite(sweep.learned)
        lost = [np.array(self.result.seeds)[~row].tolist() for row in finite.reshape(shape)]
        trials = [
            dataclasses.replace(
                trial,
                success=[*trial.success, success[place]],
                loss=[*trial.loss, loss[place]],
                diverged=sorted({*trial.diverged, *lost[place]}),
            )
            for place, trial in enumerate(self.result.trials)
        ]
        self.result = result = dataclasses.replace(
            self.result, trials=trials, compile_seconds=sweep.prepare_seconds, run_seconds=sweep.run_seconds
        )
        if self.watch is not None:
            self.watch.evaluated(result)
            header = result.about.values() | {"trials": [dataclasses.asdict(trial) for trial in trials]}
            checkpoint.save(self.watch.folder / "checkpoint", header, sweep.states)
            self.stop.advice = how_to_go_on(self.watch, result)


def how_to_go_on(watch: Watch | None, result: TuneResult) -> str:
    """What is on disk, in words, and the command that goes on with it."""
    if watch is None:
        return NOTHING
    there = f"the scores until epoch {result.epochs[-1]}" if result.epochs else "no scores yet"
    return f"{watch.folder} holds {there}; go on with: {typed_command(watch.command, '--resume', watch.folder)}"


def last_point(folder: Path, start: TuneResult, programs: Programs) -> tuple[TuneResult, Member | None]:
    """Where the search in this folder goes on: its result and its members, or the start if it was stopped before the
    first evaluation.

    Raises `UserError`, and changes nothing, for another search, or a file that is not what was written.
    """
    about, plan = read_plan(folder)
    check_same(folder / "config.json", about, start.about, longer=False)
    path, drawn = folder / "checkpoint", [trial.drawn() for trial in start.trials]
    if [trial.drawn() for trial in plan] != drawn:
        raise Place(folder / "config.json").refusal("its trials are others than those that are to go on")
    if not path.exists():
        return start, None
    header, payload = checkpoint.read_header(path)
    place = Place(path, remedy=checkpoint.REMEDY)
    check_same(path, from_values(header, place), start.about, longer=False)
    trials = decode_value(list[Trial], header.get("trials"), "trials", place)
    check_trials(trials, place, start.seeds)
    saved = dataclasses.replace(start, trials=trials)
    if [trial.drawn() for trial in trials] != drawn or not 0 < len(saved.epochs) <= start.config.num_evaluations:
        raise place.refusal("its trials are not those of config.json")
    return saved, checkpoint.arrays(path, payload, programs.states.shapes)
