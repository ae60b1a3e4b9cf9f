"""Goal codes as points of a plane: means of the Gaussians, and samples of them, on the principal axes of the means
(paper, Figs. 9 to 11)."""

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from infogoal_jax.goals import GoalSet
from infogoal_jax.learners.learner import GoalCode
from infogoal_jax.report.canvas import USE_MARKERS, USE_TITLES, Subject, new_figure, room_colour
from infogoal_jax.runner.compilation import jit

CODE_SAMPLES = 60  # Drawn from the Gaussian of each goal.


def principal_components(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre [d], the first two principal axes [2, d] and their shares of the variance [2] of points [n, d]. Where
    there is no second axis, as of codes of one number, it is 0."""
    centre = points.mean(0)
    _, scales, axes = np.linalg.svd(points - centre, full_matrices=False)
    shares = scales**2 / max((scales**2).sum(), np.finfo(float).tiny)
    lacking = max(2 - len(axes), 0)
    return centre, np.pad(axes[:2], ((0, lacking), (0, 0))), np.pad(shares[:2], (0, lacking))


def finish_code_axes(axes: Axes, shares: np.ndarray) -> None:
    """Label a plane of codes with the axes' shares of the variance."""
    # One unit is as long on both axes: an axis of little variance shall look like one.
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"first principal axis ({shares[0]:.0%} of the variance of the means)")
    axes.set_ylabel(f"second principal axis ({shares[1]:.0%})")


def draw_codes(
    axes: Axes,
    code: GoalCode,
    goals: GoalSet,
    which: np.ndarray,
    centre: np.ndarray,
    directions: np.ndarray,
    size: float = 1.0,
    num_samples: int = CODE_SAMPLES,
) -> None:
    """Codes [n, d] of the goals `which` [n], coloured by region: faded samples, means over them. size: of the
    markers; num_samples: of each code."""
    regions = np.asarray(goals.regions)[which]
    if code.std is not None:
        noise = np.random.default_rng(0).normal(size=(num_samples, *code.mean.shape))
        samples = (code.mean + code.std * noise - centre) @ directions.T
        for goal, region in enumerate(regions):
            axes.scatter(
                *samples[:, goal].T, s=5 * size, color=room_colour(region), alpha=0.18, linewidths=0, rasterized=True
            )
    means = (code.mean - centre) @ directions.T
    masks = {group: np.asarray(getattr(goals, f"{group}_mask"))[which] for group in goals.groups}
    masks["other"] = ~np.any(list(masks.values()), axis=0)
    for group, mask in masks.items():
        marker, area = USE_MARKERS[group]
        colours = [room_colour(region) for region in regions[mask]]
        axes.scatter(
            *means[mask].T,
            marker=marker,
            s=area * size,
            c=colours,
            edgecolors="black",
            linewidths=0.8 * size**0.5,
            zorder=3,
        )
    axes.grid()


def code_legend(
    goals: GoalSet, groups: tuple[str, ...], random_code: bool, titles: dict[str, str] | None = None
) -> list[Line2D]:
    """What the marks of `draw_codes` mean. random_code: whether there are samples. titles: of a goal of each group, or
    those of the canvas."""
    titles = titles or {group: title.removesuffix("s") for group, title in USE_TITLES.items()}
    entries = [
        Line2D([], [], linestyle="", marker="s", color=room_colour(index), label=name)
        for index, name in enumerate(goals.region_names)
    ]
    for group in groups:
        marker, area = USE_MARKERS[group]
        outline = {"linestyle": "", "markersize": area**0.5, "markerfacecolor": "white", "markeredgecolor": "black"}
        entries.append(Line2D([], [], marker=marker, label=f"mean, {titles[group]}", **outline))
    if random_code:
        entries.append(Line2D([], [], linestyle="", marker=".", color="#888888", label="samples of a code"))
    return entries


def codes_of(subject: Subject, which: np.ndarray) -> GoalCode:
    """The codes [n, d] of the goals `which` int [n] by the goal encoder of one seed."""
    encode = jit(lambda params, goals: subject.train.parts.learner.encode(params, goals.inputs_of(which)))
    return jax.device_get(encode(subject.params["goal"], subject.train.env.goals))


def representations(subject: Subject) -> Figure | None:
    """Codes of the evaluated goals of one seed on the principal axes of their means, coloured by room or region (paper,
    Fig. 10)."""
    goals = subject.train.env.goals
    which = np.asarray(goals.evaluated)
    if subject.params is None or len(which) < 3:
        return None
    code = codes_of(subject, which)
    centre, directions, shares = principal_components(code.mean)
    figure = new_figure(subject, "goal representations", (9.5, 6), shown=f"seed {subject.params_seed}, last parameters")
    axes = figure.subplots()
    draw_codes(axes, code, goals, which, centre, directions)
    axes.legend(
        handles=code_legend(goals, goals.groups, code.std is not None), loc="center left", bbox_to_anchor=(1.0, 0.5)
    )
    finish_code_axes(axes, shares)
    return figure
