"""Figures 8 to 15 of the paper, each drawn from the compact numbers by a function of its own. Here stand Figures 8, 13
and 15: success with and without SSE-DB, beta and accuracy while training, and success under fixed beta."""

from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

from infogoal_jax.goal_uses import TEST, TRAINING
from infogoal_jax.report.canvas import USE_COLOURS, USE_TITLES, draw_curve, empty_figure, finish_share_axis
from infogoal_jax.report.comparison_figures import COLOURS
from infogoal_jax.report.figures import finish_length_axis, finish_progress_axis, success_within
from infogoal_jax.report.statistics import mean_interval
from infogoal_paper.code_figures import fig9, fig10, fig11, fig12, fig14
from infogoal_paper.files import Result
from infogoal_paper.manifest import EXTERNAL, FETCH, FIXED_BETAS, PRESET, fixed
from infogoal_paper.numbers import Results
from infogoal_paper.scores import KINDS, TITLES, row_of

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
    below = (
        "synthetic house 0, a stand-in; mean over seeds with 95 % interval, each seed a thin line",
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
    below = ("mean over seeds with 95 % interval, each seed a thin line; the paper: beta about 0.013, accuracy 0.96",)
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


def lanes() -> dict[str, str]:
    """The lanes of Fig. 15 as the axis names them, by name."""
    betas = {fixed(beta)[0]: f"{beta:g}" for beta in FIXED_BETAS}
    return betas | {PRESET[0]: "adaptive", EXTERNAL[0]: "adaptive,\nno intrinsic\nreward"}


def by_task(results: Results, lane: str, kind: str) -> dict[str, np.ndarray]:
    """Success of InfoGoal under a lane, [seeds] of each Fetch task, on the first goal set."""
    rows = {task: row_of(results, "paper", task, "infogoal", lane) for task in FETCH}
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
        for place, lane in enumerate(lanes()):
            found = by_task(results, lane, kind)
            if not found:
                continue
            fewest = min(len(values) for values in found.values())
            mean = mean_interval(np.mean([values[:fewest] for values in found.values()], axis=0))
            half = mean.half_width if np.isfinite(mean.half_width) else None
            colour = USE_COLOURS["test"] if lane == PRESET[0] else USE_COLOURS["train"]
            axes.bar(place, mean.mean, yerr=half, color=colour, alpha=0.7, capsize=4)
            for task, values in found.items():
                axes.plot(place, values.mean(), markers[task], color="black", markersize=5)
        axes.set_xticks(range(len(lanes())), list(lanes().values()), fontsize=8)
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
