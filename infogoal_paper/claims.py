"""The paper's claims, each with the test that decides it.

An effect is a mean over tasks, their goal sets and seeds of differences that are paired by goal set and seed. Its 95 %
interval is that over seeds or that over goal sets, as in the table, whichever is wider. A claim holds where the whole
interval lies on its side, fails where it lies on the other, and else cannot be told. One that says several things at
once holds where all of them do, and fails where one does. A claim about Table I is looked at under both readings of the
paper, and is decided where they agree. Nothing can be told of one that rests on fewer than three seeds, or on a row
that is missing, or of which the table says that it does not count.

First what a finding is, and the tests of Table I: success, and how long paths are. Then those of the figures: SSE-DB on
the first goal set of object search (Fig. 8), what beta converges to and fixed ones beside it (Figures 13 to 15), and
codes and the intrinsic reward, a number of each seed (Figures 9 to 12). The claims stand at the end.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from infogoal_jax.errors import counted_each
from infogoal_jax.goal_uses import TEST
from infogoal_jax.report.statistics import mean_interval
from infogoal_paper.files import Result
from infogoal_paper.image_goal_figures import WEIGHTS
from infogoal_paper.manifest import FETCH, FIXED_BETAS, METHODS, PRESET, fixed
from infogoal_paper.numbers import Results
from infogoal_paper.paper import IMAGE_TASKS, TASKS
from infogoal_paper.plan import PICTURED
from infogoal_paper.scores import KINDS, MARKS, NOT_COUNTED, TITLES, Bounds, Row, over_tasks, row_of, scores_of

Verdict = Literal["holds", "fails", "cannot be told"]
Paired = dict[int, dict[int, float]]
"""A number of each seed, by goal set and seed."""
INTERVALS = "Effects are paired by goal set and seed; intervals are over seeds or goal sets, whichever is wider."
LEAST_SEEDS = 3
"""On each goal set, for anything to be told."""


@dataclasses.dataclass(frozen=True)
class Finding:
    """What the numbers say about a claim.

    effect: the number that decides it, with its interval; None without runs.
    above: the claim holds if the effect lies above it.
    words: what the effect is, and what else is to be known.
    faults: why it does not count.
    """

    effect: Bounds | None
    words: str
    above: float = 0.0
    faults: tuple[str, ...] = ()
    decimals: int = 2

    @property
    def shown(self) -> str:
        """The effect and its interval, with a decimal more where a bound would look as if the verdict were open;
        nothing without runs."""
        if self.effect is None:
            return ""
        looks_open = self.verdict != "cannot be told" and self.above in (
            round(bound, self.decimals) for bound in (self.effect.low, self.effect.high)
        )
        return self.effect.show(self.decimals + looks_open)

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
    over = f"{counted_each(seeds, 'seed')} on {counted_each([len(scores) for scores in values], 'goal set')}"
    return Finding(over_tasks(values), f"{words}; {over}", above, faults_of(*rows) + few, decimals)


def lacking(found: Finding, *missing: str) -> Finding:
    """The finding, for which something did not run."""
    return dataclasses.replace(found, faults=(*found.faults, *missing))


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


DEPENDS = "depends on the reading"
"""The verdict on a claim that the two readings decide, and not alike."""
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

    def find(results: Results, reading: str = "paper") -> Finding:
        rows = {method: row_of(results, reading, task, method) for method in METHODS}
        rows = {method: row for method, row in rows.items() if row is not None and row.mean(kind)}
        if "infogoal" not in rows or len(rows) < 2:
            return Finding(None, "no runs")
        found = []
        for method in (method for method in METHODS if method != "infogoal"):
            if method not in rows:
                found.append(Finding(None, f"{METHODS[method]} not run"))
                continue
            both = shared(*(of_row(rows[each], success(kind)) for each in ("infogoal", method)))
            if not both[0]:
                found.append(Finding(None, f"InfoGoal and {METHODS[method]}: no goal set that both ran on"))
                continue
            means = [mean_number(own) for own in both]
            words = f"InfoGoal {means[0]:.2f}, {METHODS[method]} {means[1]:.2f}"
            found.append(finding({task: difference(*both)}, words, [*rows.values()]))
        return weakest(found)

    return find


def weakest(found: Sequence[Finding]) -> Finding:
    """Of findings that must all hold, the one that decides: which surely does not, or else is least certain to hold. It
    then decides nothing while others are not known."""
    known = [each for each in found if each.effect is not None]
    if not known:
        return found[0]
    failing = [each for each in known if each.effect.high < each.above]
    if failing:
        return min(failing, key=lambda each: each.effect.high)
    least = min(known, key=lambda each: np.nan_to_num(each.effect.low, nan=-np.inf))
    return lacking(least, *(each.words for each in found if each.effect is None))


def compare(
    pairs: Sequence[tuple[str, str]], kind: str, tasks: Sequence[str], above: float = 0.0, other: str | None = None
) -> Callable[[Results], Finding]:
    """Of each pair the first method minus the second (on another kind of goals), over the tasks on which both count. A
    claim about several methods is one about each: the weakest decides."""

    def of_pair(results: Results, reading: str, one: str, two: str) -> Finding:
        differences, left_out, missing = {}, [], []
        for task in tasks:
            rows = [row_of(results, reading, task, method) for method in (one, two)]
            if None in rows:
                missing.append(f"no runs on {TITLES[task]}")
            elif faults_of(*rows) or not all(row.mean(kind) and row.mean(other or kind) for row in rows):
                left_out.append(TITLES[task])
            elif difference := paired(*rows, kind, other):
                differences[task] = difference
        names = METHODS[one] if one == two else f"{METHODS[one]} minus {METHODS[two]}"
        without = left_out_words(left_out)
        if not differences:
            return Finding(None, f"{names}: no runs that count{without}")
        return lacking(finding(differences, f"{names}, {by_task(differences)}{without}", above=above), *missing)

    def find(results: Results, reading: str = "paper") -> Finding:
        decisive = weakest([of_pair(results, reading, *pair) for pair in pairs])
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


def infobot_paths(results: Results, reading: str = "paper") -> Finding:
    """How much longer InfoBot's paths are than InfoGoal's, on object search."""
    rows = [row_of(results, reading, "object_search", method) for method in ("infobot", "infogoal")]
    return Finding(None, "no runs") if None in rows else longer_paths(*rows, ("InfoBot", "InfoGoal"))


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


def infogoal_on_pick_and_place(results: Results, setting: str = PRESET[0]) -> Row | None:
    """The row of InfoGoal on FetchPickAndPlace."""
    return row_of(results, "paper", "fetch_pick_and_place", "infogoal", setting)


def near(
    metric: str, target: float, tolerance: float, ratio: bool = False, fault: str = ""
) -> Callable[[Results], Finding]:
    """The tolerance minus the distance of what a metric of InfoGoal converges to on FetchPickAndPlace from the paper's
    number. ratio: the distance is that of logarithms, and the tolerance a factor; fault: why it decides nothing."""

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
        found = finding({row.results[0].run.task: combined(left, values)}, words, [row], decimals=4)
        return dataclasses.replace(found, faults=(*found.faults, fault)) if fault else found

    return find


def rows_of_setting(results: Results, setting: str) -> Rows | None:
    """The rows of InfoGoal under a setting on the three Fetch tasks; None unless all of them ran."""
    rows = {task: row_of(results, "paper", task, "infogoal", setting) for task in FETCH}
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
    settings = {beta: rows for beta in FIXED_BETAS if (rows := rows_of_setting(results, fixed(beta)[0])) is not None}
    adaptive = rows_of_setting(results, PRESET[0])
    if not settings or adaptive is None:
        return Finding(None, "no runs")
    compared = {beta: side_by_side(adaptive, rows, CORRUPTED) for beta, rows in settings.items()}
    best = max(compared, key=lambda beta: compared[beta][2])
    gains, ours, fixed_best = compared[best]
    words = f"adaptive {ours:.2f}, best fixed beta {best:g} {fixed_best:.2f}"
    every = [*adaptive.values(), *(row for rows in settings.values() for row in rows.values())]
    found = finding(gains, words, every, above=-COMPARABLE)
    return found if len(settings) == len(FIXED_BETAS) else lacking(found, "rows are missing")


def beta_gain(better: float, worse: float) -> Callable[[Results], Finding]:
    """Success on corrupted test goals under one fixed beta minus that under another."""
    kinds = CORRUPTED[1:]

    def find(results: Results) -> Finding:
        first, second = (rows_of_setting(results, fixed(beta)[0]) for beta in (better, worse))
        if first is None or second is None:
            return Finding(None, "no runs")
        gains, *means = side_by_side(first, second, kinds)
        words = ", ".join(f"beta {beta:g}: {mean:.2f}" for beta, mean in zip((better, worse), means, strict=True))
        return finding(gains, words, [*first.values(), *second.values()])

    return find


def less_information(results: Results) -> Finding:
    """How many times larger the KL of the codes is under the adaptive beta than under a fixed one of 0.1, as a
    logarithm."""
    rows = [infogoal_on_pick_and_place(results, setting) for setting in (PRESET[0], fixed(0.1)[0])]
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
    """`measure.closeness` in a view of the goals by seed."""

    def find(result: Result) -> dict[int, float]:
        found = result.arrays.get("codes/closeness")
        return by_seed(result, found[:, view]) if found is not None and view < found.shape[1] else {}

    return find


def reward_near(result: Result) -> dict[int, float]:
    """`measure.reward_by_distance` by seed, mean over training goals."""
    found = result.arrays.get("codes/reward")
    return {} if found is None else by_seed(result, found)


def grouped(view: int = 0) -> Callable[[Results], Finding]:
    """The silhouette of InfoGoal's codes by region minus that of the bare agent's, in a view of the goals."""

    def find(results: Results) -> Finding:
        tasks, left_out, counted, missing = {}, [], [], []
        for task in PICTURED:
            rows = [row_of(results, "paper", task, method) for method in ("infogoal", "none")]
            if None in rows:
                missing.append(f"no runs on {TITLES[task]}")
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
        return lacking(finding(tasks, f"silhouette by region, {by_task(tasks)}{without}", counted), *missing)

    return find


def reward_near_goal(results: Results) -> Finding:
    """Minus the rank correlation of the intrinsic reward with the distance to where the goal is in view, mean over
    training goals."""
    tasks, left_out, missing = {}, [], []
    for task in ("object_search", "embodied_qa"):
        row = row_of(results, "paper", task, "infogoal")
        missing += [f"no runs on {TITLES[task]}"] if row is None else []
        own = of_row(row, reward_near) if row is not None else {}
        if own and faults_of(row):
            left_out.append(f"InfoGoal on {TITLES[task]}")
        elif own:
            tasks[task] = own
    without = left_out_words(left_out)
    if not tasks:
        return Finding(None, f"no runs that count{without}")
    words = f"minus Spearman's correlation with the distance, {by_task(tasks)}{without}"
    return lacking(finding(tasks, words), *missing)


@dataclasses.dataclass(frozen=True)
class Claim:
    """A claim of the paper.

    name: short.
    says: the claim.
    where: in the paper.
    test: what decides it, in words.
    find: what decides it.
    of_table: whether it is about Table I, and so decided under both readings.
    """

    name: str
    says: str
    where: str
    test: str
    find: Callable[..., Finding]
    of_table: bool = True


FIRST = "its least certain difference to another row"
NOT_FIRST = {("test_goal", "fetch_push"), ("corrupted_test_goal", "fetch_push"), ("test_goal", "embodied_qa")}
"""Where InfoGoal is not first in the paper's own table: InfoBot is on Push, and as good on the shelf."""
ONLINE = TASKS[:-1]
BARE = "difference to the bare agent, mean over tasks but EQA"
CLAIMS = (
    *(
        Claim(
            f"first-{kind.removesuffix('_goal').replace('_', '-')}-{TITLES[task]}",
            f"InfoGoal reaches more {KINDS[kind]} goals than every other method on {TITLES[task]}",
            "Table I, Sec. V-D",
            FIRST,
            first_of_task(task, kind),
        )
        for kind, tasks in (("test_goal", TASKS), ("corrupted_test_goal", IMAGE_TASKS))
        for task in tasks
        if (kind, task) not in NOT_FIRST
    ),
    Claim(
        "relabelling-helps",
        "HER, CHER and GHRL reach more test goals than the bare agents",
        "Sec. V-D",
        "difference to the bare agent, of each, mean over tasks",
        compare([(method, "none") for method in RELABELLINGS], "test_goal", TASKS),
    ),
    Claim(
        "relabelling-overfits",
        "HER, CHER and GHRL reach far fewer goals when these are corrupted",
        "Sec. V-D",
        f"clean minus corrupted test goals, of each, mean over tasks; above {COMPARABLE}",
        compare(
            [(method, method) for method in RELABELLINGS],
            "test_goal",
            IMAGE_TASKS,
            COMPARABLE,
            other="corrupted_test_goal",
        ),
    ),
    Claim(
        "relabelling-below-infogoal",
        "HER, CHER and GHRL lie below InfoGoal on test goals",
        "Table I",
        "InfoGoal minus each of them, mean over tasks",
        compare([("infogoal", method) for method in RELABELLINGS], "test_goal", TASKS),
    ),
    Claim(
        "reconstruction-corrupted-training",
        "VAE and DGRL reach more corrupted training goals than the bare agent",
        "Sec. V-D",
        "difference to the bare agent, of each, mean over tasks",
        compare([("vae", "none"), ("dgrl", "none")], "corrupted_train_goal", IMAGE_TASKS),
    ),
    Claim(
        "infobot-helps",
        "InfoBot reaches many more test goals than the bare agent",
        "Sec. V-E",
        f"{BARE}; above {COMPARABLE}",
        compare([("infobot", "none")], "test_goal", ONLINE, COMPARABLE),
    ),
    Claim(
        "infobot-paths",
        "InfoBot takes longer paths than InfoGoal",
        "Sec. V-E, Fig. 8",
        "by which share InfoBot's paths to test goals are longer on object search, in episodes that both reach",
        infobot_paths,
    ),
    Claim(
        "gcb-helps",
        "GCB, which groups similar goals, reaches more test goals than the bare agent",
        "Table I, Sec. V-E",
        BARE,
        compare([("gcb", "none")], "test_goal", ONLINE),
    ),
    Claim(
        "sse-db-efficiency",
        "SSE-DB makes DQN, InfoBot and InfoGoal more sample-efficient",
        "Fig. 8, left",
        "difference of the area under the curve of success on training goals",
        more_efficient("none", "infobot", "infogoal"),
        of_table=False,
    ),
    Claim(
        "sse-db-test",
        "DQN with SSE-DB reaches fewer test goals than InfoGoal",
        "Fig. 8, bottom left",
        "InfoGoal minus DQN with SSE-DB",
        less_than_infogoal,
        of_table=False,
    ),
    Claim(
        "sse-db-optimality",
        "SSE-DB does not shorten InfoBot's paths",
        "Fig. 8, right",
        f"by which share paths to test goals are longer with SSE-DB, in episodes that both reach, above -{COMPARABLE}",
        paths_not_shorter,
        of_table=False,
    ),
    Claim(
        "beta",
        "Beta converges to about 0.013 on FetchPickAndPlace",
        "Sec. V-F, Fig. 13",
        "within a quarter (a factor of two until 2026-11-28)",
        near("beta", 0.013, 1.25, ratio=True),
        of_table=False,
    ),
    Claim(
        "accuracy",
        "The accuracy stays at about 0.96 on FetchPickAndPlace",
        "Sec. V-F, Fig. 13",
        "within 0.01",
        near("accuracy", 0.96, 0.01, fault="Eq. 15 steers beta towards it, whatever is learned"),
        of_table=False,
    ),
    Claim(
        "beta-too-low",
        "A fixed beta of 0.01 is better than one of 0.0001",
        "Sec. V-F, Fig. 15",
        "difference on corrupted test goals of the three Fetch tasks",
        beta_gain(1e-2, 1e-4),
        of_table=False,
    ),
    Claim(
        "beta-too-high",
        "A fixed beta of 0.01 is better than one of 0.1",
        "Sec. V-F, Fig. 15",
        "difference on corrupted test goals of the three Fetch tasks",
        beta_gain(1e-2, 1e-1),
        of_table=False,
    ),
    Claim(
        "beta-adaptive",
        "The adaptive beta is comparable with the best fixed one",
        "Sec. V-F, Fig. 15",
        f"difference to the best fixed beta above -{COMPARABLE}",
        fixed_against_adaptive,
        of_table=False,
    ),
    Claim(
        "beta-prior",
        "Under a high fixed beta codes hold less information than under the adaptive one",
        "Sec. V-F, Fig. 14",
        "log ratio of the KL, adaptive to 0.1",
        less_information,
        of_table=False,
    ),
    Claim(
        "codes-grouped",
        "InfoGoal's codes of near goals lie together, more than the bare agent's",
        "Sec. V-E, Figs. 9 to 11",
        "difference of the silhouette by region",
        grouped(),
        of_table=False,
    ),
    Claim(
        "codes-corrupted",
        "InfoGoal's codes of near goals lie together when goals are corrupted, more than the bare agent's",
        "Sec. V-E, Fig. 9",
        "difference of the silhouette by region, backgrounds of weight 0.4",
        grouped(CORRUPTION),
        of_table=False,
    ),
    Claim(
        "reward-near-goal",
        "The intrinsic reward is high where the goal is",
        "Sec. V-E, Fig. 12",
        "minus the rank correlation with the distance to the goal",
        reward_near_goal,
        of_table=False,
    ),
)


READINGS = ("paper", "text")
"""Variants of Table I that are readings of the paper."""


class Judged(NamedTuple):
    """A claim with what the numbers say about it: under Algorithm 1, and under the text. text: None of a claim that is
    about figures, whose runs were made under the first reading alone."""

    claim: Claim
    paper: Finding
    text: Finding | None

    @property
    def verdict(self) -> str:
        """The verdict of both readings where they agree, or where there is one; else that they do not agree, or that
        one of them decides nothing."""
        if self.text is None or self.text.verdict == self.paper.verdict:
            return self.paper.verdict
        return "cannot be told" if "cannot be told" in (self.paper.verdict, self.text.verdict) else DEPENDS


def verdicts(results: Results) -> list[Judged]:
    """Every claim with what the numbers say about it under both readings."""
    return [
        Judged(claim, *(claim.find(results, reading) for reading in READINGS))
        if claim.of_table
        else Judged(claim, claim.find(results), None)
        for claim in CLAIMS
    ]
