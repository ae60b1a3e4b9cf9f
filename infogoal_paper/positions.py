"""Fetch with continuous goals: how soon it is solved, and what its policies reach in the reference.

    python -m infogoal_paper.positions [--runs RUN ...] [--transfers FILE ...] [--peers FILE ...]

`--runs` puts the evaluations of runs of `infogoal train fetch_*_positions` into docs/results/positions.csv.xz,
`--transfers` the files that benchmarks/fidelity/fetch_transfer.py wrote into docs/results/transfer.jsonl.xz, `--peers`
the numbers.csv of benchmarks/peers/fetch_sb3_her.py with --reference into docs/results/sb3_her/reference.csv.xz, each
in place of what was there of the same task, learner and agent, of the same policy, or of the same task and seed.
`pages.py positions` writes the tables of docs/reference/vectors.md.

A run whose folder has log.txt, what `infogoal train ... 2>&1 | ts -s %.s` printed, has seconds since its process began:
those of the line of each evaluation, with importing, tracing and compiling.
"""

import argparse
import json
import re
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from infogoal_jax.report.statistics import mean_interval
from infogoal_paper import trial_numbers
from infogoal_paper.table_formats import markdown_lines, tight
from infogoal_paper.trial_numbers import Row

RESULTS = Path(__file__).parents[1] / "docs" / "results"
NUMBERS, TRANSFERS = RESULTS / "positions.csv.xz", RESULTS / "transfer.jsonl.xz"
PEERS = RESULTS / "sb3_her" / "reference.csv.xz"
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
SOON = (0.9, 0.95)
"""Mean success over the seeds until which seconds are shown."""
EVALUATED = re.compile(r"^([\d.]+) epoch (\d+)/", re.M)
"""A line of progress behind the seconds of a clock."""
MANY = 1_000_000
"""Steps whose hours are shown of a peer that was cut off."""


def rows_of_run(folder: Path) -> list[Row]:
    """A row for each evaluation of each seed."""
    about = json.loads((folder / "config.json").read_text())
    log = folder / "log.txt"
    seconds = {epoch: when for when, epoch in EVALUATED.findall(log.read_text())} if log.exists() else {}
    config, machine = about["config"], f"1 x {about['device']}, jax {about['versions']['jax']}"
    parts = {"task": config["task"], "learner": config["learner"]["name"], "agent": config["agent"]["name"]}
    return [
        parts
        | {name: row[name] for name in ("seed", "epoch", "env_steps")}
        | {"success": f"{float(row['train_goal/success_rate']):.4g}", "seconds": seconds.get(row["epoch"], "")}
        | {"machine": machine}
        for row in trial_numbers.read(folder / "evaluations.csv")
    ]


def take(runs: list[Path]) -> None:
    """Put the evaluations of these runs into the numbers."""
    new = [row for run in runs for row in rows_of_run(run)]
    key = itemgetter(*KEY)
    trial_numbers.put(new, NUMBERS, key, lambda row: (*key(row), int(row["seed"]), int(row["epoch"])))


def take_transfers(files: list[Path]) -> None:
    """Put what these policies reach into the numbers."""
    rows = {(row["task"], row["method"], row["policy"]): row for row in read_transfers()}
    for file in files:
        row = json.loads(file.read_text()) | {"policy": file.stem}
        rows[row["task"], row["method"], row["policy"]] = row
    trial_numbers.write_compressed(TRANSFERS, "".join(json.dumps(row) + "\n" for _, row in sorted(rows.items())))


def take_peers(files: list[Path]) -> None:
    """Put the evaluations of Stable-Baselines3 into the numbers."""
    new = [row for file in files for row in trial_numbers.read(file)]
    key = itemgetter("task", "seed")
    trial_numbers.put(new, PEERS, key, lambda row: (row["task"], int(row["seed"]), int(row["env_steps"])))


def read_transfers() -> list[dict[str, Any]]:
    """The rows so far."""
    return [json.loads(line) for line in trial_numbers.read_text(TRANSFERS).splitlines()] if TRANSFERS.exists() else []


def solved(rows: list[Row]) -> list[str]:
    """The line of one task, learner and agent: success at the end, and steps of each seed until it is 0.9."""
    seeds = [list(own) for _, own in groupby(rows, key=lambda row: int(row["seed"]))]
    first = [next((int(row["env_steps"]) for row in own if float(row["success"]) >= ENOUGH), None) for own in seeds]
    reached = sorted(steps for steps in first if steps is not None)
    there = f"{reached[0] / 1e6:.2f} to {reached[-1] / 1e6:.2f}" if reached else "never"
    return [
        TITLES[rows[0]["task"]],
        f"{rows[0]['agent'].upper()}{NAMES[rows[0]['learner']]}",
        tight(mean_interval([float(own[-1]["success"]) for own in seeds])),
        f"{int(seeds[0][-1]['env_steps']) / 1e6:.2f}",
        f"{there} ({len(reached)} of {len(seeds)} seeds)" if 0 < len(reached) < len(seeds) else there,
        seconds_until(seeds),
    ]


