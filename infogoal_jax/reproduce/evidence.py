"""The tests that decide the paper's claims.

An effect is a mean over goal sets and tasks of differences that are paired by seed, with its 95 % interval over seeds.
A claim holds where the whole interval lies on its side, fails where it lies on the other, and else cannot be told; nor
can one that rests on a row of which the table says that it does not count.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from infogoal_jax.report.statistics import mean_interval
from infogoal_jax.reproduce.figures import sse_db
from infogoal_jax.reproduce.figures.beta import by_task
from infogoal_jax.reproduce.manifest import FETCH, FIXED_BETAS, METHODS, PRESET, fixed
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.paper import IMAGE_TASKS
from infogoal_jax.reproduce.scores import MARKS, NOT_COUNTED, TITLES, Row, row_of, scores_of
from infogoal_jax.reproduce.statistics import Bounds, over_seeds_and_sets

Verdict = Literal["holds", "fails", "cannot be told"]
COMPARABLE = 0.05
"""By how much success may be lower where the paper says that it is comparable, or close to."""
RELABELLINGS = ("her", "cher", "ghrl")


@dataclasses.dataclass(frozen=True)
class Finding:
    """What the numbers say about a claim. effect: the number that decides it, with its interval; None without runs;
    above: the claim holds if the effect lies above it; words: what the effect is, and what else is to be known."""

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
    def verdict(self) -> Verdict:
        """Holds, fails, or cannot be told."""
        if self.effect is None or self.faults or not math.isfinite(self.effect.low):
            return "cannot be told"
        if self.effect.low > self.above:
            return "holds"
        return "fails" if self.effect.high < self.above else "cannot be told"


def bounds_of(differences: Sequence[np.ndarray]) -> Bounds:
    """The mean over strata (goal sets of tasks) of differences [seeds], with its interval over seeds."""
    mean = over_seeds_and_sets(differences)
    return Bounds(mean.mean, mean.mean - mean.seeds, mean.mean + mean.seeds)


def paired(first: Row, second: Row, kind: str, other: str | None = None) -> list[np.ndarray]:
    """Success of the first row minus that of the second (on another kind of goals), for each goal set that both have,
    [seeds]; without seeds that diverged in either."""
    found = []
    for one in first.results:
        for two in second.results:
            if one.run.goal_set == two.run.goal_set:
                lost = {*one.about["diverged"], *two.about["diverged"]}
                seeds = [seed for seed in one.run.seeds if seed in two.run.seeds and seed not in lost]
                if seeds:
                    x, y = of_seeds(one, seeds, kind), of_seeds(two, seeds, other or kind)
                    found.append(x - y)
    return found


def of_seeds(result, seeds: list[int], metric: str) -> np.ndarray:
    """A metric of a run, for these seeds."""
    metric = metric if "/" in metric else f"{metric}/success_rate"
    kept = [seed for seed in result.run.seeds if seed not in result.about["diverged"]]
    return scores_of(result, metric)[[kept.index(seed) for seed in seeds]]


def faults_of(*rows: Row | None) -> tuple[str, ...]:
    """Why some of these rows do not count, in words."""
    found = {fault for row in rows if row is not None for fault in row.faults()} & NOT_COUNTED
    return tuple(MARKS[fault][1] for fault in sorted(found))


def first_of_task(task: str, kind: str) -> Callable[[Results], Finding]:
    """InfoGoal against each other row of Table I: the difference that is least certain to be one. A row that is missing
    or does not count might be better, so that nothing can be told."""

    def find(results: Results) -> Finding:
        rows = {method: row_of(results, "paper", task, method) for method in METHODS}
        means = {method: row.mean(kind).mean for method, row in rows.items() if row is not None and row.mean(kind)}
        others = {method: mean for method, mean in means.items() if method != "infogoal"}
        if "infogoal" not in means or not others:
            return Finding(None, "no runs")
        bounds = {method: bounds_of(paired(rows["infogoal"], rows[method], kind)) for method in others}
        closest = min(bounds, key=lambda method: bounds[method].low)
        words = (
            f"InfoGoal {means['infogoal']:.2f}, {METHODS[closest]} {means[closest]:.2f}, closest of {len(means)} rows"
        )
        missing = ("rows are missing",) if len(means) < len(METHODS) else ()
        return Finding(bounds[closest], words, faults=faults_of(*rows.values()) + missing)

    return find


def compare(
    first: Sequence[str], second: Sequence[str], kind: str, tasks: Sequence[str], above: float = 0.0, other=None
) -> Callable[[Results], Finding]:
    """The methods `first` minus the methods `second`, over all tasks on which both ran. other: kind of goals of the
    second, if it is not the same."""

    def find(results: Results) -> Finding:
        differences, left_out, on = [], [], []
        for task in tasks:
            of_task = []
            for one in first:
                for two in second:
                    rows = [row_of(results, "paper", task, method) for method in (one, two)]
                    if not all(row is not None and row.mean(kind) and row.mean(other or kind) for row in rows):
                        continue
                    if faults_of(*rows):
                        left_out.append(f"{METHODS[one]} and {METHODS[two]} on {TITLES[task]}")
                        continue
                    of_task.append(paired(rows[0], rows[1], kind, other))
                    on.append(TITLES[task])
            # Methods share seeds, and the runs that they are compared with: their mean is one number a seed.
            differences += [mean_of_seeds(each) for each in zip(*of_task, strict=False)]
        without = f"; left out, because a row does not count: {', '.join(left_out)}" if left_out else ""
        if not differences:
            return Finding(None, f"no runs that count{without}")
        return Finding(bounds_of(differences), f"mean over {', '.join(dict.fromkeys(on))}{without}", above)

    return find


def mean_of_seeds(differences: Sequence[np.ndarray]) -> np.ndarray:
    """The mean of differences [seeds] of several methods, [seeds], as many as all of them have."""
    fewest = min(len(each) for each in differences)
    return np.mean([each[:fewest] for each in differences], axis=0)


def shorter_paths(results: Results) -> Finding:
    """SPL of InfoGoal minus InfoBot's, on the goals of object search."""
    rows = [row_of(results, "paper", "object_search", method) for method in ("infogoal", "infobot")]
    if None in rows:
        return Finding(None, "no runs")
    rates = [row.mean("test_goal").mean for row in rows]
    words = f"SPL on test goals; success {rates[0]:.2f} against {rates[1]:.2f}"
    return Finding(bounds_of(paired(*rows, "test_goal/spl")), words, faults=faults_of(*rows))


