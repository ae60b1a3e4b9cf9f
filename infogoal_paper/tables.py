"""Every table that there are numbers for: Tables I and II, test goals at equal training, near and far goals, the
comparison of methods over tasks, and what all of it cost."""

import functools
import math
from collections.abc import Callable, Iterable

import numpy as np
from scipy import stats

from infogoal_jax.goal_uses import TEST
from infogoal_paper import plan
from infogoal_paper.files import Result
from infogoal_paper.manifest import FETCH, METHODS, RELABELLED, VARIANTS, Choice, runs_of
from infogoal_paper.numbers import Results
from infogoal_paper.paper import LEARNERS, SENTENCES, TASKS, reported
from infogoal_paper.scores import (
    KINDS,
    MARKS,
    NOT_COUNTED,
    ROWS,
    TITLES,
    Row,
    TwoIntervals,
    bootstrap,
    columns,
    has_scores,
    interquartile_mean,
    over_seeds_and_sets,
    probability_of_improvement,
    row_of,
    rows_of,
    scores_of,
)
from infogoal_paper.table_formats import INTERVALS, Cell, Table, machines_in_words


def methods_of(rows: dict[tuple[str, str], Row], variant: str) -> list[str]:
    """The methods of a variant that have a row."""
    return [method for method in ROWS[variant] if any(known == method for _, known in rows)]


def table1(results: Results, variant: str) -> Table | None:
    """Table I in one of the variants; None where there are no runs."""
    rows = rows_of(results, variant, ROWS[variant])
    if not rows:
        return None
    shown = [(kind, task) for kind, task in columns() if any(known == task for known, _ in rows)]
    methods = methods_of(rows, variant)
    cells = {
        (method, kind, task): cell_of(rows.get((task, method)), variant, kind, task, method)
        for method in methods
        for kind, task in shown
    }
    for kind, task in shown:
        if is_complete(rows, variant, kind, task):
            column = {method: cells[method, kind, task] for method in methods}
            for method, rank in ranks(column).items():
                cells[method, kind, task] = column[method]._replace(rank=rank)
    head = ["method"]
    for kind, task in shown:
        head += [f"{TITLES[task]}, {KINDS[kind]}"]
    body = [[METHODS[method], *(cells[method, kind, task] for kind, task in shown)] for method in methods]
    seeds = sorted({row.seeds for row in rows.values()})
    foot = [
        f"Success rate: mean ± {INTERVALS} (Student t); in brackets the paper's number. "
        "Bold: best of a column; underlined: second best, in columns in which every method ran on every goal set. "
        f"{' or '.join(map(str, seeds))} seed(s) on each goal set. Corrupted: background of weight 0.4."
    ]
    foot += legend(rows.values())
    return Table(f"table1_{variant}", f"Table I, {VARIANTS[variant]}", head, body, foot)


def equal_training(results: Results, variant: str) -> Table | None:
    """Success on test goals when all methods of a task have had as many updates as the one that stopped first. Training
    stops by training goals: a method that learns them slowly is given more updates, in which test goals may rise."""
    rows = rows_of(results, variant, ROWS[variant])
    lengths = {task: updates_of(rows[key] for key in rows if key[0] == task) for task in TASKS}
    updates = {task: min(each) for task, each in lengths.items() if each}
    if not updates:
        return None
    methods = methods_of(rows, variant)
    columns = []
    for task, most in updates.items():
        own = {method: rows.get((task, method)) for method in methods}
        column = {method: Cell(None if row is None else over_updates(row, most)) for method, row in own.items()}
        order = ranks(column) if is_complete(rows, variant, "test_goal", task) else {}
        columns.append({method: cell._replace(rank=order.get(method, 0)) for method, cell in column.items()})
    head = ["method", *(f"{TITLES[task]}, {most:,} updates" for task, most in updates.items())]
    body = [[METHODS[method], *(column[method] for column in columns)] for method in methods]
    longest = max(max(lengths[task]) / most for task, most in updates.items())
    foot = [
        "Success rate on clean test goals, over the three evaluations before the first run of the column stopped. "
        f"Mean ± {INTERVALS}. In Table I each run has trained until its training goals levelled off, at most for "
        f"{longest:.1f} times as long."
    ]
    return Table(f"equal_training_{variant}", f"Test goals at equal training, {VARIANTS[variant]}", head, body, foot)


