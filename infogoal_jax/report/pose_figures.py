"""The policy's ways to corrupted test poses: the angle that is left at each step, and the images on the way (paper,
Fig. 9, lower half).

The paper draws pitch and yaw, which are no distances: what counts is the angle of the turn to the goal, and that is
drawn here.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D

from infogoal_jax.envs.object_manipulation import REACHED, ObjectManipulation
from infogoal_jax.report.canvas import FAILURE, SUCCESS, Subject, in_words, new_figure, room_colour
from infogoal_jax.report.image_goal_episodes import seen_images
from infogoal_jax.train.evaluation import EVALUATION_SEED
from infogoal_jax.train.rollout import Episodes

SHOWN = f"dashed: {np.rad2deg(REACHED):g} degrees, within which a pose is reached"
"""For the small print."""
VERTICAL_LABEL = "angle to the goal (degrees)"
IMAGES = 7
"""Of an episode, start and end included."""


def has_poses(env: Any) -> bool:
    """Whether goals of this environment are poses."""
    return isinstance(env.unwrapped, ObjectManipulation)


def turn(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The angle in degrees between unit quaternions [..., 4] and [..., 4]."""
    return np.rad2deg(2 * np.arccos(np.clip(np.abs((first * second).sum(-1)), 0, 1)))


def angles_between_goals(env: Any) -> np.ndarray:
    """Degrees between any two training goals, [R, R]."""
    pose = np.asarray(env.unwrapped.goal_quaternion)[np.asarray(env.goals.training_goals)]
    return turn(pose[:, None], pose)


def angles_to_goals(env: Any, chosen: np.ndarray, episodes: Episodes) -> list[np.ndarray]:
    """Degrees to its goal at every step of each episode, one to each of the goals `chosen` [E]: [steps + 1]."""
    pose, goal_pose = np.asarray(env.unwrapped.quaternion), np.asarray(env.unwrapped.goal_quaternion)
    frames = np.asarray(episodes.observations.frame)
    return [
        turn(pose[way[: steps + 1]], goal_pose[goal])
        for goal, steps, way in zip(chosen, episodes.steps, frames, strict=True)
    ]


def draw_trajectories(axes: Axes, env: Any, chosen: np.ndarray, episodes: Episodes) -> None:
    """The angle that is left at each step, one curve to each of the goals `chosen` [E], in the colours of their
    regions."""
    regions = np.asarray(env.goals.regions)
    for goal, success, angle in zip(chosen, episodes.success, angles_to_goals(env, chosen, episodes), strict=True):
        axes.plot(angle, color=room_colour(regions[goal]), linewidth=1.6, marker=".", markersize=4, zorder=3)
        axes.plot(
            len(angle) - 1,
            angle[-1],
            marker="X",
            markersize=10,
            color=SUCCESS if success else FAILURE,
            markeredgecolor="white",
            zorder=4,
        )
    axes.axhline(np.rad2deg(REACHED), color="black", linestyle="--", linewidth=1)
    axes.set_xlim(0, env.episode_length * 1.04)
    axes.set_ylim(0, 184)
    axes.set_yticks(range(0, 181, 45))
    axes.set_xlabel("step")
    axes.grid()


def title_of(env: Any, chosen: np.ndarray, number: int) -> str:
    """A test goal by its number among those shown, and its angles."""
    return f"{number + 1}: {in_words(env.goals.names[chosen[number]])}"


def trajectory_legend(env: Any, chosen: np.ndarray) -> list[Line2D]:
    """What the marks of `draw_trajectories` mean."""
    regions = np.asarray(env.goals.regions)[chosen]
    ends = ((SUCCESS, "reached"), (FAILURE, "time is up"))
    return [
        *(
            Line2D([], [], color=room_colour(region), marker=".", label=f"way to test goal {number + 1}")
            for number, region in enumerate(regions)
        ),
        *(
            Line2D([], [], linestyle="", marker="X", markersize=10, color=colour, markeredgecolor="white", label=label)
            for colour, label in ends
        ),
    ]


def poses_on_the_way(
    subject: Subject, chosen: np.ndarray, weights: Sequence[float], episodes: list[Episodes]
) -> Figure:
    """The ways as images: for each of the goals `chosen` and each weight the goal as the policy sees it, and images
    from the start to the end."""
    env = subject.train.env
    shown = (
        f"seed {subject.params_seed}, last parameters; test backgrounds; up to {IMAGES} images of each way; below each "
        "its step and the angle "
        f"to the goal; the last in green if it is within {np.rad2deg(REACHED):g} degrees, in red if time was up "
        f"({env.episode_length} steps)"
    )
    rows, across = -(-len(chosen) // 2), min(2, len(chosen))
    figure = new_figure(subject, "ways to corrupted test poses", (7.4 * across, 4.6 * rows + 1.0), shown=shown)
    blocks = figure.subfigures(rows, across, squeeze=False, hspace=0.02, wspace=0.02).ravel()
    seen = [seen_images(env, chosen, weight, EVALUATION_SEED) for weight in weights]
    angles = [angles_to_goals(env, chosen, found) for found in episodes]
    for number, block in zip(range(len(chosen)), blocks, strict=False):
        block.suptitle(
            title_of(env, chosen, number),
            fontsize=10,
            color=room_colour(env.goals.regions[chosen[number]]),
            weight="bold",
        )
        ways = [
            (weight, images[number], found.observations.frame[number], bool(found.success[number]), angle[number])
            for weight, images, found, angle in zip(weights, seen, episodes, angles, strict=True)
        ]
        draw_ways(block, np.asarray(env.goals.inputs), ways)
    return figure


def draw_ways(block: SubFigure, frames: np.ndarray, ways: list[tuple]) -> None:
    """A row for each way (weight, goal image as seen, frames that it went through, success, angle at each of its
    steps)."""
    panels = block.subplots(len(ways), 1 + IMAGES)
    for axes in panels.ravel():
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
    for line, (weight, goal_image, way, success, angle) in zip(panels, ways, strict=True):
        line[0].imshow(goal_image)
        line[0].set_ylabel(f"weight {weight:g}", fontsize=8)
        line[0].set_xlabel("goal as seen", fontsize=7, weight="bold")
        line[0].spines[:].set(visible=True, color="black", linewidth=1.5)
        steps = np.unique(np.linspace(0, len(angle) - 1, IMAGES).round().astype(int))
        for axes, step in zip(line[1:], steps, strict=False):
            axes.imshow(frames[way[step]])
            axes.set_xlabel(f"step {step}: {angle[step]:.0f}°", fontsize=7)
        last = line[len(steps)]
        last.spines[:].set(visible=True, color=SUCCESS if success else FAILURE, linewidth=2.5)
