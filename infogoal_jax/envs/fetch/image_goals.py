"""The Fetch tasks as the paper has them (Sec. V-A.1): a goal is an image of the object, or the gripper, at the desired
position.

The finite goal space is a grid of rendered positions. Training, validation and test goals lie between its points. The
true distance decides whether a goal is reached. The nearest grid point decides which goal a position achieves, for
representation learning and relabelling. `infogoal reproduce goal-images` decides where the goals of a bank lie, and
draws them.
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.data import archives, backgrounds, goal_images
from infogoal_jax.envs.environment import Environment
from infogoal_jax.envs.fetch import environment, targets
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.envs.target_states import Cells, flattened
from infogoal_jax.goals import GoalSet
from infogoal_jax.shapes import with_rank

VISIT_CELL = 0.025
"""Side of the cells in which visits are counted, in m."""


@flax.struct.dataclass
class ImageGoalState:
    """One episode."""

    robot: environment.FetchState
    """State of the robot, whose desired goal is a position [3] in m."""
    desired_goal: jax.Array
    """int32."""

    time = property(lambda self: self.robot.time)
    terminated = property(lambda self: self.robot.terminated)
    truncated = property(lambda self: self.robot.truncated)
    diverged = property(lambda self: self.robot.diverged)


@flax.struct.dataclass
class ImageGoals(Environment):
    """A Fetch task with N image goals. A pytree."""

    robot: environment.Fetch
    """The task with positions as goals."""
    goals: GoalSet
    """The goals; those of the grid come first."""
    positions: jax.Array
    """float32 [N, 3], position of each goal in m."""
    train_backgrounds: jax.Array = flax.struct.field(kw_only=True)  # The contract's default, None, is not one here.
    test_backgrounds: jax.Array = flax.struct.field(kw_only=True)
    grid_low: jax.Array
    """float32 [3], first point of the grid in m."""
    spacing: jax.Array
    """float32 [], step of the grid in m."""
    grid_shape: tuple[int, int, int] = flax.struct.field(pytree_node=False)
    """Points of the grid along x, y and z."""
    source: str = flax.struct.field(pytree_node=False)
    """The data in words."""

    discrete = False
    has_target_states = True

    @property
    def space(self) -> targets.TargetSpace:
        """The target states of this task, for a low level."""
        return targets.TargetSpace(self.robot.task)

    @property
    def action_size(self) -> int:
        """Size of an action."""
        return self.robot.action_size

    @property
    def episode_length(self) -> int:
        """Steps of 40 ms after which an episode is truncated."""
        return self.robot.episode_length

    def reset(self, key: jax.Array) -> ImageGoalState:
        """A new episode for a goal that is desired in training, uniform among them."""
        goal_key, start_key = jax.random.split(key)
        return self.reset_to(start_key, jax.random.choice(goal_key, self.goals.desired_goals))

    def reset_to(self, key: jax.Array, goal: jax.Array) -> ImageGoalState:
        """A new episode for this goal, int32."""
        robot = self.robot.begin_anew(key, self.positions[goal])
        return ImageGoalState(robot=robot, desired_goal=jnp.asarray(goal, jnp.int32))

    def step(self, state: ImageGoalState, action: jax.Array) -> ImageGoalState:
        """40 ms under an action [4] in [-1, 1]."""
        return state.replace(robot=self.robot.step(state.robot, action))

    def observe(self, state: ImageGoalState) -> jax.Array:
        """The stored observation: all of it, float32 [10 or 25]."""
        return state.robot.observation

    def render(self, observation: jax.Array) -> jax.Array:
        """The input of the network, as the robot has it."""
        return self.robot.render(observation)

    def achieved(self, state: ImageGoalState) -> jax.Array:
        """The record of what was achieved: position [3] of the object, or of the grip without one (m)."""
        return self.robot.achieved(state.robot)

    def reached(self, record: jax.Array, goal: jax.Array) -> jax.Array:
        """Whether the position [..., 3] lies within 5 cm of the goal's, bool [...]."""
        return self.robot.reached(record, self.positions[goal])

    @property
    def goal_positions(self) -> jax.Array:
        """Positions of the goals, float32 [N, 3] (m)."""
        return self.positions

    @property
    def near_goals(self) -> jax.Array:
        """Goals within 5 cm of a training goal, bool [N]."""
        training = self.positions[self.goals.training_goals]
        return self.robot.reached(training[:, None], self.positions).any(0)

    @property
    def _visit_cells(self) -> Cells:
        return Cells.over(self.space.bounds, VISIT_CELL)

    @property
    def num_cells(self) -> int:
        """Number of cells; the last one is everything outside the grid."""
        return self._visit_cells.count + 1

    def cell_of(self, record: jax.Array) -> jax.Array:
        """The cell of each position [..., 3], int32 [...]."""
        cells = self._visit_cells
        cell = cells.of(record)
        return jnp.where(cell < 0, cells.count, cell)

    def goals_of(self, record: jax.Array) -> jax.Array:
        """The grid goal nearest to each position, int32 [..., 1]; -1 for positions more than a step outside the
        grid."""
        low, spacing, last = (
            with_rank(jnp.asarray(value, jnp.float32), record.ndim)
            for value in (self.grid_low, self.spacing, np.array(self.grid_shape) - 1)
        )
        place = (record - low) / spacing
        near = ((place > -1.0) & (place < last + 1.0)).all(-1)
        nearest = jnp.clip(jnp.round(place), 0, last).astype(jnp.int32)
        return jnp.where(near, flattened(nearest, self.grid_shape), -1)[..., None]


def make(name: str, config: FetchConfig) -> ImageGoals:
    """Make the task from the goal images and backgrounds of the configuration. Raises `UserError` for unusable
    files."""
    robot = environment.make(name, config)
    bank = goal_images.load(config.goal_images or goal_images.shipped(name), name)
    behind = backgrounds.load(config.backgrounds)
    uses = bank.uses.astype(np.int32) - 1
    return from_data(robot, bank, behind, uses)


def from_data(
    robot: environment.Fetch, bank: goal_images.GoalImages, behind: backgrounds.Backgrounds, uses: np.ndarray
) -> ImageGoals:
    """Make the task with these goals. uses: [N], `goals.NO_USE` for grid goals. The region of a goal is that of the
    training goal nearest to it."""
    training = np.flatnonzero(uses == 0)
    nearest = np.linalg.norm(bank.positions[:, None] - bank.positions[training], axis=-1).argmin(1)
    content = archives.checksum(bank.images, bank.positions)
    kinds = ("grid", "training", "validation", "test")
    names = tuple(
        f"{kinds[use + 1]} {np.round(place.astype(float), 3).tolist()}"
        for use, place in zip(uses, bank.positions, strict=True)
    )
    return ImageGoals(
        robot=robot,
        goals=GoalSet.of(
            bank.images, nearest, uses, names, tuple(f"near training goal {number}" for number in range(len(training)))
        ),
        positions=jax.device_put(bank.positions),
        train_backgrounds=jax.device_put(behind.train),
        test_backgrounds=jax.device_put(behind.test),
        grid_low=jax.device_put(np.asarray(bank.grid_low, np.float32)),
        spacing=jnp.float32(bank.spacing),
        grid_shape=tuple(int(n) for n in bank.grid_shape),
        source=f"MuJoCo physics in JAX, rendered goal images ({bank.describe()}, content {content}); backgrounds: "
        f"{behind.source}",
    )
