"""The study of the README: InfoGoal against bare DQN on three synthetic houses, five seeds each, beside a random policy
and the shortest path.

    python benchmarks/paper/house_study.py --out FOLDER [--houses 0 1 2] [--seeds 5]

House 0 is the default one; the others are built from their seeds. No house of this study was used for tuning. Every run
stays in FOLDER/house_N/METHOD; what is there is not run again, so houses may come from several machines.
FOLDER/numbers.npz holds the numbers of all runs (study_numbers.py), FOLDER/study.md the table and FOLDER/learning.png
the curves. Scores are shown without random actions in evaluation (test epsilon 0), and with the share of random actions
that is best for the success on training goals, for each method and house.
"""

import argparse
import dataclasses
import itertools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import study
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from study_numbers import Study, StudyRun

from infogoal_jax import envs, presets
from infogoal_jax.report.canvas import SHARE, draw_curve, figure_style, finish_share_axis, save
from infogoal_jax.report.statistics import mean_interval, paired_difference
from infogoal_jax.reproduce.paper import reported
from infogoal_jax.stand_ins.house import build_house
from infogoal_jax.train import host

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


def scores_by_epsilon(sweep: host.Sweep) -> dict[str, dict[str, list]]:
    """Every score of the last parameters at every epsilon, as part of result.json: {"scores": {metric:
    [seeds][epsilons]}}."""
    train = sweep.train

    def one(params, epsilon, env):
        hyper = train.config.hyper.replace(test_epsilon=epsilon)
        scores = train.evaluate(params, hyper, env, STARTS, seed=START_SEED)
        return {name: value for name, value in scores.items() if name != "first_reached"}

    every = jax.vmap(jax.vmap(one, in_axes=(None, 0, None)), in_axes=(0, None, None))
    found = jax.device_get(jax.jit(every)(sweep.params, jnp.asarray(EPSILONS), train.env))
    return {"scores": {name: value.tolist() for name, value in found.items()}}


def house_rows(
    runs: dict[str, StudyRun], baselines: dict[str, float], house: str, groups: tuple[str, ...]
) -> list[list[str]]:
    """Rows of one house: each group of goals and score at test epsilon 0, then at the one chosen on training goals."""
    results = {method: run.about["result"] for method, run in runs.items()}
    scores = {
        method: {name: np.asarray(value) for name, value in result["scores"].items()}
        for method, result in results.items()
    }
    diverged = {int(seed) for result in results.values() for seed in result["diverged"]}
    kept = [place for place, seed in enumerate(runs["none"].evaluations.seeds) if seed not in diverged]
    chosen = {method: int(scores[method]["train_goal/success_rate"].mean(0).argmax()) for method in METHODS}
    rows = []
    for group, score, columns in itertools.product(groups, SCORES, (dict.fromkeys(METHODS, 0), chosen)):
        name = f"{group}_goal/{score}"
        cells = [scores[method][name][kept, column] for method, column in columns.items()]
        epsilons = ", ".join(str(EPSILONS[column]) for column in columns.values())
        known = [f"{baselines[f'{group}_goal_{policy}/{score}']:.2f}" for policy in ("random", "shortest")]
        shown = [mean_interval(cell).show(2) for cell in cells] + [paired_difference(cells[1], cells[0]).show(2)]
        rows.append([house.removeprefix("house_"), group, SCORES[score], epsilons, *known, *shown])
    return rows


def houses(results: Study) -> dict[str, dict[str, StudyRun]]:
    """The runs of every house that is whole."""
    found = {house: results.finished(house, METHODS) for house in sorted(results.baselines)}
    return {house: runs for house, runs in found.items() if len(runs) == len(METHODS)}


