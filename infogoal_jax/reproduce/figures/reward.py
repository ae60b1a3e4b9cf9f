"""Fig. 12: the intrinsic reward over the states of object search and of the shelf, for training goals."""

import numpy as np
from matplotlib.figure import Figure

from infogoal_jax.report.canvas import empty_figure
from infogoal_jax.reproduce.figures.codes import PATHS_IN_WORDS, height_of_places, picture_of, trajectory_panel
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.scores import TITLES

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
