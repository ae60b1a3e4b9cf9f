"""Every table that a page shows of what was measured, written from the numbers in docs/results.

    python benchmarks/paper/tables.py [SOURCE ...] [--picture]

A table stands in README.md or docs/*.md between `<!-- table: SOURCE/NAME -->` and `<!-- end -->`; what is between them
is replaced by what the numbers of the source give. Sources:

    paper     Table I of the runs in table1.npz; docs/reproduction.md has all that is made of them
    tuning    the searches of tuning.py, in tuning.jsonl
    trials    the trials of trials.py, in trials/numbers.csv
    sb3_her   the curves of sb3_her.py, in sb3_her/
    drone     the flights of drone_flights.py and drone_faults.py, in drone/

--picture draws docs/results/learning.png, the picture of the README, too.
"""

import argparse
import re
from collections.abc import Callable
from pathlib import Path

import drone_numbers
import numpy as np
import sb3_her
import trials
import tuning
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from infogoal_jax.report.canvas import SHARE, draw_curve, figure_style, finish_share_axis, save
from infogoal_jax.reproduce import numbers, scores
from infogoal_jax.reproduce import tables as paper
from infogoal_jax.reproduce.table_formats import markdown_cell, markdown_lines

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
MARKED = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end -->)", re.S)
SHOWN = {"infogoal": ("InfoGoal", "tab:blue"), "her": ("HER", "tab:green"), "none": ("DQN", "tab:orange")}
"""Methods of the picture, with name and colour."""


def paper_tables() -> dict[str, str]:
    """The table of the README: the columns of test goals of Table I in the paper's way, and what its marks mean."""
    table = paper.table1(numbers.load(RESULTS), "paper")
    columns = [place for place, title in enumerate(table.head) if not place or title.endswith(", test")]
    shown = markdown_lines(
        [table.head[place].removesuffix(", test") for place in columns],
        [[markdown_cell(row[place]) for place in columns] for row in table.rows],
    )
    return {"overview": "\n".join([shown, "", *(f"- {line}" for line in table.foot[1:])]).strip()}


SOURCES: dict[str, Callable[[], dict[str, str]]] = {
    "paper": paper_tables,
    "tuning": lambda: tuning.tables(tuning.load(tuning.NUMBERS)),
    "trials": lambda: trials.tables(trials.load(trials.NUMBERS)),
    "sb3_her": lambda: sb3_her.tables(sb3_her.load()) if sb3_her.FOLDER.exists() else {},
    "drone": lambda: drone_numbers.tables(drone_numbers.load()),
}
"""The tables of each source, by name; none where it has no numbers yet."""


def written(sources: list[str]) -> dict[Path, str]:
    """What every page should be, by its path; tables of other sources, or of one without numbers, stay as they are."""
    found = {name: tables for name in sources if (tables := SOURCES[name]())}

    def replace(match: re.Match) -> str:
        before, name, after = match.groups()
        source, _, table = name.partition("/")
        return f"{before}{found[source][table]}\n{after}" if source in found else match[0]

    return {page: MARKED.sub(replace, page.read_text()) for page in PAGES}


def learning_figure(results: numbers.Results) -> Figure:
    """Success on training (dashed) and test goals of object search against environment steps, a panel a house: mean
    over seeds, 95 % band, every seed a thin line."""
    rows = {method: scores.row_of(results, "paper", "object_search", method) for method in SHOWN}
    runs = {method: {each.run.goal_set: each for each in row.results} for method, row in rows.items() if row}
    houses = sorted(set.intersection(*(set(own) for own in runs.values())))
    figure = Figure(figsize=(4.2 * len(houses), 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, house in zip(np.atleast_1d(figure.subplots(1, len(houses), sharey=True)), houses, strict=True):
        for method, own in runs.items():
            label, colour = SHOWN[method]
            values = own[house].evaluations
            steps = values["env_steps"].mean(0) / 1e3
            draw_curve(axes, steps, values["test_goal/success_rate"], colour, f"{label}, test goals", SHARE)
            training = values["train_goal/success_rate"].mean(0)
            axes.plot(steps, training, color=colour, linestyle="--", label=f"{label}, training goals")
        axes.set_title(f"synthetic house {house} (a stand-in)")
        axes.set_xlabel("environment steps a seed (thousands)")
        finish_share_axis(axes, "success rate")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), fontsize=8, loc="outside upper center", ncols=6)
    return figure


def main():
    """Write the pages."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", metavar="SOURCE", help=f"{', '.join(SOURCES)}; left out: all")
    parser.add_argument("--picture", action="store_true", help="draw the picture of the README too")
    arguments = parser.parse_args()
    for path, text in written(arguments.sources or list(SOURCES)).items():
        path.write_text(text)
    if arguments.picture:
        with figure_style():
            save(learning_figure(numbers.load(RESULTS)), picture := RESULTS / "learning.png")
        Image.open(picture).convert("RGB").quantize(64, dither=Image.Dither.NONE).save(picture, optimize=True)


if __name__ == "__main__":
    main()
