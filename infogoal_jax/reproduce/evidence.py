"""The tests that decide what the paper says of Table I: success, and how long paths are."""

from collections.abc import Callable, Sequence

import numpy as np

from infogoal_jax.reproduce.effects import (
    Finding,
    Paired,
    by_task,
    combined,
    difference,
    faults_of,
    finding,
    lacking_rows,
    left_out_words,
    mean_of,
    of_row,
    pair_words,
    success,
)
from infogoal_jax.reproduce.files import Result
from infogoal_jax.reproduce.manifest import METHODS
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.paper import IMAGE_TASKS
from infogoal_jax.reproduce.scores import TITLES, Row, row_of

COMPARABLE = 0.05
"""By how much success may be lower where the paper says that it is comparable, or close to; and the share by which a
path may be shorter where it says that paths are not shortened."""
RELABELLINGS = ("her", "cher", "ghrl")
TEST = 2
"""The number of test goals in `uses`."""


def paired(first: Row, second: Row, kind: str, other: str | None = None) -> Paired:
    """Success of the first row minus that of the second (on another kind of goals)."""
    return difference(of_row(first, success(kind)), of_row(second, success(other or kind)))


def first_of_task(task: str, kind: str) -> Callable[[Results], Finding]:
    """InfoGoal against each other row of Table I. The row that is surely better decides, or else the difference that is
    least certain to be one. A row that is missing or does not count might be better, so that nothing can be told."""

    def find(results: Results) -> Finding:
        rows = {method: row_of(results, "paper", task, method) for method in METHODS}
        rows = {method: row for method, row in rows.items() if row is not None and row.mean(kind)}
        if "infogoal" not in rows or len(rows) < 2:
            return Finding(None, "no runs")
        means = {method: row.mean(kind).mean for method, row in rows.items()}
        found = {}
        for method in (method for method in rows if method != "infogoal"):
            other = f"{METHODS[method]} {means[method]:.2f}"
            words = f"InfoGoal {means['infogoal']:.2f}, {other}, closest of {len(rows)} rows"
            found[method] = finding({task: paired(rows["infogoal"], rows[method], kind)}, words, [*rows.values()])
        found = {method: each for method, each in found.items() if each.effect is not None}
        if not found:
            return Finding(None, "no runs of the same seeds")
        better = [method for method in found if found[method].effect.high < 0]
        closest = (
            min(better, key=lambda method: found[method].effect.high)
            if better
            else min(found, key=lambda method: np.nan_to_num(found[method].effect.low, nan=-np.inf))
        )
        return found[closest] if len(rows) == len(METHODS) else lacking_rows(found[closest])

    return find


def compare(
    first: Sequence[str], second: Sequence[str], kind: str, tasks: Sequence[str], above: float = 0.0
) -> Callable[[Results], Finding]:
    """The methods `first` minus the methods `second`, over all tasks on which both ran."""

    def find(results: Results) -> Finding:
        differences, left_out = {}, []
        for task in tasks:
            of_task = []
            for one in first:
                for two in second:
                    rows = [row_of(results, "paper", task, method) for method in (one, two)]
                    if not all(row is not None and row.mean(kind) for row in rows):
                        continue
                    if faults_of(*rows):
                        left_out.append(pair_words(one, two, task))
                        continue
                    of_task.append(paired(*rows, kind))
            if of_task and (mean := mean_of(of_task)):
                differences[task] = mean
        without = left_out_words(left_out)
        if not differences:
            return Finding(None, f"no runs that count{without}")
        return finding(differences, f"{by_task(differences)}{without}", above=above)

    return find


def own_loss(results: Results) -> Finding:
    """What HER, CHER and GHRL lose when test goals are corrupted."""
    tasks, left_out = {}, []
    for task in IMAGE_TASKS:
        of_task = []
        for method in RELABELLINGS:
            row = row_of(results, "paper", task, method)
            if row is None or not row.mean("corrupted_test_goal"):
                continue
            if faults_of(row):
                left_out.append(f"{METHODS[method]} on {TITLES[task]}")
                continue
            of_task.append(paired(row, row, "test_goal", "corrupted_test_goal"))
        if of_task and (mean := mean_of(of_task)):
            tasks[task] = mean
    without = left_out_words(left_out)
    if not tasks:
        return Finding(None, f"no runs that count{without}")
    words = f"loss of success, {by_task(tasks)}; more than {COMPARABLE} is asked for{without}"
    return finding(tasks, words, above=COMPARABLE)


def steps_where_both_reach(first: Row, second: Row) -> tuple[Paired, Paired, str]:
    """Mean steps of each row over the episodes of test goals that both reach, which start alike, by goal set and seed;
    and in words how many episodes these are."""
    steps: tuple[Paired, Paired] = {}, {}
    both, all_episodes = 0, 0
    others = {result.run.goal_set: result for result in second.results}
    for one in first.results:
        two = others.get(one.run.goal_set)
        if two is None or one.arrays["first_reached"].shape[1:] != two.arrays["first_reached"].shape[1:]:
            continue
        found: tuple[dict[int, float], dict[int, float]] = {}, {}
        for seed in (seed for seed in one.run.seeds if seed in two.run.seeds):
            x, y = (of_seed(result, seed) for result in (one, two))
            reached = (x <= one.about["episode_length"]) & (y <= two.about["episode_length"])
            both, all_episodes = both + reached.sum(), all_episodes + reached.size
            if reached.any():
                found[0][seed], found[1][seed] = x[reached].mean(), y[reached].mean()
        for own, result, values in zip(steps, (one, two), found, strict=True):
            kept = {seed: value for seed, value in values.items() if seed not in result.about["diverged"]}
            own |= {one.run.goal_set: kept} if kept else {}
    return *steps, f"{both:,} of {all_episodes:,} episodes, which both reach"


def of_seed(result: Result, seed: int) -> np.ndarray:
    """Steps after which each test goal was reached from each start, [M, starts]; past the episode where it was not."""
    test = result.arrays["uses"] == TEST
    return result.arrays["first_reached"][result.run.seeds.index(seed)][test].astype(float)


def longer_paths(first: Row, second: Row, names: tuple[str, str], above: float = 0.0) -> Finding:
    """By which share the first row's paths are longer than the second's, in episodes that both reach. Those that one
    alone reaches have no say, so that success does not pass for short paths."""
    task = first.results[0].run.task
    x, y, episodes = steps_where_both_reach(first, second)
    longer = combined(lambda one, two: (one - two) / max(two, 1e-9), x, y)
    means = [np.mean([value for seeds in each.values() for value in seeds.values()]) if each else 0 for each in (x, y)]
    words = f"steps: {names[0]} {means[0]:.1f}, {names[1]} {means[1]:.1f}; {episodes}"
    return finding({task: longer}, words, (first, second), above)


def infobot_paths(results: Results) -> Finding:
    """How much longer InfoBot's paths are than InfoGoal's, on object search."""
    rows = [row_of(results, "paper", "object_search", method) for method in ("infobot", "infogoal")]
    return Finding(None, "no runs") if None in rows else longer_paths(*rows, ("InfoBot", "InfoGoal"))
