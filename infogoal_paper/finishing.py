"""From a trained batch to the files of its runs: when it is finished, its numbers, and what is measured of it."""

import shlex
import time
import traceback
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from infogoal_jax.config import TrainConfig
from infogoal_jax.envs.environment import data_of
from infogoal_jax.errors import UserError
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.runner.training import describe
from infogoal_paper import batches, files, measure, plan
from infogoal_paper.files import Result, command_of
from infogoal_paper.manifest import Run


def curve_of(training: batches.Training, run: Run, metric: str) -> np.ndarray:
    """A metric of a run so far, [seeds, evaluations, ...]."""
    index = training.batch.index(run)
    return np.stack([values[index] for values in training.history[metric]], 1)


def mean_success(training: batches.Training, run: Run) -> tuple[float, float]:
    """Success on training and test goals at the last evaluation, mean over seeds."""
    return tuple(
        float(curve_of(training, run, f"{group}_goal/success_rate")[:, -1].mean()) for group in ("train", "test")
    )


def ended(training: batches.Training) -> list[Run]:
    """The runs of a batch that are trained to their end: each has levelled off, or the ceiling is reached."""
    if not training.evaluations:
        return []
    curves = {run: curve_of(training, run, "train_goal/success_rate") for run in training.batch.runs.values()}
    return [run for run, curve in curves.items() if plan.is_trained(curve, run.task, run.toy)]


def share_out(training: batches.Training, runs: list[Run]) -> float:
    """Share out what the batch took so far between the runs that end now and those that go on, member by member.
    Returns the seconds of those that end."""
    going_on = [run for run in training.batch.runs.values() if run.name not in training.costs]
    count = sum(len(run.seeds) for run in runs)
    share = count / sum(len(run.seeds) for run in going_on)
    seconds = share * training.compile_seconds, share * training.run_seconds
    own = {
        "runs": sorted(run.name for run in runs),
        "lanes": count,
        "compile_seconds": round(seconds[0], 1),
        "run_seconds": round(seconds[1], 1),
    }
    training.costs |= {run.name: own for run in runs}
    training.compile_seconds -= seconds[0]
    training.run_seconds -= seconds[1]
    return sum(seconds)


class Extras(NamedTuple):
    """What is measured of a run when its training has ended.

    share: of the learner's loss in the gradient, of the first seed.
    arrays: of its codes and pictures.
    error: why something could not be had.
    seconds: that it took.
    """

    share: float | None = None
    arrays: dict[str, np.ndarray] = {}  # noqa: RUF012 (never written to)
    error: str = ""
    seconds: float = 0.0

    def missing(self, run: Run) -> list[str]:
        """What is to be measured of the run and was not."""
        return plan.missing(run, self.share, self.arrays)


def result_of(training: batches.Training, run: Run, config: TrainConfig, measured: Extras) -> Result:
    """What a run of a finished batch came to. config: of the run."""
    batch, (place, _) = training.batch, training.batch.places[run]
    env, finite = batch.envs[place], training.finite[batch.index(run)]
    evaluations = {
        name: curve_of(training, run, name).astype(float) for name in training.history if name != "first_reached"
    }
    about = {
        "config": files.recorded_config(config),
        "data": data_of(env),
        "versions": describe(batch.config, env, [0]).versions,
        "machine": describe_machine(),
        "updates": batch.config.epochs_per_evaluation * batch.config.updates_per_epoch,
        "diverged": [seed for seed, good in zip(run.seeds, finite, strict=True) if not good],
        "learner": training.train.parts.name,
        "learner_share": measured.share,
        "measuring_failed": measured.error or (plan.NO_TIME if measured.missing(run) else ""),
        "episode_length": env.episode_length,
        "program": training.costs[run.name] | {"spans": training.spans_until_now()},
        "measure_seconds": round(measured.seconds, 1),
        "command": shlex.join(command_of(run)),
    }
    first = curve_of(training, run, "first_reached")
    arrays = {
        "first_reached": first.astype(np.min_scalar_type(int(first.max()))),
        "uses": measure.uses_of(env.goals, np.asarray(env.goals.evaluated)),
    }
    if env.near_goals is not None:
        arrays["near"] = np.asarray(env.near_goals)[np.asarray(env.goals.evaluated)]
    return Result(run, about, evaluations, arrays | measured.arrays)


def known_of(folder: Path, training: batches.Training, run: Run) -> Extras:
    """What an earlier process measured of this very training of a run."""
    try:
        found = files.read(files.path_of(folder, run))
    except UserError:  # There is no file yet, or it is damaged.
        return Extras()
    curve = curve_of(training, run, "train_goal/success_rate").astype(np.float32)
    if found.run != run or not np.array_equal(found.evaluations["train_goal/success_rate"].astype(np.float32), curve):
        return Extras()
    arrays = {name: value for name, value in found.arrays.items() if name.partition("/")[0] in ("picture", "codes")}
    return Extras(found.about["learner_share"], arrays, "", found.about["measure_seconds"])


def first_seed(training: batches.Training, run: Run, tree: Any) -> Any:
    """Of a pytree of all members that of the first seed of a run."""
    *place, members = training.batch.index(run)
    return jax.tree.map(lambda leaf: leaf[(*place, members.start)], tree)


def share_of(training: batches.Training, run: Run, config: TrainConfig) -> Extras:
    """The share of the learner's loss in the gradient, of the first seed."""
    place, _ = training.batch.places[run]
    state, hyper = first_seed(training, run, (training.states, training.hyper))
    last = training.evaluations * training.batch.config.epochs_per_evaluation - 1
    return Extras(float(training.share(state, last, hyper, training.batch.envs[place])))


def codes_of(training: batches.Training, run: Run, config: TrainConfig) -> Extras:
    """What claims say of the codes of all seeds."""
    place, index = training.batch.places[run][0], training.batch.index(run)
    params = jax.tree.map(lambda leaf: leaf[index], training.states.params)
    train = measure.on(training.train, config, training.batch.envs[place])
    return Extras(arrays=measure.judged_codes(train, params, run.seeds))


def pictures_of(training: batches.Training, run: Run, config: TrainConfig) -> Extras:
    """What the pictures of the first seed are drawn from."""
    place, _ = training.batch.places[run]
    params = first_seed(training, run, training.states.params)
    train = measure.on(training.train, config, training.batch.envs[place])
    return Extras(arrays=measure.pictures(measure.subject_of(train, params, run.seeds[0])))


MEASURES = {"share": share_of, "codes": codes_of, "pictures": pictures_of}
"""How what `plan.missing` names is measured; the most wanted first."""


def measured_also(
    name: str, training: batches.Training, run: Run, config: TrainConfig, before: Extras
) -> tuple[Extras, str]:
    """What was measured of a run before, and this; and the trace of an error. What fails costs a figure, or a mark in a
    table, and not the run."""
    started, found, error, trace = time.perf_counter(), Extras(), before.error, ""
    try:
        found = MEASURES[name](training, run, config)
    except Exception as reason:
        error, trace = f"{type(reason).__name__}: {reason}"[:500], traceback.format_exc()
    share = before.share if found.share is None else found.share
    return Extras(share, before.arrays | found.arrays, error, before.seconds + time.perf_counter() - started), trace
