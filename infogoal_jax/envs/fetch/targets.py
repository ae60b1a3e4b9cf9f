"""Target states, which the high level of HRAC chooses and the low level reaches (paper, Sec. V-C: "a target state"),
and the tasks that a low level is trained on, whose goals they are.

fetch_reach: the grip [3]. With an object: grip and object [6]; the grip has to be near the object's target, the object
has to be there.
"""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.envs.environment import Environment
from infogoal_jax.envs.fetch import environment
from infogoal_jax.envs.fetch.tasks import FetchConfig, TargetsConfig, Task
from infogoal_jax.envs.target_states import Cells
from infogoal_jax.goals import GoalBox
from infogoal_jax.keys import draw_chance
from infogoal_jax.shapes import aligned, with_rank

PRECISE = 0.03
"""Distance, in m, of grip (fetch_reach) or object below which a target state is reached. Below the 5 cm of a goal, to
which the low level's error should add little."""
BESIDE = 0.1
"""Distance, in m, of the grip from its target in tasks with an object: a pushing finger touches the cube up to 7 cm
from its centre."""
FARTHEST, HELD = 0.15, 5
"""Largest distance of a moving target from grip or object along each axis, in m, and steps between two targets."""
RANDOM_SHARE = 0.5
"""Share of moving targets that are drawn at random; the others lead to the task's goal."""


@dataclasses.dataclass(frozen=True)
class TargetSpace:
    """Target states of one task, in m."""

    task: Task

    @property
    def name(self) -> str:
        """Of the task, by which a low level is known."""
        return self.task.name

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

    def reached(self, state: jax.Array, target: jax.Array) -> jax.Array:
        """Whether states [..., S] are at targets [..., S], bool [...]: within `PRECISE` for grip or object, `BESIDE`
        for a grip that has an object."""
        state, target = aligned(state, target)
        apart = state - target
        distance = jnp.linalg.norm(apart.reshape(*apart.shape[:-1], self.components, 3), axis=-1)
        tolerance = jnp.array([PRECISE] if self.components == 1 else [BESIDE, PRECISE], jnp.float32)
        return (distance < with_rank(tolerance, distance.ndim)).all(-1)

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


@dataclasses.dataclass(frozen=True)
class FinishedTasks:
    """Draws the target states at which a task is solved, for goals as the reference draws them."""

    space: TargetSpace

    def __call__(self, key: jax.Array) -> jax.Array:
        """A target state [S] in m."""
        return self.space.at_goal(environment.GoalsOf(self.space.task)(key))


@flax.struct.dataclass
class TargetState:
    """An episode of reaching target states."""

    robot: environment.FetchState
    """State of the robot, whose desired goal [3] is that of the task."""
    desired_goal: jax.Array
    """float32 [S] in m, the target state."""
    moving: jax.Array
    """bool, whether the target changes."""
    key: jax.Array
    """Key that changes are drawn from."""

    time = property(lambda self: self.robot.time)
    truncated = property(lambda self: self.robot.truncated)
    diverged = property(lambda self: self.robot.diverged)

    @property
    def terminated(self) -> jax.Array:
        """False: the robot has to stay at its target."""
        return jnp.zeros_like(self.robot.terminated)


@flax.struct.dataclass
class TargetReaching(Environment):
    """The task that the low level is trained on: full episodes under target states.

    The target is the finished task. In a share of the training episodes it moves as a high level would have it: every
    `HELD` steps a subgoal, drawn at random or leading straight to the task's goal.
    """

    robot: environment.Fetch
    goals: GoalBox
    """Target states in m."""
    space: TargetSpace = flax.struct.field(pytree_node=False)
    moving_share: float = flax.struct.field(pytree_node=False)
    """Share of training episodes with a moving target."""

    discrete = False
    ends_at_goal = False
    action_size = property(lambda self: self.robot.action_size)
    episode_length = property(lambda self: self.robot.episode_length)
    source = property(lambda self: self.robot.source)

    def reset(self, key: jax.Array) -> TargetState:
        """A new episode; its target may move."""
        start_key, choose_key, key = jax.random.split(key, 3)
        robot = self.robot.reset(start_key)
        moving = draw_chance(choose_key, self.moving_share)
        return self._aim(TargetState(robot, self.space.at_goal(robot.desired_goal), moving, key))

    def reset_to(self, key: jax.Array, goal: jax.Array) -> TargetState:
        """A new episode for this target state [S], which stays."""
        goal = jnp.asarray(goal, jnp.float32)
        return TargetState(self.robot.begin_anew(key, goal[-3:]), goal, jnp.zeros((), bool), key)

    def step(self, state: TargetState, action: jax.Array) -> TargetState:
        """40 ms under an action [4] in [-1, 1]."""
        return self._aim(state.replace(robot=self.robot.step(state.robot, action)))

    def _aim(self, state: TargetState) -> TargetState:
        """The state with its next target, where a moving target changes in this step."""
        choose_key, draw_key = jax.random.split(jax.random.fold_in(state.key, state.robot.time))
        here = self.achieved(state)
        # The grip's share stays beside the object.
        ahead = (self.space.at_goal(state.robot.desired_goal) - here).at[:-3].set(0.0) / FARTHEST
        drawn = jax.random.uniform(draw_key, here.shape, minval=-1.0, dtype=jnp.float32)
        subgoal = jnp.where(draw_chance(choose_key, RANDOM_SHARE), drawn, ahead)
        due = state.moving & (state.robot.time % HELD == 0)
        target = self.space.from_subgoal(state.robot.observation, subgoal, FARTHEST)
        return state.replace(desired_goal=jnp.where(due, target, state.desired_goal))

    def observe(self, state: TargetState) -> jax.Array:
        """The robot's observation, float32 [..., 10 or 25]."""
        return state.robot.observation

    def render(self, observation: jax.Array) -> jax.Array:
        """The input of the network, as the robot has it."""
        return self.robot.render(observation)

    def achieved(self, state: TargetState) -> jax.Array:
        """The state in the space of targets, float32 [..., S]."""
        return self.space.of(state.robot.observation)

    def reached(self, record: jax.Array, goal: jax.Array) -> jax.Array:
        """Whether states [..., S] are at target states [..., S], bool [...]."""
        return self.space.reached(record, goal)


def make(name: str, config: TargetsConfig) -> TargetReaching:
    """The target states of a Fetch task."""
    robot = environment.make(
        name, FetchConfig(faithful=config.faithful, episode_length=config.episode_length, ends_at_goal=False)
    )
    space = TargetSpace(robot.task)
    low, high = np.tile(robot.workspace, space.components)
    goals = GoalBox.of(low, high, sampler=FinishedTasks(space), seen=environment.Seen(robot.task))
    return TargetReaching(robot, goals, space, config.moving_share)
