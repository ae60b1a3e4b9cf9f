"""The study of the README: InfoGoal against bare DQN on three synthetic houses, five seeds each, beside a random policy and the shortest path.

    python benchmarks/paper/house_study.py --out FOLDER [--houses 0 1 2] [--seeds 5]

House 0 is the default one; the others are built from their seeds. No house of this study was used for tuning. Every run stays in
FOLDER with the curve of every seed; FOLDER/house_N/result.json holds the numbers, FOLDER/study.md the table
and FOLDER/learning.png the curves. What is there is not run
again, so houses may come from several machines. Scores are shown without random actions in evaluation (test epsilon 0), and with the share of
random actions that is best for the success on training goals, for each method and house.
"""

import argparse
import dataclasses
import itertools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from infogoal_jax import presets
from infogoal_jax.report import tables
from infogoal_jax.report.canvas import draw_curve, finish_share_axis, save
from infogoal_jax.report.machine import describe_machine
from infogoal_jax.report.statistics import mean_interval, paired_difference
from infogoal_jax.stand_ins.house import build_house
from infogoal_jax.train import host
from infogoal_jax.train.evaluation import evaluate, random_policy, shortest_path_policy
from infogoal_jax.train.listeners import make_listeners

METHODS = {"none": "DQN", "infogoal": "InfoGoal"}
EPSILONS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3)
STARTS, START_SEED = 50, 1
SCORES = {"success_rate": "success", "spl": "SPL"}


def house_config(method: str, house: int, folder: Path):
    """The preset of a method on this house, built first if it is not the default one."""
    config = presets.load("object_search", method)
    if house == 0:
        return config
    path = folder / f"house_{house}" / "dataset"
    if not path.exists():
        build_house(path, seed=house)
    return dataclasses.replace(config, env=dataclasses.replace(config.env, dataset=str(path)))


def scores_by_epsilon(sweep: host.Sweep) -> dict[str, np.ndarray]:
    """Every score of the last parameters at every epsilon: {"{group}_goal/{score}": [seeds, epsilons]}, and with `_mean_code` for the mean code."""
    train = sweep.train

    def one(params, epsilon, env):
        policies = train.test_policies(params, train.config.hyper.replace(test_epsilon=epsilon), env, STARTS, seed=START_SEED)
        scores = evaluate(env, policies, STARTS, START_SEED)
        return {name: value for name, value in scores.items() if name != "first_reached"}

    every = jax.vmap(jax.vmap(one, in_axes=(None, 0, None)), in_axes=(0, None, None))
    return jax.device_get(jax.jit(every)(sweep.params, jnp.asarray(EPSILONS), train.env))


def baselines(env) -> dict[str, float]:
    """The same scores of a random policy (`_random`) and of shortest paths (`_shortest`)."""
    policies = {"{group}_goal_random": random_policy(env), "{group}_goal_shortest": shortest_path_policy(env)}
    scores = jax.device_get(jax.jit(lambda env: evaluate(env, policies, STARTS, START_SEED))(env))
    return {name: float(value) for name, value in scores.items() if name != "first_reached"}


def study_house(house: int, seeds: int, folder: Path) -> dict:
    """Numbers of one house: random policy, shortest path, and for each method its scores at the epsilon chosen on training goals."""
    result: dict = {"house": house, "machine": describe_machine(), "seeds": seeds, "epsilons": EPSILONS}
    for method in METHODS:
        config, out = house_config(method, house, folder), folder / f"house_{house}" / method
        with make_listeners(out, config, seeds) as listeners:
            sweep = host.run(config, list(range(seeds)), out, resume=(out / "checkpoint").exists(), listeners=listeners)
        scores = scores_by_epsilon(sweep)
        chosen = int(scores["train_goal/success_rate"].mean(0).argmax())
        result["data"] = sweep.train.env.source
        result[method] = {
            "epochs": config.num_epochs, "chosen": chosen, "diverged": [str(seed) for seed in sweep.diverged],
            "scores": {name: value.tolist() for name, value in scores.items()},
        }
    return result | {"baselines": baselines(sweep.train.env)}


