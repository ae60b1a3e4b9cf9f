"""Definition 1 of the paper, tested: goals with equal codes have equal optimal values.

    python -m infogoal_paper.sufficiency --out FOLDER [--methods ...] [--toy]
    python -m infogoal_paper.sufficiency --merge FOLDER

On a house Q* is known: value iteration over its graph. Presets are trained to their end on the houses of the study of
noise at test (noise.py), which no choice has seen. Then for every seed the codes of all goals are compared with their
Q*: the difference of two goals is the mean of |Q*(s, a, g) - Q*(s, a, g+)| over states and legal actions. Goals are put
into as many clusters of codes as the house has rooms, by average linkage of the mean absolute difference of mean codes.

--merge puts FOLDER/sufficiency.csv into docs/results/sufficiency.csv.xz; `pages.py sufficiency` writes the table of
docs/research/sufficiency.md. Columns:

    method, data_set, seed           what was trained
    within, between                  mean difference of Q* of two goals of one cluster of codes, and of two clusters
    within_rooms, between_rooms      the same for rooms, which are what the clusters of codes should be
    nearest                          mean difference of Q* of a goal and the goal with the nearest code
    agreement                        adjusted Rand index of clusters and rooms
    rank                             Spearman's correlation of differences of codes and of Q* over pairs
    overlap                          share of pairs whose codes overlap by half or more (Bhattacharyya coefficient)
    overlapping                      mean difference of Q* of these pairs
    machine                          device, versions and date
"""

import argparse
import itertools
from operator import itemgetter
from pathlib import Path
from typing import Any

import jax
import numpy as np
import scipy.cluster.hierarchy
import scipy.stats

from infogoal_jax import use_compilation_cache
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.runner.sweep import Callback, train_sweep
from infogoal_jax.runs.tables import csv_text
from infogoal_jax.stopping import stop_on_signal
from infogoal_paper import batches, noise, trial_numbers
from infogoal_paper.noise_numbers import METHODS, mean_by_set
from infogoal_paper.table_formats import machines_in_words, markdown_lines
from infogoal_paper.trial_numbers import Row

TASK = "object_search"
HOUSES = (7, 8, 9)
SHOWN = ("infogoal", "infogoal+her", "infobot+her", "cogoal", "vae", "her", "none")
"""Methods whose codes are compared, in the order in which they are run."""
HALF = 0.5
"""Overlap of two codes from which on a sample of one could as well be one of the other."""
NUMBERS = Path(__file__).parents[1] / "docs" / "results" / "sufficiency.csv.xz"


def optimal_values(next_node: np.ndarray, at_goal: np.ndarray, discount: float) -> np.ndarray:
    """Q* by value iteration, float64 [M, K, A]: a step that reaches the goal is worth 1 and ends the episode.

    next_node: int32 [K, A]; at_goal: bool [K, M].
    """
    arrives = at_goal.T[:, next_node]
    values = arrives.astype(float)
    while True:
        following = np.where(arrives, 1.0, discount * values.max(-1)[:, next_node])
        if np.allclose(following, values, rtol=0, atol=1e-12):
            return following
        values = following


