"""Figures of tasks whose goals are images: examples of them (paper, Fig. 6), and goal codes with trajectories under
corruption (Fig. 9).

How the way to a goal is drawn is the task's: seen from above for Fetch, as poses for an object that is turned.
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from infogoal_jax.goals import corrupt, draw_backgrounds
from infogoal_jax.report import fetch_figures, pose_figures
from infogoal_jax.report.canvas import Subject, empty_figure, figure_style, new_figure, save, share_limits
from infogoal_jax.report.goal_codes import code_legend, draw_codes, principal_components
from infogoal_jax.report.image_goal_episodes import policy_episodes, seen_images
from infogoal_jax.train.evaluation import EVALUATION_SEED
from infogoal_jax.train.rollout import Episodes
from infogoal_jax.train.settings import has_image_goals

WEIGHTS = (0.1, 0.2, 0.4, 0.8)
"""Of the backgrounds, in the paper's figures."""
EXAMPLES, EXAMPLE_SEED = 2, 0
"""Goals of each kind in the figure of examples, and the seed of their backgrounds."""
SHOWN_GOALS = 4
"""Test goals whose trajectories are drawn."""


def draw_image_goals(subject: Subject) -> dict[str, Figure | None]:
    """The figures of this file by name; none for a task with other goals. Those of the policy need parameters and test
    goals."""
    env = subject.train.env
    if not has_image_goals(env):
        return {}
    figures = {"goal_images": goal_images(env, subject.run.config.task)}
    if subject.params is None or "test" not in env.goals.groups:
        return figures
    has_poses = pose_figures.has_poses(env)
    apart = pose_figures.angles_between_goals(env) if has_poses else fetch_figures.distances_of_goals(env)
    chosen = spread_goals(env.goals, env.goals.test_mask, SHOWN_GOALS, apart)
    episodes = policy_episodes(subject, chosen, WEIGHTS, EVALUATION_SEED)
    figures["codes_and_trajectories"] = codes_and_trajectories(subject, chosen, episodes)
    if has_poses:
        figures["poses_on_the_way"] = pose_figures.poses_on_the_way(subject, chosen, WEIGHTS, episodes)
    return figures


def save_goal_images(env: Any, path: Path) -> None:
    """Draw examples of an environment's goal images without a run: `save_goal_images(envs.load("fetch_push",
    FetchConfig(goals="images")), path)`."""
    with figure_style():
        save(goal_images(env), path)


def goal_images(env: Any, task: str = "") -> Figure:
    """Goal images clean and corrupted, a row a goal (paper, Fig. 6): training goals while training and in the test,
    then test goals.

    task: for the title.
    """
    goals, rows = env.goals, []
    for title, mask, backgrounds in (
        ("training goal,\ntraining background", goals.train_mask, env.train_backgrounds),
        ("training goal,\ntest background", goals.train_mask, env.test_backgrounds),
        ("test goal,\ntest background", goals.test_mask, env.test_backgrounds),
    ):
        chosen = np.flatnonzero(np.asarray(mask))[:EXAMPLES]
        behind = draw_backgrounds(
            jax.random.fold_in(jax.random.key(EXAMPLE_SEED), len(rows)), backgrounds, chosen.shape
        )
        rows += [(title, goals.inputs_of(goal), background) for goal, background in zip(chosen, behind, strict=True)]
    columns = {"clean": 0.0, **{f"weight {weight:g}": weight for weight in WEIGHTS}, "background": 1.0}
    title = f"{task.replace('_', ' ')}: " * bool(task) + "goal images and the weight of their background"
    below = (f"the first goals of each kind; backgrounds drawn from seed {EXAMPLE_SEED}", f"data: {env.source}")
    figure = empty_figure(title, below, (9.6, 1.56 * len(rows) + 0.9))
    for (title, image, background), line in zip(
        rows, figure.subplots(len(rows), len(columns), squeeze=False), strict=True
    ):
        line[0].set_ylabel(title, fontsize=8)
        for axes, (name, weight) in zip(line, columns.items(), strict=True):
            axes.imshow(corrupt(image, background, weight))
            axes.set_xticks([])
            axes.set_yticks([])
            if axes.get_subplotspec().is_first_row():
                axes.set_title(name, fontsize=10)
    return figure


def spread_goals(goals: Any, mask: np.ndarray, count: int, apart: np.ndarray) -> np.ndarray:
    """The first goal of the mask in each of `count` regions, int [C]: a rule that looks at no result. apart: [R, R]
    distances of training goals.

    The first region, then again and again the one whose training goal lies farthest from those of all that were taken.
    """
    regions, which = np.asarray(goals.regions), np.flatnonzero(np.asarray(mask))
    left = np.unique(regions[which])
    taken = [left[0]]
    while len(taken) < min(count, len(left)):
        taken.append(left[apart[left][:, taken].min(1).argmax()])
    return np.array([which[regions[which] == region][0] for region in taken])


def codes_and_trajectories(subject: Subject, chosen: np.ndarray, episodes: list[Episodes]) -> Figure:
    """Codes of corrupted goals, and beneath them the policy's way to the corrupted test goals `chosen`, a column a
    weight (paper, Fig. 9)."""
    env, goals = subject.train.env, subject.train.env.goals
    below = pose_figures if pose_figures.has_poses(env) else fetch_figures
    shown = (
        f"seed {subject.params_seed}, last parameters; test backgrounds; principal axes of the clean goals' means; "
        f"{below.SHOWN}; "
        f"at most {env.episode_length} steps"
    )
    figure = new_figure(subject, "codes of corrupted goals, and ways to corrupted test goals", (14.5, 7.4), shown=shown)
    panels = figure.subplots(2, len(WEIGHTS))
    groups = tuple(group for group in ("train", "test") if group in goals.groups)
    which = np.flatnonzero(np.any([np.asarray(getattr(goals, f"{group}_mask")) for group in groups], axis=0))
    clean, *codes = (
        jax.tree.map(
            np.asarray,
            subject.train.parts.learner.encode(
                subject.params["goal"], seen_images(env, which, weight, EVALUATION_SEED)
            ),
        )
        for weight in (0.0, *WEIGHTS)
    )
    centre, directions, _ = principal_components(clean.mean)
    for (code_axes, way_axes), weight, code, found in zip(panels.T, WEIGHTS, codes, episodes, strict=True):
        code_axes.set_title(f"background of weight {weight:g}", fontsize=10)
        draw_codes(code_axes, code, goals, which, centre, directions, size=0.55)
        code_axes.set_xlabel("first principal axis")
        below.draw_trajectories(way_axes, env, chosen, found)
    share_limits(panels[0], square=True)
    panels[0, 0].set_ylabel("second principal axis")
    panels[1, 0].set_ylabel(below.VERTICAL_LABEL)
    random_code = any(code.std is not None for code in codes)
    legends = code_legend(goals, groups, random_code), below.trajectory_legend(env, chosen)
    for axes, entries in zip(panels[:, -1], legends, strict=True):
        axes.legend(handles=entries, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
