"""What compressing the goal does where goals are vectors: the studies of benchmarks/goals/continuous.py.

    python -m infogoal_paper.continuous FILE ...    # put studies into docs/results/continuous.json.xz
    python -m infogoal_paper.pages continuous       # write docs/research/continuous_goals.md's tables

The file has {study: {"machine", "settings"}}; a setting has every seed: success [seeds, 4 evaluations] by group of
goals, the error of a code [seeds], and what the study of negatives counts. A setting comes in place of its namesake.
"""

import itertools
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from infogoal_jax.report.canvas import (
    ROOM_COLOURS,
    USE_TITLES,
    draw_curve,
    empty_figure,
    figure_style,
    finish_share_axis,
    save,
)
from infogoal_jax.report.statistics import mean_interval
from infogoal_paper import trial_numbers
from infogoal_paper.table_formats import markdown_lines, tight

RESULTS = Path(__file__).parents[1] / "docs" / "results"
NUMBERS = RESULTS / "continuous.json.xz"
GROUPS = ("train", "validation", "test")
LEFT_OUT = ("agent/td_error", "agent/value", "infogoal/kl", "seconds", "together")
"""Fields of a study that are not kept."""
TASKS = ("point_maze", "reacher", "fetch_reach_positions")
SHOWN = (
    "none",
    "infogoal, window 1, alpha 0.96, weight 1.0",
    "infogoal, window 5, alpha 0.99, weight 1.0",
    "infogoal, window 5, beta 0, weight 0.1",
    "infogoal, window 5, margin 0.005, weight 1.0",
    "infogoal, window 5, margin 0.005, weight 0.1",
)
"""Settings of `causes` that the page has; the file has all 19 of each task."""

Setting = dict[str, Any]


def read() -> dict[str, Any]:
    """The studies so far."""
    return json.loads(trial_numbers.read_text(NUMBERS)) if NUMBERS.exists() else {}


def take(files: list[Path]) -> None:
    """Put these studies into the numbers."""
    studies = read()
    for file in files:
        new = json.loads(file.read_text())
        own = {each["name"]: each for each in studies.get(new["study"], {"settings": []})["settings"]}
        own |= {each["name"]: {k: v for k, v in each.items() if k not in LEFT_OUT} for each in new["settings"]}
        studies[new["study"]] = {"machine": new["machine"], "settings": list(own.values())}
    trial_numbers.write_compressed(NUMBERS, json.dumps(studies))


def last(setting: Setting, group: str) -> str:
    """Success after the last evaluation, with its interval; nothing where the task has no such goals."""
    return tight(mean_interval(np.asarray(setting[group])[:, -1])) if group in setting else ""


def error(setting: Setting) -> str:
    """The error of a code, mean over the seeds."""
    return f"{np.mean(setting['error_of_a_code']):.3f}" if "error_of_a_code" in setting else ""


def of_maze(setting: Setting) -> list[str]:
    """The cells of the maze."""
    return [last(setting, "validation"), last(setting, "test"), error(setting)]


def words(setting: Setting) -> str:
    """The method of a setting with what was changed: `vae, beta 0.1, weight 1.0`."""
    changed = {name.removeprefix("vae_"): value for name, value in setting["learner"].items()}
    changed |= {"weight": setting["hyper"]["learner_weight"]} if setting["hyper"] else {}
    return ", ".join([setting["method"], *(f"{name} {value}" for name, value in changed.items())])


def seeds_below(settings: list[Setting]) -> str:
    """How many settings of FetchReach leave each seed below half of the test goals."""
    ends = np.stack([np.asarray(each["test"])[:, -1] for each in settings if each["task"] == TASKS[2]])
    counts = ", ".join(map(str, (ends < 0.5).sum(0)))
    return f"Of {len(ends)} settings, those below 0.5 by seed: {counts}."


def by_task(settings: list[Setting]) -> dict[tuple[str, str], Setting]:
    """The settings by task, and by name without it."""
    return {(each["task"], each["name"].removeprefix(f"{each['task']} ")): each for each in settings}


