"""Figures 8 to 15 of the paper, each drawn from the compact numbers by a function of its own: codes of goals on their
principal axes and the trajectories of the policy (9, 10, 11 and 14), the intrinsic reward (12), success with and
without SSE-DB (8), beta and accuracy while training (13), and success under fixed beta (15)."""

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from infogoal_jax.goal_uses import NO_USE, TEST, TRAINING, USES
from infogoal_jax.goals import GoalSet
from infogoal_jax.learners.learner import GoalCode
from infogoal_jax.report.canvas import (
    FAILURE,
    NOTHING,
    SUCCESS,
    USE_COLOURS,
    USE_TITLES,
    draw_curve,
    empty_figure,
    finish_share_axis,
    interval_in_words,
    room_colour,
)
from infogoal_jax.report.codes import draw_codes, principal_components
from infogoal_jax.report.comparison_figures import COLOURS
from infogoal_jax.report.figures import finish_length_axis, finish_progress_axis, success_within
from infogoal_jax.report.statistics import mean_interval
from infogoal_paper.files import Result
from infogoal_paper.image_goal_figures import WEIGHTS
from infogoal_paper.manifest import DRAWN, EXTERNAL, FETCH, FIXED_BETAS, PRESET, fixed
from infogoal_paper.numbers import Results
from infogoal_paper.paper import title_of
from infogoal_paper.scores import KINDS, TITLES, row_of

PATHS_IN_WORDS = "stars: goals; circles: starts; crosses: ends, green where the goal was reached"
CODE_SAMPLES = 20
"""Of each goal: panels are small, and the pictures of many panels stay light."""
CODES_IN_WORDS = (
    "large marks: means, circles of training goals and stars of test goals; faded: samples; colours: regions"
)


def picture_of(results: Results, task: str, method: str, *settings: str) -> Result | None:
    """The run whose pictures are shown: on goal set 0, of the first of these settings that there is."""
    for setting in settings or (PRESET[0],):
        row = row_of(results, "paper", task, method, setting)
        found = row and next((result for result in row.results if "picture/code_mean" in result.arrays), None)
        if found:
            return found
    return None


def codes_panel(axes: Axes, result: Result, view: int) -> None:
    """The codes of a run in one view of its goals, 0: clean; on the principal axes of the clean means."""
    arrays = {name: result.arrays[f"picture/{name}"] for name in ("code_mean", "code_region", "code_use")}
    mean, use = arrays["code_mean"].astype(float), arrays["code_use"]
    std = result.arrays.get("picture/code_std")
    centre, directions, _ = principal_components(mean[0])
    regions = tuple(str(region) for region in range(int(arrays["code_region"].max()) + 1))
    uses = np.where(use == len(USES), NO_USE, use)
    goals = GoalSet.of(
        np.zeros((len(use), 1), np.float32), arrays["code_region"], uses, tuple(map(str, range(len(use)))), regions
    )
    code = GoalCode(mean[view], None if std is None else std[view].astype(float))
    draw_codes(axes, code, goals, np.arange(len(use)), centre, directions, 0.5, CODE_SAMPLES)
    axes.set_xticks([])
    axes.set_yticks([])


def trajectory_panel(axes: Axes, result: Result, view: int, goal: int | None = None, name: str = "way") -> None:
    """The trajectories of a run in one view, to all of the drawn goals or to one of them, over its graph."""
    picture = {key.partition("/")[2]: value for key, value in result.arrays.items() if key.startswith("picture/")}
    angles = result.run.task == "object_manipulation"
    if "place" in picture:
        axes.scatter(*picture["place"].T, s=2, color=NOTHING, zorder=0)
    for number, way in enumerate(picture[name][view]):
        if goal is not None and number != goal:
            continue
        colour, way = room_colour(int(picture[f"{name}_region"][number])), way[np.isfinite(way[:, 0])]
        outcome = SUCCESS if picture[f"{name}_success"][view, number] else FAILURE
        axes.plot(*way.T, color=colour, linewidth=1.3, marker=".", markersize=2.5, zorder=3)
        axes.plot(*way[0], "o", markersize=5, markerfacecolor="white", markeredgecolor="black", zorder=5)
        axes.plot(*way[-1], "X", markersize=8, color=outcome, markeredgecolor="white", zorder=6)
        if not angles:
            star = picture[f"{name}_goal"][number]
            axes.plot(*star, "*", markersize=11, color=colour, markeredgecolor="black", zorder=4)
    axes.set_aspect("auto" if angles else "equal", adjustable="box" if "place" in picture else "datalim")
    if angles:
        axes.set_ylim(0, 184)
    axes.tick_params(labelsize=6)
    axes.grid(alpha=0.3, linewidth=0.5)


