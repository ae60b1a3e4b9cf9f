"""What all figures share: a canvas without a display, their style, the line that says what was drawn, colours, and
curves with their intervals.

Figures are made as objects and never through pyplot, so that drawing changes no state of the user's and needs no
screen.
"""

import dataclasses
import os
import re
import sys
import textwrap
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from infogoal_jax import presets
from infogoal_jax.errors import UserError, counted_each, require
from infogoal_jax.files import regular
from infogoal_jax.report.runs import Run, RunTable
from infogoal_jax.report.statistics import mean_interval
from infogoal_jax.runs import disk
from infogoal_jax.train.program import Train

FORMATS = ("png", "pdf", "svg")
STYLE = Path(__file__).with_name("figures.mplstyle")
"""Of all figures: a style sheet of matplotlib."""
FEWEST_SEEDS = 3
"""For an interval: with two seeds, Student's t makes it thirteen standard errors wide."""
ANY, NOT_NEGATIVE, SHARE = (-np.inf, np.inf), (0.0, np.inf), (0.0, 1.0)
"""What a metric can be at least and at most."""
MISSING = re.compile(r"Glyph (\d+)")
"""What matplotlib says of a letter that the font does not have."""
LETTERS_PER_INCH = 17
"""Of the small print."""
# Okabe and Ito's colours, which colour-blind readers can tell apart.
ROOM_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#7A6A00", "#555555")
USE_COLOURS = {"train": "#0072B2", "validation": "#009E73", "test": "#D55E00"}
USE_TITLES = {"train": "training goals", "validation": "validation goals", "test": "test goals", "other": "other goals"}
USE_MARKERS = {"train": ("o", 90), "validation": ("D", 60), "test": ("*", 190), "other": ("s", 70)}
"""Marker of a goal by its use, and its area; other goals are never desired nor evaluated."""
SUCCESS, FAILURE, NOTHING = "#1A9641", "#D7191C", "#DDDDDD"


@dataclasses.dataclass(frozen=True)
class Subject:
    """What the figures of a run are about. The tables leave out the seeds that diverged; params: of one seed, None if
    the run holds none yet."""

    run: Run
    train: Train
    epochs: RunTable
    evaluations: RunTable
    diverged: dict[int, int]
    params: Any
    params_seed: int


@contextmanager
def figure_style(own: str | Path = "") -> Iterator[None]:
    """Draw and write figures in the style of `figures.mplstyle`, and of a style sheet of one's own after it. Raises
    `UserError` where that cannot be read."""
    try:
        if own and os.path.exists(own):
            regular(own)  # A pipe would be waited for.
        with matplotlib.style.context([STYLE, *([own] if own else [])]):
            yield
    except UnicodeDecodeError as error:
        raise UserError(f"style = {str(own)!r}: is no text; give a style sheet of matplotlib") from error
    except OSError as error:
        if own and str(own) in str(error):
            raise UserError(f"style = {str(own)!r}: give a style sheet of matplotlib, or the name of one") from error
        raise


def check_format(path: Path) -> None:
    """Raise `UserError` unless the file's ending is one that figures can be written in."""
    endings = [f".{name}" for name in FORMATS]
    require(path.suffix in endings, "out", str(path), f"give a file that ends in {', '.join(endings)}")
    disk.check_out(path)


def room_colour(region: int) -> str:
    """The colour of a room."""
    return ROOM_COLOURS[region % len(ROOM_COLOURS)]


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
    config, seeds = subject.run.config, shown or curves_in_words([len(subject.evaluations.seeds)])
    left_out = "".join(
        f"; seed {seed} diverged at epoch {epoch} and is left out" for seed, epoch in subject.diverged.items()
    )
    below = (f"{seeds}{left_out}", f"data: {subject.run.data}")
    return empty_figure(f"{config.task.replace('_', ' ')}, {presets.method_title(config)}: {title}", below, size)


def curves_in_words(counts: Sequence[int]) -> str:
    """What `draw_curve` draws of curves of so many seeds each, for the small print."""
    number = counted_each(counts, "seed")
    return number if max(counts) == 1 else f"mean of {number}{interval_in_words(counts)}"


def interval_in_words(counts: Sequence[int]) -> str:
    """What `draw_curve` draws beside the means of so many seeds each, for the small print."""
    interval = f" (no interval below {FEWEST_SEEDS} seeds)"
    if max(counts) >= FEWEST_SEEDS:
        interval = " with 95 % interval" + f" from {FEWEST_SEEDS} seeds on" * (min(counts) < FEWEST_SEEDS)
    return f"{interval}, each seed a thin line"


def save(figure: Figure, path: Path, captions: bool = False) -> None:
    """Write a figure, in the format of the path's ending. captions: the line above it and the small print go into
    NAME.caption.txt beside it, and not into the figure. Raises `UserError` if the disk refuses."""
    disk.make_folder(path.parent)
    if captions:
        words = f"{figure.get_suptitle()}\n{figure.get_supxlabel()}\n"
        disk.write_atomically(path.with_suffix(".caption.txt"), lambda file: file.write(words.encode()))
        for text in (figure.suptitle(""), figure.supxlabel("")):
            text.set_in_layout(False)
    with warnings.catch_warnings(record=True) as said:
        warnings.filterwarnings("always", MISSING.pattern)
        disk.write_atomically(path, lambda file: figure.savefig(file, format=path.suffix[1:]))
    found = [(one, MISSING.match(str(one.message))) for one in said]
    for other in (one for one, letter in found if letter is None):
        warnings.warn_explicit(other.message, other.category, other.filename, other.lineno)
    if letters := "".join(sorted({chr(int(letter[1])) for _, letter in found if letter})):
        remedy = "a font.family that has them goes into the style sheet of `--style`"
        print(f"infogoal: {path}: the font has no {letters}, drawn as boxes; {remedy}", file=sys.stderr)


def white_mark(marker: str, label: str, size: float | None = None) -> Line2D:
    """What stands in a legend for a white mark with a black edge, such as a start. size: in points; None: as in the
    style."""
    edge = {"markerfacecolor": "white", "markeredgecolor": "black"}
    return Line2D([], [], linestyle="", marker=marker, markersize=size, label=label, **edge)


def draw_curve(
    axes: Axes, x: np.ndarray, values: np.ndarray, colour: str, label: str, bounds: tuple[float, float] = ANY
) -> None:
    """Mean over seeds and every seed as a thin line, from `FEWEST_SEEDS` on with the mean's 95 % band: x [T], values
    [seeds, T]. bounds: what a value can be at least and at most; the band ends there."""
    interval = mean_interval(values)
    # A run of one evaluation has points, but no lines.
    axes.plot(x, interval.mean, color=colour, linewidth=2, label=label, marker="o" if len(x) == 1 else None)
    if interval.count >= FEWEST_SEEDS:
        low, high = (np.clip(end, *bounds) for end in (interval.low, interval.high))
        axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)
    if interval.count > 1:
        axes.plot(x, values.T, color=colour, linewidth=0.6, alpha=0.5)


def finish_share_axis(axes: Axes, label: str) -> None:
    """A vertical axis for a share from 0 to 1, with a grid."""
    axes.set_ylim(-0.02, 1.02)
    axes.set_ylabel(label)
    axes.grid()
