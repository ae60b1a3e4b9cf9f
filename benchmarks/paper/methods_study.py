"""Table I of the paper: every method on its tasks, five seeds each, beside the paper's numbers.

    python benchmarks/paper/methods_study.py --out FOLDER [--tasks object_search fetch_reach ...] [--methods vae her ...] [--seeds 5] [--with-her]

Every run stays in FOLDER/TASK/METHOD with the curve of every seed; result.json beside it holds times and machine. What is there is not run again, so
that runs may come from several machines and several processes; FOLDER/study.md is the table of all that is there: 5 or 10 starts for each goal
(the preset's), no random actions.

As in the paper, numbers are those after the agent has converged on the training goals: of the first evaluation by which the mean success on
training goals was 0.99 or more twice in a row, or the last; a second table has the last parameters. Methods are the presets'; docs/methods.md says
how they were tuned. With --with-her learners are given HER besides, which the paper does not do, into FOLDER/TASK/METHOD+her.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import study

from infogoal_jax import learners, presets
from infogoal_jax.report import tables
from infogoal_jax.report.statistics import mean_interval, paired_difference

NAMES = {
    "infogoal": "InfoGoal", "infobot": "InfoBot", "cogoal": "COGOAL", "gcb": "GCB", "vae": "VAE", "dgrl": "DGRL", "rad": "RAD",
    "none": "DQN / HRAC / CQL", "her": "HER", "cher": "CHER", "ghrl": "GHRL",
}
WITH_HER = {f"{method}+her": f"{title} + HER" for method, title in NAMES.items() if method in learners.registry and method != "none"}
KINDS = {"train_goal": "training", "test_goal": "test", "corrupted_test_goal": "corrupted test", "corrupted_train_goal": "corrupted training"}
TASKS = ("object_search", "object_manipulation", "fetch_reach", "fetch_push", "fetch_pick_and_place", "embodied_qa")
PAPER = {
    "test_goal": {
        "infogoal": (0.93, 0.92, 0.91, 0.84, 0.90, 1.0), "infobot": (0.85, 0.84, 0.70, 0.95, 0.72, 1.0), "cogoal": (0.45, 0.42, 0.34, 0.52, 0.17),
        "gcb": (0.41, 0.53, 0.59, 0.78, 0.61, 0.15), "vae": (0.21, 0.27, 0.22, 0.61, 0.37), "dgrl": (0.33, 0.41, 0.38, 0.70, 0.38),
        "rad": (0.19, 0.63, 0.33, 0.65, 0.33), "none": (0.18, 0.40, 0.06, 0.48, 0.19, 0.05), "her": (0.51, 0.88, 0.59, 0.75, 0.71),
        "cher": (0.53, 0.83, 0.48, 0.76, 0.67), "ghrl": (0.55, 0.84, 0.61, 0.81, 0.68, 0.65),
    },
    "corrupted_test_goal": {
        "infogoal": (0.95, 0.84, 0.74, 0.82), "infobot": (0.79, 0.80, 0.94, 0.76), "cogoal": (0.18, 0.0, 0.17, 0.0), "gcb": (0.35, 0.10, 0.28, 0.25),
        "vae": (0.19, 0.14, 0.51, 0.24), "dgrl": (0.25, 0.33, 0.50, 0.31), "rad": (0.44, 0.16, 0.46, 0.15), "none": (0.30, 0.09, 0.25, 0.23),
        "her": (0.52, 0.23, 0.48, 0.38), "cher": (0.50, 0.21, 0.52, 0.35), "ghrl": (0.48, 0.22, 0.48, 0.32),
    },
    "corrupted_train_goal": {
        "infogoal": (1.0, 0.91, 0.88, 0.82), "infobot": (0.88, 0.76, 0.92, 0.69), "cogoal": (0.48, 0.12, 0.31, 0.17), "gcb": (0.75, 0.13, 0.38, 0.53),
        "vae": (1.0, 0.84, 1.0, 0.91), "dgrl": (1.0, 0.90, 0.98, 0.95), "rad": (0.66, 0.62, 0.62, 0.46), "none": (0.75, 0.67, 0.56, 0.62),
        "her": (0.69, 0.44, 0.53, 0.44), "cher": (0.69, 0.34, 0.59, 0.50), "ghrl": (0.72, 0.42, 0.78, 0.41),
    },
}
"""Table I: by kind of goals and method, the tasks in the order of `TASKS`; corrupted goals of those with image goals, in the same order."""


def reported(kind: str, method: str, task: str) -> str:
    """The paper's number, or nothing where its table has none."""
    tasks = TASKS if kind == "test_goal" else TASKS[1:5]
    found = dict(zip(tasks, PAPER.get(kind, {}).get(method, ()), strict=False))
    return f"{found[task]:.2f}" if task in found else ""


