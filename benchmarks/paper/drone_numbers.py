"""Tables of docs/drone.md, of what the scripts of benchmarks/fidelity wrote: flights.json and faults.json."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from infogoal_jax.reproduce.table_formats import markdown_lines

NUMBERS = Path(__file__).parents[2] / "docs" / "results" / "drone"
KINDS = ("interrupted", "battery", "link lost", "video", "its own landing", "were refused", "were never answered")
"""Words by which reasons are counted as one, in front of what is special to a flight."""


def load() -> dict[str, dict[str, Any]]:
    """What the scripts wrote, {"flights" or "faults": ...}."""
    return {name: json.loads((NUMBERS / f"{name}.json").read_text()) for name in ("flights", "faults")}


def tables(results: dict[str, dict[str, Any]]) -> dict[str, str]:
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


def faults_table(results: dict[str, Any]) -> str:
    """What came of every kind of fault: each flight but those that had landed before their fault came."""
    rows, before = [], 0
    for name in dict.fromkeys(flight["fault"] for flight in results["flights"]):
        all_flights = [flight for flight in results["flights"] if flight["fault"] == name]
        flights = list({flight["seed"]: flight for flight in all_flights}.values())  # The last attempt of each.
        before += len(all_flights) - len(flights)
        kept = [sum(flight[promise] for flight in flights) for promise in ("on_ground", "inside", "explained")]
        rows.append([name, str(len(flights)), *map(str, kept), reasons(flights)])
    total = [str(sum(int(row[column]) for row in rows)) for column in range(1, 5)]
    columns = ["fault", "flights", "on the ground", "inside of the envelope", "log has the reason", "reasons"]
    apart = f" {before} more flights ended, on the ground, before their fault came." if before else ""
    return f"{markdown_lines(columns, [*rows, ['all', *total, '']])}\n\n{measured(results)}{apart}"


def reasons(flights: list[dict[str, Any]]) -> str:
    """The reasons in the logs with their counts, the most frequent first; that of the drone where a log has no end."""
    counts = Counter(kind_of(flight) for flight in flights)
    return ", ".join(f"{kind} ({count})" if len(counts) > 1 else kind for kind, count in counts.most_common())


def kind_of(flight: dict[str, Any]) -> str:
    """The reason of a landing without what is special to this flight."""
    reason = flight["reason"] or f"no end; the firmware's landing, {flight['why_landed']}"
    return next((shown(kind, reason) for kind in KINDS if kind in reason), reason)


def shown(kind: str, reason: str) -> str:
    """A kind of reason in words."""
    words = {"battery": "battery at the floor", "its own landing": "motion of another controller or of its own landing"}
    words |= {"video": reason, "were refused": reason.split(",")[0]}
    return words.get(kind, kind)