def fig9(results: Results) -> Figure | None:
    """Codes and trajectories of four methods under four degrees of corruption, on FetchPickAndPlace and on the cube,
    trained on external rewards alone."""
    tasks = ("fetch_pick_and_place", "object_manipulation")
    found = {
        (task, method): picture
        for task in tasks
        for method in DRAWN
        if (picture := picture_of(results, task, method, EXTERNAL[0], *([PRESET[0]] if method in DRAWN[2:] else [])))
    }
    if not found:
        return None
    below = (
        f"{CODES_IN_WORDS}; below them trajectories to corrupted test goals, on the cube the angle to the goal "
        f"(degrees) against steps; {PATHS_IN_WORDS}; one seed, last parameters, test backgrounds",
    )
    title = "Codes and trajectories under corruption, external rewards alone"
    figure = empty_figure(title, below, (13, 4.2 * len(found) + 1))
    panels = figure.subplots(2 * len(found), len(WEIGHTS), squeeze=False)
    for row, ((task, method), result) in enumerate(found.items()):
        for place, weight in enumerate(WEIGHTS):
            codes, trajectories = panels[2 * row : 2 * row + 2, place]
            codes_panel(codes, result, 1 + place)
            trajectory_panel(trajectories, result, place)
            codes.set_title(f"background of weight {weight:g}", fontsize=9)
        panels[2 * row, 0].set_ylabel(f"{TITLES[task]}, {title_of(task, method)}", fontsize=11)
        panels[2 * row + 1, 0].set_ylabel("trajectories", fontsize=11)
    return figure


def codes_and_ways(results: Results, task: str, title: str) -> Figure | None:
    """A row for each method: codes of the goals, and the trajectories to a test goal of each region."""
    found = {method: picture for method in DRAWN if (picture := picture_of(results, task, method))}
    if not found:
        return None
    below = (
        f"{CODES_IN_WORDS}; right: trajectories to a test goal a region from the farthest start; {PATHS_IN_WORDS}; "
        "one seed",
    )
    trajectories = min(4, max(result.arrays["picture/way"].shape[1] for result in found.values()))
    # Ways on a shelf, which is wide and low, stand one below the other.
    low = height_of_places(next(iter(found.values()))) < 0.4
    figure = empty_figure(
        title, below, (11, 5 * len(found) + 1) if low else (3.6 + 3.6 * trajectories, 2.9 * len(found) + 1)
    )
    rows = figure.add_gridspec(len(found), 2, width_ratios=[1, 1.7 if low else trajectories])
    for row, (method, result) in enumerate(found.items()):
        codes = figure.add_subplot(rows[row, 0])
        codes_panel(codes, result, 0)
        codes.set_ylabel(title_of(task, method), fontsize=11)
        panels = rows[row, 1].subgridspec(*((trajectories, 1) if low else (1, trajectories)))
        for goal in range(min(trajectories, result.arrays["picture/way"].shape[1])):
            trajectory_panel(figure.add_subplot(panels[goal]), result, 0, goal)
    return figure


def height_of_places(result: Result) -> float:
    """The height of the places of a graph, as a share of their width."""
    extent = np.ptp(result.arrays["picture/place"], axis=0)
    return float(extent[1] / extent[0])


def fig10(results: Results) -> Figure | None:
    """Codes and trajectories on object search."""
    return codes_and_ways(results, "object_search", "Object search: codes, and trajectories to test goals")


def fig11(results: Results) -> Figure | None:
    """Codes and flights on embodied question answering."""
    return codes_and_ways(results, "embodied_qa", "Embodied question answering: codes, and flights to test questions")


def fig14(results: Results) -> Figure | None:
    """Codes of InfoGoal under fixed beta, and under the adaptive one, by corruption, on FetchPickAndPlace."""
    settings = {f"beta {beta:g}": fixed(beta)[0] for beta in (1e-4, 1e-2, 1e-1)} | {"adaptive": PRESET[0]}
    found = {
        title: picture
        for title, setting in settings.items()
        if (picture := picture_of(results, "fetch_pick_and_place", "infogoal", setting))
    }
    if len(found) < 2:
        return None
    below = (f"{CODES_IN_WORDS}; principal axes of the clean means; one seed, last parameters, test backgrounds",)
    figure = empty_figure("FetchPickAndPlace: codes under fixed beta", below, (15, 3.1 * len(found) + 0.8))
    panels = figure.subplots(len(found), 1 + len(WEIGHTS), squeeze=False)
    for line, (title, result) in zip(panels, found.items(), strict=True):
        for view, axes in enumerate(line):
            codes_panel(axes, result, view)
        line[0].set_ylabel(title, fontsize=11)
    for axes, weight in zip(panels[0], (0.0, *WEIGHTS), strict=True):
        axes.set_title(f"background of weight {weight:g}" if weight else "clean")
    return figure