def finished(folder: Path, task: str, names: dict[str, str]) -> list[str]:
    """Those of the methods whose runs are there."""
    return [method for method in names if (folder / task / method / "result.json").exists()]


def task_table(folder: Path, task: str, names: dict[str, str], choose: Callable[[dict], int], base: str = "none") -> list[str]:
    """Rows of Markdown for one task: a row for each finished method, at the evaluation that `choose` picks, compared with the method `base`."""
    runs = {method: tables.read(folder / task / method, "evaluations") for method in finished(folder, task, names)}
    places = {method: choose(table.values) for method, table in runs.items()}
    kinds = {kind: title for kind, title in KINDS.items() if any(f"{kind}/success_rate" in table.values for table in runs.values())}
    columns = ["method", "epochs"]
    for kind, title in kinds.items():
        columns += [title] + (["paper"] if kind in PAPER else [])
    columns.append(f"test, less {'the bare agent' if base == 'none' else names[base]}'s")
    lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]

    def scores(method: str, kind: str):
        return runs[method].values[f"{kind}/success_rate"][:, places[method]]

    for method, table in runs.items():
        cells = [names[method], str(int(table.epochs[places[method]]))]
        for kind in kinds:
            cells += [mean_interval(scores(method, kind)).show(2)] + ([reported(kind, method, task)] if kind in PAPER else [])
        compared = method != base and base in runs
        cells.append(paired_difference(scores(method, "test_goal"), scores(base, "test_goal")).show(2) if compared else "")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def report(folder: Path) -> str:
    """The study as Markdown: for each task both tables, then what each run took."""
    lines = ["Success rate; mean ± 95 % interval (Student t) over seeds, and of the paired difference. Corrupted goals: a background of weight 0.4.",
             ""]
    for task in TASKS:
        if not finished(folder, task, NAMES | WITH_HER):
            continue
        lines += [f"### {task}", ""]
        if finished(folder, task, NAMES):
            lines += ["After the agent has converged on the training goals:", "", *task_table(folder, task, NAMES, study.converged), ""]
            lines += ["Last parameters:", "", *task_table(folder, task, NAMES, lambda values: -1), ""]
        if finished(folder, task, WITH_HER):
            names = {"her": NAMES["her"]} | WITH_HER
            lines += ["Learners with HER, after the agent has converged on the training goals:", "",
                      *task_table(folder, task, names, study.converged, base="her"), ""]
        for method in finished(folder, task, NAMES | WITH_HER):
            learner = presets.METHODS[method.removesuffix("+her")].learner
            lines.append(study.describe_run(folder / task / method, f"{task}, {(NAMES | WITH_HER)[method]}", learner))
        lines.append("")
    return "\n".join(lines)


def main():
    """Run what is not there yet, then write the table of all that is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tasks", nargs="*", default=["object_search", "fetch_reach"], choices=TASKS)
    parser.add_argument("--methods", nargs="*", choices=list(NAMES), help="all, unless given; with --with-her learners alone")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--with-her", action="store_true", help="give the learners HER besides")
    arguments = parser.parse_args()
    known = [name.removesuffix("+her") for name in WITH_HER] if arguments.with_her else list(NAMES)
    if without := set(arguments.methods or ()) - set(known):
        parser.error(f"--with-her is for learners: {', '.join(known)}; not for {', '.join(sorted(without))}")
    for task in arguments.tasks:
        for method in arguments.methods or known:
            config = presets.load(task, method, relabelling="her" if arguments.with_her else None)
            study.train(config, arguments.seeds, arguments.out / task / (f"{method}+her" if arguments.with_her else method))
    (arguments.out / "study.md").write_text(report(arguments.out))
    print(report(arguments.out))


if __name__ == "__main__":
    main()
