"""The policy's ways to corrupted test goals (paper, Fig. 9): on Fetch as they are seen from above; for an object that
is turned, as the angle that is left at each step, and as images.

The paper draws pitch and yaw, which are no distances: what counts is the angle of the turn to the goal, and that is
drawn here.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from infogoal_jax.envs.fetch.environment import DISTANCE_THRESHOLD
from infogoal_jax.envs.object_manipulation import REACHED, ObjectManipulation
from infogoal_jax.report.canvas import FAILURE, SUCCESS, Subject, in_words, new_figure, room_colour, white_mark
from infogoal_jax.train.episodes import Episodes

IMAGES = 7
"""Of an episode, start and end included."""


class Drawing(NamedTuple):
    """How the ways to the goals of a task are drawn. shown: for the small print; vertical_label: of the axis;
    apart(env): how far training goals lie apart, [R, R]; draw(axes, env, chosen, episodes): an episode to each of the
    goals `chosen` [E]; legend(env, chosen): what the marks mean."""

    shown: str
    vertical_label: str
    apart: Callable[[Any], np.ndarray]
    draw: Callable[[Axes, Any, np.ndarray, Episodes], None]
    legend: Callable[[Any, np.ndarray], list[Line2D]]


def drawing_of(env: Any) -> Drawing:
    """The drawing for this environment's goals."""
    return AS_ANGLES if has_poses(env) else FROM_ABOVE


def distances_of_goals(env: Any) -> np.ndarray:
    """Metres between any two training goals, [R, R]."""
    centres = np.asarray(env.unwrapped.positions)[np.asarray(env.goals.training_goals)]
    return np.linalg.norm(centres[:, None] - centres, axis=-1)


def draw_from_above(axes: Axes, env: Any, chosen: np.ndarray, episodes: Episodes) -> None:
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


def legend_from_above(env: Any, chosen: np.ndarray) -> list[Line2D]:
    """What the marks of `draw_from_above` mean."""
    mover = "gripper" if env.unwrapped.robot.task.object_height is None else "object"
    round_mark = {"linestyle": "", "marker": "o", "markersize": 13, "markerfacecolor": "none", "markeredgewidth": 1.6}
    return [
        white_mark("o", f"start of the {mover}"),
        Line2D([], [], color="#888888", marker=".", markersize=3, label=f"path of the {mover}, a dot a step"),
        white_mark("*", "test goal", 11),
        *(
            Line2D([], [], markeredgecolor=colour, label=label, **round_mark)
            for colour, label in ((SUCCESS, "reached"), (FAILURE, "not reached"))
        ),
    ]


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


def draw_angles(axes: Axes, env: Any, chosen: np.ndarray, episodes: Episodes) -> None:
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


def legend_of_angles(env: Any, chosen: np.ndarray) -> list[Line2D]:
    """What the marks of `draw_angles` mean."""
    regions = np.asarray(env.goals.regions)[chosen]
    ends = ((SUCCESS, "reached"), (FAILURE, "time is up"))
    return [
        *(
            Line2D([], [], color=room_colour(region), marker=".", label=f"path to test goal {number + 1}")
            for number, region in enumerate(regions)
        ),
        *(
            Line2D([], [], linestyle="", marker="X", markersize=10, color=colour, markeredgecolor="white", label=label)
            for colour, label in ends
        ),
    ]


FROM_ABOVE = Drawing(
    f"circles: within {100 * DISTANCE_THRESHOLD:g} cm of the goal in x and y, green if it was reached (z counts too)",
    "y (m)",
    distances_of_goals,
    draw_from_above,
    legend_from_above,
)
AS_ANGLES = Drawing(
    f"dashed: {np.rad2deg(REACHED):g} degrees, within which a pose is reached",
    "angle to the goal (degrees)",
    angles_between_goals,
    draw_angles,
    legend_of_angles,
)


def poses_on_the_way(
    subject: Subject, chosen: np.ndarray, seen: dict[float, np.ndarray], episodes: list[Episodes]
) -> Figure:
    """The ways as images: for each of the goals `chosen` and each weight the goal as the policy sees it, and images
    from the start to the end. seen: {weight: images of the goals, uint8 [C, H, W, 3]}."""
    env = subject.train.env
    shown = (
        f"seed {subject.params_seed}, last parameters; test backgrounds; up to {IMAGES} images of each path; below "
        "each its step and the angle "
        f"to the goal; the last in green if it is within {np.rad2deg(REACHED):g} degrees, in red if time was up "
        f"({env.episode_length} steps)"
    )
    rows, across = -(-len(chosen) // 2), min(2, len(chosen))
    figure = new_figure(subject, "paths to corrupted test poses", (7.4 * across, 4.6 * rows + 1.0), shown=shown)
    blocks = figure.subfigures(rows, across, squeeze=False, hspace=0.02, wspace=0.02).ravel()
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
            for (weight, images), found, angle in zip(seen.items(), episodes, angles, strict=True)
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
