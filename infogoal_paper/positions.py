"""Fetch with continuous goals: how soon it is solved, and what its policies reach in the reference.

    python -m infogoal_paper.positions [--runs RUN ...] [--transfers FILE ...]

`--runs` puts the evaluations of runs of `infogoal train fetch_*_positions` into docs/results/positions.csv.gz,
`--transfers` the files that benchmarks/fidelity/fetch_transfer.py wrote into docs/results/transfer.jsonl, each in place
of what was there of the same task, learner and agent, or of the same policy. `pages.py positions` writes the tables of
docs/reference/vectors.md.
"""

import argparse
import json
from itertools import groupby
from pathlib import Path
from typing import Any

from infogoal_jax.report.statistics import mean_interval
from infogoal_paper import trial_numbers
from infogoal_paper.table_formats import markdown_lines
from infogoal_paper.trial_numbers import Row

RESULTS = Path(__file__).parents[1] / "docs" / "results"
NUMBERS, TRANSFERS = RESULTS / "positions.csv.gz", RESULTS / "transfer.jsonl"
KEY = "task", "learner", "agent"
TITLES = {
    "fetch_reach_positions": "Reach",
    "fetch_push_positions": "Push",
    "fetch_pick_and_place_positions": "PickAndPlace",
    "fetch_slide_positions": "Slide",
}
"""The tasks, in the order of the tables."""
NAMES = {"none": "", "infogoal": " + InfoGoal"}
ENOUGH = 0.9


def rows_of_run(folder: Path) -> list[Row]:
    """A row for each evaluation of each seed."""
    about = json.loads((folder / "config.json").read_text())
    config, machine = about["config"], f"1 x {about['device']}, jax {about['versions']['jax']}"
    parts = {"task": config["task"], "learner": config["learner"]["name"], "agent": config["agent"]["name"]}
    return [
        parts
        | {name: row[name] for name in ("seed", "epoch", "env_steps")}
        | {"success": f"{float(row['train_goal/success_rate']):.4g}", "machine": machine}
        for row in trial_numbers.read(folder / "evaluations.csv")
    ]


def read() -> list[Row]:
    """The rows so far."""
    return trial_numbers.read(NUMBERS) if NUMBERS.exists() else []


def take(runs: list[Path]) -> None:
    """Put the evaluations of these runs into the numbers."""
    new = [row for run in runs for row in rows_of_run(run)]
    replaced = {tuple(row[name] for name in KEY) for row in new}
    rows = [row for row in read() if tuple(row[name] for name in KEY) not in replaced] + new
    rows.sort(key=lambda row: (*(row[name] for name in KEY), int(row["seed"]), int(row["epoch"])))
    trial_numbers.write(rows, NUMBERS)


def take_transfers(files: list[Path]) -> None:
    """Put what these policies reach into the numbers."""
    rows = {(row["task"], row["method"], row["policy"]): row for row in read_transfers()}
    for file in files:
        row = json.loads(file.read_text()) | {"policy": file.stem}
        rows[row["task"], row["method"], row["policy"]] = row
    TRANSFERS.write_text("".join(json.dumps(row) + "\n" for _, row in sorted(rows.items())))


def read_transfers() -> list[dict[str, Any]]:
    """The rows so far."""
    return [json.loads(line) for line in TRANSFERS.read_text().splitlines()] if TRANSFERS.exists() else []


def solved(rows: list[Row]) -> list[str]:
    """The line of one task, learner and agent: success at the end, and steps of each seed until it is 0.9."""
    seeds = [list(own) for _, own in groupby(rows, key=lambda row: int(row["seed"]))]
    first = [next((int(row["env_steps"]) for row in own if float(row["success"]) >= ENOUGH), None) for own in seeds]
    reached = sorted(steps for steps in first if steps is not None)
    there = f"{reached[0] / 1e6:.2f} to {reached[-1] / 1e6:.2f}" if reached else "never"
    return [
        TITLES[rows[0]["task"]],
        f"{rows[0]['agent'].upper()}{NAMES[rows[0]['learner']]}",
        mean_interval([float(own[-1]["success"]) for own in seeds]).show(2),
        f"{int(seeds[0][-1]['env_steps']) / 1e6:.2f}",
        f"{there} ({len(reached)} of {len(seeds)} seeds)" if 0 < len(reached) < len(seeds) else there,
    ]


def tables() -> dict[str, str]:
    """The tables on the page, by name; none without numbers."""
    order = list(TITLES)
    rows = sorted(read(), key=lambda row: (order.index(row["task"]), row["agent"] != "sac", row["learner"] != "none"))
    lines = [solved(list(own)) for _, own in groupby(rows, key=lambda row: tuple(row[name] for name in KEY))]
    head = ["task", "agent", "success at the end", "million steps in all", f"until {ENOUGH}"]
    found = {"success": markdown_lines(head, lines)} if rows else {}
    if transfers := sorted(read_transfers(), key=lambda row: order.index(row["task"])):
        found["transfer"] = markdown_lines(
            ["task", "policies", "ours", "Gymnasium-Robotics", "difference"],
            [transferred(list(own)) for _, own in groupby(transfers, key=lambda row: row["task"])],
        )
    return found


def transferred(rows: list[dict[str, Any]]) -> list[str]:
    """The line of one task: success within an episode of policies of several seeds, here and in the reference."""
    ours, reference = ([row["reached"][where]["mean"] for row in rows] for where in ("ours", "reference"))
    differences = [row["reached"]["difference"] for row in rows]
    intervals = (mean_interval(values).show(3) for values in (ours, reference, differences))
    return [TITLES[rows[0]["task"]], str(len(rows)), *intervals]


def main() -> None:
    """Take what is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", nargs="*", type=Path, default=[], metavar="RUN")
    parser.add_argument("--transfers", nargs="*", type=Path, default=[], metavar="FILE")
    arguments = parser.parse_args()
    if arguments.runs:
        take(arguments.runs)
    if arguments.transfers:
        take_transfers(arguments.transfers)


if __name__ == "__main__":
    main()
