"""The tests that decide what the paper says of its figures: SSE-DB on the first goal set of object search (Fig. 8),
what beta converges to and fixed ones beside it (Figures 13 to 15), and codes and the intrinsic reward, a number of each
seed (Figures 9 to 12)."""

from collections.abc import Callable, Sequence

import numpy as np

from infogoal_jax.report.image_goals import WEIGHTS
from infogoal_jax.report.statistics import mean_interval
from infogoal_paper import measure
from infogoal_paper.evidence import (
    COMPARABLE,
    LEAST_SEEDS,
    Finding,
    Paired,
    by_seed,
    by_task,
    combined,
    difference,
    faults_of,
    finding,
    lacking_rows,
    left_out_words,
    longer_paths,
    mean_number,
    mean_of,
    metric_of,
    of_row,
    pair_words,
    shared,
    success,
    weakest,
)
from infogoal_paper.files import Result
from infogoal_paper.manifest import FETCH, FIXED_BETAS, METHODS, PRESET, fixed
from infogoal_paper.numbers import Results
from infogoal_paper.plan import PICTURED
from infogoal_paper.scores import TITLES, Row, row_of

TASK = "object_search"


def rows_of(results: Results, method: str) -> tuple[Row | None, Row | None]:
    """The row of a method with SSE-DB, and without."""
    with_it, without = (row_of(results, "paper", TASK, method, explorer=explorer) for explorer in ("sse_db", None))
    return with_it, without


def area(row: Row, evaluations: int) -> Paired:
    """The area under the curve of success on training goals over the first so many evaluations."""
    return of_row(row, lambda run: by_seed(run, run.evaluations["train_goal/success_rate"][:, :evaluations].mean(1)))


def more_efficient(*methods: str) -> Callable[[Results], Finding]:
    """The area under the curve of success on training goals with SSE-DB minus that without, of each method: the weakest
    decides."""

    def of_method(results: Results, method: str) -> Finding:
        with_it, without = rows_of(results, method)
        if with_it is None or without is None:
            return Finding(None, f"{METHODS[method]}: no runs")
        shared = {run.run.goal_set for run in with_it.results} & {run.run.goal_set for run in without.results}
        runs = [run for run in (*with_it.results, *without.results) if run.run.goal_set in shared]
        count = min((run.evaluations["train_goal/success_rate"].shape[1] for run in runs), default=0)
        gain = difference(area(with_it, count), area(without, count))
        words = f"{METHODS[method]}, area under the curve of training goals; the weakest of {len(methods)}"
        return finding({TASK: gain}, words, (with_it, without))

    return lambda results: weakest([of_method(results, method) for method in methods])


def less_than_infogoal(results: Results) -> Finding:
    """Test success of InfoGoal alone minus that of DQN with SSE-DB."""
    infogoal, explorer = rows_of(results, "infogoal")[1], rows_of(results, "none")[0]
    if infogoal is None or explorer is None:
        return Finding(None, "no runs")
    numbers = shared(*(of_row(row, success("test_goal")) for row in (infogoal, explorer)))
    if not numbers[0]:
        return Finding(None, "no runs")
    means = [mean_number(each) for each in numbers]
    words = f"test goals: {METHODS['infogoal']} {means[0]:.2f}, DQN + SSE-DB {means[1]:.2f}"
    return finding({TASK: difference(*numbers)}, words, (infogoal, explorer))


def paths_not_shorter(results: Results) -> Finding:
    """How much longer InfoBot's paths are with SSE-DB than without."""
    rows = rows_of(results, "infobot")
    if None in rows:
        return Finding(None, "no runs")
    return longer_paths(*rows, ("with SSE-DB", "without"), above=-COMPARABLE)


CORRUPTED = ("corrupted_train_goal", "corrupted_test_goal")
Rows = dict[str, Row]
LEAST = 1e-6
"""A beta below it compresses nothing: its logarithm is that of this one, since 0 has none."""


def infogoal_on_pick_and_place(results: Results, lane: str = PRESET[0]) -> Row | None:
    """The row of InfoGoal on FetchPickAndPlace."""
    return row_of(results, "paper", "fetch_pick_and_place", "infogoal", lane)


