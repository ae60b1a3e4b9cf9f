"""The figures of a run: learning curves, beta and accuracy (Fig. 13), goal codes, success by length (Fig. 8) and by
goal, or over the goal space. What a task brings besides is found by its name (`task_figures`).
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from infogoal_jax import checks, learners
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import counted, require
from infogoal_jax.report.canvas import (
    FORMATS,
    NOT_NEGATIVE,
    SHARE,
    USE_COLOURS,
    USE_TITLES,
    Subject,
    draw_curve,
    figure_style,
    finish_share_axis,
    in_words,
    new_figure,
    room_colour,
    save,
)
from infogoal_jax.report.codes import representations
from infogoal_jax.report.goal_space_figures import codes_over_goals, success_over_goals
from infogoal_jax.report.runs import RunTable, diverged_seeds, evaluated_masks, load_run, read_params, table_of
from infogoal_jax.report.task_figures import draw_of_task
from infogoal_jax.runner.compilation import compiling_quickly, jit
from infogoal_jax.runs.folder import check_own, remove_abandoned
from infogoal_jax.train.evaluation import draw_starts

MOST_BARS = 60  # Goals up to which every one gets a bar of its own.


def draw_figures(
    folder: Path, env: Any = None, format: str = "png", captions: bool = False, style: str = ""
) -> list[Path]:
    """Draw everything that this run has numbers for under RUN/figures; the paths of the files.

    env: the environment if it is loaded already; format: one of `canvas.FORMATS`; captions: what stands above and below
    a figure goes into a text beside it; style: a style sheet of matplotlib, applied after the package's.
    Raises `UserError` for a folder without a run, a damaged file, or a disk that refuses.
    """
    checks.path(folder, "run", "give the folder of a run")
    known = isinstance(format, str) and format in FORMATS
    require(known, "format", format, f"give one of {', '.join(FORMATS)}")
    captions = checks.flag(captions, "captions")
    with figure_style(style), compiling_quickly():
        subject = read_subject(folder, env)
        return draw_all(subject, subject.run.folder, format, captions)


def draw_all(subject: Subject, folder: Path, format: str, captions: bool) -> list[Path]:
    """Draw everything that there are numbers for, in the present style; the paths of the files."""
    if not subject.evaluations.values:
        return []
    if not subject.train.env.simulated:
        figures = {"beta_and_accuracy": beta_and_accuracy(subject), "representations": codes_over_goals(subject)}
        return save_all(figures, folder, format, captions)
    figures = {draw.__name__: draw(subject) for draw in (learning_curves, beta_and_accuracy, success_by_length)}
    if subject.train.env.goals.finite:
        figures |= {"success_by_goal": success_by_goal(subject), "representations": representations(subject)}
    else:
        figures |= {"success_over_goals": success_over_goals(subject), "representations": codes_over_goals(subject)}
    figures |= draw_of_task(subject)
    return save_all(figures, folder, format, captions)


def save_all(figures: dict[str, Figure | None], folder: Path, format: str, captions: bool) -> list[Path]:
    """Write the figures that there are, by their names; the paths of the files."""
    check_own(folder, ["figures"])
    remove_abandoned(folder)
    drawn = {name: figure for name, figure in figures.items() if figure is not None}
    paths = {folder / "figures" / f"{name}.{format}": figure for name, figure in drawn.items()}
    for path, figure in paths.items():
        save(figure, path, captions)
    return list(paths)


def read_subject(folder: Path, env: Any = None) -> Subject:
    """The run in this folder with its tables, and the parameters of its first seed that did not diverge."""
    run = load_run(folder)
    folder = run.folder
    diverged = diverged_seeds(folder)
    train, evaluations = run.train_in(env), table_of(folder, "evaluations", diverged)
    params, seed = None, -1
    if (folder / "policy").exists() and evaluations.seeds:
        seed = evaluations.seeds[0]
        index = run.seeds.index(seed)
        params = jax.tree.map(lambda leaf: jax.device_put(leaf[index]), read_params(run, train))
    return Subject(run, train, table_of(folder, "epochs", diverged), evaluations, diverged, params, seed)


def learning_curves(subject: Subject) -> Figure:
    """Success rate of training, validation and test goals against environment steps; beside it SPL, or success on
    corrupted goals."""
    values, groups = subject.evaluations.values, subject.train.env.goals.groups
    steps, steps_label = progress(subject.run.config, subject.evaluations, subject.train.env)
    panels = {
        "success rate": {f"{group}_goal/success_rate": (group, USE_TITLES[group]) for group in groups},
        "success weighted by path length (SPL)": {f"{group}_goal/spl": (group, USE_TITLES[group]) for group in groups},
        f"success rate, corruption {subject.run.config.test_corruption:g}": {
            f"corrupted_{group}_goal/success_rate": (group, f"corrupted {USE_TITLES[group]}")
            for group in groups
            if group != "validation"
        },
    }
    panels = {label: curves for label, curves in panels.items() if all(name in values for name in curves)}
    figure = new_figure(subject, "success while training", (10, 4.2))
    for axes, (label, curves) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        for name, (group, title) in curves.items():
            draw_curve(axes, steps, values[name], USE_COLOURS[group], title, SHARE)
        finish_share_axis(axes, label)
        finish_progress_axis(axes, steps_label, steps[-1])
        axes.legend(loc="best")
    return figure


def progress(config: TrainConfig, evaluations: RunTable, env) -> tuple[np.ndarray, str]:
    """How far training was at each evaluation [E], and in what: environment steps, or epochs for who learns offline and
    takes none."""
    if env.recorded is not None:
        return evaluations.epochs, f"epochs of {config.updates_per_epoch} updates, offline"
    return evaluations.values["env_steps"].mean(0), "environment steps"


def finish_progress_axis(axes: Axes, label: str, last: float) -> None:
    """A horizontal axis for the progress of training, from nothing to `last`, or to 1 where there was none."""
    axes.set_xlabel(label)
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.set_xlim(0, max(last, 1) * 1.02)


def finish_length_axis(axes: Axes, longest: int) -> None:
    """A horizontal axis for the steps that an episode may take."""
    axes.set_xlabel("allowed episode length (steps)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlim(0, longest)


def beta_and_accuracy(subject: Subject) -> Figure | None:
    """The Lagrange multiplier and the accuracy of telling goals apart, against epochs (paper, Fig. 13); None for
    methods without them."""
    config, values, epochs = subject.run.config, subject.epochs.values, subject.epochs.epochs
    names = [f"{learners.registry.name_of(config.learner)}/{name}" for name in ("beta", "accuracy")]
    if any(name not in values for name in names):
        return None
    figure = new_figure(subject, "adaptive Lagrange multiplier", (10, 4.2))
    beta_axes, accuracy_axes = figure.subplots(1, 2)
    draw_curve(beta_axes, epochs, values[names[0]], USE_COLOURS["train"], "beta", NOT_NEGATIVE)
    beta_axes.set_ylabel("Lagrange multiplier beta")
    beta_axes.set_ylim(bottom=0)
    beta_axes.grid()
    draw_curve(accuracy_axes, epochs, values[names[1]], USE_COLOURS["test"], "accuracy", SHARE)
    if getattr(config.learner, "beta_rule", "fixed") in ("linear", "sign"):
        alpha = config.hyper.learner.beta_threshold
        accuracy_axes.axhline(
            alpha, color="black", linestyle="--", linewidth=1, label=rf"threshold $\alpha$ = {alpha:g}"
        )
    accuracy_axes.set_ylabel("accuracy, similar against dissimilar goals")
    accuracy_axes.set_ylim(min(0.48, values[names[1]].min() - 0.02), 1.01)
    accuracy_axes.grid()
    accuracy_axes.legend(loc="lower right")
    for axes in (beta_axes, accuracy_axes):
        axes.set_xlabel(f"epochs of {config.updates_per_epoch} updates")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def success_within(first_reached: np.ndarray, mask: np.ndarray, longest: int) -> np.ndarray:
    """Share of episodes that reached their goal within 0, 1, ..., `longest` steps, [..., longest + 1]: first_reached
    [..., M, starts], mask [M]."""
    episodes = first_reached[..., mask, :].reshape(*first_reached.shape[:-2], -1)
    return (episodes[..., None] <= np.arange(longest + 1)).mean(-2)


def success_by_length(subject: Subject) -> Figure:
    """Success against the allowed episode length at the last evaluation (paper, Fig. 8 right), beside a shortest path
    where one is known."""
    env = subject.train.env
    first_reached = subject.evaluations.last()["first_reached"]
    num_starts, longest = first_reached.shape[-1], env.episode_length
    shortest = None
    if env.has_shortest_path:

        def from_starts(env):
            return jax.vmap(jax.vmap(env.shortest_path))(draw_starts(env, env.goals.evaluated, num_starts))

        shortest = np.asarray(jit(from_starts)(env))
    figure = new_figure(subject, f"success by length, epoch {subject.evaluations.epochs[-1]}", (9.5, 4.6))
    axes = figure.subplots()
    for group, mask in evaluated_masks(env.goals).items():
        colour = USE_COLOURS[group]
        within = success_within(first_reached, mask, longest)
        draw_curve(axes, np.arange(longest + 1), within, colour, USE_TITLES[group], SHARE)
        if shortest is not None:
            curve = success_within(shortest, mask, longest)
            axes.plot(curve, color=colour, linestyle=":", linewidth=1.2, label=f"{USE_TITLES[group]}, shortest path")
    finish_share_axis(axes, "reached by then")  # And left again, where reaching a goal does not end an episode.
    finish_length_axis(axes, longest)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def success_by_goal(subject: Subject) -> Figure | None:
    """Success rate of every evaluated goal at the last evaluation, room by room; training goals filled, the others
    hatched. None for very many."""
    env = subject.train.env
    goals, which = env.goals, np.asarray(env.goals.evaluated)
    if len(which) > MOST_BARS:
        return None
    regions, trained, names = (
        np.asarray(goals.regions)[which],
        evaluated_masks(goals)["train"],
        [goals.names[goal] for goal in which],
    )
    reached = (subject.evaluations.last()["first_reached"] <= env.episode_length).mean(-1)
    order = sorted(range(len(which)), key=lambda goal: (regions[goal], not trained[goal], names[goal]))
    count, num_starts = len(reached), subject.evaluations.values["first_reached"].shape[-1]
    seeds = "1 seed" if count == 1 else f"mean of {count} seeds, each seed a dot"
    shown = f"{counted(num_starts, 'start')} a goal; {seeds}"
    title = f"success by goal, epoch {subject.evaluations.epochs[-1]}"
    figure = new_figure(subject, title, (9, 1.8 + 0.26 * len(which)), shown=shown)
    axes = figure.subplots()
    # A gap between rooms; the first goal on top.
    places = [-(row + 0.7 * int(np.searchsorted(np.unique(regions), regions[goal]))) for row, goal in enumerate(order)]
    for place, goal in zip(places, order, strict=True):
        colour, mean = room_colour(regions[goal]), reached[:, goal].mean()
        axes.barh(
            place,
            mean,
            height=0.8,
            color=colour if trained[goal] else "white",
            edgecolor=colour,
            hatch=None if trained[goal] else "////",
        )
        if count > 1:  # Dots side by side, where seeds agree.
            axes.scatter(
                reached[:, goal], place + np.linspace(-0.25, 0.25, count), s=9, color="black", linewidths=0, zorder=3
            )
    axes.set_yticks(places, [in_words(names[goal]) for goal in order], fontsize=8)
    entries = [Patch(facecolor=room_colour(index), label=name) for index, name in enumerate(goals.region_names)]
    entries.append(Patch(facecolor="#888888", label="training goal"))
    entries.append(Patch(facecolor="white", edgecolor="#888888", hatch="////", label="not trained on"))
    axes.legend(handles=entries, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes.set_xlim(-0.015, 1.015)
    axes.set_ylim(places[-1] - 0.7, places[0] + 0.7)
    axes.set_xlabel("success rate")
    axes.grid(axis="x")
    return figure
