"""Every table that a page shows of what was measured, written from the numbers in docs/results.

    python -m infogoal_paper.pages [SOURCE ...] [--take FOLDER] [--pictures]

A table stands in README.md or docs/*/*.md between `<!-- table: SOURCE/NAME -->` and `<!-- end -->`; what is between
them is replaced by what the numbers of the source give. Sources:

    readme    the README's two tables, of noise.csv.xz and of the runs in all_goals.npz; docs/research/noise_at_test.md
              and docs/research/all_goals.md have all that is made of them, with intervals
    trials    the cubes of the bare agent in trials/numbers.csv.xz, of which trials.py --table prints the other tables
    tuning    the searches of tuning.py, in tuning.jsonl.xz
    noise     the study of noise at test, noise.py, in noise.csv.xz
    sufficiency Definition 1 on houses, sufficiency.py, in sufficiency.csv.xz
    choices   what was chosen for Table I and what it saw, choices.py, of the presets
    all_goals the study of docs/research/all_goals.md, in all_goals.npz, with what it shares with the paper in paper.npz
    sb3_her   Stable-Baselines3's SAC with hindsight replay beside this project's TD3, on FetchReach, in
              sb3_her/curves.csv
    drone     the flights of drone_flights.py and drone_faults.py, in drone.json.xz
    positions Fetch with continuous goals, positions.py, in positions.csv.xz, transfer.jsonl.xz and
              sb3_her/reference.csv.xz
    continuous the studies of docs/research/continuous_goals.md, continuous.py, in continuous.json.xz
    jaxgcrl   our agents beside JaxGCRL, jaxgcrl.py, in jaxgcrl.json.xz
    ogbench   our offline agents beside OGBench, ogbench.py, in ogbench.jsonl.xz
    goal_encoders  goal encoders on both, goal_encoders.py
    first_hour  what benchmarks/speed/first_steps.py saved, in first_hour.json
    bfloat16  success with --bfloat16, which benchmarks/speed/success.py saved, in bfloat16.jsonl.xz

--take puts into the last two, in place of what was there, what FOLDER has of flights.json and faults.json of the
scripts, numbers.csv of benchmarks/peers/fetch_sb3_her.py and evaluations.csv of `infogoal pretrain fetch_reach`.
--pictures draws docs/results/learning.png, the picture of the README, sb3_her/learning.png, noise.png,
all_goals.png, jaxgcrl.png and continuous_*.png, too.
"""

