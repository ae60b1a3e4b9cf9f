"""Recorded episodes (data/episodes.py) as what an agent learns from: `with_recordings` makes of a task with continuous
goals the same task to be learned offline. It is simulated in evaluations alone. `from_recordings` makes a task of
recordings alone, whose environment is elsewhere."""

import contextlib
import dataclasses
import math
import os
from collections.abc import Callable, Iterator

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import checks
from infogoal_jax.data.archives import checksum
from infogoal_jax.data.episodes import Episodes, load
from infogoal_jax.envs.contract import check_desired
from infogoal_jax.envs.environment import one_observation
from infogoal_jax.envs.goal_task import GoalTask
from infogoal_jax.errors import UserError, renamed, require
from infogoal_jax.goals import GoalBox
from infogoal_jax.replay import Trajectories
from infogoal_jax.shapes import aligned

MARGIN = 1e-3
"""How far the space of goals that are states goes beyond these, in their units."""
AT_ONCE = 2**28
"""Bytes of observations whose goals are read at once. Before training nothing else lies on a device: recordings may be
larger than its memory, which is said then."""


def with_recordings(task: GoalTask, episodes: Episodes) -> GoalTask:
    """The task with recordings to learn from. Where they tell no desired goals, each episode has a training goal of the
    task, which is a recorded one where nobody can act in it.

    What was achieved is read from the file, or else from its observations by `GoalTask.achieved_in`. Raises `UserError`
    for recordings of another task.
    """
    require(isinstance(episodes, Episodes), "episodes", type(episodes).__name__, "give Episodes of data/episodes.py")
    require(isinstance(task, GoalTask), "task", type(task).__name__, "give a GoalTask")
    seen, size = one_observation(task), task.goals.shape[0]
    observations = task.recorded_observation(episodes)
    require(
        observations.shape[1:] == seen.shape and observations.dtype == seen.dtype,
        "observations",
        f"{observations.dtype} {list(observations.shape[1:])}",
        f"the task has {seen.dtype} {list(seen.shape)}",
    )
    taken = episodes.action_size
    fits = taken <= task.action_size if task.discrete else taken == task.action_size
    require(
        fits and episodes.moves == task.discrete,
        "actions",
        f"{taken} moves" if episodes.moves else taken,
        f"the task has {task.action_size} {'moves' if task.discrete else 'numbers in an action'}",
    )
    bounds, own = episodes.action_bounds, task.action_bounds
    if bounds is not None:
        own = np.array([[-1.0], [1.0]]) * np.ones(taken) if own is None else np.asarray(own)
        remedy = f"give recordings of the task, whose actions have {own.tolist()}"
        same = own.shape == bounds.shape and np.allclose(bounds, own)
        require(same, "action_bounds", bounds.tolist(), remedy)
    achieved = episodes.achieved_goals
    if achieved is None:
        example = jax.ShapeDtypeStruct(episodes.observations.shape[1:], episodes.observations.dtype)
        wanted = checks.Spec((size,), "float32")
        checks.returned(checks.traced("achieved_in", task.achieved_in, example), "achieved_in", wanted)
        achieved_in = jax.jit(jax.vmap(task.achieved_in))
        parts = np.array_split(episodes.observations, math.ceil(episodes.observations.nbytes / AT_ONCE))
        achieved = np.concatenate([np.asarray(achieved_in(part)) for part in parts])
        infinite = achieved[np.isinf(achieved).any(1)][:1]
        require(not len(infinite), "achieved_in", infinite.tolist(), "return finite numbers, or NaN for no goal")
    for name, goals in (("achieved_goals", achieved), ("desired_goals", episodes.desired_goals)):
        fits = goals is None or goals.shape[1:] == (size,)
        require(fits, name, list(np.shape(goals)), f"give goals float32 [N, {size}]")
    if episodes.desired_goals is not None:
        remedy = "leave the member out: each episode then has a training goal"
        check_desired(task.goals, episodes.desired_goals, "desired_goals", remedy)
    rows = rows_of(task, observations, achieved, episodes)
    given = [episodes.observations, episodes.actions, episodes.achieved_goals, episodes.desired_goals]
    return task.replace(recorded=rows, recorded_checksum=checksum(*(each for each in given if each is not None)))


@flax.struct.dataclass
class RecordedTask(GoalTask):
    """Recorded states, each of which is a goal, reached there alone. Nobody can act in it: the world stays as it
    began."""

    action_size: int = flax.struct.field(pytree_node=False, default=1)
    """Numbers in an action, or how many moves there are."""
    discrete: bool = flax.struct.field(pytree_node=False, default=False)
    """Whether actions are moves."""
    action_bounds: np.ndarray | None = None
    """Those of the recordings."""
    source: str = flax.struct.field(pytree_node=False, default="recordings alone; success is measured elsewhere")
    """What is told of it."""

    simulated = False

    def begin(self, key: jax.Array) -> jax.Array:
        return self.goals.draw(key)

    def move(self, world: jax.Array, action: jax.Array) -> jax.Array:
        return world

    def observation(self, world: jax.Array) -> jax.Array:
        return world

    def achieved_goal(self, world: jax.Array) -> jax.Array:
        return world

    def achieved_in(self, observation: jax.Array) -> jax.Array:
        return observation

    def reached(self, record: jax.Array, goal: jax.Array) -> jax.Array:
        """Whether records [..., F] are the very states that goals [..., F] are, bool [...]."""
        record, goal = aligned(record, goal)
        return (record == goal).all(-1)


