"""Target states, which the high level of HRAC chooses (Sec. V-C of the paper): angles of the joints of an arm with
discrete moves; grids of cells over positions or angles, over which HRAC's adjacency matrix is made; and the environment
that the high level acts in, with the frozen low level inside."""

import dataclasses
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.angles import on_circles, wrapped
from infogoal_jax.envs.environment import Environment
from infogoal_jax.goals import GoalSpace
from infogoal_jax.shapes import with_rank


@dataclasses.dataclass(frozen=True)
class Cells:
    """A grid of cells, in m or radians."""

    low: np.ndarray
    """[D], lower corner."""
    side: float
    """Side of a cell."""
    shape: tuple[int, ...]
    """Number of cells along each axis."""
    periodic: bool = False
    """Whether the grid is periodic, as angles are."""

    @classmethod
    def over(cls, bounds: np.ndarray, side: float) -> "Cells":
        """Make a grid over the space between the corners [2, D], with at least one more cell on every side.

        A cell is centred on the lower corner, so that an object at rest there lies in the middle of a cell and not on
        the border of two.
        """
        counts = np.round((bounds[1] - bounds[0]) / side).astype(int) + 3
        return cls(bounds[0] - 1.5 * side, side, tuple(int(count) for count in counts))

    @classmethod
    def over_angles(cls, axes: int, side: float) -> "Cells":
        """Make a periodic grid over full turns about so many axes, with cells of about this side (radians)."""
        count = max(1, round(2 * np.pi / side))
        return cls(np.full(axes, -np.pi / count), 2 * np.pi / count, (count,) * axes, periodic=True)

    @property
    def count(self) -> int:
        return int(np.prod(self.shape))

    def of(self, position: jax.Array) -> jax.Array:
        """The cell of each position [..., D], int32 [...]; -1 outside the grid."""
        low, shape = (
            with_rank(jnp.asarray(value, kind), position.ndim)
            for value, kind in ((self.low, jnp.float32), (self.shape, jnp.int32))
        )
        place = jnp.floor((position - low) / self.side).astype(jnp.int32)
        place = place % shape if self.periodic else place
        inside = ((place >= 0) & (place < shape)).all(-1)
        return jnp.where(inside, flattened(place, self.shape), -1)


def flattened(place: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """The numbers of cells, int32 [...], that stand at these places int32 [..., D] of a grid, counted along its last
    axis first."""
    steps = np.cumprod([1, *shape[:0:-1]])[::-1].astype(np.int32)
    return (place * with_rank(steps, place.ndim)).sum(-1, dtype=jnp.int32)


@dataclasses.dataclass(frozen=True)
class JointSpace:
    """Target states of J = `size` joints, in radians."""

    size: int
    name = "object_manipulation"
    """Of the task, by which a low level is known."""
    components = 1

    def of(self, observation) -> jax.Array:
        """The joints [..., J] of an observation."""
        return observation.joints

    def from_subgoal(self, observation, subgoal: jax.Array, scale: float) -> jax.Array:
        """The target state [..., J] of a subgoal [..., J] in [-1, 1]: each joint turns by up to `scale` radians."""
        return wrapped(observation.joints + scale * jnp.clip(subgoal, -1.0, 1.0))

    def parts(self, states: jax.Array) -> jax.Array:
        """The components of target states with adjacency matrices of their own: one, [1, ..., J]."""
        return states[None]

    def network_input(self, part: jax.Array, scale: float) -> jax.Array:
        """A component as a network sees it: sines and cosines, so that a full turn ends where it began."""
        return on_circles(part)

    def cells(self, side: float) -> Cells:
        """Cells of about this side (radians) over all angles."""
        return Cells.over_angles(self.size, side)


@flax.struct.dataclass
class SubgoalState:
    """An episode: the environment's own state, and the target state [S] that the low level is on its way to."""

    inner: Any
    target: jax.Array

    node = property(lambda self: self.inner.node)  # Of states on a graph.
    desired_goal = property(lambda self: self.inner.desired_goal)
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
    goals, episode_length = of_env("goals"), of_env("episode_length")
    recorded, recorded_checksum = of_env("recorded"), of_env("recorded_checksum")
    num_observations, num_cells = of_env("num_observations"), of_env("num_cells")
    goal_positions, near_goals = of_env("goal_positions"), of_env("near_goals")
    train_backgrounds, test_backgrounds = of_env("train_backgrounds"), of_env("test_backgrounds")
    has_shortest_path, unwrapped = of_env("has_shortest_path"), of_env("unwrapped")
    can_fail, simulated, costly_reset = of_env("can_fail"), of_env("simulated"), of_env("costly_reset")
    goals_are_observations, ends_at_goal = of_env("goals_are_observations"), of_env("ends_at_goal")
    render, reached, goals_of, cell_of = of_env("render"), of_env("reached"), of_env("goals_of"), of_env("cell_of")

    @property
    def action_size(self) -> int:
        """Numbers of a subgoal."""
        return self.space.size

    def with_goals(self, goals: GoalSpace) -> "SubgoalEnv":
        return self.replace(env=self.env.with_goals(goals))

    def failed(self, state: SubgoalState) -> jax.Array:
        """Whether the episode has failed in the environment inside, bool."""
        return self.env.failed(state.inner)

    def shortest_path(self, state: SubgoalState) -> jax.Array:
        """Steps to the desired goal on a shortest path of the environment inside, int32."""
        return self.env.shortest_path(state.inner)

    def reset(self, key: jax.Array) -> SubgoalState:
        return self._begin(self.env.reset(key))

    def reset_to(self, key: jax.Array, goal: jax.Array) -> SubgoalState:
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

    def observe(self, state: SubgoalState) -> jax.Array:
        return self.env.observe(state.inner)

    def achieved(self, state: SubgoalState) -> jax.Array:
        return self.env.achieved(state.inner)
