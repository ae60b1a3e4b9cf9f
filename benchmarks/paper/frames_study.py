"""The study of object manipulation and embodied question answering: InfoGoal against the bare agent on three generated
datasets, five seeds each.

    python benchmarks/paper/frames_study.py --out FOLDER [--tasks object_manipulation embodied_qa] [--datasets 0 1 2]
    [--methods ...] [--seeds 5]

Dataset N is generated from seed N, and so are its goals; none of them was used for tuning. Methods are those of
`VARIANTS`: a learner, and where it says so another relabelling than the preset's. Every run stays in
FOLDER/TASK/N/METHOD, with result.json for times and machine. What is there is not run again, so that runs may come from
several machines. FOLDER/numbers.npz holds the numbers of all runs (study_numbers.py), FOLDER/study.md the table: last
parameters, 5 starts for each goal, no random actions, the goal's code sampled at every step.
"""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path

import study
from study_numbers import Study

from infogoal_jax import envs, presets
from infogoal_jax.report.tables import Table
from infogoal_jax.reproduce.paper import reported

VARIANTS = {
    "object_manipulation": {"none": ("HRAC", "none", None), "infogoal": ("InfoGoal", "infogoal", None)},
    "embodied_qa": {
        "none": ("CQL", "none", None),
        "infogoal": ("InfoGoal", "infogoal", None),
        "none_unrelabelled": ("CQL without relabelling", "none", "none"),
    },
}
"""For each task: a method's name, its learner, and its relabelling (None: the preset's). The second is compared with
the first."""
STARTS = 50  # For each goal, of the random policy and the shortest path.
HALF_WAY = 30  # Epochs of embodied question answering, of 60.
SHORT_TABLE = {
    "object_manipulation": ("train_goal", "test_goal", "corrupted_train_goal"),
    "embodied_qa": ("validation_goal", "test_goal"),
}
"""The kinds of goals in the README."""


def configuration(task: str, variant: str, dataset: int):
    """The preset of a task and a variant on the dataset and the goals of this seed."""
    _, method, relabelling = VARIANTS[task][variant]
    config = presets.load(task, method, relabelling=relabelling)
    seeds = {"generator_seed": dataset} | ({"goal_seed": dataset} if task == "object_manipulation" else {})
    return dataclasses.replace(config, env=dataclasses.replace(config.env, **seeds))


def datasets(results: Study, task: str) -> list[str]:
    """The datasets of a task that baselines are known of."""
    return sorted(place.removeprefix(f"{task}/") for place in results.baselines if place.startswith(f"{task}/"))


def scores(results: Study, task: str, kinds, choose: Callable[[Table], int]) -> list[tuple[str, str, dict]]:
    """(dataset, kind of goals, {variant: success [seeds]}) of a task, of every dataset and those of the kinds that the
    task has."""
    found = []
    for dataset in datasets(results, task):
        runs = results.finished(f"{task}/{dataset}", VARIANTS[task])
        for kind in kinds:
            values = {variant: study.success(run, kind, choose(run.evaluations)) for variant, run in runs.items()}
            if values and all(value is not None for value in values.values()):
                found.append((dataset, kind, values))
    return found


def task_table(results: Study, task: str) -> str:
    """A row for each dataset and kind of goals of a task, at the last evaluation."""
    names, rows = [name for name, _, _ in VARIANTS[task].values()], []
    for dataset, kind, values in scores(results, task, study.KINDS, study.last):
        known = results.baselines.get(f"{task}/{dataset}", {})
        simple = [known.get(f"{kind}_{policy}/success_rate") for policy in ("random", "shortest")]
        paper = " / ".join(reported(task, kind, method) for method in ("none", "infogoal"))
        shown = ["" if value is None else f"{value:.2f}" for value in simple]
        rows.append([dataset, study.KINDS[kind], *shown, *study.cells(values, VARIANTS[task]), paper.strip(" /")])
    columns = [
        "dataset",
        "goals",
        "random",
        "shortest path",
        *names,
        f"InfoGoal - {names[0]}",
        f"paper: {names[0]} / InfoGoal",
    ]
    return study.markdown(columns, rows)


def half_way_table(results: Study) -> str:
    """CQL and InfoGoal on the shelf after half of the updates."""
    found = scores(
        results,
        "embodied_qa",
        ("validation_goal", "test_goal"),
        lambda evaluations: list(evaluations.epochs).index(HALF_WAY),
    )
    rows = [[dataset, study.KINDS[kind], *study.cells(values, ("none", "infogoal"))] for dataset, kind, values in found]
    return study.markdown(["shelf", "goals", "CQL", "InfoGoal", "InfoGoal - CQL"], rows)


def short_table(results: Study) -> str:
    """Both tasks in one table, with the kinds of goals of `SHORT_TABLE`."""
    rows = []
    for task, kinds in SHORT_TABLE.items():
        for dataset, kind, values in scores(results, task, kinds, study.last):
            paper = [reported(task, kind, method) for method in ("none", "infogoal")]
            rows.append([task, dataset, study.KINDS[kind], *study.cells(values, ("none", "infogoal")), *paper])
    columns = [
        "task",
        "dataset",
        "goals",
        "bare agent",
        "InfoGoal",
        "InfoGoal - bare agent",
        "paper: bare agent",
        "paper: InfoGoal",
    ]
    return study.markdown(columns, rows)


def report(results: Study) -> str:
    """The study as Markdown: for each task its table, then what each run took."""
    lines = [
        "Success rate of the last parameters; mean ± 95 % interval (Student t) over seeds, and of the paired "
        "difference. "
        "All datasets are stand-ins.",
        "",
    ]
    for task, variants in VARIANTS.items():
        lines += [f"### {task}", "", task_table(results, task), ""]
        for dataset in datasets(results, task):
            runs = results.finished(f"{task}/{dataset}", variants)
            lines += [
                study.describe_run(run, f"{task} {dataset}, {variants[variant][0]}") for variant, run in runs.items()
            ]
        lines.append("")
    return "\n".join(lines)


def tables(results: Study) -> dict[str, str]:
    """The tables that pages show, by name."""
    shown = {task: task_table(results, task) for task in VARIANTS}
    return shown | {"embodied_qa_half_way": half_way_table(results), "short": short_table(results)}


def main():
    """Run what is not there yet, then write the numbers and the table of all that is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tasks", nargs="*", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--datasets", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--methods", nargs="*", default=None, help="variants; left out: all of a task")
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    for task in arguments.tasks:
        for dataset in arguments.datasets:
            place = arguments.out / task / str(dataset)
            for variant in VARIANTS[task] if arguments.methods is None else arguments.methods:
                study.train(configuration(task, variant, dataset), arguments.seeds, place / variant)
            config = configuration(task, "none", dataset).env
            study.write_baselines(
                lambda task=task, config=config: envs.load(task, config), place / "baselines.json", STARTS
            )
    study.finish(arguments.out, report)


if __name__ == "__main__":
    main()