def near(metric: str, target: float, tolerance: float, ratio: bool = False) -> Callable[[Results], Finding]:
    """The tolerance minus the distance of what a metric of InfoGoal converges to on FetchPickAndPlace from the paper's
    number. ratio: the distance is that of logarithms, and the tolerance a factor."""

    def left(value: float) -> float:
        off = abs(np.log(max(value, LEAST) / target)) if ratio else abs(value - target)
        return (np.log(tolerance) if ratio else tolerance) - off

    def find(results: Results) -> Finding:
        row = infogoal_on_pick_and_place(results)
        if row is None:
            return Finding(None, "no runs")
        values = of_row(row, metric_of(f"infogoal/{metric}"))
        shown = mean_interval([value for seeds in values.values() for value in seeds.values()]).show(4)
        words = f"{metric} {shown}, the paper {target}; the effect is what it may still be off"
        return finding({row.results[0].run.task: combined(left, values)}, words, [row], decimals=4)

    return find


def rows_of_lane(results: Results, lane: str) -> Rows | None:
    """The rows of InfoGoal under a lane on the three Fetch tasks; None unless all of them ran."""
    rows = {task: row_of(results, "paper", task, "infogoal", lane) for task in FETCH}
    return None if None in rows.values() else rows


def side_by_side(first: Rows, second: Rows, kinds: Sequence[str]) -> tuple[dict[str, Paired], float, float]:
    """Success, mean over kinds of goals, on the goal sets and seeds of both rows: that of the first minus that of the
    second by task, and the mean over tasks of each."""
    numbers = {
        task: shared(*(mean_of([of_row(rows[task], success(kind)) for kind in kinds]) for rows in (first, second)))
        for task in first
    }
    means = [float(np.mean([mean_number(both[place]) for both in numbers.values()])) for place in (0, 1)]
    return {task: difference(*both) for task, both in numbers.items()}, *means


def fixed_against_adaptive(results: Results) -> Finding:
    """Adaptive minus the best fixed beta, mean over the three Fetch tasks and both kinds of corrupted goals. A row that
    does not count might be the best, so that nothing can be told."""
    lanes = {beta: rows for beta in FIXED_BETAS if (rows := rows_of_lane(results, fixed(beta)[0])) is not None}
    adaptive = rows_of_lane(results, PRESET[0])
    if not lanes or adaptive is None:
        return Finding(None, "no runs")
    compared = {beta: side_by_side(adaptive, rows, CORRUPTED) for beta, rows in lanes.items()}
    best = max(compared, key=lambda beta: compared[beta][2])
    gains, ours, fixed_best = compared[best]
    words = f"adaptive {ours:.2f}, best fixed beta {best:g} {fixed_best:.2f}"
    every = [*adaptive.values(), *(row for rows in lanes.values() for row in rows.values())]
    found = finding(gains, words, every, above=-COMPARABLE)
    return found if len(lanes) == len(FIXED_BETAS) else lacking_rows(found)


def beta_gain(better: float, worse: float) -> Callable[[Results], Finding]:
    """Success on corrupted test goals under one fixed beta minus that under another."""
    kinds = CORRUPTED[1:]

    def find(results: Results) -> Finding:
        first, second = (rows_of_lane(results, fixed(beta)[0]) for beta in (better, worse))
        if first is None or second is None:
            return Finding(None, "no runs")
        gains, *means = side_by_side(first, second, kinds)
        words = ", ".join(f"beta {beta:g}: {mean:.2f}" for beta, mean in zip((better, worse), means, strict=True))
        return finding(gains, words, [*first.values(), *second.values()])

    return find


