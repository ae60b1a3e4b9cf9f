"""Where the goals of the image banks lie: a grid over the goal space, and goals for training, validation and test."""

import numpy as np

from infogoal_jax.data.goal_images import GRID, TEST, TRAIN, VALIDATION, grid_positions
from infogoal_jax.envs.fetch.tasks import Task

SPACING = 0.025
"""Half of the distance at which a goal counts as reached, in m."""
HIGHEST_GOAL = 0.45
"""A goal in the air is at most this far above the table, in m."""
COUNTS = {TRAIN: 8, VALIDATION: 8, TEST: 32}
FARTHEST = 0.2
"""A validation or test goal is at most this far from a training goal, in m."""


def grid_of(task: Task) -> tuple[np.ndarray, tuple[int, int, int]]:
    """First position [3] (m) and shape of the grid that fills the goal space of a task."""
    across = round(2 * task.goal_range / SPACING) + 1
    low = np.array(task.start_grip) - task.goal_range
    if task.object_height is None:
        return low, (across, across, across)
    low[2] = task.object_height
    return low, (across, across, round(HIGHEST_GOAL / SPACING) + 1 if task.goals_in_air else 1)


def draw_goal(task: Task, generator: np.random.Generator) -> np.ndarray:
    """A goal [3] (m), drawn as the environment draws it."""
    goal = np.array(task.start_grip) + generator.uniform(-task.goal_range, task.goal_range, 3)
    if task.object_height is not None:
        lifted = task.goals_in_air and generator.random() < 0.5
        goal[2] = task.object_height + (generator.uniform(0, HIGHEST_GOAL) if lifted else 0)
    return goal


def choose_goals(task: Task, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions float32 [N, 3] and uses uint8 [N] of all goals of a bank: the grid, then goals drawn for training,
    validation and tests.

    Those for validation and tests are drawn again until each is near a training goal.
    """
    generator = np.random.default_rng([seed, *task.name.encode()])
    low, shape = grid_of(task)
    goals = grid_positions(low, SPACING, shape)
    positions, uses = list(goals), [GRID] * len(goals)
    training: list[np.ndarray] = []
    for use, count in COUNTS.items():
        drawn: list[np.ndarray] = []
        while len(drawn) < count:
            goal = draw_goal(task, generator)
            if use == TRAIN or np.linalg.norm(np.array(training) - goal, axis=1).min() < FARTHEST:
                drawn.append(goal)
        training = drawn if use == TRAIN else training
        positions += drawn
        uses += [use] * count
    return np.array(positions, np.float32), np.array(uses, np.uint8)
