"""Fig. 8: sample efficiency, and optimality as success within so many steps, with and without SSE-DB."""

from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from infogoal_jax.goal_uses import TEST, TRAINING
from infogoal_jax.report.canvas import USE_TITLES, draw_curve, empty_figure, finish_share_axis
from infogoal_jax.report.comparison_figures import COLOURS
from infogoal_jax.report.figures import finish_length_axis, finish_progress_axis, success_within
from infogoal_jax.report.statistics import mean_interval
from infogoal_jax.reproduce.files import Result
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.scores import row_of

TITLES = {"none": "DQN", "infobot": "InfoBot", "infogoal": "InfoGoal"}
GROUPS = {"train": TRAINING, "test": TEST}
"""Groups of goals of the figure, and their number in `uses`."""


class Areas(NamedTuple):
    """Areas under the curves of a run, [seeds] each, as shares of the largest: of success while training up to the same
    environment steps, and of success within so many steps."""

    efficiency: np.ndarray
    optimality: np.ndarray


def compared(results: Results) -> dict[str, Result]:
    """The runs of the figure that there are, by title."""
    found = {}
    for explorer in (None, "sse_db"):
        for method, title in TITLES.items():
            row = row_of(results, "paper", "object_search", method, explorer=explorer)
            first = row and next((result for result in row.results if result.run.goal_set == 0), None)
            if first:
                found[title + (" + SSE-DB" if explorer else "")] = first
    return found


def within(result: Result, group: str) -> np.ndarray:
    """Success within 0, 1, ... steps on a group of goals, [seeds, T + 1]."""
    mask = result.arrays["uses"] == GROUPS[group]
    return success_within(result.arrays["first_reached"], mask, result.about["episode_length"])


def areas(result: Result, group: str, evaluations: int) -> Areas:
    """The areas under the curves of a group of goals, over the first so many evaluations."""
    curve = result.evaluations[f"{group}_goal/success_rate"][:, :evaluations]
    return Areas(curve.mean(1), within(result, group).mean(1))


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
