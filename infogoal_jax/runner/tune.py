"""Random search over hyperparameters (Bergstra & Bengio 2012): every trial with every seed is a lane of one compiled
program.

Every method is searched alike: the same number of trials, seeds and updates, the same ranges, and the same draws for
the fields that methods share. Trial 0 is the preset. Scores are successes on validation goals, or on training goals
where a task has none; goals of the test are not even evaluated.

The best of many trials owes something to luck: in a final the preset and the best of a search run again, fewer trials
with more and other seeds.
"""

import dataclasses
import zlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval

from infogoal_jax import agents, envs, presets
from infogoal_jax.config import Hyperparameters, TrainConfig
from infogoal_jax.errors import nearest, require
from infogoal_jax.hyperparameters import Search, search_space, values_of
from infogoal_jax.runner import host
from infogoal_jax.runner.lanes import Watch, lanes_at_once, side_by_side
from infogoal_jax.runs.search import Trial, TuneResult
from infogoal_jax.train.combinations import check_combination, has_reward
from infogoal_jax.train.program import Train, make_train

FIRST_SEED = 1000
"""Seeds of tuning start here: reported runs have seeds 0, 1, 2, ..."""
BUDGET = ("num_epochs", "epochs_per_evaluation", "num_envs", "rollout_steps", "updates_per_epoch")


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
    host.checked_seeds(seeds)
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
    return side_by_side(
        train, group, [Trial(number, values, [], [], []) for number, values in enumerate(drawn)], seeds, watch
    )


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
    return side_by_side(train, group, trials, seeds, watch, resume)


def scored_training(config: TrainConfig, trials: int, seeds: Sequence[int], env: Any) -> tuple[Train, str]:
    """Training that evaluates nothing but the goals that trials are scored on, and their group. Raises `UserError` for
    what cannot be run."""
    check_seeds(seeds, trials)
    check_combination(config, env)
    env, group = scored_goals_only(envs.load(config.task, config.env) if env is None else env)
    train = make_train(config, env)
    lanes_at_once(train, trials * len(seeds))
    return train, group