def table(results: list[dict]) -> str:
    """The study as Markdown: each group of goals and score at test epsilon 0, then at the one chosen on training goals."""
    seeds = results[0]["seeds"]
    lines = [
        f"Mean ± 95 % interval (Student t) over {seeds} seeds; in the last column of the paired difference. {STARTS} starts for each goal. "
        "The paper, on the real dataset: InfoGoal 0.93, DQN 0.18 on test goals.", "",
        "| house | goals | score | test epsilon (DQN, InfoGoal) | random | shortest path | DQN | InfoGoal | InfoGoal - DQN |", "|" + "---|" * 9,
    ]
    for result in results:
        chosen = {method: result[method]["chosen"] for method in METHODS}
        for group, score, columns in itertools.product(("train", "test"), SCORES, (dict.fromkeys(METHODS, 0), chosen)):
            name = f"{group}_goal/{score}"
            diverged = {int(seed) for method in METHODS for seed in result[method]["diverged"]}
            kept = [seed for seed in range(seeds) if seed not in diverged]
            cells = [np.asarray(result[method]["scores"][name])[kept, column] for method, column in columns.items()]
            epsilons = ", ".join(str(EPSILONS[column]) for column in columns.values())
            known = [f"{result['baselines'][f'{group}_goal_{policy}/{score}']:.2f}" for policy in ("random", "shortest")]
            shown = [mean_interval(cell).show(2) for cell in cells] + [paired_difference(cells[1], cells[0]).show(2)]
            lines.append(f"| {' | '.join([str(result['house']), group, SCORES[score], epsilons, *known, *shown])} |")
    lines.append("")
    for result in results:
        epochs = ", ".join(f"{label} {result[method]['epochs']} epochs" for method, label in METHODS.items())
        lost = {label: result[method]["diverged"] for method, label in METHODS.items() if result[method]["diverged"]}
        left_out = "".join(f"; {label} seeds {', '.join(seeds_lost)} diverged and are left out" for label, seeds_lost in lost.items())
        lines.append(f"- House {result['house']}: {result['data']}; {epochs}; {result['machine']}{left_out}")
    return "\n".join(lines) + "\n"


def learning_figure(results: list[dict], folder: Path) -> Figure:
    """Success on training (dashed) and test goals against environment steps, a panel a house: mean over seeds, 95 % band, every seed a thin line."""
    figure = Figure(figsize=(4.2 * len(results), 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, result in zip(np.atleast_1d(figure.subplots(1, len(results), sharey=True)), results, strict=True):
        for (method, label), colour in zip(METHODS.items(), ("tab:orange", "tab:blue"), strict=True):
            table = tables.read(folder / f"house_{result['house']}" / method, "evaluations")
            steps = table.values["env_steps"].mean(0) / 1e3
            draw_curve(axes, steps, table.values["test_goal/success_rate"], colour, f"{label}, test goals")
            axes.plot(steps, table.values["train_goal/success_rate"].mean(0), color=colour, linestyle="--", label=f"{label}, training goals")
        axes.axhline(result["baselines"]["test_goal_random/success_rate"], color="grey", linestyle=":", label="random policy")
        axes.set_title(f"synthetic house {result['house']} (a stand-in)")
        axes.set_xlabel("environment steps a seed (thousands)")
        finish_share_axis(axes, "success rate")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), fontsize=8, loc="outside upper center", ncols=5)
    figure.supxlabel(f"object search, test epsilon 0; {results[0]['seeds']} seeds, mean with 95 % interval, each seed a thin line", fontsize=8)
    return figure


def main():
    """Run what is not there yet, then write result.json of each house and study.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--houses", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    for house in arguments.houses:
        path = arguments.out / f"house_{house}" / "result.json"
        if not path.exists():
            result = study_house(house, arguments.seeds, arguments.out)
            path.write_text(json.dumps(result) + "\n")
    results = [json.loads(path.read_text()) for path in sorted(arguments.out.glob("house_*/result.json"))]
    (arguments.out / "study.md").write_text(table(results))
    save(learning_figure(results, arguments.out), arguments.out / "learning.png")
    print(table(results))


if __name__ == "__main__":
    main()
