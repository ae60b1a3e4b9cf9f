"""From the numbers of runs to those of tables: success of a row of Table I on a task, and whether the row counts."""

from typing import NamedTuple

import numpy as np

from infogoal_jax.reproduce import budget
from infogoal_jax.reproduce.files import Result
from infogoal_jax.reproduce.manifest import LEARNERS, METHODS, PRESET, WITH_LOSS, parts_of
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.paper import IMAGE_TASKS, TASKS
from infogoal_jax.reproduce.statistics import TwoIntervals, over_seeds_and_sets

ROWS = {"paper": tuple(METHODS), "her": (*LEARNERS, "her")}
"""The rows of each variant of Table I."""
KINDS = {"test_goal": "test", "corrupted_test_goal": "corrupted test", "corrupted_train_goal": "corrupted training"}
"""The kinds of goals of Table I, as metrics name them, and in words."""
TITLES = {
    "object_search": "ObjSearch",
    "object_manipulation": "ObjMani",
    "fetch_reach": "Reach",
    "fetch_push": "Push",
    "fetch_pick_and_place": "PickAndPlace",
    "embodied_qa": "EQA",
}
"""Tasks as Table I names them."""
LEAST_SHARE = 0.01
"""Of the goal encoder's gradient that a method's own loss has to make; below it the row is the bare agent's."""
MARKS = {
    "rises": ("†", "its training curve still rises where training stopped"),
    "off": ("‡", f"the method's own loss makes less than {LEAST_SHARE:.0%} of the goal encoder's gradient"),
    "diverged": ("§", "seeds diverged and are left out"),
    "unmeasured": ("°", "the share of the method's own loss in the gradient was not measured"),
    "sets": ("¶", "other methods ran on goal sets of the task on which it did not"),
}
"""What is wrong with a row: its mark, and in words."""
NOT_COUNTED = {"rises", "off", "unmeasured", "sets"}
"""Faults with which a row does not count for verdicts."""


class Row(NamedTuple):
    """A method on a task: its runs, one a goal set. lacking: goal sets on which other methods of its table ran."""

    results: tuple[Result, ...]
    lacking: frozenset[int] = frozenset()

    def scores(self, kind: str) -> list[np.ndarray] | None:
        """Success on a kind of goals, [seeds] of each goal set, without seeds that diverged; None where the task has no
        such goals."""
        if any(f"{kind}/success_rate" not in result.evaluations for result in self.results):
            return None
        return [scores_of(result, f"{kind}/success_rate") for result in self.results]

    def mean(self, kind: str) -> TwoIntervals | None:
        """The mean over goal sets and seeds with its intervals."""
        scores = self.scores(kind)
        return None if scores is None or not all(len(each) for each in scores) else over_seeds_and_sets(scores)

    def faults(self) -> list[str]:
        """What is wrong with the row, keys of `MARKS`; a row without any counts."""
        found = []
        if any(budget.still_rises(result.evaluations["train_goal/success_rate"]) for result in self.results):
            found.append("rises")
        shares = [result.about["learner_share"] for result in self.results]
        measured = [share for share in shares if share is not None]
        if any(not share >= LEAST_SHARE for share in measured):
            found.append("off")
        if not measured and self.results[0].run.method in WITH_LOSS:
            found.append("unmeasured")
        if any(result.about["diverged"] for result in self.results):
            found.append("diverged")
        if self.lacking:
            found.append("sets")
        return found

    def marks(self) -> str:
        """The marks of what is wrong."""
        return "".join(MARKS[fault][0] for fault in self.faults())

    @property
    def seeds(self) -> int:
        """How many there are of each goal set at least."""
        return min(len(result.run.seeds) for result in self.results)


def scores_of(result: Result, metric: str) -> np.ndarray:
    """A metric of a run, [seeds]: the mean over the evaluations that count, without the seeds that diverged."""
    kept = [place for place, seed in enumerate(result.run.seeds) if seed not in result.about["diverged"]]
    which = budget.shown(result.evaluations["train_goal/success_rate"])
    return result.evaluations[metric][kept, which].mean(1)


def row_of(results: Results, variant: str, task: str, method: str, lane: str = PRESET[0], explorer=None) -> Row | None:
    """The runs of a row of Table I, or of another lane or explorer, those of the most seeds where there are several;
    None where there are none."""
    parts = parts_of(variant, task, method)
    if parts is None:
        return None
    by_set: dict[int, Result] = {}
    for run, result in sorted(results.items(), key=lambda item: len(item[0].seeds)):
        own = run.task, run.method, run.relabelling, run.explorer, run.lane.name
        if own == (task, method, parts[0], explorer, lane):
            by_set[run.goal_set] = result
    if not by_set:
        return None
    in_table = explorer is None and lane == PRESET[0]  # What is beside it is run on the first goal set alone.
    lacking = goal_sets_of(results, variant, task) - by_set.keys() if in_table else frozenset()
    return Row(tuple(by_set[number] for number in sorted(by_set)), lacking)


def goal_sets_of(results: Results, variant: str, task: str) -> frozenset[int]:
    """The goal sets of a task on which at least one row of a variant's table ran."""
    relabellings = {method: parts[0] for method in METHODS if (parts := parts_of(variant, task, method)) is not None}
    return frozenset(
        run.goal_set
        for run in results
        if (run.task, run.explorer, run.lane.name) == (task, None, PRESET[0])
        and run.method in relabellings
        and run.relabelling == relabellings[run.method]
    )


def rows_of(results: Results, variant: str, methods) -> dict[tuple[str, str], Row]:
    """Every row that there is, by (task, method)."""
    found = {(task, method): row_of(results, variant, task, method) for task in TASKS for method in methods}
    return {key: row for key, row in found.items() if row is not None}


def columns() -> list[tuple[str, str]]:
    """(kind of goals, task) of the columns of Table I."""
    return [(kind, task) for kind in KINDS for task in (TASKS if kind == "test_goal" else IMAGE_TASKS)]


def has_scores(row: Row | None, kind: str) -> bool:
    """Whether a row has success on a kind of goals, of a seed that did not diverge."""
    scores = None if row is None else row.scores(kind)
    return scores is not None and all(len(each) for each in scores)