def sse_db_gain(area: str, group: str, methods: Sequence[str], sign: float = 1.0) -> Callable[[Results], Finding]:
    """The area under a curve with SSE-DB minus that without, mean over these methods; times the sign."""

    def find(results: Results) -> Finding:
        runs = sse_db.compared(results)
        pairs = [(runs.get(f"{title} + SSE-DB"), runs.get(title)) for title in methods]
        pairs = [pair for pair in pairs if None not in pair]
        if not pairs:
            return Finding(None, "no runs")
        differences = []
        for with_it, without in pairs:
            count = min(each.evaluations["env_steps"].shape[1] for each in (with_it, without))
            x, y = (getattr(sse_db.areas(each, group, count), area) for each in (with_it, without))
            fewest = min(len(x), len(y))
            differences.append(sign * (x[:fewest] - y[:fewest]))
        return Finding(bounds_of(differences), f"area under the curve of {group} goals, {len(pairs)} method(s)")

    return find


def sse_db_less_than_infogoal(results: Results) -> Finding:
    """Test success of InfoGoal alone minus that of DQN with SSE-DB."""
    runs = sse_db.compared(results)
    if not {"InfoGoal", "DQN + SSE-DB"} <= runs.keys():
        return Finding(None, "no runs")
    x, y = (scores_of(runs[name], "test_goal/success_rate") for name in ("InfoGoal", "DQN + SSE-DB"))
    fewest = min(len(x), len(y))
    words = f"test goals: InfoGoal {x.mean():.2f}, DQN + SSE-DB {y.mean():.2f}"
    return Finding(bounds_of([x[:fewest] - y[:fewest]]), words)