def tables() -> dict[str, str]:
    """The tables of the page, by name; none without numbers."""
    studies = read()
    if not studies:
        return {}
    causes, methods = (by_task(studies[name]["settings"]) for name in ("causes", "methods"))
    maze, reacher, reach = TASKS
    head = ["maze, validation", "maze, test", "maze, error of a code"]
    heads = {
        "causes": ["setting", *head, "reacher, validation", "reacher, test", "FetchReach, test"],
        "methods": ["learner", *head, "FetchReach, test"],
        "negatives": ["dissimilar by", "validation", "test", "false negatives, %", "ms an update"],
    }
    lines: dict[str, list[list[str]]] = {name: [] for name in heads}
    for name in SHOWN:
        in_maze, in_reacher = causes[maze, name], causes[reacher, name]
        cells = [*of_maze(in_maze), last(in_reacher, "validation"), last(in_reacher, "test")]
        lines["causes"].append([name.removeprefix("infogoal, "), *cells, last(causes[reach, name], "test")])
    for (task, name), each in methods.items():
        if task == maze:
            there = methods[reach, name]
            lines["methods"].append([words(each), *of_maze(each), last(there, "test")])
    for each in studies["negatives"]["settings"]:
        wrong = tight(mean_interval(100 * np.asarray(each["false_negatives"])), 1)
        cells = [wrong, f"{each['ms_an_update']:.2f}"]
        rule = each["learner"]["dissimilar_by"]
        lines["negatives"].append([f"`{rule}`", last(each, "validation"), last(each, "test"), *cells])
    below = seeds_below([*studies["causes"]["settings"], *studies["methods"]["settings"]])
    machines = {name: studies[name]["machine"].removeprefix("1 x NVIDIA ") for name in heads}
    return {"seeds": below} | {
        name: f"{markdown_lines(heads[name], lines[name])}\n\n5 seeds; {machines[name]}." for name in heads
    }


def best_by_validation(settings: list[Setting]) -> list[Setting]:
    """Of each method in the maze the setting with the highest success on validation goals."""
    best: dict[str, tuple[float, Setting]] = {}
    for each in settings:
        if each["task"] == TASKS[0]:
            score = np.mean(np.asarray(each["validation"])[:, -1])
            if score > best.get(each["method"], (-1.0, {}))[0]:
                best[each["method"]] = score, each
    return [each for _, each in best.values()]


def draw(settings: list[Setting], names: list[str], path: Path) -> None:
    """Draw success over training for each setting, a panel for each group of goals; and what share of the negatives is
    false, where that was counted."""
    wrong = [each["false_negatives"] for each in settings if "false_negatives" in each]
    with figure_style():
        figure = empty_figure(
            "The point's maze", ("Mean of 5 seeds, 95 % interval, every seed a thin line.",), (10.8, 3.4)
        )
        panels = figure.subplots(1, len(GROUPS) + bool(wrong))
        for axes, group in zip(panels, GROUPS, strict=False):
            for colour, each, name in zip(itertools.cycle(ROOM_COLOURS), settings, names, strict=False):
                values = np.asarray(each[group])
                steps = each["env_steps"] * np.arange(1, values.shape[1] + 1) / values.shape[1]
                draw_curve(axes, steps / 1e3, values, colour, name)
            axes.set(title=USE_TITLES[group], xlabel="thousand steps")
            finish_share_axis(axes, "success")
        for place, (colour, values) in enumerate(zip(itertools.cycle(ROOM_COLOURS), wrong, strict=False)):
            panels[-1].bar(place, 100 * np.mean(values), color=colour, alpha=0.5)
            panels[-1].plot([place] * len(values), 100 * np.asarray(values), "k.", markersize=3)
            panels[-1].set(title="false negatives", xticks=[], ylabel="% of the negatives")
        panels[0].legend(fontsize="x-small")
        save(figure, path)


def draw_all() -> list[Path]:
    """Draw the two pictures of the page; their paths."""
    studies = read()
    best, negatives = best_by_validation(studies["methods"]["settings"]), studies["negatives"]["settings"]
    paths = [RESULTS / "continuous_methods.png", RESULTS / "continuous_negatives.png"]
    draw(best, [words(each) for each in best], paths[0])
    draw(negatives, [each["learner"]["dissimilar_by"] for each in negatives], paths[1])
    return paths


if __name__ == "__main__":
    take([Path(word) for word in sys.argv[1:]])
