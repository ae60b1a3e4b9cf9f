"""What the runs cost: programs, and the time of compiling, measuring and training."""

import math

import numpy as np

from infogoal_jax.reproduce.files import Result
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.paper import TASKS
from infogoal_jax.reproduce.scores import TITLES
from infogoal_jax.reproduce.table_formats import Table


def costs(results: Results) -> Table | None:
    """Programs, and the time of compiling and of running, by task."""
    body, machines, totals = [], {}, np.zeros(4)
    for task in TASKS:
        own = [result for run, result in results.items() if run.task == task]
        programs = {"\n".join(result.about["program"]["runs"]): result.about["program"] for result in own}
        if not own:
            continue
        compiling, running = (
            sum(program[f"{name}_seconds"] for program in programs.values()) for name in ("compile", "run")
        )
        measuring = sum(result.about["measure_seconds"] for result in own)
        numbers = np.array([len(own), len(programs), compiling + measuring, running])
        totals += numbers
        body.append([TITLES[task], *cost_cells(numbers, own)])
        machines |= dict.fromkeys(result.about["machine"] for result in own)
    if not body:
        return None
    body.append(["all", *cost_cells(totals, list(results.values()))])
    head = ["task", "runs", "programs", "compiling and measuring (s)", "training (s)", "process-minutes"]
    foot = (
        "Seconds and process-minutes are sums over processes. Several share a GPU and its host, each with a clock of "
        "its own, so that the sums are more than the time of the GPU."
    )
    if any("spans" in result.about["program"] for result in results.values()):
        head.append("wall clock (min)")
        foot += (
            " Wall clock: the time in which at least one process was at work, of the runs that recorded it; empty "
            "where none did."
        )
    else:
        body = [row[:-1] for row in body]
    return Table("costs", "What it cost", head, body, [f"{'; '.join(machines)}.", foot])


def cost_cells(numbers: np.ndarray, own: list[Result]) -> list[str]:
    """The cells of a line of the costs: of these numbers, and of the wall clock of the runs."""
    timed = [result.about["program"]["spans"] for result in own if "spans" in result.about["program"]]
    clock = f"{seconds_of(timed) / 60:,.0f}" if timed else ""
    clock += f" ({len(timed)} of {len(own)} runs)" if 0 < len(timed) < len(own) else ""
    return [*(f"{number:,.0f}" for number in numbers), f"{numbers[2:].sum() / 60:,.0f}", clock]


def seconds_of(spans_of_runs: list[list[list[float]]]) -> float:
    """Seconds in which at least one of these spans, [from, to] of each run, was running."""
    total, until = 0.0, -math.inf
    for start, end in sorted((start, end) for spans in spans_of_runs for start, end in spans):
        total += max(0.0, end - max(start, until))
        until = max(until, end)
    return total