def near(metric: str, target: float, tolerance: float, ratio: bool = False) -> Callable[[Results], Finding]:
    """The tolerance minus the distance of what a metric of InfoGoal converges to on FetchPickAndPlace from the paper's
    number. ratio: the distance is that of logarithms, and the tolerance a factor."""

    def find(results: Results) -> Finding:
        row = row_of(results, "paper", "fetch_pick_and_place", "infogoal")
        if row is None:
            return Finding(None, "no runs")
        values = scores_of(row.results[0], f"infogoal/{metric}")
        shown = mean_interval(values).show(4)
        words = f"{metric} {shown}, the paper {target}; the effect is what it may still be off"
        off = np.abs(np.log(values / target)) if ratio else np.abs(values - target)
        return Finding(bounds_of([(np.log(tolerance) if ratio else tolerance) - off]), words, decimals=4)

    return find


def fixed_against_adaptive(results: Results) -> Finding:
    """Adaptive minus the best fixed beta, mean over the three Fetch tasks and both kinds of corrupted goals."""
    kinds = ("corrupted_train_goal", "corrupted_test_goal")
    means = {beta: fetch_mean(results, fixed(beta)[0], kinds) for beta in FIXED_BETAS}
    means = {beta: values for beta, values in means.items() if values is not None}
    adaptive = fetch_mean(results, PRESET[0], kinds)
    if not means or adaptive is None:
        return Finding(None, "no runs")
    best = max(means, key=lambda beta: means[beta].mean())
    fewest = min(len(adaptive), len(means[best]))
    words = f"adaptive {adaptive.mean():.2f}, best fixed beta {best:g} {means[best].mean():.2f}"
    return Finding(bounds_of([adaptive[:fewest] - means[best][:fewest]]), words, -COMPARABLE)


def fetch_mean(results: Results, lane: str, kinds: Sequence[str]) -> np.ndarray | None:
    """Success of a lane of InfoGoal, mean over the three Fetch tasks and these kinds of goals, [seeds]; None unless all
    tasks ran."""
    found = [by_task(results, lane, kind) for kind in kinds]
    if any(len(each) < len(FETCH) for each in found):
        return None
    fewest = min(len(values) for each in found for values in each.values())
    return np.mean([values[:fewest] for each in found for values in each.values()], axis=0)


def beta_gain(better: float, worse: float) -> Callable[[Results], Finding]:
    """Success on corrupted test goals under one fixed beta minus that under another."""

    def find(results: Results) -> Finding:
        first, second = (fetch_mean(results, fixed(beta)[0], ("corrupted_test_goal",)) for beta in (better, worse))
        if first is None or second is None:
            return Finding(None, "no runs")
        fewest = min(len(first), len(second))
        return Finding(
            bounds_of([first[:fewest] - second[:fewest]]),
            f"beta {better:g}: {first.mean():.2f}, beta {worse:g}: {second.mean():.2f}",
        )

    return find


def less_information(results: Results) -> Finding:
    """How many times larger the KL of the codes is under the adaptive beta than under a fixed one of 0.1, as a
    logarithm."""
    rows = [row_of(results, "paper", "fetch_pick_and_place", "infogoal", lane) for lane in (PRESET[0], fixed(0.1)[0])]
    if None in rows:
        return Finding(None, "no runs")
    adaptive, high = (scores_of(row.results[0], "infogoal/kl") for row in rows)
    fewest = min(len(adaptive), len(high))
    difference = np.log(np.maximum(adaptive[:fewest], 1e-6)) - np.log(np.maximum(high[:fewest], 1e-6))
    words = f"log ratio of the KL: adaptive {adaptive.mean():.1f}, beta 0.1 {high.mean():.2f} nats"
    return Finding(bounds_of([difference]), words)


def own_loss(results: Results) -> Finding:
    """What HER, CHER and GHRL lose when test goals are corrupted."""
    rows = [row_of(results, "paper", task, method) for task in IMAGE_TASKS for method in RELABELLINGS]
    rows = [row for row in rows if row is not None and row.mean("corrupted_test_goal") and not faults_of(row)]
    if not rows:
        return Finding(None, "no runs that count")
    differences = [each for row in rows for each in paired(row, row, "test_goal", "corrupted_test_goal")]
    words = f"mean loss of success over {len(rows)} rows; more than {COMPARABLE} is asked for"
    return Finding(bounds_of(differences), words, COMPARABLE)
