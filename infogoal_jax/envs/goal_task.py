"""Tasks with continuous goals in a few lines: `GoalTask` keeps the goal, the time, the end of an episode and what
diverged, so that a task says only how its world begins, moves and looks. docs/guides/own_task.md makes one.
"""

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.data.episodes import Episodes
from infogoal_jax.envs.environment import Environment, Traits
from infogoal_jax.errors import UserError
from infogoal_jax.field_types import Positive, Size
from infogoal_jax.goals import GoalBox
from infogoal_jax.replay import Trajectories
from infogoal_jax.shapes import aligned

STARTS = 8
"""Starts that are drawn to find one at which the goal is not reached yet."""


@dataclasses.dataclass(frozen=True)
class GoalTaskConfig:
    """When an episode ends."""

    episode_length: Size = 50
    """Steps of an episode."""
    radius: Positive = 0.1
    """Distance below which a goal is reached, in the units of goals."""
    ends_at_goal: bool = True
    """Whether reaching the goal ends the episode."""
    dataset: str = ""
    """File of recorded episodes to learn from offline (docs/reference/datasets.md); empty: the agent acts."""


def between(bounds: Any, action: Any) -> Any:
    """An action from -1 to 1 as one between the lowest [A] and the highest [A]."""
    low, high = bounds
    return (low + high) / 2 + (high - low) / 2 * action


def traits(config: GoalTaskConfig) -> Traits:
    """What such a task, whose actions are vectors, can be combined with."""
    recorded = bool(config.dataset)
    return Traits(finite_goals=False, moves=False, recorded=recorded, ends_at_goal=config.ends_at_goal)


@flax.struct.dataclass
class Episode:
    """The state of an episode. `terminated` and `truncated` are never both set."""

    world: Any
    """What the task itself knows: a pytree of arrays."""
    desired_goal: jax.Array
    """float32 [D]."""
    time: jax.Array
    """int32, steps so far."""
    terminated: jax.Array
    """bool, the goal is reached, where that ends the episode."""
    truncated: jax.Array
    """bool, the time is up, the last step diverged, or the episode failed."""
    diverged: jax.Array
    """bool, the last step led to numbers that are not finite, and was taken back."""


