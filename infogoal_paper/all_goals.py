"""The study of learning from all goals at once, beside the paper (docs/research/all_goals.md): tables and figure, from
the numbers of its runs (`manifest.all_goals`).

OUT/tables/NAME.md, .tex, .csv    OUT/figures/all_goals.png (and .pdf or .svg)    OUT/all_goals.md
"""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from infogoal_jax.report import canvas
from infogoal_jax.report.canvas import SHARE, draw_curve, finish_share_axis
from infogoal_jax.report.comparison_figures import COLOURS
from infogoal_jax.report.figures import finish_progress_axis
from infogoal_jax.runs import disk
from infogoal_paper import drawing, table_formats
from infogoal_paper.claims import INTERVALS, finding, paired
from infogoal_paper.files import Result
from infogoal_paper.manifest import AGENTS, ALL_GOALS, PROTOCOLS, Choice, all_goals, all_goals_run, protocol_of
from infogoal_paper.numbers import Results
from infogoal_paper.scores import TITLES, Row, by_goal_set, has_scores
from infogoal_paper.table_formats import Cell, Table, machines_in_words, markdown, narrow
from infogoal_paper.tables import costs, legend, ranks

NAME = "all_goals"
"""Of the study and of its figure."""
KINDS = {
    "train_goal": "training",
    "validation_goal": "validation",
    "test_goal": "test",
    "corrupted_train_goal": "corrupted training",
    "corrupted_test_goal": "corrupted test",
}
"""Kinds of goals, as metrics name them, and in words."""
HEADS, BESIDE_THEM = ("all_goals", "infogoal+all_goals", "infobot+all_goals"), ("her", "leo")
"""Rows that value a goal through its code, and those that each of them is compared with."""
KINDS_ON_PAGE, HEADS_ON_PAGE = ("train_goal", "test_goal", "corrupted_test_goal"), ("all_goals", "infogoal+all_goals")
"""Kinds of goals that the page shows, and the rows whose differences to HER on test goals it shows."""
Rows = dict[tuple[str, str], Row]
"""The rows of a task by (method, protocol)."""


def of_study(results: Results) -> Results:
    """The runs that the study shows, those that it shares with the paper among them."""
    rows = {run.row for run in all_goals(Choice())}
    return {run: result for run, result in results.items() if run.row in rows}


def rows_of(results: Results, task: str) -> Rows:
    """Every row of a task that there is."""
    found: Rows = {}
    for protocol in PROTOCOLS:
        runs = {
            method: by_goal_set(results, all_goals_run(task, method, protocol, 0, (0,), toy=False).row)
            for method in ALL_GOALS
        }
        sets = frozenset().union(*runs.values())
        for method, own in runs.items():
            if own:
                found[method, protocol] = Row(tuple(own[number] for number in sorted(own)), sets - own.keys())
    return found


def protocols_of(task: str) -> list[str]:
    """The protocols that are shown of a task: one, where both are the same."""
    return [protocol for protocol in PROTOCOLS if protocol_of(task, "her", protocol) == protocol]


def columns(rows: Rows, task: str) -> list[tuple[str, str]]:
    """(kind of goals, protocol) of the columns of a task's tables: those that any row has."""
    return [
        (kind, protocol)
        for protocol in protocols_of(task)
        for kind in KINDS
        if any(has_scores(row, kind) for (_, known), row in rows.items() if known == protocol)
    ]


def heading(kind: str, protocol: str, task: str) -> str:
    """A column in words: `test, held_out`."""
    return KINDS[kind] if len(protocols_of(task)) == 1 else f"{KINDS[kind]}, {protocol}"


def success_table(results: Results, task: str) -> Table | None:
    """Success of every method on a task, by kind of goals and protocol; None where there are no runs."""
    rows = rows_of(results, task)
    if not rows:
        return None
    shown = columns(rows, task)
    methods = [method for method in ALL_GOALS if any(known == method for known, _ in rows)]
    body: list[list[Cell | str]] = [[ALL_GOALS[method]] for method in methods]
    for kind, protocol in shown:
        own = {method: rows.get((method, protocol)) for method in methods}
        column = {method: success_cell(row, kind) for method, row in own.items()}
        complete = len(own) == len(ALL_GOALS) and all(row and not row.lacking for row in own.values())
        rank = ranks(column) if complete else {}
        for line, (method, cell) in zip(body, column.items(), strict=True):
            line.append(cell._replace(rank=rank.get(method, 0)))
    seeds = sorted({row.seeds for row in rows.values()})
    corrupted = ["Corrupted: background of weight 0.4."] if any("corrupted" in kind for kind, _ in shown) else []
    foot = [
        f"Success rate: mean ± {table_formats.INTERVALS} (Student t). Bold: best of a column; "
        "underlined: second best, once every method ran on every goal set. "
        f"{' or '.join(map(str, seeds))} seed(s) on each goal set.",
        *corrupted,
        protocols_in_words(task),
        *legend(rows.values()),
        f"{machines_in_words(result.about['machine'] for row in rows.values() for result in row.results)}.",
    ]
    head = ["method", *(heading(*column, task) for column in shown)]
    return Table(f"{NAME}_{task}", f"All goals at once: {TITLES[task]}", head, body, foot)