def seconds_until(seeds: list[list[Row]]) -> str:
    """Seconds from the start of the process until the mean over the seeds was that of `SOON`; nothing without a log."""
    seconds = [float(row.get("seconds") or "nan") for row in seeds[0]]
    if np.isnan(seconds).any():
        return ""
    mean = np.mean([[float(row["success"]) for row in own] for own in seeds], 0)
    first = (next((when for when, now in zip(seconds, mean, strict=True) if now >= least), None) for least in SOON)
    return ", ".join("never" if when is None else f"{when:.0f}" for when in first)


def peer(rows: list[Row], ours: list[Row]) -> list[str]:
    """The line of one task of Stable-Baselines3, beside our SAC."""
    seeds = [list(own) for _, own in groupby(rows, key=lambda row: row["seed"])]
    last = [own[-1] for own in seeds]
    rate = np.mean([int(row["env_steps"]) / float(row["wall_seconds"]) for row in last])
    first = [next((float(r["wall_seconds"]) for r in own if float(r["success_rate"]) >= ENOUGH), None) for own in seeds]
    reached = sorted(when for when in first if when is not None)
    of_ours = [list(own) for _, own in groupby(ours, key=lambda row: row["seed"])]
    return [
        TITLES[f"{rows[0]['task']}_positions"],
        str(len(seeds)),
        f"{rate:.0f}",
        f"{reached[0]:.0f} to {reached[-1]:.0f}" if reached else "never",
        f"{np.mean([float(row['success_rate']) for row in last]):.2f} after {float(last[0]['wall_seconds']):.0f} s",
        "" if reached else f"{MANY / rate / 3600:.1f}",
        seconds_until(of_ours).split(",")[0] if of_ours else "",
    ]


def tables() -> dict[str, str]:
    """The tables on the page, by name, of SAC alone; none without numbers."""
    order = list(TITLES)
    rows = trial_numbers.kept(NUMBERS)
    rows.sort(key=lambda row: (order.index(row["task"]), row["agent"] != "sac", row["learner"] != "none"))
    shown = (row for row in rows if row["agent"] == "sac")
    lines = [solved(list(own)) for _, own in groupby(shown, key=lambda row: tuple(row[name] for name in KEY))]
    head = ["task", "agent", "success at the end", "million steps in all", f"until {ENOUGH}"]
    head += ["seconds to " + ", ".join(map(str, SOON))]
    found = {"success": markdown_lines(head, lines)} if rows else {}
    if transfers := sorted(read_transfers(), key=lambda row: (order.index(row["task"]), row["faithful"])):
        found["transfer"] = markdown_lines(
            ["task", "our physics", "policies", "ours", "reference", "difference", "difference at the end"],
            [
                transferred(list(own))
                for _, own in groupby(transfers, key=lambda row: (row["task"], row["faithful"], row["episodes"]))
            ],
        )
    if peers := sorted(trial_numbers.kept(PEERS), key=lambda row: order.index(f"{row['task']}_positions")):
        alone = [row for row in rows if (row["learner"], row["agent"]) == ("none", "sac")]
        head = ["task", "seeds", "steps/s", f"seconds to {ENOUGH}", "success at the end"]
        found["peer"] = markdown_lines(
            [*head, f"hours for {MANY:,} steps", f"ours, seconds to {ENOUGH}"],
            [
                peer(list(own), [row for row in alone if row["task"] == f"{task}_positions"])
                for task, own in groupby(peers, key=lambda row: row["task"])
            ],
        )
    return found


def transferred(rows: list[dict[str, Any]]) -> list[str]:
    """The line of one task: success within an episode of policies of several seeds, here and in the reference."""
    ours, reference = ([row["reached"][where]["mean"] for row in rows] for where in ("ours", "reference"))
    differences = ([row[when]["difference"] for row in rows] for when in ("reached", "at_end"))
    intervals = (tight(mean_interval(values), 3) for values in (ours, reference, *differences))
    physics = "faithful" if rows[0]["faithful"] else "fast"
    return [TITLES[rows[0]["task"]], physics, f"{len(rows)} x {rows[0]['episodes']}", *intervals]


def main() -> None:
    """Take what is named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", nargs="*", type=Path, default=[], metavar="RUN")
    parser.add_argument("--transfers", nargs="*", type=Path, default=[], metavar="FILE")
    parser.add_argument("--peers", nargs="*", type=Path, default=[], metavar="FILE")
    arguments = parser.parse_args()
    if arguments.runs:
        take(arguments.runs)
    if arguments.transfers:
        take_transfers(arguments.transfers)
    if arguments.peers:
        take_peers(arguments.peers)


if __name__ == "__main__":
    main()
