"""The tests that decide what the paper says of SSE-DB, on the first goal set of object search (Fig. 8)."""

from collections.abc import Callable

import numpy as np

from infogoal_jax.reproduce.effects import (
    Finding,
    Paired,
    by_seed,
    difference,
    finding,
    lacking_rows,
    mean_of,
    of_row,
    success,
)
from infogoal_jax.reproduce.evidence import COMPARABLE, longer_paths
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
    """The area under the curve of success on training goals with SSE-DB minus that without, mean over these methods."""

    def find(results: Results) -> Finding:
        pairs = [rows for method in methods if None not in (rows := rows_of(results, method))]
        if not pairs:
            return Finding(None, "no runs")
        gains = []
        for with_it, without in pairs:
            runs = (*with_it.results, *without.results)
            count = min(run.evaluations["train_goal/success_rate"].shape[1] for run in runs)
            gains.append(difference(area(with_it, count), area(without, count)))
        words = f"area under the curve of training goals, {len(pairs)} of {len(methods)} methods"
        found = finding({TASK: mean_of(gains)}, words, [row for rows in pairs for row in rows])
        return found if len(pairs) == len(methods) else lacking_rows(found)

    return find


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