def pairwise(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Mean absolute difference [M, M] of values [M, ...] under weights [...] of a sum of 1."""
    flat, weights = values.reshape(len(values), -1), weights.reshape(-1)
    return np.stack([np.abs(flat - row) @ weights for row in flat])


def overlaps(mean: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Bhattacharyya coefficients [M, M] of Gaussians with means and standard deviations [M, d]."""
    variance = (std[:, None] ** 2 + std[None] ** 2) / 2
    distance = ((mean[:, None] - mean[None]) ** 2 / variance).sum(-1) / 8
    distance += 0.5 * (np.log(variance) - np.log(std)[:, None] - np.log(std)[None]).sum(-1)
    return np.exp(-distance)


def rand_index(first: np.ndarray, second: np.ndarray) -> float:
    """Adjusted Rand index of two partitions [M]: 1 where they are the same, 0 by chance."""
    table = np.zeros((first.max() + 1, second.max() + 1))
    np.add.at(table, (first, second), 1)
    both, rows, columns = ((part * (part - 1) / 2).sum() for part in (table, table.sum(1), table.sum(0)))
    expected = rows * columns / (len(first) * (len(first) - 1) / 2)
    most = (rows + columns) / 2
    return 1.0 if most == expected else float((both - expected) / (most - expected))


def comparison(mean: np.ndarray, std: np.ndarray | None, values: np.ndarray, rooms: np.ndarray) -> dict[str, float]:
    """The columns of a seed. mean, std: codes [M, d], std None for codes without noise; values: differences of Q* [M,
    M]; rooms: int [M]."""
    codes = pairwise(mean, np.full(mean.shape[1], 1 / mean.shape[1]))
    pairs = np.triu_indices(len(mean), 1)
    tree = scipy.cluster.hierarchy.average(codes[pairs])
    clusters = scipy.cluster.hierarchy.fcluster(tree, len(np.unique(rooms)), "maxclust") - 1
    found = {}
    for ending, parts in (("", clusters), ("_rooms", rooms)):
        same = (parts[:, None] == parts[None])[pairs]
        for name, chosen in (("within", same), ("between", ~same)):
            found[name + ending] = values[pairs][chosen].mean() if chosen.any() else np.nan
    others = codes + np.where(np.eye(len(mean), dtype=bool), np.inf, 0.0)
    found["nearest"] = values[np.arange(len(mean)), others.argmin(1)].mean()
    found["agreement"] = rand_index(clusters, rooms)
    found["rank"] = scipy.stats.spearmanr(codes[pairs], values[pairs]).statistic
    over = np.zeros(len(pairs[0]), bool) if std is None else overlaps(mean, std)[pairs] >= HALF
    found["overlap"] = over.mean()
    found["overlapping"] = values[pairs][over].mean() if over.any() else np.nan
    return found


def rows_of(training: batches.Training, method: str) -> list[Row]:
    """The rows of the seeds and houses of a batch that is trained."""
    batch, machine, rows = training.batch, describe_machine(), []
    learner = training.train.parts.learner
    for (place, _), run in batch.runs.items():
        env = batch.envs[place]
        goals = np.asarray(env.goals.evaluated)
        legal = np.asarray(env.action_mask(np.arange(env.num_observations)))
        discount = float(batch.config.hyper.discount)
        exact = optimal_values(np.asarray(env.next_node), np.asarray(env.in_view)[:, goals], discount)
        # Places that were added to give houses one shape lead nowhere.
        legal = legal & (exact.max((0, 2)) > 0)[:, None]
        values = pairwise(exact, legal / legal.sum())
        encode = jax.jit(jax.vmap(learner.encode, in_axes=(0, None)))
        params = jax.tree.map(lambda leaf, run=run: leaf[batch.index(run)], training.states.params["goal"])
        code = encode(params, env.goals.inputs_of(goals))
        for number, seed in enumerate(run.seeds):
            std = None if code.std is None else np.asarray(code.std[number], float)
            found = comparison(np.asarray(code.mean[number], float), std, values, np.asarray(env.goals.regions)[goals])
            rows.append(
                {"method": method, "data_set": run.goal_set, "seed": seed}
                | {name: f"{value:.5g}" for name, value in found.items()}
                | {"machine": machine}
            )
    return rows


class Quiet(Callback):
    """Says how far training is."""

    def evaluated(self, sweep: Any) -> None:
        """A line for each evaluation."""
        print(f"evaluation {sweep.evaluations} in {sweep.last_seconds:.0f} s", flush=True)


def run(method: str, path: Path, toy: bool) -> None:
    """Train a method on the houses, and write its rows."""
    runs, rows = [noise.run_of(TASK, method, number, toy) for number in (HOUSES[:1] if toy else HOUSES)], []
    for batch in noise.batches_on(runs, path.parent, {}):
        training = batches.begin(batch)
        with stop_on_signal() as stop:
            train_sweep(training.sweep, Quiet(), stop)
            stop.check()
        rows += rows_of(training, method)
    path.write_text(csv_text(rows), newline="")
    print(f"{method}: written", flush=True)


def tables(rows: list[Row]) -> dict[str, str]:
    """The tables of docs/research/sufficiency.md by name; none before the study was run."""
    if not rows:
        return {}
    columns = ("within", "between", "nearest", "agreement", "rank", "overlap", "overlapping")
    body = []
    for method in SHOWN:
        own = [row for row in rows if row["method"] == method]
        if own:
            body.append([METHODS[method], *(interval_of(own, column) for column in columns)])
    rooms = {(row["data_set"], name): row[name] for row in rows for name in ("within_rooms", "between_rooms")}
    means = [
        np.mean([float(value) for (_, own), value in rooms.items() if own == name])
        for name in sorted({n for _, n in rooms}, reverse=True)
    ]
    body.append(["rooms themselves", *(f"{mean:.3f}" for mean in means), "", "1.00", "", "", ""])
    head = ["codes of", "within", "between", "nearest", "agreement", "rank", "overlap", "overlapping"]
    seeds = len({(row["data_set"], row["seed"]) for row in rows})
    said = f"{seeds} seeds on houses {', '.join(sorted({row['data_set'] for row in rows}))}. "
    said += f"Measured on {machines_in_words(sorted({row['machine'] for row in rows}))}."
    return {"differences": f"{markdown_lines(head, body)}\n\n{said}"}


def interval_of(rows: list[Row], column: str) -> str:
    """The mean of a column with its 95 % interval over seeds or houses, whichever is wider; nothing where no seed has
    it."""
    values = {
        (int(row["data_set"]), int(row["seed"])): float(row[column]) for row in rows if np.isfinite(float(row[column]))
    }
    if not values:
        return ""
    interval = mean_by_set(values)
    digits = 2 if column in ("agreement", "rank", "overlap") else 3
    return f"{interval.mean:.{digits}f}±{interval.half_width:.{digits}f}"


def merge(folder: Path) -> list[str]:
    """Put the files of FOLDER into the numbers, in place of what they hold of the same methods."""
    new = {path.stem: trial_numbers.read(path) for path in sorted(folder.glob("sufficiency_*.csv"))}
    rows = itertools.chain.from_iterable(new.values())
    trial_numbers.put(rows, NUMBERS, itemgetter("method"), lambda row: SHOWN.index(row["method"]))
    return list(new)


def main():
    """Run what is not there yet, or merge it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--methods", nargs="*", choices=SHOWN, default=list(SHOWN))
    parser.add_argument("--toy", action="store_true", help="at a size at which nothing is learned")
    parser.add_argument("--merge", type=Path, metavar="FOLDER", help="put the rows of this folder into the numbers")
    arguments = parser.parse_args()
    if arguments.merge is not None:
        print(f"{NUMBERS.name}: {', '.join(merge(arguments.merge))}")
        return
    if arguments.out is None:
        parser.error("give --out FOLDER or --merge FOLDER")
    use_compilation_cache()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for method in arguments.methods:
        path = arguments.out / f"sufficiency_{method}.csv"
        if not path.exists():
            run(method, path, arguments.toy)


if __name__ == "__main__":
    main()