def less_information(results: Results) -> Finding:
    """How many times larger the KL of the codes is under the adaptive beta than under a fixed one of 0.1, as a
    logarithm."""
    rows = [infogoal_on_pick_and_place(results, lane) for lane in (PRESET[0], fixed(0.1)[0])]
    if None in rows:
        return Finding(None, "no runs")
    adaptive, high = shared(*(of_row(row, metric_of("infogoal/kl")) for row in rows))
    if not adaptive:
        return Finding(None, "no runs")
    ratio = combined(lambda x, y: np.log(max(x, 1e-6)) - np.log(max(y, 1e-6)), adaptive, high)
    means = [mean_number(each) for each in (adaptive, high)]
    words = f"log ratio of the KL: adaptive {means[0]:.1f}, beta 0.1 {means[1]:.2f} nats"
    return finding({rows[0].results[0].run.task: ratio}, words, rows)


CORRUPTION = 1 + WEIGHTS.index(0.4)
"""The view of the goals under Table I's corruption."""


def closeness(view: int) -> Callable[[Result], dict[int, float]]:
    """`measure.closeness` in a view of the goals by seed; of a run that was made before all seeds were looked at, that
    of the one seed of its picture."""

    def find(result: Result) -> dict[int, float]:
        if "codes/closeness" in result.arrays:
            found = result.arrays["codes/closeness"]
            return by_seed(result, found[:, view]) if view < found.shape[1] else {}
        if "picture/code_mean" not in result.arrays or view >= len(result.arrays["picture/code_mean"]):
            return {}
        mean, region, use = (result.arrays[f"picture/code_{name}"] for name in ("mean", "region", "use"))
        return {result.run.seeds[0]: measure.closeness(mean[view], region, use)}

    return find


def reward_near(result: Result) -> dict[int, float]:
    """`measure.reward_by_distance` by seed, mean over training goals; or that of the one seed of the run's picture."""
    if "codes/reward" in result.arrays:
        return by_seed(result, result.arrays["codes/reward"])
    if "picture/reward" not in result.arrays:
        return {}
    place, goals = result.arrays["picture/place"], result.arrays["picture/reward_way_goal"]
    rewards = result.arrays["picture/reward"].astype(float)
    found = [measure.reward_by_distance(*each) for each in zip(rewards, [place] * len(goals), goals, strict=True)]
    return {result.run.seeds[0]: float(np.mean(found))}


def enough(tasks: dict[str, Paired]) -> dict[str, Paired]:
    """The goal sets with enough seeds, where there are such; else all."""
    kept = {
        task: {place: seeds for place, seeds in sets.items() if len(seeds) >= LEAST_SEEDS}
        for task, sets in tasks.items()
    }
    kept = {task: sets for task, sets in kept.items() if sets}
    return kept or tasks


def grouped(view: int = 0) -> Callable[[Results], Finding]:
    """The silhouette of InfoGoal's codes by region minus that of the bare agent's, in a view of the goals."""

    def find(results: Results) -> Finding:
        tasks, left_out, counted = {}, [], []
        for task in PICTURED:
            rows = [row_of(results, "paper", task, method) for method in ("infogoal", "none")]
            if None in rows:
                continue
            own = difference(*(of_row(row, closeness(view)) for row in rows))
            if own and faults_of(*rows):
                left_out.append(pair_words("infogoal", "none", task))
            elif own:
                tasks[task] = own
                counted += rows
        without = left_out_words(left_out)
        if not tasks:
            return Finding(None, f"no runs that count{without}")
        tasks = enough(tasks)
        return finding(tasks, f"silhouette by region, {by_task(tasks)}{without}", counted)

    return find


def reward_near_goal(results: Results) -> Finding:
    """Minus the rank correlation of the intrinsic reward with the distance to where the goal is in view, mean over
    training goals."""
    tasks, left_out = {}, []
    for task in ("object_search", "embodied_qa"):
        row = row_of(results, "paper", task, "infogoal")
        own = of_row(row, reward_near) if row is not None else {}
        if own and faults_of(row):
            left_out.append(f"InfoGoal on {TITLES[task]}")
        elif own:
            tasks[task] = own
    without = left_out_words(left_out)
    if not tasks:
        return Finding(None, f"no runs that count{without}")
    tasks = enough(tasks)
    words = f"minus Spearman's correlation with the distance, {by_task(tasks)}{without}"
    return finding(tasks, words)
