"""What decides a claim: an effect with its interval, and why it may not count; then the tests of what the paper says of
Table I, success and how long paths are.

An effect is a mean over tasks, their goal sets and seeds of differences that are paired by goal set and seed. Its 95 %
interval is that over seeds or that over goal sets, as in the table, whichever is wider. A claim holds where the whole
interval lies on its side, fails where it lies on the other, and else cannot be told. Nor can one that rests on fewer
than three seeds, or on a row of which the table says that it does not count.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from infogoal_jax.goal_uses import TEST
from infogoal_paper.files import Result
from infogoal_paper.manifest import METHODS
from infogoal_paper.numbers import Results
from infogoal_paper.scores import MARKS, NOT_COUNTED, TITLES, Bounds, Row, over_tasks, row_of, scores_of

Verdict = Literal["holds", "fails", "cannot be told"]
Paired = dict[int, dict[int, float]]
"""A number of each seed, by goal set and seed."""
INTERVALS = "Effects are paired by goal set and seed; intervals are over seeds or goal sets, whichever is wider."
LEAST_SEEDS = 3
"""On each goal set, for anything to be told."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """What the numbers say about a claim. effect: the number that decides it, with its interval; None without runs;
    above: the claim holds if the effect lies above it; words: what the effect is, and what else is to be known; faults:
    why it does not count."""

    effect: Bounds | None
    words: str
    above: float = 0.0
    faults: tuple[str, ...] = ()
    decimals: int = 2

    @property
    def shown(self) -> str:
        """The effect and its interval; nothing without runs."""
        return "" if self.effect is None else self.effect.show(self.decimals)

    @property
    def details(self) -> str:
        """What the effect is, and why it does not count."""
        return self.words + (f"; not counted: {'; '.join(self.faults)}" if self.faults else "")

    @property
    def verdict(self) -> Verdict:
        """Holds, fails, or cannot be told."""
        if self.effect is None or self.faults or not math.isfinite(self.effect.low):
            return "cannot be told"
        if self.effect.low > self.above:
            return "holds"
        return "fails" if self.effect.high < self.above else "cannot be told"


def finding(
    tasks: dict[str, Paired], words: str, rows: Sequence[Row | None] = (), above: float = 0.0, decimals: int = 2
) -> Finding:
    """The mean effect over tasks and its interval. rows: that it rests on."""
    values = [[np.array([*seeds.values()]) for seeds in sets.values()] for sets in tasks.values() if sets]
    if not values:
        return Finding(None, "no runs", above, faults_of(*rows))
    seeds = [len(each) for scores in values for each in scores]
    few = (f"fewer than {LEAST_SEEDS} seeds",) if min(seeds) < LEAST_SEEDS else ()
    over = f"{count_of(seeds, 'seed')} on {count_of([len(scores) for scores in values], 'goal set')}"
    return Finding(over_tasks(values), f"{words}; {over}", above, faults_of(*rows) + few, decimals)


def lacking_rows(found: Finding) -> Finding:
    """The finding, of whose rows some did not run."""
    return dataclasses.replace(found, faults=(*found.faults, "rows are missing"))


def count_of(counts: Sequence[int], name: str) -> str:
    """`3 goal sets`, `1 to 3 goal sets`."""
    low, high = min(counts), max(counts)
    return f"{low if low == high else f'{low} to {high}'} {name}{'s' * (high > 1)}"


def faults_of(*rows: Row | None) -> tuple[str, ...]:
    """Why some of these rows do not count, in words."""
    found = {fault for row in rows if row is not None for fault in row.faults()} & NOT_COUNTED
    return tuple(MARKS[fault][1] for fault in sorted(found))


def by_seed(result: Result, values: np.ndarray) -> dict[int, float]:
    """Values [seeds] of a run by seed, without those that are no numbers and the seeds that diverged."""
    own = {result.run.seeds[place]: float(values[place]) for place in result.kept}
    return {seed: value for seed, value in own.items() if math.isfinite(value)}


def metric_of(metric: str) -> Callable[[Result], dict[int, float]]:
    """A metric of a run by seed, over the evaluations that count."""

    def find(result: Result) -> dict[int, float]:
        kept = [result.run.seeds[place] for place in result.kept]
        return dict(zip(kept, scores_of(result, metric).tolist(), strict=True))

    return find


def success(kind: str) -> Callable[[Result], dict[int, float]]:
    """Success on a kind of goals by seed."""
    return metric_of(f"{kind}/success_rate")


def of_row(row: Row, number: Callable[[Result], dict[int, float]]) -> Paired:
    """A number of each run of a row."""
    found = {result.run.goal_set: number(result) for result in row.results}
    return {place: seeds for place, seeds in found.items() if seeds}


def shared(*several: Paired) -> list[Paired]:
    """Several numbers on the goal sets and seeds of which all have one."""
    places = sorted(set(several[0]).intersection(*several[1:]))
    seeds = {
        place: sorted(set(several[0][place]).intersection(*(each[place] for each in several[1:]))) for place in places
    }
    return [
        {place: {seed: each[place][seed] for seed in own} for place, own in seeds.items() if own} for each in several
    ]


def combined(function: Callable[..., float], *several: Paired) -> Paired:
    """The function of several numbers on the same goal set and seed, where all have one."""
    first, *others = shared(*several)
    return {
        place: {seed: float(function(value, *(each[place][seed] for each in others))) for seed, value in own.items()}
        for place, own in first.items()
    }


def mean_number(numbers: Paired) -> float:
    """The mean over goal sets of the mean over seeds."""
    return float(np.mean([np.mean([*seeds.values()]) for seeds in numbers.values()]))


def difference(first: Paired, second: Paired) -> Paired:
    """The first minus the second."""
    return combined(lambda x, y: x - y, first, second)


def mean_of(several: Sequence[Paired]) -> Paired:
    """The mean of several: methods share seeds, and the runs that they are compared with."""
    return combined(lambda *values: np.mean(values), *several)


def by_task(tasks: dict[str, Paired]) -> str:
    """`mean over Push 0.12, EQA 0.15`: a mean may hide a task that is otherwise."""
    means = {task: mean_number(sets) + 0.0 for task, sets in tasks.items()}
    return f"mean over {', '.join(f'{TITLES[task]} {mean:.2f}' for task, mean in means.items())}"


def left_out_words(left_out: Sequence[str]) -> str:
    """Which comparisons are left out, and why."""
    return f"; left out, because a row does not count: {', '.join(left_out)}" if left_out else ""


def pair_words(one: str, two: str, task: str) -> str:
    """`HER and DQN/HRAC/CQL on ObjSearch`."""
    return f"{METHODS[one]} and {METHODS[two]} on {TITLES[task]}"


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
        found = []
        for method in (method for method in rows if method != "infogoal"):
            both = shared(*(of_row(rows[each], success(kind)) for each in ("infogoal", method)))
            if not both[0]:
                found.append(Finding(None, f"InfoGoal and {METHODS[method]}: no goal set that both ran on"))
                continue
            means = [mean_number(own) for own in both]
            words = f"InfoGoal {means[0]:.2f}, {METHODS[method]} {means[1]:.2f}, least certain of {len(rows) - 1}"
            found.append(finding({task: difference(*both)}, words, [*rows.values()]))
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