def scores_table(results: Study, groups: tuple[str, ...]) -> str:
    """The table of all houses, of these groups of goals."""
    columns = [
        "house",
        "goals",
        "score",
        "test epsilon (DQN, InfoGoal)",
        "random",
        "shortest path",
        "DQN",
        "InfoGoal",
        "InfoGoal - DQN",
    ]
    rows = [
        row
        for house, runs in houses(results).items()
        for row in house_rows(runs, results.baselines[house], house, groups)
    ]
    return study.markdown(columns, rows)


def report(results: Study) -> str:
    """The study as Markdown: its table, and what the houses and runs were."""
    paper = ", ".join(
        f"{METHODS[method]} {reported('object_search', 'test_goal', method)}" for method in ("infogoal", "none")
    )
    seeds = {len(run.evaluations.seeds) for run in results.runs.values()}
    lines = [
        f"Mean ± 95 % interval (Student t) over {max(seeds)} seeds; in the last column of the paired difference. "
        f"{STARTS} starts for each goal. "
        f"The paper, on the real dataset: {paper} on test goals.",
        "",
        scores_table(results, ("train", "test")),
        "",
    ]
    for house, runs in houses(results).items():
        epochs = ", ".join(f"{METHODS[method]} {run.evaluations.epochs[-1]} epochs" for method, run in runs.items())
        lost = "".join(
            f"; {METHODS[method]} seeds {', '.join(map(str, run.about['result']['diverged']))} diverged and are left "
            "out"
            for method, run in runs.items()
            if run.about["result"]["diverged"]
        )
        first = runs["none"].about
        lines.append(
            f"- House {house.removeprefix('house_')}: {first['data']}; {epochs}; {first['result']['machine']}{lost}"
        )
    return "\n".join(lines) + "\n"


def tables(results: Study) -> dict[str, str]:
    """The tables that pages show, by name."""
    return {"test_goals": scores_table(results, ("test",))}


def learning_figure(results: Study) -> Figure:
    """Success on training (dashed) and test goals against environment steps, a panel a house: mean over seeds, 95 %
    band, every seed a thin line."""
    found = houses(results)
    figure = Figure(figsize=(4.2 * len(found), 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (house, runs) in zip(
        np.atleast_1d(figure.subplots(1, len(found), sharey=True)), found.items(), strict=True
    ):
        for (method, label), colour in zip(METHODS.items(), ("tab:orange", "tab:blue"), strict=True):
            values = runs[method].evaluations.values
            steps = values["env_steps"].mean(0) / 1e3
            draw_curve(axes, steps, values["test_goal/success_rate"], colour, f"{label}, test goals", SHARE)
            axes.plot(
                steps,
                values["train_goal/success_rate"].mean(0),
                color=colour,
                linestyle="--",
                label=f"{label}, training goals",
            )
        axes.axhline(
            results.baselines[house]["test_goal_random/success_rate"],
            color="grey",
            linestyle=":",
            label="random policy",
        )
        axes.set_title(f"synthetic {house.replace('_', ' ')} (a stand-in)")
        axes.set_xlabel("environment steps a seed (thousands)")
        finish_share_axis(axes, "success rate")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), fontsize=8, loc="outside upper center", ncols=5)
    seeds = max(len(run.evaluations.seeds) for run in results.runs.values())
    figure.supxlabel(
        f"object search, test epsilon 0; {seeds} seeds, mean with 95 % interval, each seed a thin line", fontsize=8
    )
    return figure


def main():
    """Run what is not there yet, then write the numbers, the table and the figure of all that is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--houses", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    for house in arguments.houses:
        place = arguments.out / f"house_{house}"
        for method in METHODS:
            study.train(house_config(method, house, arguments.out), arguments.seeds, place / method, scores_by_epsilon)
        config = house_config("none", house, arguments.out).env
        study.write_baselines(
            lambda config=config: envs.load("object_search", config), place / "baselines.json", STARTS, START_SEED
        )
    with figure_style():
        save(learning_figure(study.finish(arguments.out, report)), arguments.out / "learning.png")


if __name__ == "__main__":
    main()
