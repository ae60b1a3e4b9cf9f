"""A robot steered by subgoals: the environment that the high level of HRAC acts in, with the frozen low level inside
(Sec. V-C of the paper)."""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp

from infogoal_jax.envs.environment import Environment
from infogoal_jax.envs.target_states import JointSpace
from infogoal_jax.errors import require
from infogoal_jax.goals import GoalSet


@flax.struct.dataclass
class SubgoalState:
    """An episode: the environment's own state, and the target state [S] that the low level is on its way to."""

    inner: Any
    target: jax.Array

    node = property(lambda self: self.inner.node)  # Of states on a graph.
    goal = property(lambda self: self.inner.goal)
    time = property(lambda self: self.inner.time)
    terminated = property(lambda self: self.inner.terminated)
    truncated = property(lambda self: self.inner.truncated)
    diverged = property(lambda self: self.inner.diverged)


def of_env(name: str) -> property:
    """A member that steering does not change: that of the environment inside."""
    return property(lambda self: getattr(self.env, name))


@flax.struct.dataclass
class SubgoalEnv(Environment):
    """An environment whose actions are subgoals, each followed for `interval` steps by a frozen policy over target
    states.

    A step is still one step of the environment inside; the action of a step between two decisions is not looked at. A
    pytree.
    """

    env: Any
    low_level: Any
    space: Any = flax.struct.field(pytree_node=False)
    interval: int = flax.struct.field(pytree_node=False)
    subgoal_scale: float = flax.struct.field(pytree_node=False)
    low_level_name: str = flax.struct.field(pytree_node=False, default="")

    @property
    def source(self) -> str:
        """What the data is, in words, the low level included: a run goes on with the one that it started with."""
        return f"{self.env.source}; {self.low_level_name}" if self.low_level_name else self.env.source

    discrete = False
    has_target_states = True
    goals, episode_length, recorded = of_env("goals"), of_env("episode_length"), of_env("recorded")
    num_observations, num_cells = of_env("num_observations"), of_env("num_cells")
    goal_positions, near_goals = of_env("goal_positions"), of_env("near_goals")
    train_backgrounds, test_backgrounds = of_env("train_backgrounds"), of_env("test_backgrounds")
    has_shortest_path, unwrapped = of_env("has_shortest_path"), of_env("unwrapped")
    render, reached, goals_of, cell_of = of_env("render"), of_env("reached"), of_env("goals_of"), of_env("cell_of")

    @property
    def action_size(self) -> int:
        """Numbers of a subgoal."""
        return self.space.size

    def with_goals(self, goals: GoalSet | None) -> "SubgoalEnv":
        """The same task with another goal set."""
        return self.replace(env=self.env.with_goals(goals))

    def shortest_path(self, state: SubgoalState) -> jax.Array:
        """Steps to the desired goal on a shortest path of the environment inside, int32."""
        return self.env.shortest_path(state.inner)

    def reset(self, key: jax.Array) -> SubgoalState:
        """A new episode."""
        return self._begin(self.env.reset(key))

    def reset_to(self, key: jax.Array, goal: jax.Array) -> SubgoalState:
        """A new episode for this goal."""
        return self._begin(self.env.reset_to(key, goal))

    def _begin(self, inner) -> SubgoalState:
        return SubgoalState(inner=inner, target=self.space.of(self.env.observe(inner)))

    def decides(self, state: SubgoalState) -> jax.Array:
        """Whether the next step follows a new subgoal, bool."""
        return state.inner.time % self.interval == 0

    def step(self, state: SubgoalState, subgoal: jax.Array) -> SubgoalState:
        """One step of the low level towards this subgoal [S] in [-1, 1], or towards the one that was decided before."""
        observation = self.env.observe(state.inner)
        asked = self.space.from_subgoal(observation, subgoal, self.subgoal_scale)
        target = jnp.where(self.decides(state), asked, state.target)
        return SubgoalState(inner=self.env.step(state.inner, self.low_level.act(observation, target)), target=target)

    def action_mask(self, observation: jax.Array) -> jax.Array:
        """All subgoals can be asked for, bool [..., S]."""
        return jnp.ones((*self.space.of(observation).shape[:-1], self.action_size), bool)

    def observe(self, state: SubgoalState) -> jax.Array:
        """What is stored of the observation."""
        return self.env.observe(state.inner)

    def achieved(self, state: SubgoalState) -> jax.Array:
        """The record of what was achieved."""
        return self.env.achieved(state.inner)


def steer(env, config) -> SubgoalEnv:
    """The environment under the low level that HRAC's configuration names. Raises `UserError` for one that cannot be
    used."""
    # With it comes MuJoCo, which takes half a second that no other task needs.
    from infogoal_jax.train.low_level.trainer import load_joint_level, load_with_header

    require(env.has_target_states, "agent", "hrac", "this task has no target states that a low level could be sent to")
    if isinstance(env.space, JointSpace):
        header, low_level = load_joint_level(config.low_level, env.space.size, env.action_size)
    else:
        header, low_level = load_with_header(config.low_level, env.space.task.name)
    name = f"low level, content {header['sha256'][:8]}"
    return SubgoalEnv(env, low_level, env.space, config.interval, config.subgoal_scale, name)