def from_recordings(
    episodes: Episodes | str | os.PathLike,
    *,
    held_out: Callable[[jax.Array], jax.Array] | None = None,
    seen: Callable[[jax.Array], jax.Array] | None = None,
) -> GoalTask:
    """A task to be learned offline from recordings alone, as OGBench has it: goals are whole states. What is learned is
    judged in an environment elsewhere (docs/reference/datasets.md).

    episodes: `Episodes` or the file of them, whose observations are vectors. held_out: says of a goal float32 [F]
    whether it is kept out of training. seen: what the goal encoder sees of goals float32 [..., F] instead of them as
    they are, such as pictures uint8 [..., H, W, C] that it draws.

    Raises `UserError` for recordings of images, and for what `with_recordings` refuses.
    """
    if isinstance(episodes, str | os.PathLike):
        episodes = load(episodes)
    require(isinstance(episodes, Episodes), "episodes", type(episodes).__name__, "give a file, or Episodes")
    states = episodes.observations
    require(
        states.ndim == 2,
        "observations",
        f"{states.dtype} {list(states.shape[1:])}",
        "goals are states as vectors here; for images write a task, and with_recordings",
    )
    if held_out is not None:
        checks.function(held_out, "held_out", 1, "give a function of a goal, or leave it out")
    with np.errstate(over="ignore"):  # Corners that are not finite are refused.
        margin = np.maximum(MARGIN, 1e-5 * np.abs(states).max(0)).astype(np.float32)
    seen = jnp.asarray if seen is None else seen
    with renamed(use_of="held_out"):
        space = GoalBox.of(states.min(0) - margin, states.max(0) + margin, use_of=held_out, seen=seen, num_evaluated=1)
    alone = dataclasses.replace(episodes, achieved_goals=None, desired_goals=None)
    task = RecordedTask(
        space,
        radius=MARGIN,
        episode_length=episodes.width - 1,
        action_size=episodes.action_size,
        discrete=episodes.moves,
        action_bounds=episodes.action_bounds,
    )
    return with_recordings(task, alone)


def recorded_in(task: GoalTask, path: str) -> GoalTask:
    """The task, with the recordings of this file to learn from; empty: as it is. Raises `UserError`, naming the file,
    for what cannot be used."""
    if not path:
        return task
    with naming_field("env.dataset", path, path):
        return with_recordings(task, load(path))


@contextlib.contextmanager
def naming_field(field: str, value: str, path: str) -> Iterator[None]:
    """Turn a `UserError` in the block about the file at `path` into one about the field that led to it."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{field} = {value!r}: {str(error).removeprefix(f'dataset = {path!r}: ')}") from error


def goals_of_episodes(task: GoalTask, achieved: np.ndarray, count: int) -> np.ndarray:
    """So many training goals [E, D]: drawn by the task; where nobody can act in it, from those that were achieved [N,
    D], since a drawn vector need not be a state."""
    if task.simulated:
        keys = jax.random.split(jax.random.key(0), count)
        return np.asarray(jax.jit(jax.vmap(task.goals.draw))(keys))
    of_training = np.flatnonzero(np.asarray(jax.jit(task.goals.is_training_goal)(achieved)))
    require(len(of_training) > 0, "held_out", "every recorded state", "leave some of them to learn from")
    return achieved[np.random.default_rng(0).choice(of_training, count)]


def rows_of(task: GoalTask, observations: np.ndarray, achieved: np.ndarray, episodes: Episodes) -> Trajectories:
    """The episodes as rows as long as the longest of them, each with as many whole episodes as follow each other in
    it."""
    lengths, (row, column) = episodes.lengths + 1, episodes.places()
    steps = np.concatenate([np.arange(length) for length in lengths])
    rows, columns = np.repeat(row, lengths), np.repeat(column, lengths) + steps
    shape = (int(row[-1]) + 1, episodes.width)

    def laid_out(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """The values [N, ...] at their places, [R, T, ...]."""
        found = np.zeros((*shape, *values.shape[1:]), values.dtype)
        inside = columns < shape[1]
        found[rows[inside], columns[inside]] = values[inside]
        return found

    desired = episodes.desired_goals
    if desired is None:
        desired = np.repeat(goals_of_episodes(task, achieved, len(lengths)), lengths, 0)
    last = episodes.last
    before_last = np.append(last[1:], False) & ~last
    within = (shape[0], shape[1] - 1)
    none = np.zeros(within, bool)
    valid, there = laid_out(~last, within), laid_out(np.ones(len(last), bool), shape)
    return Trajectories(
        observation=laid_out(observations, shape),
        record=laid_out(achieved, shape),
        action=laid_out(episodes.actions if episodes.moves else np.clip(episodes.actions, -1.0, 1.0), within),
        desired_goal=laid_out(desired, within),
        valid=valid,
        terminated=none,
        truncated=laid_out(before_last, within),
        decided=valid,
        there=None if there.all() else there,
    )
