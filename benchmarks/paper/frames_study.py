"""The study of object manipulation and embodied question answering: InfoGoal against the bare agent on three generated datasets, five seeds each.

    python benchmarks/paper/frames_study.py --out FOLDER [--tasks object_manipulation embodied_qa] [--datasets 0 1 2] [--methods ...] [--seeds 5]

Dataset N is generated from seed N, and so are its goals; none of them was used for tuning. Methods are those of `VARIANTS`: a learner, and where it
says so another relabelling than the preset's. Every run stays in FOLDER/TASK/N/METHOD with the curve of every seed; result.json beside it holds
times and machine. What is there is not run again, so that runs may come from several machines; FOLDER/study.md is the table of all that is there:
last parameters, 5 starts for each goal, no random actions, the goal's code sampled at every step.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import jax
import study

from infogoal_jax import envs, presets
from infogoal_jax.report import tables
from infogoal_jax.report.statistics import mean_interval, paired_difference
from infogoal_jax.train.evaluation import evaluate, random_policy, shortest_path_policy

VARIANTS = {
    "object_manipulation": {"none": ("HRAC", "none", None), "infogoal": ("InfoGoal", "infogoal", None)},
    "embodied_qa": {
        "none": ("CQL", "none", None), "infogoal": ("InfoGoal", "infogoal", None), "none_unrelabelled": ("CQL without relabelling", "none", "none"),
    },
}
"""For each task: a method's name, its learner, and its relabelling (None: the preset's). The second is compared with the first."""
KINDS = {
    "train_goal": "training", "validation_goal": "validation", "test_goal": "test", "corrupted_test_goal": "corrupted test",
    "corrupted_train_goal": "corrupted training",
}
PAPER = {
    "object_manipulation": {"test_goal": "0.40 / 0.92", "corrupted_test_goal": "0.30 / 0.95", "corrupted_train_goal": "0.75 / 1.00"},
    "embodied_qa": {"test_goal": "0.05 / 1.00"},
}
"""Table I of the paper: bare agent / InfoGoal."""
STARTS = 50  # For each goal, of the random policy and the shortest path.


def configuration(task: str, variant: str, dataset: int):
    """The preset of a task and a variant on the dataset and the goals of this seed."""
    _, method, relabelling = VARIANTS[task][variant]
    config = presets.load(task, method, relabelling=relabelling)
    seeds = {"generator_seed": dataset} | ({"goal_seed": dataset} if task == "object_manipulation" else {})
    return dataclasses.replace(config, env=dataclasses.replace(config.env, **seeds))


def baselines(task: str, dataset: int) -> dict[str, float]:
    """Success of a random policy and of shortest paths on every kind of goals."""
    env = envs.load(task, configuration(task, "none", dataset).env)
    policies = {"{group}_goal random": random_policy(env), "{group}_goal shortest": shortest_path_policy(env)}
    scores = jax.device_get(jax.jit(lambda env: evaluate(env, policies, STARTS))(env))
    return {name.removesuffix("/success_rate"): float(value) for name, value in scores.items() if name.endswith("/success_rate")}


def task_table(folder: Path, task: str) -> list[str]:
    """Rows of Markdown for one task: a row for each dataset and kind of goals."""
    variants = VARIANTS[task]
    names = [name for name, _, _ in variants.values()]
    header = ["dataset", "goals", "random", "shortest path", *names, f"{names[1]} - {names[0]}", f"paper: {names[0]} / {names[1]}"]
    lines = [f"### {task}", "", f"| {' | '.join(header)} |", "|" + "---|" * len(header)]
    for place in sorted((folder / task).glob("[0-9]*"), key=lambda path: int(path.name)):
        if not (place / "baselines.json").exists():
            continue  # Another process is still at work here.
        known = json.loads((place / "baselines.json").read_text())
        found = {variant: tables.read(place / variant, "evaluations").last() for variant in variants if (place / variant / "result.json").exists()}
        for kind, title in KINDS.items():
            cells = {variant: values[f"{kind}/success_rate"] for variant, values in found.items() if f"{kind}/success_rate" in values}
            if not cells:
                continue
            simple = [f"{known[f'{kind} {policy}']:.2f}" if f"{kind} {policy}" in known else "" for policy in ("random", "shortest")]
            shown = [mean_interval(cells[variant]).show(2) if variant in cells else "" for variant in variants]
            first, second = list(variants)[:2]
            shown.append(paired_difference(cells[second], cells[first]).show(2) if {first, second} <= cells.keys() else "")
            lines.append(f"| {' | '.join([place.name, title, *simple, *shown, PAPER[task].get(kind, '')])} |")
    lines.append("")
    for result in sorted((folder / task).glob("*/*/result.json")):
        values = json.loads(result.read_text())
        memory = f", {values['peak_bytes'] / 2**30:.1f} GiB of device memory" if values["peak_bytes"] else ""
        lost = f", seeds {values['diverged']} diverged" if values["diverged"] else ""
        lines.append(
            f"- {task} {result.parent.parent.name}, {variants[result.parent.name][0]}: {values['seeds']} seeds, {values['epochs']} epochs, "
            f"{values['updates']:,} updates; compiling {values['compile_seconds']:.0f} s, running {values['run_seconds']:.0f} s; "
            f"the dataset takes {values['data_bytes'] / 2**20:.0f} MiB{memory}{lost}. {values['data']}. {values['machine']}")
    return [*lines, ""]


def main():
    """Run what is not there yet, then write the table of all that is."""
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
            if not (place / "baselines.json").exists():
                (place / "baselines.json").write_text(json.dumps(baselines(task, dataset)) + "\n")
    introduction = ("Success rate of the last parameters; mean ± 95 % interval (Student t) over seeds, and of the paired difference. "
                    "All datasets are stand-ins.")
    shown = [line for task in VARIANTS if (arguments.out / task).exists() for line in task_table(arguments.out, task)]
    (arguments.out / "study.md").write_text("\n".join([introduction, "", *shown]))
    print("\n".join(shown))


if __name__ == "__main__":
    main()
