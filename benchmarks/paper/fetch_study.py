"""The study of the Fetch tasks: InfoGoal against bare HRAC on goal images, beside Table I of the paper.

    python benchmarks/paper/fetch_study.py --out FOLDER [--tasks fetch_reach ...] [--methods none infogoal] [--seeds 5] [--goal-images FOLDER]

Every run stays in FOLDER/TASK/METHOD with the curve of every seed; result.json beside it holds the times and the machine. What is there is not run
again, so that runs may come from several machines; without anything to run the table is made anew. FOLDER/study.md is the table: 5 starts for
each goal, no random actions, the goal's code sampled at every step.

As in the paper, numbers are those "after the agent has converged on the training goals": of the first evaluation by which the mean success on
training goals was 0.99 or more twice in a row. No other goal has a say in it. A second table has the last parameters.
"""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path

import study

from infogoal_jax import presets
from infogoal_jax.report import tables
from infogoal_jax.report.statistics import mean_interval, paired_difference

METHODS = {"none": "HRAC", "infogoal": "InfoGoal"}
KINDS = {"train_goal": "training", "test_goal": "test", "corrupted_test_goal": "corrupted test", "corrupted_train_goal": "corrupted training"}
PAPER = {
    "fetch_reach": {"test_goal": (0.06, 0.91), "corrupted_test_goal": (0.09, 0.84), "corrupted_train_goal": (0.67, 0.91)},
    "fetch_push": {"test_goal": (0.48, 0.84), "corrupted_test_goal": (0.25, 0.74), "corrupted_train_goal": (0.56, 0.88)},
    "fetch_pick_and_place": {"test_goal": (0.19, 0.90), "corrupted_test_goal": (0.23, 0.82), "corrupted_train_goal": (0.62, 0.82)},
}
"""Table I of the paper: HRAC and InfoGoal. It has no row for training goals."""


def configuration(task: str, method: str, goal_images: Path | None):
    """The preset of this task and method, on these goal images or those that are shipped."""
    config = presets.load(task, method)
    if goal_images:
        config = dataclasses.replace(config, env=dataclasses.replace(config.env, goal_images=str(goal_images / f"{task}.npz")))
    return config


def scores_table(folder: Path, choose: Callable[[dict], int]) -> list[str]:
    """Rows of Markdown: each task and kind of goals, at the evaluation that `choose` picks for each run."""
    lines = ["| task | goals | HRAC | InfoGoal | InfoGoal - HRAC | paper: HRAC | paper: InfoGoal | epochs |", "|" + "---|" * 8]
    for task, paper in PAPER.items():
        values = {method: tables.read(path, "evaluations") for method, path in finished(folder, task).items()}
        chosen = {method: choose(table.values) for method, table in values.items()}
        epochs = ", ".join(str(int(values[method].epochs[place])) for method, place in chosen.items())
        for kind, title in KINDS.items():
            cells = {method: table.values[f"{kind}/success_rate"][:, chosen[method]] for method, table in values.items()}
            shown = [mean_interval(cells[method]).show(2) if method in cells else "" for method in METHODS]
            shown.append(paired_difference(cells["infogoal"], cells["none"]).show(2) if len(cells) == 2 else "")
            reported = [f"{value:.2f}" for value in paper[kind]] if kind in paper else ["", ""]
            lines.append(f"| {' | '.join([task, title, *shown, *reported, epochs])} |")
    return lines


def finished(folder: Path, task: str) -> dict[str, Path]:
    """The runs of a task that are whole, by method."""
    return {method: folder / task / method for method in METHODS if (folder / task / method / "result.json").exists()}


def table(folder: Path) -> str:
    """The study as Markdown: both tables, then what each run took."""
    runs = [study.describe_run(path, f"{task}, {METHODS[method]}", method) for task in PAPER for method, path in finished(folder, task).items()]
    return "\n".join([
        "Success rate; mean ± 95 % interval (Student t) over seeds, and of the paired difference. Corrupted goals: a background of weight 0.4.", "",
        "After the agent has converged on the training goals:", "", *scores_table(folder, study.converged), "",
        "Last parameters:", "", *scores_table(folder, lambda values: -1), "", *runs,
    ]) + "\n"


def main():
    """Run what is not there yet, then write the table of all that is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tasks", nargs="*", default=list(PAPER), choices=list(PAPER))
    parser.add_argument("--methods", nargs="*", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--goal-images", type=Path, help="folder of goal images, of `infogoal data build fetch`; left out: those that are shipped")
    arguments = parser.parse_args()
    for task in arguments.tasks:
        for method in arguments.methods:
            study.train(configuration(task, method, arguments.goal_images), arguments.seeds, arguments.out / task / method)
    (arguments.out / "study.md").write_text(table(arguments.out))
    print(table(arguments.out))


if __name__ == "__main__":
    main()