def success_cell(row: Row | None, kind: str) -> Cell:
    """Success of a row on a kind of goals."""
    if row is None or not has_scores(row, kind):
        return Cell(None)
    return Cell(row.mean(kind), "", 0, row.marks(), row.results[0].run.name)


def protocols_in_words(task: str) -> str:
    """What the protocols of known goals are on a task."""
    if len(protocols_of(task)) == 1:
        return "Both protocols of known goals are the same here: training achieves no test or validation goal."
    words = "; ".join(f"{protocol}: {meaning}" for protocol, meaning in PROTOCOLS.items())
    return f"{words}. The bare agent learns of desired goals alone, under both the same."


def differences_table(results: Results, task: str) -> Table | None:
    """Success of each head minus that of HER and of LEO, by kind of goals and protocol; None where no two ran."""
    rows = rows_of(results, task)
    shown, body, compared = columns(rows, task), [], []
    for method in HEADS:
        for other in BESIDE_THEM:
            cells = []
            for kind, protocol in shown:
                pair = rows.get((method, protocol)), rows.get((other, protocol))
                cells.append(difference_cell(*pair, kind, task))
                compared += [row for row in pair if row is not None]
            if any(cells):
                body.append([f"{ALL_GOALS[method]} minus {ALL_GOALS[other]}", *cells])
    if not body:
        return None
    foot = [f"Difference of success rates [95 % interval]. {INTERVALS}", *legend(compared)]
    head = ["methods", *(heading(*column, task) for column in shown)]
    return Table(f"{NAME}_{task}_differences", f"All goals at once: differences on {TITLES[task]}", head, body, foot)


def difference_cell(first: Row | None, second: Row | None, kind: str, task: str) -> str:
    """`0.12 [0.05, 0.19]†`: the first row minus the second, paired by goal set and seed, with the marks of both;
    nothing where one of them has no such goals."""
    if not has_scores(first, kind) or not has_scores(second, kind):
        return ""
    marks = "".join(dict.fromkeys(first.marks() + second.marks()))
    return finding({task: paired(first, second, kind)}, "", (first, second)).shown + marks


def all_tables(results: Results) -> list[Table]:
    """Every table of the study that there are numbers for. What it cost is of the runs that the paper does not have."""
    made = [make(results, task) for task in AGENTS for make in (success_table, differences_table)]
    own = {run: result for run, result in of_study(results).items() if not run.of_paper}
    cost = costs(own)
    made.append(cost and Table(f"{NAME}_costs", "All goals at once: what it cost", cost.head, cost.rows, cost.foot))
    return [table for table in made if table is not None]


class Progress(NamedTuple):
    """A row while it is trained.

    steps: thousands of the environment's until each evaluation [E], of updates where flights are recorded.
    seconds: of training of one seed [E].
    success: on test goals [seeds, E], mean over goal sets.
    """

    steps: np.ndarray
    seconds: np.ndarray
    success: np.ndarray


def steps_of(result: Result) -> np.ndarray:
    """Thousands of environment steps of a seed until each evaluation [E]; of updates where flights are recorded."""
    count = result.evaluations["test_goal/success_rate"].shape[1]
    if result.run.task == "embodied_qa":
        return result.about["updates"] * np.arange(1.0, count + 1) / 1e3
    return result.evaluations["env_steps"].mean(0) / 1e3


def seconds_of(result: Result) -> np.ndarray:
    """Seconds of training of one seed until each evaluation [E], evaluations among them and compiling not.

    A program trains all seeds and goal sets of a method side by side: its running time is shared out equally among
    them, and among the evaluations. A seed by itself would take longer than its share; and where processes share a GPU,
    the running time of each has the others' work in it.
    """
    program, count = result.about["program"], result.evaluations["test_goal/success_rate"].shape[1]
    return program["run_seconds"] / program["lanes"] * np.arange(1.0, count + 1) / count


def progress_of(row: Row) -> Progress:
    """The row's mean over its goal sets, of the seeds that diverged on none, up to the evaluation that all of them
    have."""
    count = min(result.evaluations["test_goal/success_rate"].shape[1] for result in row.results)
    lost = {seed for result in row.results for seed in result.about["diverged"]}
    seeds = sorted(set.intersection(*(set(result.run.seeds) for result in row.results)) - lost)
    success = [
        result.evaluations["test_goal/success_rate"][[result.run.seeds.index(seed) for seed in seeds], :count]
        for result in row.results
    ]
    steps, seconds = (np.mean([of(run)[:count] for run in row.results], 0) for of in (steps_of, seconds_of))
    return Progress(steps, seconds, np.mean(success, 0))