def all_finite(numbers: Any) -> jax.Array:
    """Whether all floats of a pytree are finite, bool []; of one without any, too."""
    floats = [leaf for leaf in jax.tree.leaves(numbers) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.stack([jnp.asarray(True), *(jnp.isfinite(leaf).all() for leaf in floats)]).all()


@flax.struct.dataclass
class GoalTask(Environment):
    """A task whose goals are vectors, reached within a radius. Derive from it, give `action_size`, and write the four
    functions without a body: all are pure, and take one world."""

    goals: GoalBox
    """The goal space, `GoalBox.of(low, high)`."""
    radius: float = flax.struct.field(pytree_node=False, default=0.1)
    """Distance below which a goal is reached, in the units of goals."""
    episode_length: int = flax.struct.field(pytree_node=False, default=50)
    """Steps of an episode."""
    ends_at_goal: bool = flax.struct.field(pytree_node=False, default=True)
    """Whether reaching the goal ends the episode."""
    recorded: Trajectories | None = flax.struct.field(default=None, kw_only=True)
    """Recorded episodes to learn from, see recordings.py; None: the agent acts."""
    recorded_checksum: str = flax.struct.field(pytree_node=False, default="", kw_only=True)
    """Checksum of those."""

    discrete = False
    source = "simulated"
    action_bounds = None
    """Numbers [2, A], what -1 and 1 of an action are where it is taken; None: the same."""
    starts = STARTS
    """Starts that are drawn to find one at which the goal is not reached yet."""

    def begin(self, key: jax.Array) -> Any:
        """A world at the start of an episode."""
        raise NotImplementedError("begin")

    def move(self, world: Any, action: jax.Array) -> Any:
        """The world after one action: float32 [action_size] in [-1, 1], or int32 where `discrete`."""
        raise NotImplementedError("move")

    def observation(self, world: Any) -> jax.Array:
        """What the agent sees: float32 [F], each number of the order of 1, or an image uint8 [H, W, C]."""
        raise NotImplementedError("observation")

    def achieved_goal(self, world: Any) -> jax.Array:
        """The goal that is achieved, float32 [D]; NaN where there is none."""
        raise NotImplementedError("achieved_goal")

    def achieved_in(self, observation: jax.Array) -> jax.Array:
        """The goal that is achieved where a recording saw this, float32 [D]; for recordings that do not tell it."""
        remedy = "give the member achieved_goals, or write achieved_in"
        raise UserError(
            f"achieved_goals: is missing, and {type(self).__name__} cannot tell it from observations; {remedy}"
        )

    def recorded_observation(self, episodes: Episodes) -> np.ndarray:
        """What the agent sees of the observations of a recording, [N, ...]: the same."""
        return episodes.observations

    def own_action(self, action: jax.Array) -> jax.Array:
        """The action between the bounds that it has where it is taken."""
        if self.action_bounds is None:
            return action
        bounds = jnp.asarray(self.action_bounds, jnp.float32)
        return jnp.clip(between(bounds, action), *bounds)

    def fails(self, world: Any) -> jax.Array:
        """Whether the episode has failed in this world, bool; where `can_fail`."""
        raise NotImplementedError

    def is_finite(self, world: Any) -> jax.Array:
        """Whether all numbers of a world and of what is seen of it are finite, bool; the goal that it achieves may be
        NaN, which is none."""
        return all_finite((world, self.observation(world))) & ~jnp.isinf(self.achieved_goal(world)).any()

    def reset(self, key: jax.Array) -> Episode:
        """A new episode for a training goal."""
        goal_key, start_key = jax.random.split(key)
        return self.reset_to(start_key, self.goals.draw(goal_key))

    def reset_to(self, key: jax.Array, goal: jax.Array) -> Episode:
        """A new episode for this goal [D]: the first of several starts at which it is not reached."""
        worlds = jax.vmap(self.begin)(jax.random.split(key, self.starts))
        first = self.first_away(worlds, goal)
        return self.episode(jax.tree.map(lambda leaf: leaf[first], worlds), goal)

    def first_away(self, worlds: Any, goals: jax.Array) -> jax.Array:
        """The number of the first of these worlds [S] at which its goal is not reached, int32; 0 if each is. goals: one
        for all [D], or one for each [S, D]."""
        return (~self.reached(jax.vmap(self.achieved_goal)(worlds), goals)).argmax()

    def episode(self, world: Any, goal: jax.Array) -> Episode:
        """A new episode that starts in this world."""
        false = jnp.zeros((), bool)
        return Episode(
            world=world,
            desired_goal=jnp.asarray(goal, jnp.float32),
            time=jnp.zeros((), jnp.int32),
            terminated=false,
            truncated=false,
            diverged=false,
        )

    def step(self, state: Episode, action: jax.Array) -> Episode:
        """One step. One that leads to numbers that are not finite is undone, and ends the episode."""
        action = action if self.discrete else jnp.clip(action, -1.0, 1.0)
        moved = self.move(state.world, action)
        diverged = ~self.is_finite(moved)
        world = jax.tree.map(lambda old, new: jax.lax.select(diverged, old, new), state.world, moved)
        time = state.time + 1
        terminated = self.ends_at_goal & ~diverged & self.reached(self.achieved_goal(world), state.desired_goal)
        over = (time >= self.episode_length) | diverged
        over = over | self.fails(world) if self.can_fail else over
        truncated = over & ~terminated
        return state.replace(world=world, time=time, terminated=terminated, truncated=truncated, diverged=diverged)

    def failed(self, state: Episode) -> jax.Array:
        """Whether an episode, or each of episodes [E], has failed; one that reached its goal in the same step has
        not."""
        fails = jax.vmap(self.fails) if state.time.ndim else self.fails
        return fails(state.world) & ~state.terminated

    def observe(self, state: Episode) -> jax.Array:
        """The stored observation; of one state, or of states [E]."""
        axes = state.time.ndim
        return jax.vmap(self.observation)(state.world) if axes else self.observation(state.world)

    def render(self, observation: jax.Array) -> jax.Array:
        """The input of the network: the observation."""
        return observation

    def achieved(self, state: Episode) -> jax.Array:
        """The record of what was achieved: the goal [D]; of one state, or of states [E]."""
        axes = state.time.ndim
        return jax.vmap(self.achieved_goal)(state.world) if axes else self.achieved_goal(state.world)

    def reached(self, record: jax.Array, goal: jax.Array) -> jax.Array:
        """Whether records [..., D] lie within the radius of goals [..., D], bool [...]."""
        record, goal = aligned(record, goal)
        return ((record - goal) ** 2).sum(-1) < self.radius**2

    @property
    def num_cells(self) -> int:
        """Cells that the goal space is divided into, and a last one for what achieves no goal."""
        return self.goals.num_cells + 1

    def cell_of(self, record: jax.Array) -> jax.Array:
        """The cell of each record [..., D], int32 [...]; one outside of the goal space lies in the nearest."""
        cell = self.goals.cell_of(record)
        return jnp.where(cell < 0, self.goals.num_cells, cell)
