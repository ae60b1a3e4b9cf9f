"""Figures of tasks whose goals are images: examples of them (paper, Fig. 6), and goal codes with trajectories under corruption (Fig. 9)."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from infogoal_jax.envs.fetch.environment import DISTANCE_THRESHOLD
from infogoal_jax.goals import corrupt, draw_backgrounds
from infogoal_jax.report.canvas import FAILURE, SUCCESS, Subject, empty_figure, new_figure, room_colour, save
from infogoal_jax.report.fetch_episodes import policy_episodes, seen_images, with_evaluated
from infogoal_jax.report.goal_codes import code_legend, draw_codes, principal_components
from infogoal_jax.train.evaluation import EVALUATION_SEED
from infogoal_jax.train.rollout import Episodes

WEIGHTS = (0.1, 0.2, 0.4, 0.8)
"""Of the backgrounds, in the paper's figures."""
EXAMPLES, EXAMPLE_SEED = 2, 0
"""Goals of each kind in the figure of examples, and the seed of their backgrounds."""
SHOWN_GOALS = 4
"""Test goals whose trajectories are drawn."""


def has_image_goals(env: Any) -> bool:
    """Whether goals of this environment are images that can be corrupted."""
    return getattr(env, "test_backgrounds", None) is not None


def draw_image_goals(subject: Subject) -> dict[str, Figure | None]:
    """The figures of this file by name; none for a task with other goals."""
    if not has_image_goals(subject.train.env):
        return {}
    return {"goal_images": goal_images(subject.train.env), "codes_and_trajectories": codes_and_trajectories(subject)}


def save_goal_images(env: Any, path: Path) -> None:
    """Draw examples of an environment's goal images without a run: `save_goal_images(envs.load("fetch_push", FetchConfig(goals="images")), path)`."""
    save(goal_images(env), path)


def goal_images(env: Any) -> Figure:
    """Goal images clean and corrupted, a row a goal (paper, Fig. 6): training goals while training and in the test, then test goals."""
    goals, rows = env.goals, []
    for title, mask, backgrounds in (
        ("training goal,\ntraining background", goals.train_mask, env.train_backgrounds),
        ("training goal,\ntest background", goals.train_mask, env.test_backgrounds),
        ("test goal,\ntest background", goals.test_mask, env.test_backgrounds),
    ):
        chosen = np.flatnonzero(np.asarray(mask))[:EXAMPLES]
        behind = draw_backgrounds(jax.random.fold_in(jax.random.key(EXAMPLE_SEED), len(rows)), backgrounds, chosen.shape)
        rows += [(title, goals.inputs_of(goal), background) for goal, background in zip(chosen, behind, strict=True)]
    columns = {"clean": 0.0, **{f"weight {weight:g}": weight for weight in WEIGHTS}, "background": 1.0}
    title, shown = f"{env.robot.task.name.replace('_', ' ')}: goal images and the weight of their background", "the first goals of each kind"
    figure = empty_figure(title, (f"{shown}; backgrounds drawn from seed {EXAMPLE_SEED}", f"data: {env.source}"), (9.6, 1.56 * len(rows) + 0.9))
    for (title, image, background), line in zip(rows, figure.subplots(len(rows), len(columns), squeeze=False), strict=True):
        line[0].set_ylabel(title, fontsize=8)
        for axes, (name, weight) in zip(line, columns.items(), strict=True):
            axes.imshow(corrupt(image, background, weight))
            axes.set_xticks([])
            axes.set_yticks([])
            if axes.get_subplotspec().is_first_row():
                axes.set_title(name, fontsize=10)
    return figure


def spread_goals(env: Any, mask: np.ndarray, count: int) -> np.ndarray:
    """The first goal of the mask in each of `count` regions, int [C]: a rule that looks at no result.

    The first region, then again and again the one whose training goal lies farthest from those of all that were taken.
    """
    regions, which = np.asarray(env.goals.regions), np.flatnonzero(np.asarray(mask))
    centres = np.asarray(env.positions)[np.asarray(env.goals.commanded)]
    left = np.unique(regions[which])
    taken = [left[0]]
    while len(taken) < min(count, len(left)):
        distance = np.linalg.norm(centres[left][:, None] - centres[taken], axis=-1).min(1)
        taken.append(left[distance.argmax()])
    return np.array([which[regions[which] == region][0] for region in taken])


