"""The policy's ways to corrupted test goals of a Fetch task, seen from above (paper, Fig. 9, upper half)."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from infogoal_jax.envs.fetch.environment import DISTANCE_THRESHOLD
from infogoal_jax.report.canvas import FAILURE, SUCCESS, room_colour
from infogoal_jax.train.rollout import Episodes

SHOWN = (
    f"circles: within {100 * DISTANCE_THRESHOLD:g} cm of the goal in x and y, green if it was reached (z counts too)"
)
"""For the small print."""
VERTICAL_LABEL = "y (m)"


def distances_of_goals(env: Any) -> np.ndarray:
    """Metres between any two training goals, [R, R]."""
    centres = np.asarray(env.unwrapped.positions)[np.asarray(env.goals.training_goals)]
    return np.linalg.norm(centres[:, None] - centres, axis=-1)


def draw_trajectories(axes: Axes, env: Any, chosen: np.ndarray, episodes: Episodes) -> None:
    """Episodes from above, one to each of the goals `chosen` [E], in the colours of their regions."""
    path, positions = (
        np.asarray(env.unwrapped.robot.achieved(episodes.observations)),
        np.asarray(env.unwrapped.positions),
    )
    regions = np.asarray(env.goals.regions)
    for goal, steps, success, way in zip(chosen, episodes.steps, episodes.success, path, strict=True):
        colour, outcome, way = room_colour(regions[goal]), SUCCESS if success else FAILURE, way[: steps + 1]
        axes.add_patch(
            Circle(positions[goal, :2], DISTANCE_THRESHOLD, facecolor=outcome, edgecolor="none", alpha=0.22, zorder=1)
        )
        axes.add_patch(
            Circle(
                positions[goal, :2], DISTANCE_THRESHOLD, facecolor="none", edgecolor=outcome, linewidth=1.6, zorder=2
            )
        )
        axes.plot(
            *positions[goal, :2],
            marker="*",
            markersize=11,
            color=colour,
            markeredgecolor="black",
            markeredgewidth=0.7,
            zorder=4,
        )
        axes.plot(*way[:, :2].T, color=colour, linewidth=1.6, marker=".", markersize=3, zorder=3)
        axes.plot(*way[0, :2], marker="o", markersize=6, markerfacecolor="white", markeredgecolor="black", zorder=5)
    low, high = env.space.bounds[:, :2] + np.array([[-1.5], [1.5]]) * DISTANCE_THRESHOLD
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.grid()


def trajectory_legend(env: Any, chosen: np.ndarray) -> list[Line2D]:
    """What the marks of `draw_trajectories` mean."""
    mover = "gripper" if env.unwrapped.robot.task.object_height is None else "object"
    round_mark = {"linestyle": "", "marker": "o", "markersize": 13, "markerfacecolor": "none", "markeredgewidth": 1.6}
    return [
        Line2D(
            [],
            [],
            linestyle="",
            marker="o",
            markerfacecolor="white",
            markeredgecolor="black",
            label=f"start of the {mover}",
        ),
        Line2D([], [], color="#888888", marker=".", markersize=3, label=f"way of the {mover}, a dot a step"),
        Line2D(
            [],
            [],
            linestyle="",
            marker="*",
            markersize=11,
            markerfacecolor="white",
            markeredgecolor="black",
            label="test goal",
        ),
        *(
            Line2D([], [], markeredgecolor=colour, label=label, **round_mark)
            for colour, label in ((SUCCESS, "reached"), (FAILURE, "not reached"))
        ),
    ]
