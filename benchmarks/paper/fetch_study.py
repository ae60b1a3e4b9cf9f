"""The study of the Fetch tasks: InfoGoal against bare HRAC on goal images, beside Table I of the paper.

    python benchmarks/paper/fetch_study.py --out FOLDER [--tasks fetch_reach ...] [--methods none infogoal] [--seeds 5]
    [--goal-images FOLDER]

Every run stays in FOLDER/TASK/METHOD, with result.json for the times and the machine. What is there is not run again,
so that runs may come from several machines. FOLDER/numbers.npz holds the numbers of all runs (study_numbers.py),
FOLDER/study.md the table: 5 starts for each goal, no random actions, the goal's code sampled at every step.

As in the paper, numbers are those "after the agent has converged on the training goals": of the first evaluation by
which the mean success on training goals was 0.99 or more twice in a row. No other goal has a say in it. A second table
has the last parameters.
"""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path

import study
from study_numbers import Study

from infogoal_jax import presets
from infogoal_jax.report.tables import Table
from infogoal_jax.reproduce.paper import reported

TASKS = ("fetch_reach", "fetch_push", "fetch_pick_and_place")
METHODS = ("none", "infogoal")
KINDS = ("train_goal", "test_goal", "corrupted_test_goal", "corrupted_train_goal")


def configuration(task: str, method: str, goal_images: Path | None):
    """The preset of this task and method, on these goal images or those that are shipped."""
    config = presets.load(task, method)
    if goal_images:
        config = dataclasses.replace(
            config, env=dataclasses.replace(config.env, goal_images=str(goal_images / f"{task}.npz"))
        )
    return config


def scores_table(
    results: Study, choose: Callable[[Table], int], kinds: tuple[str, ...] = KINDS, epochs: bool = True
) -> str:
    """Each task and kind of goals, at the evaluation that `choose` picks for each run; epochs: whether a last column
    says which that was."""
    columns = ["task", "goals", "HRAC", "InfoGoal", "InfoGoal - HRAC", "paper: HRAC", "paper: InfoGoal"] + [
        "epochs"
    ] * epochs
    rows = []
    for task in TASKS:
        runs = results.finished(task, METHODS)
        places = {method: choose(run.evaluations) for method, run in runs.items()}
        chosen = ", ".join(str(run.evaluations.epochs[places[method]]) for method, run in runs.items())
        for kind in kinds if runs else ():
            values = {method: study.success(run, kind, places[method]) for method, run in runs.items()}
            paper = [reported(task, kind, method) for method in METHODS]
            rows.append([task, study.KINDS[kind], *study.cells(values, METHODS), *paper] + [chosen] * epochs)
    return study.markdown(columns, rows)


def report(results: Study) -> str:
    """The study as Markdown: both tables, then what each run took."""
    runs = {(task, method): run for task in TASKS for method, run in results.finished(task, METHODS).items()}
    return (
        "\n".join(
            [
                "Success rate; mean ± 95 % interval (Student t) over seeds, and of the paired difference. Corrupted "
                "goals: a background of weight 0.4.",
                "",
                "After the agent has converged on the training goals:",
                "",
                scores_table(results, study.converged),
                "",
                "Last parameters:",
                "",
                scores_table(results, study.last),
                "",
                *(
                    study.describe_run(run, f"{task}, {study.title_of(method, task)}")
                    for (task, method), run in runs.items()
                ),
            ]
        )
        + "\n"
    )


def tables(results: Study) -> dict[str, str]:
    """The tables that pages show: none."""
    return {}


def main():
    """Run what is not there yet, then write the numbers and the table of all that is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tasks", nargs="*", default=TASKS, choices=TASKS)
    parser.add_argument("--methods", nargs="*", default=METHODS, choices=METHODS)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument(
        "--goal-images",
        type=Path,
        help="folder of goal images, of `infogoal data build fetch`; left out: those that are shipped",
    )
    arguments = parser.parse_args()
    for task in arguments.tasks:
        for method in arguments.methods:
            study.train(
                configuration(task, method, arguments.goal_images), arguments.seeds, arguments.out / task / method
            )
    study.finish(arguments.out, report)


if __name__ == "__main__":
    main()