def updates_of(rows: Iterable[Row]) -> list[int]:
    """The updates of each run of these rows until its training goals levelled off."""
    return [
        plan.shown(result.evaluations["train_goal/success_rate"]).stop * result.about["updates"]
        for row in rows
        for result in row.results
    ]


def over_updates(row: Row, updates: int) -> TwoIntervals | None:
    """Success of a row on test goals over the last evaluations up to so many updates."""
    scores = []
    for result in row.results:
        count = updates // result.about["updates"]
        scores.append(scores_of(result, "test_goal/success_rate", slice(max(0, count - plan.WINDOW), count)))
    return over_seeds_and_sets(scores) if all(len(each) for each in scores) else None


def legend(rows: Iterable[Row]) -> list[str]:
    """What the marks of these rows mean, a line each."""
    found = {fault for row in rows for fault in row.faults()}
    return [f"{mark} {words}." for fault, (mark, words) in MARKS.items() if fault in found]


def cell_of(row: Row | None, variant: str, kind: str, task: str, method: str) -> Cell:
    """A cell of Table I. The paper has no table with HER in every row."""
    paper = reported(task, kind, method) if variant != "her" or method == "her" else ""
    return Cell(None, paper) if row is None else Cell(row.mean(kind), paper, 0, row.marks(), row.results[0].run.name)


def ranks(column: dict[str, Cell]) -> dict[str, int]:
    """1 for the best of a column, 2 for the second best, by the two decimals that are shown; ties share a rank."""
    means = {name: round(cell.ours.mean, 2) for name, cell in column.items() if cell.ours is not None}
    order = sorted(set(means.values()), reverse=True)[:2]
    return {name: order.index(mean) + 1 for name, mean in means.items() if mean in order}


def is_complete(rows: dict[tuple[str, str], Row], variant: str, kind: str, task: str) -> bool:
    """Whether each method that the variant and the task allow has its number, and all of them on the same goal sets."""
    wanted = [rows.get((task, method)) for method in ROWS[variant] if is_planned(variant, task, method)]
    sets = {None if row is None else tuple(result.run.goal_set for result in row.results) for row in wanted}
    return len(sets) == 1 and all(has_scores(row, kind) for row in wanted)


@functools.cache
def is_planned(variant: str, task: str, method: str) -> bool:
    """Whether a variant has this row on a task."""
    return bool(runs_of(("table1",), Choice((task,), (method,), (variant,), seeds=1)))


def fit(results: Results) -> Table | None:
    """How far the test goals of each learner lie from the paper's numbers without HER and with it."""
    rows = {variant: rows_of(results, variant, ROWS[variant]) for variant in ("paper", "her")}
    body = []
    for method in LEARNERS:
        distances = [distance_to_paper(rows[variant], method) for variant in ("paper", "her")]
        if None not in distances:
            relabels = "yes" if method in RELABELLED else "no"
            body.append(
                [METHODS[method], *(f"{value:.2f}" for value in distances), relabels, SENTENCES.get(method, "")]
            )
    if not body:
        return None
    foot = ["Mean distance of success on test goals to the paper's number, over the tasks without EQA."]
    head = ["learner", "without HER", "with HER", "relabels in the text", "sentence"]
    return Table("fit", "Which learners relabel?", head, body, foot)


