"""Several runs of one task in one figure: success while training, and as a function of the allowed episode length
(paper, Fig. 8); or any metrics of their tables while training."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from infogoal_jax import checks, presets
from infogoal_jax.errors import counted, require, require_known
from infogoal_jax.loading import load_environment, traits_declared
from infogoal_jax.report.canvas import (
    ANY,
    NOT_NEGATIVE,
    ROOM_COLOURS,
    SHARE,
    USE_TITLES,
    check_format,
    curves_in_words,
    draw_curve,
    empty_figure,
    figure_style,
    finish_share_axis,
    save,
)
from infogoal_jax.report.figures import finish_length_axis, finish_progress_axis, success_within
from infogoal_jax.report.runs import Run, RunTable, diverged_seeds, evaluated_masks, load_run, table_of
from infogoal_jax.runs.configuration import DATA
from infogoal_jax.runs.folder import PREFIX

COLOURS = (*ROOM_COLOURS, "#000000", "#F0E442", "#882255", "#44AA99")
"""One a run: Okabe and Ito's, then Tol's. More runs, such as the settings of a sweep, have those of a map in order."""
ENTRY, LETTER = 0.25, 0.085
"""Inches that a line of the legend is high, and one of its letters wide."""
BOUNDS = {
    SHARE: ("success_rate", "spl", "accuracy", "nothing_achieved", "valid"),
    NOT_NEGATIVE: ("episode_length", "beta", "kl", "td_error", "gradient_norm", "env_steps"),
}
"""What metrics can be at least and at most, by the last part of their names; others can be anything."""
LOW_LEVEL = "; low level, content "
"""Where the words of the data end in which the low level of an agent is described: agents may differ."""


class Compared(NamedTuple):
    """A run, its tables without the seeds that diverged, and those seeds with the epoch. label: what the legend calls
    it; empty: by `titles_of`."""

    run: Run
    evaluations: RunTable
    epochs: RunTable
    diverged: dict[int, int]
    label: str = ""

    @property
    def is_drawn(self) -> bool:
        """Whether a seed did not diverge."""
        return bool(self.evaluations.seeds)


def draw_comparison(
    folders: list[Path],
    path: Path,
    env: Any = None,
    metrics: tuple[str, ...] = (),
    captions: bool = False,
    style: str = "",
    labels: tuple[str, ...] = (),
) -> Path:
    """Draw the runs in these folders as one figure; its path, whose ending names the format.

    env: the environment of the task if it is loaded already; metrics: names of the tables' columns, a panel each; none:
    success while training and by length, or the loss where nobody can act in the task; captions and style: see
    `figures.draw_figures`; labels: what the legend calls each run; none: `titles_of` them.
    A run whose seeds all diverged is named, and left out.
    Raises `UserError` for runs of different tasks, labels that are not one for each run and each of its own, a folder
    without a run or without numbers, no run with a seed that did not diverge, a metric that no run has, or a disk that
    refuses.
    """
    remedy = "give a list of folders of runs"
    require(isinstance(folders, list | tuple), "runs", folders, remedy)
    for folder in folders:
        checks.path(folder, "runs", remedy)
    named = isinstance(metrics, list | tuple) and all(isinstance(metric, str) for metric in metrics)
    require(named, "metrics", metrics, "give a tuple of names of columns")
    captions = checks.flag(captions, "captions")
    path = Path(checks.path(path, "path", "give the file to draw to"))
    check_format(path)
    given = tuple(map(str, folders))
    require(len(given) > 0, "runs", given, "give at least one folder of a run")
    require(len(labels) in (0, len(given)), "labels", labels, f"give {len(given)}, one for each run")
    require(len(set(labels)) == len(labels), "labels", labels, "give each run a label of its own")
    names = labels or ("",) * len(given)
    with figure_style(style):  # One that cannot be read is named before any data is loaded.
        compared = [read_compared(folder)._replace(label=label) for folder, label in zip(folders, names, strict=True)]
        check_same_task([each.run for each in compared])
        require(any(each.is_drawn for each in compared), "runs", given, "every seed of each diverged; give others")
        for metric in metrics:
            check_metric(metric, compared)
        env = load_environment(compared[0].run.config, env)
        metrics = metrics if metrics or env.simulated else ("agent/loss",)
        save(metrics_while_training(compared, metrics, env) if metrics else comparison(compared, env), path, captions)
    return path


def read_compared(folder: Path) -> Compared:
    """The run in this folder. Raises `UserError` if it has no evaluation yet."""
    run = load_run(folder)
    folder = run.folder
    diverged = diverged_seeds(folder)
    evaluations = table_of(folder, "evaluations", diverged)
    require(len(evaluations.epochs) > 0, "run", run.name, "has no evaluation yet; leave it out")
    return Compared(run, evaluations, table_of(folder, "epochs", diverged), diverged)


def table_with(metric: str, each: Compared) -> RunTable | None:
    """The table of a run that has this metric; None if neither has."""
    return next((table for table in (each.evaluations, each.epochs) if metric in table.values), None)


def check_metric(metric: str, compared: list[Compared]) -> None:
    """Raise `UserError` unless at least one run has this metric, with one number a row."""
    columns = {
        name
        for each in compared
        for table in (each.evaluations, each.epochs)
        for name, values in table.values.items()
        if values.ndim == 2
    }
    require_known("metric", metric, sorted(columns), "no run has it")


def check_same_task(runs: list[Run]) -> None:
    """Raise `UserError` unless all runs are of one task, on the same data and of the same settings. Where the data lie
    may differ: what they are has a checksum."""
    first = runs[0]
    for run in runs[1:]:
        require(
            run.config.task == first.config.task,
            "run",
            run.name,
            f"is of task {run.config.task}, and {first.name} of {first.config.task}; give runs of one task",
        )
        for name in [field.name for field in dataclasses.fields(first.config.env) if field.name not in DATA]:
            own, other = (getattr(each.config.env, name) for each in (run, first))
            require(
                own == other,
                "run",
                run.name,
                f"has env.{name} = {own!r}, and {first.name} {other!r}; give runs of the same settings of the task",
            )
        own, other = (each.data.partition(LOW_LEVEL)[0] for each in (run, first))
        remedy = f"has data = {own!r}, and {first.name} {other!r}; give runs on the same data"
        require(own == other, "run", run.name, remedy)


def titles_of(runs: list[Run]) -> list[str]:
    """The names of the runs' methods, behind those of their agents where these differ; where two are of the same, with
    the end of the path of the folder or the file that tells them apart, or with the name of a shipped policy."""
    names = [presets.method_title(run.config) for run in runs]
    agents = [presets.names_of(run.config)["agent"] for run in runs]
    if len(set(agents)) > 1:
        names = [f"{agent}, {name}" for agent, name in zip(agents, names, strict=True)]
    places = [(run.name,) if run.name.startswith(PREFIX) else Path(os.path.abspath(run.name)).parts for run in runs]
    titles = []
    for name, place in zip(names, places, strict=True):
        others = [other for known, other in zip(names, places, strict=True) if known == name and other != place]
        titles.append(name if names.count(name) == 1 else f"{name} ({shortest_end(place, others)})")
    return titles


def legend_titles(compared: list[Compared]) -> list[str]:
    """What the legend calls each run: its label, or the title that the run has among the others."""
    titles = titles_of([each.run for each in compared])
    return [each.label or title for each, title in zip(compared, titles, strict=True)]


def shortest_end(place: tuple[str, ...], others: list[tuple[str, ...]]) -> str:
    """As few of the last parts of a path as no other path ends in."""
    ends = (place[-count:] for count in range(1, len(place)))
    return str(Path(*next((end for end in ends if all(other[-len(end) :] != end for other in others)), place)))


def small_print(compared: list[Compared], titles: list[str], *more: str) -> tuple[str, ...]:
    """What stands below the figure: seeds, what is left out, and the data."""
    left_out = []
    for title, each in zip(titles, compared, strict=True):
        seeds = [f"seed {seed} diverged at epoch {epoch} and" for seed, epoch in each.diverged.items()]
        whole = ["every seed diverged, and it"]
        left_out += [f"{title}: {words} is left out" for words in (seeds if each.is_drawn else whole)]
    seeds = curves_in_words([len(each.evaluations.seeds) for each in compared if each.is_drawn])
    data = "; ".join(dict.fromkeys(each.run.data for each in compared))
    return "; ".join((seeds, *left_out, *more)), f"data: {data}"


def entry_of(title: str, table: RunTable) -> str:
    """A run in the legend."""
    return f"{title}, {counted(len(table.seeds), 'seed')}"


class Curve(NamedTuple):
    """A run that is drawn."""

    run: Compared
    title: str
    colour: str


def curves_of(compared: list[Compared], titles: list[str]) -> list[Curve]:
    """The runs that are drawn."""
    count = len(compared)
    colours = COLOURS if count <= len(COLOURS) else map(to_hex, colormaps["turbo"](np.linspace(0, 1, count)))
    curves = map(Curve, compared, titles, colours)
    return [curve for curve in curves if curve.run.is_drawn]


def canvas_of(heading: str, below: tuple[str, ...], panels: tuple[int, int], drawn: list[Curve]) -> Figure:
    """An empty figure with room for so many rows and columns of panels, and for a legend of these curves beside
    them."""
    rows, across = panels
    longest = max(len(entry_of(title, run.evaluations)) for run, title, _ in drawn)
    size = 4.5 * across + 0.6 + LETTER * longest, 1.4 + max(3.2 * rows, ENTRY * len(drawn))
    return empty_figure(heading, below, size)


def shared_progress(compared: list[Compared], env) -> tuple[Callable[[Compared, RunTable], np.ndarray], str]:
    """(run, one of its tables [E]) -> how far its training was [E], and in what all runs count: environment steps, or
    updates where one of them learns offline and takes no steps."""
    declared = [traits_declared(each.run.config) for each in compared]
    if any(env.recorded is not None if traits is None else traits.recorded for traits in declared):
        return lambda each, table: table.epochs * each.run.config.updates_per_epoch, "updates"
    return lambda each, table: table.values["env_steps"].mean(0), "environment steps"


def metrics_while_training(compared: list[Compared], metrics: tuple[str, ...], env) -> Figure:
    """These metrics against progress of training, a panel each with a curve for every run that has it."""
    titles, (steps_of, label) = legend_titles(compared), shared_progress(compared, env)
    drawn = curves_of(compared, titles)
    without = [
        f"{title} has no {metric}" for metric in metrics for each, title, _ in drawn if table_with(metric, each) is None
    ]
    heading = f"{compared[0].run.config.task.replace('_', ' ')}: {', '.join(metrics)} while training"
    across = min(2, len(metrics))
    rows = -(-len(metrics) // across)
    figure = canvas_of(heading, small_print(compared, titles, *without), (rows, across), drawn)
    grid = figure.subplots(rows, across, squeeze=False).ravel()
    handles = {}
    for axes, metric in zip(grid, metrics, strict=False):
        bounds = next((bounds for bounds, names in BOUNDS.items() if metric.split("/")[-1] in names), ANY)
        ends = []
        for each, title, colour in drawn:
            if (table := table_with(metric, each)) is not None:
                steps = steps_of(each, table)
                ends.append(steps[-1])
                draw_curve(axes, steps, table.values[metric], colour, entry_of(title, table), bounds)
        if bounds == SHARE:
            finish_share_axis(axes, metric)
        else:
            axes.set_ylabel(metric)
            axes.grid()
        finish_progress_axis(axes, label, max(ends))
        handles |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    for axes in grid[len(metrics) :]:
        axes.set_visible(False)
    figure.legend(handles.values(), handles.keys(), loc="outside right center")
    return figure


def comparison(compared: list[Compared], env) -> Figure:
    """Success against progress of training, beside success within so many steps at the last evaluation; training goals
    above test goals."""
    titles, (steps_of, label) = legend_titles(compared), shared_progress(compared, env)
    drawn = curves_of(compared, titles)
    groups = {group: mask for group, mask in evaluated_masks(env.goals).items() if group != "validation"}
    task = compared[0].run.config.task.replace("_", " ")
    heading = f"{task}: success while training, and by length at the last evaluation"
    figure = canvas_of(heading, small_print(compared, titles), (len(groups), 2), drawn)
    for (left, right), group in zip(figure.subplots(len(groups), 2, squeeze=False), groups, strict=True):
        ends = []
        for each, title, colour in drawn:
            evaluations, entry = each.evaluations, entry_of(title, each.evaluations)
            steps = steps_of(each, evaluations)
            ends.append(steps[-1])
            draw_curve(left, steps, evaluations.values[f"{group}_goal/success_rate"], colour, entry, SHARE)
            within = success_within(evaluations.last()["first_reached"], groups[group], env.episode_length)
            draw_curve(right, np.arange(env.episode_length + 1), within, colour, entry, SHARE)
        finish_progress_axis(left, label, max(ends))
        finish_length_axis(right, env.episode_length)
        for axes, label_of_share in ((left, "success rate"), (right, "reached by then")):
            finish_share_axis(axes, f"{label_of_share}, {USE_TITLES[group]}")
    figure.legend(*figure.axes[1].get_legend_handles_labels(), loc="outside right center")
    return figure
