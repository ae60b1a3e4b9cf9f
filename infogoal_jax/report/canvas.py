"""What all figures share: a canvas without a display, the line that says what was drawn, colours, and curves with their
intervals.

Figures are made as objects and never through pyplot, so that drawing changes no state of the user's and needs no
screen.
"""

import dataclasses
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from infogoal_jax import presets
from infogoal_jax.report.runs import Run
from infogoal_jax.report.statistics import mean_interval
from infogoal_jax.report.tables import Table
from infogoal_jax.runs import disk
from infogoal_jax.train.program import Train

DOTS_PER_INCH = 130
LETTERS_PER_INCH = 17
"""Of the small print."""
# Okabe and Ito's colours, which colour-blind readers can tell apart.
ROOM_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#7A6A00", "#555555")
USE_COLOURS = {"train": "#0072B2", "validation": "#009E73", "test": "#D55E00"}
USE_TITLES = {"train": "training goals", "validation": "validation goals", "test": "test goals", "other": "other goals"}
USE_MARKERS = {"train": ("o", 90), "validation": ("D", 60), "test": ("*", 190), "other": ("s", 70)}
"""Marker of a goal by its use, and its area; other goals are never commanded nor evaluated."""
SUCCESS, FAILURE, NOTHING = "#1A9641", "#D7191C", "#DDDDDD"


@dataclasses.dataclass(frozen=True)
class Subject:
    """What the figures of a run are about. The tables leave out the seeds that diverged; params: of one seed, None if
    the run holds none yet."""

    run: Run
    train: Train
    epochs: Table
    evaluations: Table
    diverged: dict[int, int]
    params: Any
    params_seed: int


def room_colour(region: int) -> str:
    """The colour of a room."""
    return ROOM_COLOURS[region % len(ROOM_COLOURS)]


def write_room(axes: Axes, positions: np.ndarray, region: int, name: str, zorder: float) -> None:
    """Write the name of a room in its colour, in the middle of these positions [M, 2]."""
    axes.text(
        *np.median(positions, axis=0),
        name,
        color=room_colour(region),
        fontsize=8,
        weight="bold",
        ha="center",
        va="center",
        zorder=zorder,
        path_effects=[withStroke(linewidth=3, foreground="white")],
    )


def in_words(name: str, longest: int = 44) -> str:
    """The name of a goal for people, cut where it is too long."""
    words = name.replace("_", " ")
    return words if len(words) <= longest else words[: longest - 3].rstrip() + "..."


def empty_figure(title: str, below: tuple[str, ...], size: tuple[float, float]) -> Figure:
    """An empty figure (size in inches) with a line above and small print below, broken where it is wider than the
    figure."""
    below = "\n".join(textwrap.fill(line, round(LETTERS_PER_INCH * size[0])) for line in below)
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12)
    figure.supxlabel(below, fontsize=8, color="#444444")
    return figure


def new_figure(subject: Subject, title: str, size: tuple[float, float], shown: str = "") -> Figure:
    """An empty figure (size in inches) that says what it shows: task, method and title above, seeds and data below.
    shown: instead of the seeds."""
    config, count = subject.run.config, len(subject.evaluations.seeds)
    seeds = shown or ("1 seed" if count == 1 else f"mean of {count} seeds with 95 % interval, each seed a thin line")
    left_out = "".join(
        f"; seed {seed} diverged at epoch {epoch} and is left out" for seed, epoch in subject.diverged.items()
    )
    below = (f"{seeds}{left_out}", f"data: {subject.run.data}")
    return empty_figure(f"{config.task.replace('_', ' ')}, {presets.name_of(config)}: {title}", below, size)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG. Raises `UserError` if the disk refuses."""
    disk.make_folder(path.parent)
    disk.write_atomically(path, lambda file: figure.savefig(file, format="png", dpi=DOTS_PER_INCH, facecolor="white"))


def draw_curve(axes: Axes, x: np.ndarray, values: np.ndarray, colour: str, label: str) -> None:
    """Mean over seeds with its 95 % band, and every seed as a thin line: x [T], values [seeds, T]."""
    interval = mean_interval(values)
    # A run of one evaluation has points, but no lines.
    axes.plot(x, interval.mean, color=colour, linewidth=2, label=label, marker="o" if len(x) == 1 else None)
    if interval.count > 1:
        axes.fill_between(x, interval.low, interval.high, color=colour, alpha=0.18, linewidth=0)
        axes.plot(x, values.T, color=colour, linewidth=0.6, alpha=0.5)


def finish_share_axis(axes: Axes, label: str) -> None:
    """A vertical axis for a share from 0 to 1, with a grid."""
    axes.set_ylim(-0.02, 1.02)
    axes.set_ylabel(label)
    axes.grid(alpha=0.3, linewidth=0.6)
