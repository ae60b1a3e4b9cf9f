"""Which runs are trained in one compiled program: those whose configurations differ in floats, seeds and goal sets
alone; and goal sets on graphs of different sizes as environments of one shape, so that one program trains on all.
And when a run is complete: how long it is trained, and what is measured of it beside its success.

A run is trained until success on training goals has levelled off, by one rule for all methods. The budget of a task is
the largest that its preset gives to a row of Table I. A run is evaluated ten times within it. It has levelled off at
the first evaluation, from the sixth on, by which the mean success on training goals over the last three evaluations is
less than 0.02 above that over the three before them; the mean is over its seeds. Where it is below 0.1, the run is on
the floor, from which some rise late: it is not taken to be level before its budget is spent, nor while it is 0.02 above
the mean over the first three evaluations. Its numbers are means over these last three evaluations. A run that has not
levelled off by three times the budget is stopped there, and marked. Validation and test goals have no say in it.
"""

import dataclasses
import functools
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import presets
from infogoal_jax.config import TrainConfig
from infogoal_jax.data.splits import AUTHORS_SPLIT
from infogoal_jax.envs.graph import UNREACHABLE, DetectionWalk, GraphWalk
from infogoal_jax.envs.object_search import RememberingSearch
from infogoal_jax.errors import UserError, require
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.runs.configuration import to_dict
from infogoal_paper.manifest import DRAWN, FETCH, PRESET, Run
from infogoal_paper.paper import IMAGE_TASKS, METHODS, WITH_LOSS

GOAL_SET_FIELDS = ("dataset", "generator_seed", "goal_seed", "goal_images")
"""Fields of an environment's configuration that say which goal set it has."""
TOY = {"num_envs": 8, "rollout_steps": 12, "updates_per_epoch": 2, "batch_size": 16, "evaluation_starts": 1}
"""A size at which nothing is learned."""
TOY_STEPS = 6
"""Of an episode of an arm: two subgoals of HRAC."""
ONE_SET_AT_A_TIME = ("fetch_push",)
"""Tasks whose goal sets are trained one after another. On GPUs XLA does not compile InfoGoal, InfoBot, COGOAL and GCB
on several of Push's side by side (`dims not physically sequential`, jax 0.11.2)."""
EVALUATIONS = 10
"""Within the budget of a task."""
FIRST, MOST = 6, 30
"""The earliest evaluation at which training may stop, and the last one."""
WINDOW, RISE, FLOOR = 3, 0.02, 0.1
"""Evaluations whose mean is compared, and shown; what it may still rise; and below which it is on the floor."""


class Program(NamedTuple):
    """Runs that one compiled program trains. config: of the first; it decides the program."""

    config: TrainConfig
    runs: tuple[Run, ...]

    @property
    def name(self) -> str:
        """The task and the method, for people."""
        return f"{self.runs[0].task} {self.runs[0].label}"


def fetch_sets(goal_images: Path | None) -> tuple[int, ...]:
    """The goal sets of Fetch that there are images of: the shipped one, and a folder for each further one."""
    if goal_images is None:
        return (0,)
    require(goal_images.is_dir(), "goal_images", str(goal_images), "give a folder of `infogoal reproduce goal-images`")
    numbers = sorted(int(path.name) for path in goal_images.iterdir() if path.name.isdigit() and path.is_dir())
    return (0, *(number for number in numbers if number > 0))


def config_of(run: Run, goal_images: Path | None = None) -> TrainConfig:
    """The configuration that a run is trained with. Builds no data."""
    config, budget = run.preset(), budget_of(run.task, run.toy)
    env, number = config.env, run.goal_set
    if run.task in FETCH and number:
        require(goal_images is not None, "goal_images", None, f"give the folder of the goal images of set {number}")
        env = dataclasses.replace(env, goal_images=str(goal_images / str(number) / f"{run.task}.npz"))
    elif run.task == "object_search" and number:
        from infogoal_jax.stand_ins import house

        env = dataclasses.replace(env, dataset=str(house.cached_folder(number)))
    elif run.task == "object_manipulation":
        env = dataclasses.replace(env, generator_seed=number, goal_seed=number)
    elif run.task == "embodied_qa":
        env = dataclasses.replace(env, generator_seed=number)
    sizes = {"num_epochs": budget.chunk * budget.evaluations, "epochs_per_evaluation": budget.chunk}
    if run.toy:
        sizes |= TOY | {"buffer_steps": 10 * TOY["num_envs"] * TOY["rollout_steps"]}
        env = dataclasses.replace(env, episode_length=TOY_STEPS) if run.task in IMAGE_TASKS else env
    return dataclasses.replace(config, env=env, hyper=with_values(config.hyper, dict(run.setting.values)), **sizes)


def build_data(run: Run) -> None:
    """Build the data of a run's goal set in the user's cache where it is not built with the environment."""
    if run.task == "object_search" and run.goal_set:
        from infogoal_jax.stand_ins import house

        if not house.cached_folder(run.goal_set).exists():
            house.load(run.goal_set, objects=AUTHORS_SPLIT.objects)


def program_key(config: TrainConfig) -> str:
    """What two configurations share that one program can train: all but floats and the goal set."""
    values = to_dict(config)
    values["env"] = {name: value for name, value in values["env"].items() if name not in GOAL_SET_FIELDS}
    del values["hyper"]
    return json.dumps(values, sort_keys=True, default=str)


def programs_of(runs: list[Run], goal_images: Path | None = None) -> list[Program]:
    """The runs, grouped by the program that trains them, in order of the first of each."""
    grouped: dict[str, tuple[TrainConfig, list[Run]]] = {}
    for run in runs:
        config = config_of(run, goal_images)
        grouped.setdefault(program_key(config), (config, []))[1].append(run)
    return [Program(config, tuple(members)) for config, members in grouped.values()]


