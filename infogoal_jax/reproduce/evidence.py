"""The tests that decide what the paper says of Table I: success, and how long paths are."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from infogoal_jax.goal_uses import TEST
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
    of_row,
    success,
)
from infogoal_jax.reproduce.files import Result
from infogoal_jax.reproduce.manifest import METHODS
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.scores import TITLES, Row, row_of

COMPARABLE = 0.05
"""By how much success may be lower where the paper says that it is comparable, or close to; and the share by which a
path may be shorter where it says that paths are not shortened."""
RELABELLINGS = ("her", "cher", "ghrl")


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
        found = []
        for method in (method for method in rows if method != "infogoal"):
            other = f"{METHODS[method]} {means[method]:.2f}"
            words = f"InfoGoal {means['infogoal']:.2f}, {other}, least certain of {len(rows) - 1}"
            found.append(finding({task: paired(rows["infogoal"], rows[method], kind)}, words, [*rows.values()]))
        return weakest(found) if len(rows) == len(METHODS) else lacking_rows(weakest(found))

    return find


def weakest(found: Sequence[Finding]) -> Finding:
    """Of findings that must all hold, the one that decides: which surely does not, or is not known, or is least certain
    to hold."""
    known = [each for each in found if each.effect is not None]
    failing = [each for each in known if each.effect.high < each.above]
    if failing:
        return min(failing, key=lambda each: each.effect.high)
    unknown = [each for each in found if each.effect is None]
    return unknown[0] if unknown else min(known, key=lambda each: np.nan_to_num(each.effect.low, nan=-np.inf))


def compare(
    pairs: Sequence[tuple[str, str]], kind: str, tasks: Sequence[str], above: float = 0.0, other: str | None = None
) -> Callable[[Results], Finding]:
    """Of each pair the first method minus the second (on another kind of goals), over the tasks on which both count. A
    claim about several methods is one about each: the weakest decides."""

    def of_pair(results: Results, one: str, two: str) -> Finding:
        differences, left_out = {}, []
        for task in tasks:
            rows = [row_of(results, "paper", task, method) for method in (one, two)]
            if not all(row is not None and row.mean(kind) and row.mean(other or kind) for row in rows):
                continue
            if faults_of(*rows):
                left_out.append(TITLES[task])
            elif difference := paired(*rows, kind, other):
                differences[task] = difference
        names = METHODS[one] if one == two else f"{METHODS[one]} minus {METHODS[two]}"
        without = left_out_words(left_out)
        if not differences:
            return Finding(None, f"{names}: no runs that count{without}")
        return finding(differences, f"{names}, {by_task(differences)}{without}", above=above)

    def find(results: Results) -> Finding:
        decisive = weakest([of_pair(results, *pair) for pair in pairs])
        weakest_of = f"; the weakest of {len(pairs)}" if len(pairs) > 1 else ""
        return dataclasses.replace(decisive, words=f"{decisive.words}{weakest_of}")

    return find


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