import argparse
import csv
import itertools
import json
import lzma
import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from infogoal_jax.report import canvas
from infogoal_jax.report.canvas import SHARE, draw_curve, figure_style, finish_share_axis, save
from infogoal_jax.report.statistics import paired_difference
from infogoal_paper import (
    all_goals,
    choices,
    continuous,
    goal_encoders,
    jaxgcrl,
    noise_numbers,
    numbers,
    ogbench,
    paper,
    positions,
    scores,
    sufficiency,
    trial_numbers,
    trials,
    tuning,
)
from infogoal_paper.manifest import PROTOCOLS
from infogoal_paper.table_formats import machines_in_words, markdown_lines

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "docs" / "results"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*/*.md"))]
MARKED = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end -->)", re.S)
SHOWN = {"infogoal": ("InfoGoal", "tab:blue"), "her": ("HER", "tab:green"), "none": ("DQN", "tab:orange")}
"""Methods of the picture, with name and colour."""


FEW = {"infogoal": "InfoGoal", "infogoal+her": "InfoGoal with HER", "her": "HER alone", "none": "bare agent"}
"""Rows of the README's first table."""
TASKS = {task: noise_numbers.TITLES[task] for task in paper.TASKS}
"""Tasks in words."""
UNSEEN = {"none": "bare agent", "her": "HER", "all_goals": "all-goals head", "infogoal+all_goals": "InfoGoal + head"}
"""Rows of its second table."""


def readme_tables() -> dict[str, str]:
    """The two tables of the README: success on test goals as a plain mean over goal sets and seeds, the best of a
    column in bold. The first is of the study of noise at test, each method with its own best noise."""
    results, noise = numbers.load(RESULTS), noise_numbers.Numbers(noise_numbers.read())
    studies = [noise_numbers.SHOWN[task] for task in TASKS]
    shown = [
        [float(np.mean(noise_numbers.reached_at_best(noise, study, method, "test"))) for study in studies]
        for method in FEW
    ]
    compared = {task: all_goals.rows_of(results, task) for task in ("object_search", "object_manipulation")}
    unseen = [
        [rows[method, protocol].mean("test_goal").mean for rows in compared.values() for protocol in PROTOCOLS]
        for method in UNSEEN
    ]
    heads = [f"{TASKS[task]}, `{protocol}`" for task in compared for protocol in PROTOCOLS]
    return {
        "overview": plain_table(list(TASKS.values()), list(FEW.values()), shown),
        "unseen": plain_table(heads, list(UNSEEN.values()), unseen),
    }


def plain_table(columns: list[str], names: list[str], rows: list[list[float]]) -> str:
    """Numbers [row][column] with two decimals and the best of each column, after rounding, in bold."""
    words = [[f"{number:.2f}" for number in row] for row in rows]
    best = [max(column) for column in zip(*words, strict=True)]
    cells = [[f"**{word}**" if word == top else word for word, top in zip(row, best, strict=True)] for row in words]
    return markdown_lines(["method", *columns], [[name, *row] for name, row in zip(names, cells, strict=True)])


LANDINGS = ("interrupted", "battery", "link lost", "video", "its own landing", "were refused", "were never answered")
"""Words by which reasons of a landing are counted as one, in front of what is special to a flight."""
DRONE = RESULTS / "drone.json.xz"


def drone_numbers() -> dict[str, dict[str, Any]]:
    """What the scripts wrote, {"flights" or "faults": ...}."""
    return json.loads(trial_numbers.read_text(DRONE))


def take_drone(folder: Path) -> int:
    """Put the flights of a folder into the numbers; how many of the two files it has."""
    files = [folder / name for name in ("flights.json", "faults.json") if (folder / name).exists()]
    found = drone_numbers() | {file.stem: json.loads(file.read_text()) for file in files}
    trial_numbers.write_compressed(DRONE, json.dumps(found, indent=0) + "\n")
    return len(files)


def drone_tables(results: dict[str, dict[str, Any]]) -> dict[str, str]:
    """The tables by name, each with the line that says where and when it was measured."""
    return {"flights": flights_table(results["flights"]), "faults": faults_table(results["faults"])}


def measured(results: dict[str, Any]) -> str:
    """Machine, versions, pace, load and date in words."""
    load = [flight["load"] for flight in results["flights"]]
    return (
        f"{results['speed']:g} simulated seconds in a second; load of the machine {np.median(load):.1f} in the median, "
        f"{max(load):.1f} at most; {results['machine']}."
    )


def flights_table(results: dict[str, Any]) -> str:
    """Flights beside the evaluation, and the time of a step."""
    flown = results["flights"]
    latency = 1000 * np.concatenate([flight["latency"] for flight in flown])
    difference = np.array([flight["found"] - flight["inside"] for flight in flown])
    error = difference.std(ddof=1) / np.sqrt(len(flown))
    by_video = sum(flight["reason"].startswith(("video", "link")) for flight in flown)
    rows = [
        ["flights over the real protocol that found the object", f"{np.mean([one['found'] for one in flown]):.2f}"],
        [
            "evaluation inside of the program, the same policy, questions and starts",
            f"{np.mean([one['inside'] for one in flown]):.2f}",
        ],
        ["paired difference, and its standard error", f"{difference.mean():.2f}, {error:.2f}"],
        ["evaluation inside of the program, all test questions and starts", f"{results['inside_all']:.2f}"],
        ["flights that ended on the ground", f"{sum(flight['landed'] for flight in flown)} of {len(flown)}"],
        ["flights that the checks of video and link ended", f"{by_video}"],
        ["from the arrival of the image to the command, median", f"{np.median(latency):.0f} ms"],
        [f"99th percentile of {len(latency):,} moves", f"{np.percentile(latency, 99):.0f} ms"],
    ]
    columns = [f"`{results['run']}`, {results['method']}", ""]
    return f"{markdown_lines(columns, rows)}\n\n{measured(results)}"


PROMISES = {"on_ground": "on the ground", "inside": "inside of the envelope", "explained": "log has the reason"}
"""What has to hold in every flight, as the numbers name it, and in words."""


def faults_table(results: dict[str, Any]) -> str:
    """What came of every kind of fault: each flight but those that had landed before their fault came."""
    rows, before = [], 0
    for name in dict.fromkeys(flight["fault"] for flight in results["flights"]):
        all_flights = [flight for flight in results["flights"] if flight["fault"] == name]
        flights = list({flight["seed"]: flight for flight in all_flights}.values())  # The last attempt of each.
        before += len(all_flights) - len(flights)
        kept = [sum(flight[promise] for flight in flights) for promise in PROMISES]
        rows.append([name, str(len(flights)), *map(str, kept), reasons(flights)])
    total = [str(sum(int(row[column]) for row in rows)) for column in range(1, 5)]
    columns = ["fault", "flights", *PROMISES.values(), "reasons"]
    rows.append(["all", *total, ""])
    if len(set(total)) == 1:  # Every promise was kept in every flight.
        kept = f"All {total[0]} flights: {', '.join(PROMISES.values())}. "
        columns, rows = ["fault", "flights", "reasons"], [[row[0], row[1], row[-1]] for row in rows[:-1]]
    else:
        kept = ""
    apart = f" {before} more flights ended, on the ground, before their fault came." if before else ""
    return f"{markdown_lines(columns, rows)}\n\n{kept}{measured(results)}{apart}"


def reasons(flights: list[dict[str, Any]]) -> str:
    """The reasons in the logs with their counts, the most frequent first; that of the drone where a log has no end."""
    counts = Counter(kind_of(flight) for flight in flights)
    return ", ".join(f"{kind} ({count})" if len(counts) > 1 else kind for kind, count in counts.most_common())


def kind_of(flight: dict[str, Any]) -> str:
    """The reason of a landing without what is special to this flight."""
    reason = flight["reason"] or f"no end; the firmware's landing, {flight['why_landed']}"
    return next((shown(kind, reason) for kind in LANDINGS if kind in reason), reason)


def shown(kind: str, reason: str) -> str:
    """A kind of reason in words."""
    words = {"battery": "battery at the floor", "its own landing": "motion of another controller or of its own landing"}
    words |= {"video": reason, "were refused": reason.split(",")[0]}
    return words.get(kind, kind)


SB3_HER = RESULTS / "sb3_her"
CURVES = SB3_HER / "curves.csv"
LEARNERS = {"sb3": "Stable-Baselines3, SAC + HER", "ours": "infogoal-jax, TD3 + HER"}
LEARNER_COLOURS = {"sb3": "#0072B2", "ours": "#D55E00"}
LEARNER_FILES = {"sb3": "numbers.csv", "ours": "evaluations.csv"}
FIELDS = "env_steps", "success_rate"
SUCCESS_OF_RUNS = "train_goal/success_rate"
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


def read_csv(path: Path) -> list[dict[str, str]]:
    """The rows of a file by the names of its columns."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def take_sb3(folder: Path) -> int:
    """Put the curves of a folder into the numbers; how many of the two files it has."""
    found = {name: read_csv(folder / file) for name, file in LEARNER_FILES.items() if (folder / file).exists()}
    before = read_csv(CURVES)
    rows, columns = [row for row in before if row["learner"] not in found], list(before[0])
    for row in found.get("ours", []):
        row["success_rate"] = row[SUCCESS_OF_RUNS]
    rows += [
        {"learner": name} | {key: row[key] for key in columns if key in row}
        for name, own in found.items()
        for row in own
    ]
    with open(CURVES, "w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(field for row in rows for field in row)), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return len(found)


def sb3_curves() -> dict[str, list[Curve]]:
    """The curves of each learner."""
    found: dict[str, list[Curve]] = {}
    rows = read_csv(CURVES)
    for name, seed in sorted({(row["learner"], int(row["seed"])) for row in rows}):
        own = [row for row in rows if (row["learner"], int(row["seed"])) == (name, seed)]
        numbers = (np.array([float(row[field]) for row in own]) for field in FIELDS)
        found.setdefault(name, []).append(Curve(seed, *numbers))
    return found


def sb3_tables(curves: dict[str, list[Curve]]) -> dict[str, str]:
    """Environment steps of each seed until success is 0.9, and success at the end."""
    rows = []
    for name, title in LEARNERS.items():
        first = ", ".join("never" if curve.first is None else f"{curve.first:,}" for curve in curves[name])
        last = ", ".join(f"{curve.success[-1]:.2f}" for curve in curves[name])
        rows.append([title, first, f"{int(curves[name][0].steps[-1]):,}", last])
    head = ["learner", f"steps to {ENOUGH} (each seed)", "steps in all", "success at the end"]
    return {"steps": markdown_lines(head, rows)}


def draw_sb3(curves: dict[str, list[Curve]], path: Path) -> None:
    """Success against steps, a line for each seed."""
    figure = canvas.empty_figure("FetchReach, greedy policy", ("A line for each seed.",), (6.5, 3.6))
    axes = figure.subplots()
    for name, title in LEARNERS.items():
        for number, curve in enumerate(curves[name]):
            axes.plot(
                curve.steps, curve.success, color=LEARNER_COLOURS[name], marker=".", label="" if number else title
            )
    axes.axhline(ENOUGH, color="#888888", linewidth=0.8, linestyle="--")
    axes.set(xscale="log", xlabel="environment steps", ylabel="success rate", ylim=(-0.02, 1.02))
    axes.legend()
    canvas.save(figure, path)


def first_hour_table() -> dict[str, str]:
    """What a newcomer's steps take: seconds, and CPU seconds in brackets, of the steps that both columns have."""
    saved = json.loads((RESULTS / "first_hour.json").read_text())
    columns = [saved[name]["seconds"] for name in ("before", "now")]
    rows = {step: [own[step] for own in columns] for step in columns[1] if step in columns[0]}
    rows["all of these"] = [np.sum(own, 0) for own in zip(*rows.values(), strict=True)]
    shown = {step: [f"{seconds:.0f} ({used:.0f})" for seconds, used in own] for step, own in rows.items()}
    table = markdown_lines(["", "before, s", "now, s"], [[step, *cells] for step, cells in shown.items()])
    machines = [f"{name.capitalize()}: {saved[name]['machine']}." for name in ("before", "now")]
    return {"steps": f"{table}\n\n{' '.join(machines)}"}


BFLOAT16 = RESULTS / "bfloat16.jsonl.xz"


def success_table(runs: Sequence[dict[str, Any]]) -> str:
    """Success at the last evaluation before and after a change, and the difference with its 95 % interval, seeds
    paired, of every task that has both. runs: what benchmarks/speed/success.py writes."""
    rows = []
    for before, after in itertools.product(runs, runs):
        if (before["label"], after["label"], before["task"]) != ("before", "after", after["task"]):
            continue
        for goals in ("test", "corrupted test"):
            name = f"{goals.replace(' ', '_')}_goal/success_rate"
            if name in before["success"]:
                first, last = ([row[-1] for row in each["success"][name]] for each in (before, after))
                about = [
                    before["task"],
                    after["method"],
                    f"{after['updates']:,}",
                    goals.removesuffix("_goal").replace("_", " "),
                ]
                means = [f"{np.mean(each):.3f}" for each in (first, last)]
                rows.append([*about, *means, paired_difference(last, first).show(3)])
    table = markdown_lines(["task", "method", "updates", "goals", "before", "after", "difference"], rows)
    seeds = min(each["seeds"] for each in runs)
    return f"{table}\n\n{seeds} seeds; {machines_in_words(each['machine'] for each in runs)}."


def bfloat16_table() -> dict[str, str]:
    """Success without and with `--bfloat16`."""
    return {"success": success_table([json.loads(line) for line in lzma.open(BFLOAT16)])}


SOURCES: dict[str, Callable[[], dict[str, str]]] = {
    "readme": readme_tables,
    "tuning": lambda: tuning.tables(tuning.load(tuning.NUMBERS)),
    "trials": lambda: {"calibration": trials.calibration_table(trial_numbers.read(trials.NUMBERS))},
    "noise": lambda: noise_numbers.tables(noise_numbers.read()),
    "sufficiency": lambda: sufficiency.tables(trial_numbers.kept(sufficiency.NUMBERS)),
    "choices": choices.tables,
    "all_goals": lambda: all_goals.on_page(numbers.load(RESULTS)),
    "sb3_her": lambda: sb3_tables(sb3_curves()),
    "drone": lambda: drone_tables(drone_numbers()),
    "positions": positions.tables,
    "continuous": continuous.tables,
    "jaxgcrl": jaxgcrl.tables,
    "ogbench": ogbench.tables,
    "goal_encoders": goal_encoders.tables,
    "first_hour": first_hour_table,
    "bfloat16": bfloat16_table,
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
    parser.add_argument(
        "--take", type=Path, metavar="FOLDER", help="put the files of this folder into the numbers first"
    )
    parser.add_argument("--pictures", action="store_true", help="draw the pictures too")
    arguments = parser.parse_args()
    if arguments.take and not take_drone(arguments.take) + take_sb3(arguments.take):
        parser.error(f"--take {arguments.take}: it has none of the files that are named above")
    for path, text in written(arguments.sources or list(SOURCES)).items():
        path.write_text(text)
    if arguments.pictures:
        with figure_style():
            save(learning_figure(numbers.load(RESULTS)), RESULTS / "learning.png")
            draw_sb3(sb3_curves(), SB3_HER / "learning.png")
            save(noise_numbers.figure(noise_numbers.read()), RESULTS / "noise.png")
        all_goals.draw_figure(numbers.load(RESULTS), RESULTS / "all_goals.png")
        beside = jaxgcrl.read()
        jaxgcrl.draw(beside["beside"], beside["alone"], RESULTS / "jaxgcrl.png")
        drawn = (
            *(RESULTS / f"{name}.png" for name in ("learning", "sb3_her/learning", "noise", "all_goals", "jaxgcrl")),
            *continuous.draw_all(),
        )
        for path in drawn:
            Image.open(path).convert("RGB").quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    main()