GOALS = 4


def fig12(results: Results) -> Figure | None:
    """The intrinsic reward of every place for a training goal a region, and the policy's trajectory to it."""
    tasks = {task: picture_of(results, task, "infogoal") for task in ("object_search", "embodied_qa")}
    found = {task: result for task, result in tasks.items() if result and "picture/reward" in result.arrays}
    if not found:
        return None
    below = (
        f"mean over the images of a place with a goal in view, the mean of all being -1; {PATHS_IN_WORDS}; one seed",
    )
    heights = [0.6 + 3.3 * height_of_places(result) for result in found.values()]
    figure = empty_figure("Intrinsic reward for training goals", below, (15, sum(heights) + 1.2))
    panels = figure.subplots(len(found), GOALS, squeeze=False, gridspec_kw={"height_ratios": heights})
    for line, (task, result) in zip(panels, found.items(), strict=True):
        places, of_image = np.unique(result.arrays["picture/place"].round(3), axis=0, return_inverse=True)
        for goal, axes in enumerate(line[: len(result.arrays["picture/reward"])]):
            reward = result.arrays["picture/reward"][goal].astype(float)
            seen = np.isfinite(reward)
            count = np.bincount(of_image.ravel()[seen], minlength=len(places))
            total = np.bincount(of_image.ravel()[seen], reward[seen], len(places))
            mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
            trajectory_panel(axes, result, 0, goal, "reward_way")
            dots = axes.scatter(*places.T, c=mean, s=26, cmap="viridis", vmax=0, zorder=2)
        line[0].set_ylabel(TITLES[task], fontsize=11)
        figure.colorbar(dots, ax=line, label="intrinsic reward", shrink=0.8)
    return figure


COMPARED = {"none": "DQN", "infobot": "InfoBot", "infogoal": "InfoGoal"}
"""Methods of Fig. 8, with their names in it."""
GROUPS = {"train": TRAINING, "test": TEST}
"""Groups of goals of the figure, and their number in `uses`."""


def compared(results: Results) -> dict[str, Result]:
    """The runs of the figure that there are, by title."""
    found = {}
    for explorer in (None, "sse_db"):
        for method, title in COMPARED.items():
            row = row_of(results, "paper", "object_search", method, explorer=explorer)
            first = row and next((result for result in row.results if result.run.goal_set == 0), None)
            if first:
                found[title + (" + SSE-DB" if explorer else "")] = first
    return found


def within(result: Result, group: str) -> np.ndarray:
    """Success within 0, 1, ... steps on a group of goals, [seeds, T + 1]."""
    mask = result.arrays["uses"] == GROUPS[group]
    return success_within(result.arrays["first_reached"], mask, result.about["episode_length"])


def areas(result: Result, group: str, evaluations: int) -> tuple[np.ndarray, np.ndarray]:
    """The areas under the curves of a group of goals, [seeds] each, as shares of the largest: of success while
    training, over the first so many evaluations, and of success within so many steps."""
    curve = result.evaluations[f"{group}_goal/success_rate"][:, :evaluations]
    return curve.mean(1), within(result, group).mean(1)


def fig8(results: Results) -> Figure | None:
    """The figure of the paper, with areas under the curves in the legend."""
    found = compared(results)
    if not any("SSE-DB" in title for title in found):
        return None
    shortest = min(len(result.evaluations["env_steps"][0]) for result in found.values())
    counts = [len(result.evaluations["env_steps"]) for result in found.values()]
    below = (
        f"synthetic house 0, a stand-in; mean over seeds{interval_in_words(counts)}",
        f"in the legend: area under the curve ± 95 % interval, on the left over the first {shortest} evaluations",
    )
    figure = empty_figure("Sample efficiency and optimality with and without SSE-DB", below, (12, 8))
    for (left, right), group in zip(figure.subplots(2, 2), GROUPS, strict=True):
        for (title, result), colour in zip(found.items(), COLOURS, strict=False):
            area, steps = areas(result, group, shortest), result.evaluations["env_steps"].mean(0)
            shown = [f"{title}: {mean_interval(values).show(2)}" for values in area]
            draw_curve(left, steps, result.evaluations[f"{group}_goal/success_rate"], colour, shown[0])
            curve = within(result, group)
            draw_curve(right, np.arange(curve.shape[1]), curve, colour, shown[1])
        finish_progress_axis(left, "environment steps", max(r.evaluations["env_steps"].max() for r in found.values()))
        finish_length_axis(right, next(iter(found.values())).about["episode_length"])
        for axes in (left, right):
            finish_share_axis(axes, f"success rate, {USE_TITLES[group]}")
            axes.legend(fontsize=7)
    return figure


