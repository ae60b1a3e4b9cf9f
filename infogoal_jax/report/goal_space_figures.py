"""Figures over a continuous goal space: success at the goals that an evaluation asks for as a map, with the regions
that are held out of training, and the codes of these goals."""

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from infogoal_jax.errors import counted
from infogoal_jax.goal_uses import USES
from infogoal_jax.goals import GoalBox
from infogoal_jax.report.canvas import (
    USE_COLOURS,
    USE_MARKERS,
    USE_TITLES,
    Subject,
    finish_share_axis,
    new_figure,
    white_mark,
)
from infogoal_jax.report.codes import codes_of, finish_code_axes, principal_components
from infogoal_jax.report.runs import evaluated_masks

CELLS = 8
"""Of the map, along each axis."""
PIXELS = 96
"""Along each axis, at which the held-out regions are looked for."""
OTHERS = 16
"""Values of the axes that the map does not show, at which a region is looked for."""
COLOURS = "cividis"


def success_over_goals(subject: Subject) -> Figure:
    """Success rate of every evaluated goal at the last evaluation, over the two axes along which goals vary most: cells
    have the mean of their goals, and held-out regions an outline. With one axis, success against it."""
    env = subject.train.env
    space, goals = env.goals, np.asarray(env.goals.evaluated)
    first_reached = subject.evaluations.last()["first_reached"]
    success = (first_reached <= env.episode_length).mean((0, -1))
    count, num_starts = len(first_reached), first_reached.shape[-1]
    shown = f"{counted(num_starts, 'start')} a goal; {'1 seed' if count == 1 else f'mean of {count} seeds'}"
    shown += "" if env.ends_at_goal else "; reached at any time"
    title = f"success over the goal space, epoch {subject.evaluations.epochs[-1]}"
    figure = new_figure(subject, title, (9.5, 6), shown=shown)
    axes = figure.subplots()
    across = np.sort(np.argsort(-goals.std(0), kind="stable")[:2])
    axes.set_xlabel(f"goal[{across[0]}]")
    groups = evaluated_masks(space)
    if len(across) == 1:
        for group, mask in groups.items():
            marker, area = USE_MARKERS[group]
            axes.scatter(goals[mask, 0], success[mask], s=area / 2, marker=marker, color=USE_COLOURS[group])
        finish_share_axis(axes, "success rate")
    else:
        axes.set_ylabel(f"goal[{across[1]}]")
        low, high = corners_of(space, across)
        scale = Normalize(0, 1)
        sums, counts = (
            np.histogram2d(*goals[:, across].T, CELLS, list(zip(low, high, strict=True)), weights=weights)[0].T
            for weights in (success, None)
        )
        mean = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
        extent = (low[0], high[0], low[1], high[1])
        axes.imshow(mean, extent=extent, origin="lower", cmap=COLOURS, norm=scale, alpha=0.45, aspect="equal")
        for group, mask in groups.items():
            marker, area = USE_MARKERS[group]
            points = goals[mask][:, across]
            drawn = axes.scatter(
                *points.T,
                s=area,
                marker=marker,
                c=success[mask],
                cmap=COLOURS,
                norm=scale,
                edgecolors="black",
                clip_on=False,
            )
        outline(axes, space, across, low, high)
        figure.colorbar(drawn, ax=axes, label="success rate", location="left", shrink=0.8)
        axes.grid(visible=False)
    axes.legend(handles=legend(space), loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def corners_of(space: GoalBox, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest corner [2] of what the map shows: a little more than the evaluated goals, and no more than
    the goal space."""
    goals, low, high = (np.asarray(each)[..., axes] for each in (space.evaluated, space.low, space.high))
    margin = 0.06 * (goals.max(0) - goals.min(0)) + 1e-6
    return np.maximum(goals.min(0) - margin, low), np.minimum(goals.max(0) + margin, high)


def outline(axes: Axes, space: GoalBox, across: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """Draw a line around the places [2] at which some goal is held out, whatever its other numbers."""
    if space.use_of is None:
        return
    x, y = (np.linspace(*ends, PIXELS, dtype=np.float32) for ends in zip(low, high, strict=True))
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 1, 2)
    others = np.asarray(space.evaluated)[:: -(-len(space.evaluated) // OTHERS)]
    goals = np.tile(others, (len(places), 1, 1))
    goals[..., across] = places
    uses = np.asarray(jax.jit(jax.vmap(space.use))(goals.reshape(-1, goals.shape[-1]))).reshape(PIXELS, PIXELS, -1)
    for group in space.groups[1:]:
        held_out = (uses == USES.index(group)).any(-1)
        if held_out.any() and not held_out.all():
            axes.contour(x, y, held_out.astype(float), levels=[0.5], colors=USE_COLOURS[group], linewidths=2)


def legend(space: GoalBox) -> list[Line2D]:
    """What markers and lines of the map mean."""
    marks = [white_mark(USE_MARKERS[group][0], USE_TITLES[group].removesuffix("s"), 9) for group in space.groups]
    regions = [
        Line2D([], [], color=USE_COLOURS[group], linewidth=2, label=f"region of {USE_TITLES[group]}")
        for group in space.groups[1:]
    ]
    return marks + regions


def codes_over_goals(subject: Subject) -> Figure | None:
    """Mean codes of the evaluated goals of one seed on their principal axes, coloured by the use of the goal. None
    without parameters, and for codes of one number."""
    space = subject.train.env.goals
    if subject.params is None or len(space.evaluated) < 3:
        return None
    mean = codes_of(subject, np.asarray(space.evaluated)).mean
    if mean.shape[-1] < 2:
        return None
    centre, directions, shares = principal_components(mean)
    figure = new_figure(subject, "goal representations", (9.5, 6), shown=f"seed {subject.params_seed}, last parameters")
    axes = figure.subplots()
    for group, mask in evaluated_masks(space).items():
        marker, area = USE_MARKERS[group]
        points = ((mean - centre) @ directions.T)[mask]
        axes.scatter(
            *points.T, marker=marker, s=area, color=USE_COLOURS[group], edgecolors="black", label=USE_TITLES[group]
        )
    axes.grid()
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    finish_code_axes(axes, shares)
    return figure
