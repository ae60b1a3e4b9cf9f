"""The tables of a run as arrays: seeds by epochs, without the seeds that diverged."""

import dataclasses
from pathlib import Path

import numpy as np

from infogoal_jax.runs import tables
from infogoal_jax.train import host


@dataclasses.dataclass(frozen=True)
class Table:
    """seeds: those that count; epochs: int [E], the numbers of the epochs; values: {name: [seeds, E, ...]}."""

    seeds: list[int]
    epochs: np.ndarray
    values: dict[str, np.ndarray]

    def last(self) -> dict[str, np.ndarray]:
        """The last row of each seed, {name: [seeds, ...]}."""
        return {name: value[:, -1] for name, value in self.values.items()}


def diverged_seeds(folder: Path) -> dict[int, int]:
    """Seeds whose loss or gradient stopped being finite, with the first such epoch."""
    return host.diverged_seeds(tables.read_table(folder, "epochs"))


def read(folder: Path, name: str, leave_out=()) -> Table:
    """A table of the run (one of `tables.TABLES`) without some seeds. An epoch counts once every seed has its row.

    Raises `UserError` if the run has no such table.
    """
    rows = {(row["seed"], row["epoch"]): row for row in tables.read_table(folder, name)}
    all_seeds = sorted({seed for seed, _ in rows})
    epochs = [
        epoch for epoch in sorted({epoch for _, epoch in rows}) if all((seed, epoch) in rows for seed in all_seeds)
    ]
    seeds = [seed for seed in all_seeds if seed not in leave_out]
    if not seeds or not epochs:
        return Table(seeds, np.asarray(epochs, int), {})
    columns = [column for column in rows[seeds[0], epochs[0]] if column not in ("seed", "epoch")]
    values = {
        column: np.asarray([[rows[seed, epoch][column] for epoch in epochs] for seed in seeds], float)
        for column in columns
    }
    return Table(seeds, np.asarray(epochs, int), values)
