"""Target states, which the high level of HRAC chooses and the low level reaches (paper, Sec. V-C: "a target state").

fetch_reach: the grip [3]. With an object: grip and object [6]; the grip has to be near the object's target, the object
has to be there.
"""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.envs.fetch import environment
from infogoal_jax.envs.fetch.tasks import Task
from infogoal_jax.envs.target_states import Cells
from infogoal_jax.keys import draw_chance
from infogoal_jax.shapes import with_rank

REACHED = environment.DISTANCE_THRESHOLD
"""Distance, in m, of grip (fetch_reach) or object below which a target state is reached: that of goals."""
BESIDE = 0.1
"""Distance, in m, of the grip from its target in tasks with an object: a pushing finger touches the cube up to 7 cm
from its centre."""
PRECISE = 0.03
"""Distance, in m, below which the low level is rewarded. Below `REACHED`, so that its error adds little to a goal's 5
cm."""
FARTHEST, HELD = 0.15, 5
"""Largest distance of a moving target from grip or object along each axis, in m, and steps between two targets."""


@dataclasses.dataclass(frozen=True)
class TargetSpace:
    """Target states of one task, in m."""

    task: Task

    @property
    def size(self) -> int:
        """3 numbers (the grip), or 6 (grip, then object)."""
        return 3 if self.task.object_height is None else 6

    @property
    def components(self) -> int:
        """Number of positions in a target state."""
        return self.size // 3

    def of(self, observation: jax.Array) -> jax.Array:
        """The state [..., S] in the space of targets, from an observation [..., 10 or 25]."""
        return observation[..., : self.size]

    def reached(self, state: jax.Array, target: jax.Array, precision: float = REACHED) -> jax.Array:
        """Whether the state [..., S] is at the target, bool [...]: `precision` for grip or object, `BESIDE` for a grip
        that has an object."""
        distance = jnp.linalg.norm((state - target).reshape(*state.shape[:-1], self.components, 3), axis=-1)
        tolerance = jnp.array([precision] if self.components == 1 else [BESIDE, precision], jnp.float32)
        return (distance < with_rank(tolerance, distance.ndim)).all(-1)

    def reward(self, state: jax.Array, target: jax.Array) -> jax.Array:
        """The low level's reward [...] for the state [..., S] that a step led to: 0 within `PRECISE` of the target, -1
        elsewhere."""
        return self.reached(state, target, PRECISE) - 1.0

    def at_goal(self, goal: jax.Array) -> jax.Array:
        """The target state [..., S] that solves the task for a goal [..., 3]: grip, or grip and object, at the goal."""
        return jnp.concatenate([goal] * self.components, axis=-1)

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner of the space that goals are drawn from, [2, 3] in m."""
        task, grip = self.task, np.array(self.task.start_grip)
        low, high = grip - task.goal_range, grip + task.goal_range
        if task.object_height is not None:
            low[2], high[2] = task.object_height, task.object_height + environment.HIGHEST_GOAL * task.goals_in_air
            low[0], high[0] = low[0] + task.goal_offset, high[0] + task.goal_offset
        return np.array([low, high])

    def parts(self, states: jax.Array) -> jax.Array:
        """Grip and object of target states [..., S], which have adjacency matrices of their own: [components, ...,
        3]."""
        return jnp.moveaxis(states.reshape(*states.shape[:-1], self.components, 3), -2, 0)

    def network_input(self, part: jax.Array, scale: float) -> jax.Array:
        """A position [..., 3] as input of a network: relative to the middle of the goal space, in units of `scale`
        m."""
        middle = jnp.asarray(self.bounds.mean(0), jnp.float32)
        return (part - with_rank(middle, part.ndim)) / scale

    def cells(self, side: float) -> Cells:
        """Cells of this side (m) over the space of goals, for grip and object alike."""
        return Cells.over(self.bounds, side)

    def from_subgoal(self, observation: jax.Array, subgoal: jax.Array, scale: float) -> jax.Array:
        """The target state [..., S] that a subgoal [..., S] in [-1, 1] means: a displacement of grip or object by up to
        `scale` m along each axis.

        The object's target stays inside of the space of goals, the grip's beside the object's: other target states
        cannot be reached in time.
        """
        low, high = jax.lax.expand_dims(jnp.asarray(self.bounds, jnp.float32), range(1, observation.ndim))
        subgoal = jnp.clip(subgoal, -1.0, 1.0)
        moved = jnp.clip(observation[..., self.size - 3 : self.size] + scale * subgoal[..., -3:], low, high)
        if self.components == 1:
            return moved
        return jnp.concatenate([moved + 0.5 * BESIDE * subgoal[..., :3], moved], axis=-1)


@flax.struct.dataclass
class TargetState:
    """An episode of reaching target states: the robot's state, and the target [S], which is the goal here.

    moving: bool, whether the target changes; key: that changes are drawn from.
    """

    robot: environment.FetchState
    goal: jax.Array
    moving: jax.Array
    key: jax.Array

    @property
    def terminated(self) -> jax.Array:
        """False: the robot has to stay at its target."""
        return jnp.zeros_like(self.robot.terminated)

    @property
    def truncated(self) -> jax.Array:
        """Whether time is up, or the simulation diverged."""
        return self.robot.truncated

    @property
    def diverged(self) -> jax.Array:
        """Whether the last step was undone."""
        return self.robot.diverged


@flax.struct.dataclass
class TargetReaching:
    """The task that the low level is trained on: full episodes under target states.

    An episode keeps the target state that is the finished task, or its target moves as a high level would have it:
    every `HELD` steps a subgoal, drawn at random or leading straight to the task's goal.
    """

    robot: environment.Fetch
    space: TargetSpace = flax.struct.field(pytree_node=False)
    moving_share: jax.Array | float = 0.0
    """Share of episodes with a moving target."""
    random_share: jax.Array | float = 0.5
    """Share of subgoals that are drawn at random; the others lead to the task's goal."""

    def reset(self, key: jax.Array) -> TargetState:
        """A new episode."""
        start_key, choose_key, key = jax.random.split(key, 3)
        robot = self.robot.reset(start_key)
        state = TargetState(robot, self.space.at_goal(robot.goal), draw_chance(choose_key, self.moving_share), key)
        return self._aim(state)

    def step(self, state: TargetState, action: jax.Array) -> TargetState:
        """40 ms under an action [4] in [-1, 1]."""
        return self._aim(state.replace(robot=self.robot.step(state.robot, action)))

    def _aim(self, state: TargetState) -> TargetState:
        """The state with its next target, where a moving target changes in this step."""
        choose_key, draw_key = jax.random.split(jax.random.fold_in(state.key, state.robot.time))
        here = self.achieved(state)
        ahead = (self.space.at_goal(state.robot.goal) - here).at[:-3].set(
            0.0
        ) / FARTHEST  # The grip's share stays beside the object.
        drawn = jax.random.uniform(draw_key, here.shape, minval=-1.0, dtype=jnp.float32)
        subgoal = jnp.where(draw_chance(choose_key, self.random_share), drawn, ahead)
        due = state.moving & (state.robot.time % HELD == 0)
        return state.replace(
            goal=jnp.where(due, self.space.from_subgoal(state.robot.observation, subgoal, FARTHEST), state.goal)
        )

    def decides(self, state: TargetState) -> jax.Array:
        """Whether the agent chooses the next action: always."""
        return jnp.ones_like(state.moving)

    def observe(self, state: TargetState) -> jax.Array:
        """The robot's observation, float32 [..., 10 or 25]."""
        return state.robot.observation

    def achieved(self, state: TargetState) -> jax.Array:
        """The state in the space of targets, float32 [..., S]."""
        return self.space.of(state.robot.observation)