def order(results: Results) -> Table | None:
    """How alike the order of methods on test goals is to the paper's, under both readings."""
    body = []
    for variant in ("paper", "text"):
        rows = rows_of(results, variant, ROWS[variant])
        found = [order_like_paper(rows, task) for task in TASKS]
        if any(value is not None for value in found):
            body.append([VARIANTS[variant], *("" if value is None else f"{value:.2f}" for value in found)])
    if not body:
        return None
    foot = ["Spearman's rank correlation of our test goals with the paper's, over the methods of Table I."]
    return Table("order", "Is the order of methods the paper's?", ["reading", *TITLES.values()], body, foot)


def distance_to_paper(rows: dict[tuple[str, str], Row], method: str) -> float | None:
    """The mean absolute distance of a method's test goals to the paper's, over tasks that act; None without runs."""
    found = [
        abs(rows[task, method].mean("test_goal").mean - float(reported(task, "test_goal", method)))
        for task in TASKS[:-1]
        if (task, method) in rows and has_scores(rows[task, method], "test_goal")
    ]
    return float(np.mean(found)) if found else None


def order_like_paper(rows: dict[tuple[str, str], Row], task: str) -> float | None:
    """Spearman's correlation of our test goals with the paper's over methods; None for fewer than three."""
    known = [method for method in METHODS if has_scores(rows.get((task, method)), "test_goal")]
    known = [method for method in known if reported(task, "test_goal", method)]
    if len(known) < 3:
        return None
    ours = [round(rows[task, method].mean("test_goal").mean, 2) for method in known]
    return float(stats.spearmanr(ours, [float(reported(task, "test_goal", method)) for method in known]).statistic)


def table2(results: Results) -> Table | None:
    """Table II: beta, accuracy and KL that InfoGoal converges to."""
    found = {task: row_of(results, "paper", task, "infogoal") for task in TASKS}
    rows, body = {task: row for task, row in found.items() if row}, []
    for task, row in rows.items():
        cells: list[Cell | str] = [TITLES[task]]
        for metric, decimals in (("beta", 4), ("accuracy", 3), ("kl", 1)):
            values = [scores_of(result, f"infogoal/{metric}") for result in row.results]
            mean = over_seeds_and_sets(values)
            half = f" ± {mean.seeds:.{decimals}f}" if math.isfinite(mean.seeds) else ""
            cells.append(f"{mean.mean:.{decimals}f}{half}{row.marks()}")
        body.append([*cells, "0.013, 0.96" if task == "fetch_pick_and_place" else ""])
    foot = [
        "Mean ± 95 % interval over seeds. The paper's supplementary table could not be had; its text has PickAndPlace.",
        *legend(rows.values()),
    ]
    head = ["task", "beta", "accuracy", "KL (nats)", "paper: beta, accuracy"]
    return Table("table2", "Table II: what InfoGoal converges to", head, body, foot) if body else None


def near_and_far(results: Results) -> Table | None:
    """Success on test goals of Fetch near a training goal and far from all of them, at the evaluation at which the run
    levelled off; of the runs that recorded which are near."""
    head, columns = ["method"], []
    for task in FETCH:
        rows = {method: row_of(results, "paper", task, method) for method in METHODS}
        rows = {method: row for method, row in rows.items() if row and all("near" in x.arrays for x in row.results)}
        if rows:
            head += [f"{TITLES[task]}, near", f"{TITLES[task]}, far"]
            columns += [(rows, True), (rows, False)]
    body = [
        [METHODS[method], *(near_cell(rows.get(method), near) for rows, near in columns)]
        for method in METHODS
        if any(method in rows for rows, _ in columns)
    ]
    foot = [
        "Success rate on clean test goals that count as reached from a training goal (near), and on the others (far): "
        f"mean ± {INTERVALS}, {VARIANTS['paper']}, at the last of the three "
        "evaluations whose mean Table I shows.",
        *legend(row for rows, _ in columns for row in rows.values()),
    ]
    return Table("near_and_far", "Near and far test goals of Fetch", head, body, foot) if body else None


