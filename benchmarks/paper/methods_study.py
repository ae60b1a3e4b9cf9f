"""Table I of the paper: every method on its tasks, five seeds each, beside the paper's numbers.

    python benchmarks/paper/methods_study.py --out FOLDER [--tasks object_search fetch_reach ...] [--methods vae her
    ...] [--seeds 5] [--with-her]

Every run stays in FOLDER/TASK/METHOD, with result.json for times and machine. What is there is not run again, so that
runs may come from several machines and several processes. FOLDER/numbers.npz holds the numbers of all runs
(study_numbers.py), FOLDER/study.md the tables: 5 or 10 starts for each goal (the preset's), no random actions.

As in the paper, numbers are those after the agent has converged on the training goals: of the first evaluation by which
the mean success on training goals was 0.99 or more twice in a row, or the last; a second table has the last parameters.
Methods are the presets'; docs/methods.md says how they were tuned. With --with-her learners are given HER besides,
which the paper does not do, into FOLDER/TASK/METHOD+her.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import fetch_study
import study
from study_numbers import Study

from infogoal_jax import presets
from infogoal_jax.report.statistics import mean_interval, paired_difference
from infogoal_jax.report.tables import Table
from infogoal_jax.reproduce.manifest import LEARNERS
from infogoal_jax.reproduce.paper import TABLE, TASKS, reported

WITH_HER = tuple(f"{method}+her" for method in LEARNERS)
KINDS = ("train_goal", "test_goal", "corrupted_test_goal", "corrupted_train_goal")
OVERVIEW = {"object_search": "object search", "fetch_reach": "FetchReach"}
"""Tasks on which all methods ran, and their names in the README."""


def task_table(results: Study, task: str, methods, choose: Callable[[Table], int], base: str = "none") -> str:
    """A row for each finished method of a task, at the evaluation that `choose` picks, compared with the method
    `base`."""
    runs = results.finished(task, methods)
    places = {method: choose(run.evaluations) for method, run in runs.items()}
    kinds = [kind for kind in KINDS if any(study.success(run, kind, -1) is not None for run in runs.values())]
    columns = ["method", "epochs"]
    for kind in kinds:
        columns += [study.KINDS[kind]] + ["paper"] * (kind in TABLE)
    columns.append(f"test, less {'the bare agent' if base == 'none' else study.METHODS[base]}'s")
    tests = {method: study.success(run, "test_goal", places[method]) for method, run in runs.items()}
    rows = []
    for method, run in runs.items():
        cells = [study.title_of(method, task), str(run.evaluations.epochs[places[method]])]
        for kind in kinds:
            cells += [mean_interval(study.success(run, kind, places[method])).show(2)] + [
                reported(task, kind, method)
            ] * (kind in TABLE)
        compared = method != base and base in runs
        rows.append([*cells, paired_difference(tests[method], tests[base]).show(2) if compared else ""])
    return study.markdown(columns, rows)


def with_her_table(results: Study, task: str) -> str:
    """Learners with HER, compared with HER alone."""
    return task_table(results, task, ("her", *WITH_HER), study.converged, base="her")


def overview(results: Study) -> str:
    """Every method's success on test goals, on the tasks of `OVERVIEW`."""
    rows = []
    for method in study.METHODS:
        cells = ["bare DQN, HRAC" if method == "none" else study.METHODS[method]]
        for task in OVERVIEW:
            run = results.runs[f"{task}/{method}"]
            cells += [
                mean_interval(study.success(run, "test_goal", study.converged(run.evaluations))).show(2),
                reported(task, "test_goal", method),
            ]
        rows.append(cells)
    return study.markdown(["method", *(title for name in OVERVIEW.values() for title in (name, "paper"))], rows)


def report(results: Study) -> str:
    """The study as Markdown: for each task both tables, then what each run took."""
    lines = [
        "Success rate; mean ± 95 % interval (Student t) over seeds, and of the paired difference. Corrupted goals: a "
        "background of weight 0.4.",
        "",
    ]
    for task in TASKS:
        alone, with_her = results.finished(task, study.METHODS), results.finished(task, WITH_HER)
        lines += [f"### {task}", ""] if alone or with_her else []
        if alone:
            lines += [
                "After the agent has converged on the training goals:",
                "",
                task_table(results, task, study.METHODS, study.converged),
                "",
            ]
            lines += ["Last parameters:", "", task_table(results, task, study.METHODS, study.last), ""]
        if with_her:
            lines += [
                "Learners with HER, after the agent has converged on the training goals:",
                "",
                with_her_table(results, task),
                "",
            ]
        lines += [
            study.describe_run(run, f"{task}, {study.title_of(method, task)}")
            for method, run in (alone | with_her).items()
        ]
        lines += [""] if alone or with_her else []
    return "\n".join(lines)


def tables(results: Study) -> dict[str, str]:
    """The tables that pages show, by name."""
    shown = {
        task: task_table(results, task, study.METHODS, study.converged)
        for task in ("object_search", *fetch_study.TASKS)
    }
    shown |= {f"{task}_with_her": with_her_table(results, task) for task in OVERVIEW}
    shown["fetch"] = fetch_study.scores_table(results, study.converged)
    shown["fetch_short"] = fetch_study.scores_table(results, study.converged, fetch_study.KINDS[1:], epochs=False)
    return shown | {"overview": overview(results)}


def main():
    """Run what is not there yet, then write the numbers and the tables of all that is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tasks", nargs="*", default=["object_search", "fetch_reach"], choices=TASKS)
    parser.add_argument(
        "--methods", nargs="*", choices=list(study.METHODS), help="all, unless given; with --with-her learners alone"
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--with-her", action="store_true", help="give the learners HER besides")
    arguments = parser.parse_args()
    known = LEARNERS if arguments.with_her else tuple(study.METHODS)
    if without := set(arguments.methods or ()) - set(known):
        parser.error(f"--with-her is for learners: {', '.join(known)}; not for {', '.join(sorted(without))}")
    for task in arguments.tasks:
        for method in arguments.methods or known:
            config = presets.load(task, method, relabelling="her" if arguments.with_her else None)
            study.train(
                config, arguments.seeds, arguments.out / task / (f"{method}+her" if arguments.with_her else method)
            )
    study.finish(arguments.out, report)


if __name__ == "__main__":
    main()