def with_one_shape(envs: list[Any]) -> list[Any]:
    """The environments, those on graphs padded to the largest of them; others as they are."""
    walks = [env.unwrapped for env in envs]
    if len(envs) == 1 or not all(isinstance(walk, GraphWalk) for walk in walks):
        return envs
    starts = max(walk.starts.shape[1] for walk in walks)
    padded = [walk.replace(starts=widened(walk.starts, 1, starts, 0)) for walk in walks]
    if all(isinstance(walk, DetectionWalk) for walk in walks):
        in_view = max(walk.achieved_goals.shape[1] for walk in walks)
        padded = [walk.replace(achieved_goals=widened(walk.achieved_goals, 1, in_view, -1)) for walk in padded]
        if all(walk.recorded is None and walk.views is None for walk in walks):
            images = max(len(walk.images) for walk in walks)
            padded = [with_images(walk, images) for walk in padded]
    return [walk if env is env.unwrapped else env.replace(env=walk) for env, walk in zip(envs, padded, strict=True)]


def with_images(walk: DetectionWalk, images: int) -> DetectionWalk:
    """The walk with so many images. One that was added leads to itself, and shows nothing."""
    count = len(walk.images)
    own = jnp.broadcast_to(jnp.arange(count, images, dtype=walk.next_node.dtype)[:, None], (images - count, 1))
    added = jnp.repeat(own, walk.action_size, axis=1)
    if isinstance(walk, RememberingSearch):
        walk = walk.replace(cell=widened(walk.cell, 0, images, 0))
    return walk.replace(
        next_node=jnp.concatenate([walk.next_node, added]),
        images=widened(walk.images, 0, images, 0),
        in_view=widened(walk.in_view, 0, images, False),
        achieved_goals=widened(walk.achieved_goals, 0, images, -1),
        position=widened(walk.position, 0, images, jnp.nan),
        distance=widened(walk.distance, 1, images, UNREACHABLE),
    )


def widened(array: jax.Array, axis: int, size: int, value: Any) -> jax.Array:
    """The array, filled up with a value to this size along an axis."""
    width = [(0, 0)] * array.ndim
    width[axis] = 0, size - array.shape[axis]
    return jnp.pad(array, width, constant_values=value)


class Budget(NamedTuple):
    """How a run of a task is trained. chunk: epochs between two evaluations; evaluations: at most."""

    chunk: int
    evaluations: int


@functools.cache
def budget_of(task: str, toy: bool = False) -> Budget:
    """The budget of every run of a task."""
    if toy:
        return Budget(1, FIRST)
    epochs = []
    for method in METHODS:
        try:
            epochs.append(presets.load(task, method).num_epochs)
        except UserError:  # A part's own check refuses the task.
            continue
    return Budget(max(1, math.ceil(max(epochs) / EVALUATIONS)), MOST)


def levelled(curve: np.ndarray) -> int | None:
    """The number of evaluations by which a curve of success on training goals [seeds, evaluations] has levelled off;
    None if it has not yet."""
    return levelled_mean(np.asarray(curve, float).mean(0).tobytes())


@functools.cache  # Each claim and each table asks of the same curves.
def levelled_mean(content: bytes) -> int | None:
    """`levelled`, of the bytes of the mean over seeds, float64 [evaluations]."""
    mean = np.frombuffer(content)
    for count in range(FIRST, len(mean) + 1):
        before, last = mean[count - 2 * WINDOW : count - WINDOW].mean(), mean[count - WINDOW : count].mean()
        first = mean[:WINDOW].mean()
        if last - before < RISE and (last >= FLOOR or (count >= EVALUATIONS and last - first < RISE)):
            return count
    return None


def shown(curve: np.ndarray) -> slice:
    """The evaluations whose mean is a run's number: the last three before it levelled off, or the last three."""
    count = levelled(curve) or np.shape(curve)[1]
    return slice(max(0, count - WINDOW), count)


def is_trained(curve: np.ndarray, task: str, toy: bool = False) -> bool:
    """Whether a run with this curve is trained to its end: it has levelled off, or the ceiling is reached."""
    return levelled(curve) is not None or np.shape(curve)[1] >= budget_of(task, toy).evaluations


def still_rises(curve: np.ndarray) -> bool:
    """Whether a finished run's training curve ends without having levelled off."""
    return levelled(curve) is None


PICTURED = ("object_search", "embodied_qa", "fetch_pick_and_place", "object_manipulation")
"""Tasks whose codes and trajectories are drawn."""
JUDGED = ("infogoal", "none")
"""Methods whose codes a claim compares."""
NO_TIME = "no time was left to measure it"


def is_pictured(run: Run) -> bool:
    """Whether a figure shows codes or trajectories of this run."""
    shown = run.task in PICTURED and run.method in DRAWN and run.relabelling != "her"
    return run.of_paper and run.goal_set == 0 and shown


def is_judged(run: Run) -> bool:
    """Whether a claim compares the codes of this run: of all its seeds, on every goal set."""
    plain = run.of_paper and run.setting.name == PRESET[0] and run.explorer is None and run.relabelling != "her"
    return run.task in PICTURED and run.method in JUDGED and plain


def missing(run: Run, share: float | None, arrays: Iterable[str]) -> list[str]:
    """What is to be measured of a run and was not: share, codes, pictures. share: None where it was not measured;
    arrays: names of those that there are."""
    lacking = {
        "share": run.method in WITH_LOSS and share is None,
        "codes": is_judged(run) and "codes/closeness" not in arrays,
        "pictures": is_pictured(run) and "picture/code_mean" not in arrays,
    }
    return [name for name, lacks in lacking.items() if lacks]