def near_cell(row: Row | None, near: bool) -> Cell:
    """The success of a row on its near test goals, or on its far ones."""
    if row is None:
        return Cell(None)
    scores = []
    for result in row.results:
        part = (result.arrays["uses"] == TEST) & (result.arrays["near"] == near)
        if not part.any():  # A goal set may have none that are near.
            continue
        scores.append(
            (result.arrays["first_reached"][result.kept][:, part] <= result.about["episode_length"]).mean((1, 2))
        )
    found = over_seeds_and_sets(scores) if scores and all(len(each) for each in scores) else None
    return Cell(found, "", 0, row.marks(), row.results[0].run.name)


def counts(row: Row) -> bool:
    """Whether a row counts for what is said over tasks."""
    return not NOT_COUNTED.intersection(row.faults())


def counts_alone(row: Row) -> bool:
    """Whether its mean may stand beside those of other rows, which takes the same goal sets."""
    return counts(row) and not row.lacking


def over_tasks(results: Results, variant: str) -> Table | None:
    """The interquartile mean of each method over the tasks on which its row counts, and the probability that InfoGoal
    is better over those on which both do; by kind of goals, of the tasks on which all of the methods ran."""
    rows = rows_of(results, variant, ROWS[variant])
    methods = methods_of(rows, variant)
    if len(methods) < 2:
        return None
    tasks_of = {
        kind: [task for task in TASKS if all(has_scores(rows.get((task, method)), kind) for method in methods)]
        for kind in KINDS
    }
    kinds = [kind for kind in KINDS if tasks_of[kind]]
    if not kinds:
        return None
    head = ["method"]
    for kind in kinds:
        head += [f"IQM, {KINDS[kind]}", f"P(InfoGoal better), {KINDS[kind]}"]
    body = []
    for method in methods:
        cells = [METHODS[method]]
        for kind in kinds:
            ran = len(tasks_of[kind])
            own = [rows[task, method] for task in tasks_of[kind] if counts_alone(rows[task, method])]
            cells.append(over_some(interquartile_mean, ran, [row.scores(kind) for row in own]))
            both = [pair for pair in pairs_of(rows, tasks_of[kind], method) if all(map(counts, pair))]
            scores = [[scores_of_sets(row, other, kind) for row, other in (pair, pair[::-1])] for pair in both]
            cells.append(
                over_some(probability_of_improvement, ran, *(list(each) for each in zip(*scores, strict=True)))
            )
        body.append(cells)
    filled = [place for place in range(len(head)) if any(row[place] for row in body)]
    head, body = [head[place] for place in filled], [[row[place] for place in filled] for row in body]
    foot = [
        "IQM: interquartile mean over runs and tasks. P: probability that a run of InfoGoal has more success than one "
        "of the method on the same goal set. Both are as rliable defines them, with the 95 % interval of a bootstrap "
        "over goal sets and seeds within tasks. Rows that do not count are left out: interquartile means over "
        "different tasks are not to be compared. A row that lacks a goal set is left out of the means alone."
    ]
    for kind in kinds:
        foot.append(f"{KINDS[kind]}: {', '.join(TITLES[task] for task in tasks_of[kind])}.")
        left = [left_out(rows, task, methods) for task in tasks_of[kind]]
        foot += [f"Left out of {KINDS[kind]}: {'; '.join(filter(None, left))}."] if any(left) else []
    foot += legend(rows.values())
    return Table(f"over_tasks_{variant}", f"Over tasks, {VARIANTS[variant]}", head, body, foot)


def pairs_of(rows: dict[tuple[str, str], Row], tasks: list[str], method: str) -> list[tuple[Row, Row]]:
    """InfoGoal's row and the method's of these tasks, where both are there and are not the same."""
    there = [task for task in tasks if method != "infogoal" and (task, "infogoal") in rows]
    return [(rows[task, "infogoal"], rows[task, method]) for task in there]


def scores_of_sets(row: Row, other: Row, kind: str) -> list[np.ndarray]:
    """Success of a row on the goal sets that another one has too, [seeds] of each."""
    shared = {result.run.goal_set for result in other.results}
    return [
        scores for result, scores in zip(row.results, row.scores(kind), strict=True) if result.run.goal_set in shared
    ]


