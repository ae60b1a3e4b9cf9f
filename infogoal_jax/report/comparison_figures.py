"""Several runs of one task in one figure (paper, Fig. 8): success while training, and as a function of the allowed
episode length."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from infogoal_jax import presets
from infogoal_jax.errors import require
from infogoal_jax.report import tables
from infogoal_jax.report.canvas import ROOM_COLOURS, USE_TITLES, draw_curve, empty_figure, finish_share_axis, save
from infogoal_jax.report.figures import (
    evaluated_mask,
    finish_length_axis,
    finish_progress_axis,
    progress,
    success_within,
)
from infogoal_jax.report.runs import Run, load_run
from infogoal_jax.train.parts import load_environment

COLOURS = (*ROOM_COLOURS, "#000000", "#F0E442", "#882255", "#44AA99")
"""One a run: Okabe and Ito's, then Tol's."""


class Compared(NamedTuple):
    """A run, its evaluations without the seeds that diverged, and those seeds with the epoch."""

    run: Run
    evaluations: tables.Table
    diverged: dict[int, int]


def draw_comparison(folders: list[Path], path: Path, env: Any = None) -> Path:
    """Draw the runs in these folders as one figure into a PNG; its path. env: the environment of the task if it is
    loaded already.

    Raises `UserError` for runs of different tasks, a folder without a run or without numbers, or a disk that refuses.
    """
    require(path.suffix == ".png", "out", str(path), "give a file that ends in .png")
    require(0 < len(folders) <= len(COLOURS), "run", len(folders), f"give 1 to {len(COLOURS)} folders of runs")
    compared = [read_compared(folder) for folder in folders]
    check_same_task([each.run for each in compared])
    save(comparison(compared, load_environment(compared[0].run.config, env)), path)
    return path


def read_compared(folder: Path) -> Compared:
    """The run in this folder. Raises `UserError` if it has no evaluation of a seed that did not diverge."""
    run, diverged = load_run(folder), tables.diverged_seeds(folder)
    evaluations = tables.read(folder, "evaluations", diverged)
    require(
        bool(evaluations.values), "run", str(folder), "has no evaluation of a seed that did not diverge; leave it out"
    )
    return Compared(run, evaluations, diverged)


def check_same_task(runs: list[Run]) -> None:
    """Raise `UserError` unless all runs are of one task, on the same data and of the same settings."""
    first = runs[0]
    for run in runs[1:]:
        require(
            run.config.task == first.config.task,
            "run",
            str(run.folder),
            f"is of task {run.config.task}, and {first.folder} of {first.config.task}; give runs of one task",
        )
        for field in dataclasses.fields(first.config.env):
            own, other = (getattr(each.config.env, field.name) for each in (run, first))
            require(
                own == other,
                "run",
                str(run.folder),
                f"has env.{field.name} = {own!r}, and {first.folder} {other!r}; give runs of the same settings of the "
                "task",
            )


def titles_of(runs: list[Run]) -> list[str]:
    """The names of the runs' methods; with the folder's name where two are of the same."""
    names = [presets.name_of(run.config) for run in runs]
    return [
        name if names.count(name) == 1 else f"{name} ({run.folder.name})" for name, run in zip(names, runs, strict=True)
    ]


def comparison(compared: list[Compared], env) -> Figure:
    """Success against progress of training, beside success within so many steps at the last evaluation; training goals
    above test goals."""
    runs, titles = [each.run for each in compared], titles_of([each.run for each in compared])
    groups = [group for group in env.goals.groups if group != "validation"]
    left_out = [
        f"; {title}: seed {seed} diverged at epoch {epoch} and is left out"
        for title, each in zip(titles, compared, strict=True)
        for seed, epoch in each.diverged.items()
    ]
    seeds = "mean over seeds with 95 % interval, each seed a thin line" + "".join(left_out)
    data = "; ".join(dict.fromkeys(run.data for run in runs))
    heading = f"{runs[0].config.task.replace('_', ' ')}: success while training, and by length at the last evaluation"
    figure = empty_figure(heading, (seeds, f"data: {data}"), (11, 1.4 + 3.2 * len(groups)))
    for (left, right), group in zip(figure.subplots(len(groups), 2, squeeze=False), groups, strict=True):
        labels, ends = {}, []
        for each, title, colour in zip(compared, titles, COLOURS, strict=False):
            evaluations, count = each.evaluations, len(each.evaluations.seeds)
            steps, label = progress(each.run.config, evaluations, env)
            labels[label] = None
            ends.append(steps[-1])
            entry = f"{title}, {count} seed{'s' if count > 1 else ''}"
            draw_curve(left, steps, evaluations.values[f"{group}_goal/success_rate"], colour, entry)
            within = success_within(
                evaluations.last()["first_reached"], evaluated_mask(env.goals, group), env.episode_length
            )
            draw_curve(right, np.arange(env.episode_length + 1), within, colour, entry)
        finish_progress_axis(left, " or ".join(labels), max(ends))
        finish_length_axis(right, env.episode_length)
        for axes in (left, right):
            finish_share_axis(axes, f"success rate, {USE_TITLES[group]}")
    figure.axes[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