def codes_and_trajectories(subject: Subject) -> Figure | None:
    """Codes of corrupted goals, and beneath them the policy's way to four corrupted test goals, a column a weight (paper, Fig. 9).

    None without parameters or test goals.
    """
    env, goals = subject.train.env, subject.train.env.goals
    if subject.params is None or "test" not in goals.groups:
        return None
    shown = (f"seed {subject.params_seed}, last parameters; test backgrounds; principal axes of the clean goals' means; circles: within "
             f"{100 * DISTANCE_THRESHOLD:g} cm of the goal in x and y, green if it was reached (z counts too); at most {env.episode_length} steps")
    figure = new_figure(subject, "codes of corrupted goals, and ways to corrupted test goals", (14.5, 7.4), shown=shown)
    panels = figure.subplots(2, len(WEIGHTS))
    groups = tuple(group for group in ("train", "test") if group in goals.groups)
    which = np.flatnonzero(np.any([np.asarray(getattr(goals, f"{group}_mask")) for group in groups], axis=0))
    some = with_evaluated(env, which)
    clean, *codes = (
        jax.tree.map(np.asarray, subject.train.parts.learner.encode(subject.params["goal"], seen_images(some, weight, EVALUATION_SEED)))
        for weight in (0.0, *WEIGHTS)
    )
    centre, directions, _ = principal_components(clean.mean)
    chosen = spread_goals(env, goals.test_mask, SHOWN_GOALS)
    episodes = policy_episodes(subject, chosen, WEIGHTS, EVALUATION_SEED)
    for (above, below), weight, code, found in zip(panels.T, WEIGHTS, codes, episodes, strict=True):
        above.set_title(f"background of weight {weight:g}", fontsize=10)
        draw_codes(above, code, goals, which, centre, directions, size=0.55)
        above.set_xlabel("first principal axis")
        draw_trajectories(below, env, chosen, found)
    panels[0, 0].set_ylabel("second principal axis")
    panels[1, 0].set_ylabel("y (m)")
    random_code = any((code.std > 0).any() for code in codes)
    panels[0, -1].legend(handles=code_legend(goals, groups, random_code), fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    panels[1, -1].legend(handles=trajectory_legend(env), fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def draw_trajectories(axes: Axes, env: Any, chosen: np.ndarray, episodes: Episodes) -> None:
    """Episodes from above, one to each of the goals `chosen` [E], in the colours of their regions."""
    path, positions, regions = np.asarray(env.robot.achieved(episodes.observations)), np.asarray(env.positions), np.asarray(env.goals.regions)
    for goal, steps, success, way in zip(chosen, episodes.steps, episodes.success, path, strict=True):
        colour, outcome, way = room_colour(regions[goal]), SUCCESS if success else FAILURE, way[: steps + 1]
        axes.add_patch(Circle(positions[goal, :2], DISTANCE_THRESHOLD, facecolor=outcome, edgecolor="none", alpha=0.22, zorder=1))
        axes.add_patch(Circle(positions[goal, :2], DISTANCE_THRESHOLD, facecolor="none", edgecolor=outcome, linewidth=1.6, zorder=2))
        axes.plot(*positions[goal, :2], marker="*", markersize=11, color=colour, markeredgecolor="black", markeredgewidth=0.7, zorder=4)
        axes.plot(*way[:, :2].T, color=colour, linewidth=1.6, marker=".", markersize=3, zorder=3)
        axes.plot(*way[0, :2], marker="o", markersize=6, markerfacecolor="white", markeredgecolor="black", zorder=5)
    low, high = env.space.bounds[:, :2] + np.array([[-1.5], [1.5]]) * DISTANCE_THRESHOLD
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.grid(alpha=0.3, linewidth=0.6)


def trajectory_legend(env: Any) -> list[Line2D]:
    """What the marks of `draw_trajectories` mean."""
    mover = "gripper" if env.robot.task.object_height is None else "object"
    round_mark = {"linestyle": "", "marker": "o", "markersize": 13, "markerfacecolor": "none", "markeredgewidth": 1.6}
    return [
        Line2D([], [], linestyle="", marker="o", markerfacecolor="white", markeredgecolor="black", label=f"start of the {mover}"),
        Line2D([], [], color="#888888", marker=".", markersize=3, label=f"way of the {mover}, a dot a step"),
        Line2D([], [], linestyle="", marker="*", markersize=11, markerfacecolor="white", markeredgecolor="black", label="test goal"),
        *(Line2D([], [], markeredgecolor=colour, label=label, **round_mark) for colour, label in ((SUCCESS, "reached"), (FAILURE, "not reached"))),
    ]
