"""A flight as its log has it: where the drone was, and when images, state packets, commands and answers came."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from infogoal_drone import records
from infogoal_drone.envelope import MARGIN, STEP
from infogoal_drone.records import events_of
from infogoal_jax.report.canvas import FAILURE, SUCCESS, empty_figure, figure_style, save
from infogoal_jax.runs.folder import check_own

COLOURS = {"made": "#0072B2", "refused": "#E69F00", "unanswered": FAILURE}
ROWS = ("image", "state", "command", "answer")


def report_flight(folder: Path, format: str = "png", captions: bool = False, style: str = "") -> Path:
    """Print what the log in this folder says and draw it under FOLDER/figures; the path of the figure. format,
    captions, style: see `figures.draw_figures`. Raises `UserError` for a file that is no log."""
    events = records.read(folder / records.NAME)
    check_own(folder, ["figures"])
    for line in summary(events):
        print(line)
    path = folder / "figures" / f"flight.{format}"
    with figure_style(style):
        save(flight(events), path, captions)
    return path


def summary(events: list[dict[str, Any]]) -> list[str]:
    """What happened, in lines."""
    steps, ends = events_of(events, "step"), events_of(events, "end")
    settings = (events_of(events, "settings") or [{}])[0]
    drone = "simulated drone" if settings.get("simulated") else f"drone at {settings.get('host')}"
    target = f"looking for {settings['target']}" if settings.get("target") else "looking for nothing"
    end = ends[-1] if ends else None
    lines = [f"flight      {drone}, {target}, {events[0].get('date', '')}"]
    if end is None:
        lines.append("ended       the log has no end: the program was killed; the firmware lands the drone")
    else:
        landed = "on the ground" if end["landed"] else "not known to be on the ground"
        lines.append(f"ended       {end['reason']}; {landed}")
    counts = {outcome: sum(step["outcome"] == outcome for step in steps) for outcome in COLOURS}
    lines.append(f"moves       {len(steps)}: " + ", ".join(f"{count} {outcome}" for outcome, count in counts.items()))
    if steps:
        latency = 1000 * np.array([step["latency"] for step in steps])
        lines.append(
            f"latency     image to command {np.median(latency):.0f} ms in the median, "
            f"{np.percentile(latency, 99):.0f} ms in the 99th percentile"
        )
    images, seconds = events_of(events, "image"), events[-1]["time"]
    lines.append(f"log         {len(images)} images, {len(events_of(events, 'state'))} state packets, {seconds:.1f} s")
    return lines


def flight(events: list[dict[str, Any]]) -> Figure:
    """The path in the envelope above, and the times of all that came and went below."""
    settings = (events_of(events, "settings") or [{}])[0]
    below = ("an interval, where an answer did not come, is drawn as a rectangle of the places that are possible",)
    figure = empty_figure("flight", below, (10, 7))
    path, times = figure.subplots(2, 1, height_ratios=(3, 2))
    draw_path(path, settings, events_of(events, "step"), events_of(events, "end"))
    draw_times(times, events)
    return figure


def draw_path(axes: Axes, settings: dict[str, Any], steps: list[dict[str, Any]], ends: list[dict[str, Any]]) -> None:
    """Moves from the place where it hovered first, in cm, inside of the envelope."""
    if "envelope" in settings:
        steps_of = settings["envelope"]
        left, down = -STEP * steps_of["left"], -STEP * steps_of["down"]
        width, height = STEP * (steps_of["left"] + steps_of["right"]), STEP * (steps_of["up"] + steps_of["down"])
        axes.add_patch(
            Rectangle((left, down), width, height, fill=False, color="#444444", label="envelope of the steps")
        )
        outer = (left - MARGIN, down - MARGIN), width + 2 * MARGIN, height + 2 * MARGIN
        axes.add_patch(Rectangle(*outer, fill=False, color="#444444", linestyle=":", label="with the margin"))
    place = np.zeros(2)
    shown = set()
    for step in steps:
        low, high = (STEP * np.array(step[name], float) for name in ("low", "high"))
        middle, outcome = (low + high) / 2, step["outcome"]
        label = None if outcome in shown else f"move {outcome}"
        shown.add(outcome)
        axes.plot(*np.stack([place, middle], axis=-1), color=COLOURS[outcome], marker="o", markersize=4, label=label)
        if (low != high).any():
            axes.add_patch(Rectangle(low - 4, *(high - low + 8), color=COLOURS["unanswered"], alpha=0.15))
        place = middle
    found = bool(ends) and ends[-1]["found"]
    axes.plot(0, 0, marker="s", color="black", linestyle="none", label="first hover")
    words = "found" if found else "landing"
    axes.plot(*place, marker="*", markersize=14, color=SUCCESS if found else FAILURE, linestyle="none", label=words)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("to the right (cm)")
    axes.set_ylabel("up (cm)")
    axes.grid()
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)


def draw_times(axes: Axes, events: list[dict[str, Any]]) -> None:
    """A tick for everything that came or went, and a line where the landing began."""
    for row, name in enumerate(ROWS):
        found = events_of(events, name)
        colours = [COLOURS.get(event.get("outcome"), "#555555") for event in found]
        axes.scatter([event["time"] for event in found], np.full(len(found), -row), marker="|", s=90, c=colours)
    for landing in events_of(events, "landing"):
        axes.axvline(landing["time"], color=FAILURE, linewidth=1)
        axes.annotate(landing["reason"][:60], (landing["time"], 0.6), ha="right", fontsize=8, color=FAILURE)
    axes.set_yticks([-row for row in range(len(ROWS))], [f"{name}s" for name in ROWS])
    axes.set_ylim(-len(ROWS) + 0.4, 1.0)
    axes.set_xlabel("time (s)")
