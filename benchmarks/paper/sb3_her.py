"""Stable-Baselines3's SAC with hindsight replay on FetchReach, beside this project's TD3 with hindsight replay: the
table and the curve.

    python benchmarks/paper/sb3_her.py      draws docs/results/sb3_her/learning.png

docs/results/sb3_her has numbers.csv of `benchmarks/peers/fetch_sb3_her.py --out` and ours.csv, the curve.csv of
`infogoal pretrain fetch_reach`: both learn from the same simulation and goals drawn alike.
"""

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np

from infogoal_jax.report import canvas
from infogoal_jax.reproduce.table_formats import markdown_lines

FOLDER = Path(__file__).parents[2] / "docs" / "results" / "sb3_her"
NAMES = {"numbers.csv": "Stable-Baselines3, SAC + HER", "ours.csv": "infogoal-jax, TD3 + HER"}
COLOURS = {"numbers.csv": "#0072B2", "ours.csv": "#D55E00"}
FIELDS = "env_steps", "success_rate"
ENOUGH = 0.9


class Curve(NamedTuple):
    """One seed. steps: of the environment, int [E]; success: float [E]."""

    seed: int
    steps: np.ndarray
    success: np.ndarray

    @property
    def first(self) -> int | None:
        """Steps after which success is first that of `ENOUGH`; None for never."""
        there = np.flatnonzero(self.success >= ENOUGH)
        return int(self.steps[there[0]]) if len(there) else None


def load(folder: Path = FOLDER) -> dict[str, list[Curve]]:
    """The curves of each file."""
    found: dict[str, list[Curve]] = {}
    for name in NAMES:
        with open(folder / name, newline="") as file:
            rows = list(csv.DictReader(file))
        for seed in sorted({int(row["seed"]) for row in rows}):
            own = [row for row in rows if int(row["seed"]) == seed]
            numbers = (np.array([float(row[field]) for row in own]) for field in FIELDS)
            found.setdefault(name, []).append(Curve(seed, *numbers))
    return found


def tables(curves: dict[str, list[Curve]]) -> dict[str, str]:
    """Environment steps of each seed until success is 0.9, and success at the end."""
    rows = []
    for name, title in NAMES.items():
        first = ", ".join("never" if curve.first is None else f"{curve.first:,}" for curve in curves[name])
        last = ", ".join(f"{curve.success[-1]:.2f}" for curve in curves[name])
        rows.append([title, first, f"{int(curves[name][0].steps[-1]):,}", last])
    head = ["learner", f"steps to {ENOUGH} (each seed)", "steps in all", "success at the end"]
    return {"steps": markdown_lines(head, rows)}


def draw(curves: dict[str, list[Curve]], path: Path) -> None:
    """Success against steps, a line for each seed."""
    with canvas.figure_style():
        figure = canvas.empty_figure("FetchReach, greedy policy", ("A line for each seed.",), (6.5, 3.6))
        axes = figure.subplots()
        for name, title in NAMES.items():
            for number, curve in enumerate(curves[name]):
                axes.plot(curve.steps, curve.success, color=COLOURS[name], marker=".", label="" if number else title)
        axes.axhline(ENOUGH, color="#888888", linewidth=0.8, linestyle="--")
        axes.set(xscale="log", xlabel="environment steps", ylabel="success rate", ylim=(-0.02, 1.02))
        axes.legend()
        canvas.save(figure, path)


if __name__ == "__main__":
    draw(load(), FOLDER / "learning.png")
