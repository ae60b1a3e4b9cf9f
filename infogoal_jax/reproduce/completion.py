"""When a run is complete: how long it is trained, and what is measured of it beside its success.

It is trained until success on training goals has levelled off, by one rule for all methods. The budget of a task is the
largest that its preset gives to a row of Table I. A run is evaluated ten times within it. It has levelled off at the
first evaluation, from the sixth on, by which the mean success on training goals over the last three evaluations is less
than 0.02 above that over the three before them; the mean is over its seeds. Its numbers are means over these last three
evaluations. A run that has not levelled off by three times the budget is stopped there, and marked: its training curve
still rises. Validation and test goals have no say in it.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from infogoal_jax import presets
from infogoal_jax.errors import UserError
from infogoal_jax.reproduce.manifest import DRAWN, METHODS, PRESET, WITH_LOSS, Run

EVALUATIONS = 10
"""Within the budget of a task."""
FIRST, MOST = 6, 30
"""The evaluations at which training may stop first, and at which it does."""
WINDOW, RISE = 3, 0.02
"""Evaluations whose mean is compared, and shown; and what it may still rise."""


class Budget(NamedTuple):
    """How a run of a task is trained. chunk: epochs between two evaluations; evaluations: at most."""

    chunk: int
    evaluations: int


def budget_of(task: str, toy: bool = False) -> Budget:
    """The budget of every run of a task."""
    if toy:
        return Budget(1, FIRST)
    epochs = []
    for method in METHODS:
        try:
            epochs.append(presets.load(task, method).num_epochs)
        except UserError:  # A part's own check refuses the task.
            continue
    return Budget(max(1, math.ceil(max(epochs) / EVALUATIONS)), MOST)


def levelled(curve: np.ndarray) -> int | None:
    """The number of evaluations by which a curve of success on training goals [seeds, evaluations] has levelled off;
    None if it has not yet."""
    mean = np.asarray(curve, float).mean(0)
    for count in range(FIRST, len(mean) + 1):
        rise = mean[count - WINDOW : count].mean() - mean[count - 2 * WINDOW : count - WINDOW].mean()
        if rise < RISE:
            return count
    return None


def shown(curve: np.ndarray) -> slice:
    """The evaluations whose mean is a run's number: the last three before it levelled off, or the last three."""
    count = levelled(curve) or np.shape(curve)[1]
    return slice(max(0, count - WINDOW), count)


def is_trained(curve: np.ndarray, task: str, toy: bool = False) -> bool:
    """Whether a run with this curve is trained to its end: it has levelled off, or the ceiling is reached."""
    return levelled(curve) is not None or np.shape(curve)[1] >= budget_of(task, toy).evaluations


def still_rises(curve: np.ndarray) -> bool:
    """Whether a finished run's training curve ends without having levelled off."""
    return levelled(curve) is None


PICTURED = ("object_search", "embodied_qa", "fetch_pick_and_place", "object_manipulation")
"""Tasks whose codes and trajectories are drawn."""
JUDGED = ("infogoal", "none")
"""Methods whose codes a claim compares."""
NO_TIME = "no time was left to measure it"


def has_share(run: Run) -> bool:
    """Whether the share of the method's own loss in the gradient of the goal encoder is to be measured."""
    return run.method in WITH_LOSS


def is_pictured(run: Run) -> bool:
    """Whether a figure shows codes or trajectories of this run."""
    return run.goal_set == 0 and run.task in PICTURED and run.method in DRAWN and run.relabelling != "her"


def is_judged(run: Run) -> bool:
    """Whether a claim compares the codes of this run: of all its seeds, on every goal set."""
    plain = run.lane.name == PRESET[0] and run.explorer is None and run.relabelling != "her"
    return run.task in PICTURED and run.method in JUDGED and plain


def missing(run: Run, share: float | None, arrays: Iterable[str]) -> list[str]:
    """What is to be measured of a run and was not: share, codes, pictures. share: None where it was not measured;
    arrays: names of those that there are."""
    lacking = {
        "share": has_share(run) and share is None,
        "codes": is_judged(run) and "codes/closeness" not in arrays,
        "pictures": is_pictured(run) and "picture/code_mean" not in arrays,
    }
    return [name for name, lacks in lacking.items() if lacks]
