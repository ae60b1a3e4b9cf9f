"""The tests that decide what the paper says of SSE-DB, on the first goal set of object search (Fig. 8)."""

from collections.abc import Callable

import numpy as np

from infogoal_jax.reproduce.effects import Finding, Paired, by_seed, difference, finding, of_row, success
from infogoal_jax.reproduce.evidence import COMPARABLE, longer_paths, weakest
from infogoal_jax.reproduce.manifest import METHODS
from infogoal_jax.reproduce.numbers import Results
from infogoal_jax.reproduce.scores import Row, row_of

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
    numbers = [of_row(row, success("test_goal")) for row in (infogoal, explorer)]
    means = [np.mean([value for seeds in each.values() for value in seeds.values()]) for each in numbers]
    words = f"test goals: {METHODS['infogoal']} {means[0]:.2f}, DQN + SSE-DB {means[1]:.2f}"
    return finding({TASK: difference(*numbers)}, words, (infogoal, explorer))


def paths_not_shorter(results: Results) -> Finding:
    """How much longer InfoBot's paths are with SSE-DB than without."""
    rows = rows_of(results, "infobot")
    if None in rows:
        return Finding(None, "no runs")
    return longer_paths(*rows, ("with SSE-DB", "without"), above=-COMPARABLE)