SHOWN = {"corrupted_train_goal": "(a) corrupted training goals", "corrupted_test_goal": "(b) corrupted test goals"}


def fig13(results: Results) -> Figure | None:
    """Beta and accuracy of InfoGoal on FetchPickAndPlace, seed by seed."""
    row = row_of(results, "paper", "fetch_pick_and_place", "infogoal")
    if row is None:
        return None
    result = row.results[0]
    updates = result.about["updates"] * np.arange(1, result.evaluations["infogoal/beta"].shape[1] + 1)
    threshold = result.about["config"]["hyper"]["learner"]["beta_threshold"]
    interval = interval_in_words([len(result.evaluations["infogoal/beta"])])
    below = (f"mean over seeds{interval}; the paper: beta about 0.013, accuracy 0.96",)
    figure = empty_figure("FetchPickAndPlace: adaptive Lagrange multiplier", below, (10, 4.2))
    left, right = figure.subplots(1, 2)
    draw_curve(left, updates, result.evaluations["infogoal/beta"], USE_COLOURS["train"], "beta")
    draw_curve(right, updates, result.evaluations["infogoal/accuracy"], USE_COLOURS["test"], "accuracy")
    right.axhline(threshold, color="black", linestyle="--", linewidth=1, label=f"threshold {threshold:g}")
    right.legend(loc="lower right")
    for axes, label in ((left, "Lagrange multiplier beta"), (right, "accuracy, similar against dissimilar goals")):
        axes.set_ylabel(label)
        axes.set_xlabel("updates")
        axes.grid(alpha=0.3, linewidth=0.6)
    return figure


def settings() -> dict[str, str]:
    """The settings of Fig. 15 as the axis names them, by name."""
    betas = {fixed(beta)[0]: f"{beta:g}" for beta in FIXED_BETAS}
    return betas | {PRESET[0]: "adaptive", EXTERNAL[0]: "adaptive,\nno intrinsic\nreward"}


def by_task(results: Results, setting: str, kind: str) -> dict[str, np.ndarray]:
    """Success of InfoGoal under a setting, [seeds] of each Fetch task, on the first goal set."""
    rows = {task: row_of(results, "paper", task, "infogoal", setting) for task in FETCH}
    return {task: row.scores(kind)[0] for task, row in rows.items() if row is not None}


def fig15(results: Results) -> Figure | None:
    """Success on the three Fetch tasks under fixed beta and the adaptive one: the mean over tasks with its interval
    over seeds, and each task."""
    kinds = [*SHOWN, "test_goal"]
    if not any(by_task(results, fixed(beta)[0], kinds[0]) for beta in FIXED_BETAS):
        return None
    below = ("bars: mean over tasks with 95 % interval over seeds; marks: each task. beta fixed from the first update",)
    figure = empty_figure("Fetch: success under fixed beta and under the adaptive one", below, (14, 4.6))
    markers = dict(zip(FETCH, "osD", strict=True))
    for axes, kind in zip(figure.subplots(1, len(kinds), sharey=True), kinds, strict=True):
        for place, setting in enumerate(settings()):
            found = by_task(results, setting, kind)
            if not found:
                continue
            fewest = min(len(values) for values in found.values())
            mean = mean_interval(np.mean([values[:fewest] for values in found.values()], axis=0))
            half = mean.half_width if np.isfinite(mean.half_width) else None
            colour = USE_COLOURS["test"] if setting == PRESET[0] else USE_COLOURS["train"]
            axes.bar(place, mean.mean, yerr=half, color=colour, alpha=0.7, capsize=4)
            for task, values in found.items():
                axes.plot(place, values.mean(), markers[task], color="black", markersize=5)
        axes.set_xticks(range(len(settings())), list(settings().values()), fontsize=8)
        axes.set_title(SHOWN.get(kind, f"(c) {KINDS[kind]} goals"), fontsize=10)
        axes.set_xlabel("beta")
        finish_share_axis(axes, "success rate" if kind == kinds[0] else "")
    for task, marker in markers.items():
        axes.plot([], [], marker, color="black", markersize=5, label=TITLES[task])
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


FIGURES: dict[str, Callable[[Results], Figure | None]] = {
    "fig8": fig8,
    "fig9": fig9,
    "fig10": fig10,
    "fig11": fig11,
    "fig12": fig12,
    "fig13": fig13,
    "fig14": fig14,
    "fig15": fig15,
}
"""(results) -> the figure, or None where there are no numbers for it."""
