"""The figures of a run: learning curves, beta and accuracy (Fig. 13), goal codes, success by length (Fig. 8) and by goal; plans of the house."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from infogoal_jax.report import tables
from infogoal_jax.report.canvas import (
    USE_COLOURS,
    USE_TITLES,
    Subject,
    draw_curve,
    finish_share_axis,
    in_words,
    new_figure,
    room_colour,
    save,
)
from infogoal_jax.report.house_figures import draw_plans
from infogoal_jax.report.runs import read_params, read_run
from infogoal_jax.train.evaluation import goal_starts
from infogoal_jax.train.program import make_train

CODE_SAMPLES = 60  # Drawn from the Gaussian of each goal.
MOST_BARS = 60  # Goals up to which every one gets a bar of its own.


def draw_figures(folder: Path, env: Any = None) -> list[Path]:
    """Draw everything that this run has numbers for under RUN/figures; the paths of the files. env: the environment if it is loaded already.

    Raises `UserError` for a folder without a run, a damaged file, or a disk that refuses.
    """
    subject = read_subject(folder, env)
    if not subject.evaluations.values:
        return []
    drawings = (learning_curves, beta_and_accuracy, success_by_length, success_by_goal, representations)
    figures = {draw.__name__: draw(subject) for draw in drawings} | draw_plans(subject)
    paths = {folder / "figures" / f"{name}.png": figure for name, figure in figures.items() if figure is not None}
    for path, figure in paths.items():
        save(figure, path)
    return list(paths)


def read_subject(folder: Path, env: Any = None) -> Subject:
    """The run in this folder with its tables, and the parameters of its first seed that did not diverge."""
    run, diverged = read_run(folder), tables.diverged_seeds(folder)
    train, evaluations = make_train(run.config, env), tables.read(folder, "evaluations", diverged)
    params, seed = None, -1
    if (folder / "policy").exists() and evaluations.seeds:
        seed = evaluations.seeds[0]
        index = run.seeds.index(seed)
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf[index]), read_params(run, train))
    return Subject(run, train, tables.read(folder, "epochs", diverged), evaluations, diverged, params, seed)


def learning_curves(subject: Subject) -> Figure:
    """Success rate and SPL of training, validation and test goals against environment steps."""
    figure = new_figure(subject, "success while training", (10, 4.2))
    values = subject.evaluations.values
    steps = values["env_steps"].mean(0)
    for axes, (name, label) in zip(figure.subplots(1, 2), {"success_rate": "success rate", "spl": "success weighted by path length (SPL)"}.items(),
                                   strict=True):
        for group in subject.train.env.goals.groups:
            draw_curve(axes, steps, values[f"{group}_goal/{name}"], USE_COLOURS[group], USE_TITLES[group])
        finish_share_axis(axes, label)
        axes.set_xlabel("environment steps")
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.set_xlim(0, steps[-1] * 1.02)
        axes.legend(loc="best")
    return figure


def beta_and_accuracy(subject: Subject) -> Figure | None:
    """The Lagrange multiplier and the accuracy of telling goals apart, against epochs (paper, Fig. 13); None for methods without them."""
    config, values, epochs = subject.run.config, subject.epochs.values, subject.epochs.epochs
    names = [f"{config.method}/{name}" for name in ("beta", "accuracy")]
    if any(name not in values for name in names):
        return None
    figure = new_figure(subject, "adaptive Lagrange multiplier", (10, 4.2))
    beta_axes, accuracy_axes = figure.subplots(1, 2)
    draw_curve(beta_axes, epochs, values[names[0]], USE_COLOURS["train"], "beta")
    beta_axes.set_ylabel("Lagrange multiplier beta")
    beta_axes.set_ylim(bottom=0)
    beta_axes.grid(alpha=0.3, linewidth=0.6)
    draw_curve(accuracy_axes, epochs, values[names[1]], USE_COLOURS["test"], "accuracy")
    if getattr(config.learner, "beta_rule", "fixed") != "fixed":
        alpha = config.hyper.beta_threshold
        accuracy_axes.axhline(alpha, color="black", linestyle="--", linewidth=1, label=rf"threshold $\alpha$ = {alpha:g}")
    accuracy_axes.set_ylabel("accuracy, similar against dissimilar goals")
    accuracy_axes.set_ylim(min(0.48, values[names[1]].min() - 0.02), 1.01)
    accuracy_axes.grid(alpha=0.3, linewidth=0.6)
    accuracy_axes.legend(loc="lower right")
    for axes in (beta_axes, accuracy_axes):
        axes.set_xlabel(f"epochs of {config.updates_per_epoch} updates")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def principal_components(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre [d], the first two principal axes [2, d] and their shares of the variance [2] of points [n, d]."""
    centre = points.mean(0)
    _, scales, axes = np.linalg.svd(points - centre, full_matrices=False)
    shares = scales**2 / max((scales**2).sum(), np.finfo(float).tiny)
    return centre, axes[:2], shares[:2]