def figure(results: Results) -> Figure | None:
    """Success on test goals against environment steps and against seconds of training of one seed (`seconds_of`): a row
    of panels a task, two for each protocol. None before the first run that the paper does not have."""
    if all(run.of_paper for run in results):
        return None
    found = {task: rows for task in AGENTS if (rows := rows_of(results, task))}
    counts = [row.seeds for rows in found.values() for row in rows.values()]
    below = (
        f"mean over goal sets, then over seeds{canvas.interval_in_words(counts)}",
        "seconds: the running time of a program without compiling, shared out equally among the seeds and goal sets "
        "that it trained side by side",
    )
    wide = 2 * max(len(protocols_of(task)) for task in found)
    drawn = canvas.empty_figure("Learning from all goals at once", below, (1.8 + 3 * wide, 1 + 2.6 * len(found)))
    handles, grid = {}, drawn.subplots(len(found), wide, squeeze=False, sharey=True)
    for (task, rows), line in zip(found.items(), grid, strict=True):
        for axes in line[2 * len(protocols_of(task)) :]:
            axes.set_visible(False)
        for protocol, pair in zip(protocols_of(task), line.reshape(-1, 2), strict=False):
            draw_pair(pair, {method: row for (method, known), row in rows.items() if known == protocol}, task)
            several = f", {protocol}" * (len(protocols_of(task)) > 1)
            for axes in pair:
                axes.set_title(f"{TITLES[task]}{several}", fontsize=10)
                handles |= {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    shown = [title for title in ALL_GOALS.values() if title in handles]
    drawn.legend([handles[title] for title in shown], shown, loc="outside right center")
    return drawn


def draw_pair(pair, rows: dict[str, Row], task: str) -> None:
    """The curves of these rows, by method, against steps on the first axes and against seconds on the second."""
    curves = {method: progress_of(row) for method, row in rows.items() if has_scores(row, "test_goal")}
    steps = "updates" if task == "embodied_qa" else "environment steps"
    labels = (f"{steps} (thousands)", "seconds of training of one seed")
    for axes, name, label in zip(pair, ("steps", "seconds"), labels, strict=True):
        for (method, title), colour in zip(ALL_GOALS.items(), COLOURS, strict=False):
            if method in curves:
                draw_curve(axes, getattr(curves[method], name), curves[method].success, colour, title, SHARE)
        finish_progress_axis(axes, label, max((getattr(curve, name)[-1] for curve in curves.values()), default=1))
        finish_share_axis(axes, "success rate, test goals" if axes.get_subplotspec().is_first_col() else "")


def draw_figure(results: Results, path: Path, format: str = "png") -> list[Path]:
    """Write the figure as this PNG, and beside it in this format; the paths."""
    with canvas.figure_style():
        return drawing.write_figure(figure(results), path, drawing.digest(results, NAME), format)


def on_page(results: Results) -> dict[str, str]:
    """What docs/research/all_goals.md shows, by name: parts of the tables of each task, or that it was not run yet, and
    the figure; nothing before the first run of the study. What stands below several tables stands below the first."""
    if all(run.of_paper for run in results):
        return {}
    found: dict[str, str] = {}
    said: set[str] = set()
    pairs = [f"{ALL_GOALS[method]} minus {ALL_GOALS['her']}" for method in HEADS_ON_PAGE]
    for task in AGENTS:
        tested = [heading(kind, protocol, task) for kind in KINDS_ON_PAGE[1:] for protocol in protocols_of(task)]
        trained = [heading(KINDS_ON_PAGE[0], protocol, task) for protocol in protocols_of(task)]
        success, differences = success_table(results, task), differences_table(results, task)
        parts = [narrow(success, trained + tested)] if success else []
        parts += [narrow(differences, tested, pairs)] if differences else []
        for place, part in enumerate(parts):
            parts[place] = dataclasses.replace(part, foot=[line for line in part.foot if line not in said])
            said.update(part.foot)
        found[task] = "\n\n".join(markdown(part, short=True).strip() for part in parts) or "Not run yet."
    return found | {"figure": f"![success on test goals](../results/{NAME}.png)"}


def draw(results: Results, out: Path, format: str) -> list[Path]:
    """Write the tables, the figure and one page with both; the paths of the files. format: see `drawing.draw`."""
    shown, picture = all_tables(results), out / "figures" / f"{NAME}.png"
    paths = drawing.write_tables(shown, out / "tables") + draw_figure(results, picture, format)
    lines = ["# All goals at once", ""]
    for table in shown:
        lines += [f"## {table.title}", "", markdown(table)]
    lines += [f"![success on test goals](figures/{NAME}.png)", ""] if picture in paths else []
    paths.append(out / f"{NAME}.md")
    disk.write_text(paths[-1], "\n".join(lines))
    return paths