def over_some(function: Callable[..., np.ndarray], ran: int, *methods: list) -> str:
    """The function over the tasks that count with its interval, and of how many tasks these are; nothing for none."""
    if not methods or not methods[0] or not all(scores for tasks in methods for scores in tasks):
        return ""
    count = len(methods[0])
    return bootstrap(function, *methods).show() + (f", {count} of {ran} tasks" if count < ran else "")


def left_out(rows: dict[tuple[str, str], Row], task: str, methods: list[str]) -> str:
    """The methods whose rows on a task do not count, with their marks."""
    left = [method for method in methods if not counts_alone(rows[task, method])]
    names = [f"{METHODS[method]}{rows[task, method].marks()}" for method in left]
    return f"{', '.join(names)} on {TITLES[task]}" if names else ""


def costs(results: Results) -> Table | None:
    """Programs, updates, and the time of compiling and of running, by task."""
    body, machines, totals = [], {}, np.zeros(5)
    for task in TASKS:
        own = [result for run, result in results.items() if run.task == task]
        programs = {"\n".join(result.about["program"]["runs"]): result.about["program"] for result in own}
        if not own:
            continue
        compiling, running = (
            # As exact with every version of Python; its own `sum` rounds otherwise from 3.12 on.
            math.fsum(program[f"{name}_seconds"] for program in programs.values())
            for name in ("compile", "run")
        )
        measuring = math.fsum(result.about["measure_seconds"] for result in own)
        updates = sum(result.evaluations["train_goal/success_rate"].size * result.about["updates"] for result in own)
        numbers = np.array([len(own), len(programs), updates / 1e6, compiling + measuring, running])
        totals += numbers
        body.append([TITLES[task], *cost_cells(numbers, own)])
        machines |= dict.fromkeys(result.about["machine"] for result in own)
    if not body:
        return None
    body.append(["all", *cost_cells(totals, list(results.values()))])
    head = ["task", "runs", "programs", "updates (million)"]
    head += ["compiling and measuring (s)", "training (s)", "process-minutes"]
    foot = (
        "Updates are counted over all seeds. Seconds and process-minutes are sums over processes, several of which "
        "share a GPU: the sums are more than its time."
    )
    if any("spans" in result.about["program"] for result in results.values()):
        head.append("wall clock (min)")
        foot += (
            " Wall clock: the time in which at least one process was at work, on one GPU or several, of the runs that "
            "recorded it."
        )
    else:
        body = [row[:-1] for row in body]
    return Table("costs", "What it cost", head, body, [f"{machines_in_words(machines)}.", foot])


def cost_cells(numbers: np.ndarray, own: list[Result]) -> list[str]:
    """The cells of a line of the costs: of these numbers, of which the last two are seconds, and of the wall clock of
    the runs."""
    timed = [result.about["program"]["spans"] for result in own if "spans" in result.about["program"]]
    clock = f"{seconds_of(timed) / 60:,.0f}" if timed else ""
    clock += f" ({len(timed)} of {len(own)} runs)" if 0 < len(timed) < len(own) else ""
    return [*(f"{number:,.0f}" for number in numbers), f"{numbers[-2:].sum() / 60:,.0f}", clock]


def seconds_of(spans_of_runs: list[list[list[float]]]) -> float:
    """Seconds in which at least one of these spans, [from, to] of each run, was running."""
    total, until = 0.0, -math.inf
    for start, end in sorted((start, end) for spans in spans_of_runs for start, end in spans):
        total += max(0.0, end - max(start, until))
        until = max(until, end)
    return total


def all_tables(results: Results) -> list[Table]:
    """Every table of the paper's runs that there are numbers for."""
    results = {run: result for run, result in results.items() if run.of_paper}
    made = [make(results, variant) for variant in VARIANTS for make in (table1, equal_training, over_tasks)]
    made += [fit(results), order(results), table2(results), near_and_far(results), costs(results)]
    return [table for table in made if table is not None]