def representations(subject: Subject) -> Figure | None:
    """Goal codes of one seed on the principal axes of their means, coloured by room (paper, Fig. 10): means, and samples of the Gaussians."""
    goals, learner = subject.train.env.goals, subject.train.parts.learner
    if subject.params is None or goals.num_goals < 3:
        return None
    code = jax.tree.map(np.asarray, learner.encode(subject.params["goal"], goals.inputs))
    centre, directions, shares = principal_components(code.mean)
    means = (code.mean - centre) @ directions.T
    noise = np.random.default_rng(0).normal(size=(CODE_SAMPLES, *code.mean.shape))
    samples = (code.mean + code.std * noise - centre) @ directions.T
    regions, test = np.asarray(goals.regions), np.asarray(goals.test_mask)
    figure = new_figure(subject, "goal representations", (9.5, 6), shown=f"seed {subject.params_seed}, last parameters")
    axes = figure.subplots()
    random_code = bool((code.std > 0).any())
    for goal, region in enumerate(regions):
        if random_code:
            axes.scatter(*samples[:, goal].T, s=5, color=room_colour(region), alpha=0.18, linewidths=0)
    for mask, marker, size in ((~test, "o", 90), (test, "*", 190)):
        colours = [room_colour(region) for region in regions[mask]]
        axes.scatter(*means[mask].T, marker=marker, s=size, c=colours, edgecolors="black", linewidths=0.8, zorder=3)
    entries = [Line2D([], [], linestyle="", marker="s", color=room_colour(index), label=name) for index, name in enumerate(goals.region_names)]
    entries += [Line2D([], [], linestyle="", marker=marker, markersize=size, markerfacecolor="white", markeredgecolor="black", label=label)
                for marker, size, label in (("o", 9, "mean, training goal"), ("*", 13, "mean, test goal"))]
    if random_code:
        entries.append(Line2D([], [], linestyle="", marker=".", color="#888888", label="samples of a code"))
    axes.legend(handles=entries, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes.set_xlabel(f"first principal axis ({shares[0]:.0%} of the variance of the means)")
    axes.set_ylabel(f"second principal axis ({shares[1]:.0%})")
    axes.grid(alpha=0.3, linewidth=0.6)
    return figure


def success_within(first_reached: np.ndarray, mask: np.ndarray, longest: int) -> np.ndarray:
    """Share of episodes that reached their goal within 0, 1, ..., `longest` steps, [..., longest + 1]: first_reached [..., N, starts], mask [N]."""
    episodes = first_reached[..., mask, :].reshape(*first_reached.shape[:-2], -1)
    return (episodes[..., None] <= np.arange(longest + 1)).mean(-2)


def success_by_length(subject: Subject) -> Figure:
    """Success against the allowed episode length at the last evaluation (paper, Fig. 8 right), beside a shortest path from the same starts."""
    env = subject.train.env
    first_reached = subject.evaluations.last()["first_reached"]
    num_starts, longest = first_reached.shape[-1], env.episode_length
    shortest = np.asarray(jax.vmap(env.shortest_path)(goal_starts(env, num_starts))).reshape(env.goals.num_goals, num_starts)
    figure = new_figure(subject, f"success by length, epoch {subject.evaluations.epochs[-1]}", (9.5, 4.6))
    axes = figure.subplots()
    for group in env.goals.groups:
        mask, colour = np.asarray(getattr(env.goals, f"{group}_mask")), USE_COLOURS[group]
        draw_curve(axes, np.arange(longest + 1), success_within(first_reached, mask, longest), colour, USE_TITLES[group])
        axes.plot(success_within(shortest, mask, longest), color=colour, linestyle=":", linewidth=1.2, label=f"{USE_TITLES[group]}, shortest path")
    finish_share_axis(axes, "success rate")
    axes.set_xlabel("allowed episode length (steps)")
    axes.set_xlim(0, longest)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def success_by_goal(subject: Subject) -> Figure | None:
    """Success rate of every goal at the last evaluation, room by room; training goals filled, the others hatched. None for very many goals."""
    env = subject.train.env
    goals, regions, trained = env.goals, np.asarray(env.goals.regions), np.asarray(env.goals.train_mask)
    if goals.num_goals > MOST_BARS:
        return None
    reached = (subject.evaluations.last()["first_reached"] <= env.episode_length).mean(-1)
    order = sorted(range(goals.num_goals), key=lambda goal: (regions[goal], not trained[goal], goals.names[goal]))
    count, num_starts = len(reached), subject.evaluations.values["first_reached"].shape[-1]
    shown = f"{num_starts} starts a goal; " + ("1 seed" if count == 1 else f"mean of {count} seeds, each seed a dot")
    title = f"success by goal, epoch {subject.evaluations.epochs[-1]}"
    figure = new_figure(subject, title, (9, 1.8 + 0.26 * goals.num_goals), shown=shown)
    axes = figure.subplots()
    # A gap between rooms; the first goal on top.
    places = [-(row + 0.7 * int(np.searchsorted(np.unique(regions), regions[goal]))) for row, goal in enumerate(order)]
    for place, goal in zip(places, order, strict=True):
        colour, mean = room_colour(regions[goal]), reached[:, goal].mean()
        axes.barh(place, mean, height=0.8, color=colour if trained[goal] else "white", edgecolor=colour, hatch=None if trained[goal] else "////")
        if count > 1:  # Dots side by side, where seeds agree.
            axes.scatter(reached[:, goal], place + np.linspace(-0.25, 0.25, count), s=9, color="black", linewidths=0, zorder=3)
    axes.set_yticks(places, [in_words(goals.names[goal]) for goal in order], fontsize=8)
    entries = [Patch(facecolor=room_colour(index), label=name) for index, name in enumerate(goals.region_names)]
    entries.append(Patch(facecolor="#888888", label="training goal"))
    entries.append(Patch(facecolor="white", edgecolor="#888888", hatch="////", label="not trained on"))
    axes.legend(handles=entries, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes.set_xlim(-0.015, 1.015)
    axes.set_ylim(places[-1] - 0.7, places[0] + 0.7)
    axes.set_xlabel("success rate")
    axes.grid(axis="x", alpha=0.3, linewidth=0.6)
    return figure
