"""A run as read back from its folder: configuration, environment, policies and parameters; and its tables as arrays,
seeds by epochs, without the seeds that diverged."""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import numpy as np

from infogoal_jax import checks
from infogoal_jax.envs.environment import data_of, has_image_goals
from infogoal_jax.errors import renamed, require
from infogoal_jax.goals import GoalSpace
from infogoal_jax.loading import make_train
from infogoal_jax.runner.compilation import jit
from infogoal_jax.runs import checkpoint, configuration, tables
from infogoal_jax.runs.configuration import Description
from infogoal_jax.runs.folder import find_run
from infogoal_jax.train.evaluation import GoalView, corrupted_view
from infogoal_jax.train.program import Train
from infogoal_jax.train.rollout import Policy


@dataclasses.dataclass(frozen=True)
class Run(Description):
    """A run in its folder: what its config.json says, its environment and its policies. name: what it was asked for by,
    its folder, its packed file or `shipped/NAME`; the folder of the last two is in the user's cache."""

    folder: Path
    name: str

    @functools.cached_property
    def train(self) -> Train:
        """The training function of the run's configuration, with its environment. Raises `UserError` where the data
        that the configuration names are others by now."""
        return self.train_in()

    def train_in(self, env: Any = None) -> Train:
        """As `train`, in this environment; None: in its own."""
        train = make_train(self.config, env)
        found = data_of(train.env)
        require(found == self.data, "data", found, f"the run's data were {self.data}")
        return train

    @property
    def env(self) -> Any:
        """The environment that the run was trained in, as its agent acts in it."""
        return self.train.env

    def policy(self, seed: int | None = None, use_mean: bool = False) -> Policy:
        """The last policy of a seed, of the first where none is named, greedy: observations [E, ...], goals
        [E, *shape] and a key to actions. use_mean: of the goal's code, not a sample. Codes of goals can be given in
        place of the goals.

        Raises `UserError` for a seed that the run does not have, or a damaged file.
        """
        use_mean = checks.flag(use_mean, "use_mean")
        return self.train.policy(self.params(seed), self.config.hyper, self.env, use_mean)

    def params(self, seed: int | None = None) -> dict[str, Any]:
        """The last parameters of a seed, {"goal", "state", "agent"}, as `policy` has them and raises `UserError`."""
        place = self.seeds.index(self.seed_of(seed))
        return jax.tree.map(lambda leaf: jax.device_put(leaf[place]), read_params(self, self.train))

    def seed_of(self, seed: int | None = None) -> int:
        """A seed of the run; None: its first. Raises `UserError` for one that the run does not have."""
        found = self.seeds[0] if seed is None else checks.whole(seed, "seed")
        several = "seed" if len(self.seeds) == 1 else "seeds"
        require(found in self.seeds, "seed", found, f"the run has the {several} {', '.join(map(str, self.seeds))}")
        return found

    def corrupted_view(self, goals: jax.Array, num_starts: int, weight: float, seed: int | None = None) -> GoalView:
        """These goals [M, *shape] as the encoder of a seed sees their images under test backgrounds of this weight,
        another background for each start; for `infogoal_jax.evaluate`. Raises `UserError` where goals are not images,
        for what are no goals, starts or weight, and as `policy` does.
        """
        goals = self.env.goals.checked(goals, "goals", axes=1)
        num_starts = checks.whole(num_starts, "num_starts", 1)
        weight = checks.number(weight, "weight", 0, 1, "give a number from 0 (clean) to 1 (the background alone)")
        require(
            has_image_goals(self.env), "task", self.config.task, "its goals are not images; evaluate goals as they are"
        )
        return corrupted_view(self.train.setup(env=self.env), self.params(seed), goals, num_starts, weight)


def load_run(folder: str | Path, **moved: str) -> Run:
    """The run in this folder, in this packed file, or of this name (`shipped/object_search`).

    moved: where its data lie on this machine, by the fields of the task's configuration: `dataset="photographs"`.
    Raises `UserError` if there is no run, its config.json cannot be read, or these are other data.
    """
    found = find_run(
        checks.path(folder, "run", "give a folder of a run, a packed file, or a name such as shipped/NAME")
    )
    run = Run(**vars(configuration.read(found)), folder=found, name=str(folder))
    if moved:
        for name in moved:
            known = [field for field in configuration.DATA if hasattr(run.config.env, field)]
            require(name in known, name, moved[name], f"is no place of the task's data. Known: {', '.join(known)}")
        config = dataclasses.replace(run.config, env=dataclasses.replace(run.config.env, **moved))
        run = dataclasses.replace(run, config=config)
        with renamed(data=next(iter(moved))):
            run.env  # noqa: B018 (looked at, so that other data are refused)
    return run


def read_params(run: Run, train: Train) -> dict[str, Any]:
    """Parameters of all seeds, {"goal", "state", "agent"} with leaves [seeds, ...]. Raises `UserError` for a damaged or
    missing file."""
    shapes = checks.with_axes(train.state_shapes.params, (len(run.seeds),))
    return checkpoint.load(run.folder / "policy", shapes)[1]


@dataclasses.dataclass(frozen=True)
class RunTable:
    """A table of a run as arrays.

    seeds: those that count.
    epochs: int [E], the numbers of the epochs.
    values: {name: [seeds, E, ...]}.
    """

    seeds: list[int]
    epochs: np.ndarray
    values: dict[str, np.ndarray]

    def last(self) -> dict[str, np.ndarray]:
        """The last row of each seed, {name: [seeds, ...]}."""
        return {name: value[:, -1] for name, value in self.values.items()}


def diverged_seeds(folder: Path) -> dict[int, int]:
    """Seeds whose loss or gradient stopped being finite, with the first such epoch."""
    return tables.diverged_seeds(tables.read_table(folder, "epochs"))


def table_of(folder: Path, name: str, leave_out=()) -> RunTable:
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
        return RunTable(seeds, np.asarray(epochs, int), {})
    columns = [column for column in rows[seeds[0], epochs[0]] if column not in ("seed", "epoch")]
    values = {
        column: np.asarray([[rows[seed, epoch][column] for epoch in epochs] for seed in seeds], float)
        for column in columns
    }
    return RunTable(seeds, np.asarray(epochs, int), values)


def evaluated_masks(goals: GoalSpace) -> dict[str, np.ndarray]:
    """Which of the evaluated goals belong to each of the groups, by name, bool [M]; worked out in one program."""
    return dict(zip(goals.groups, np.asarray(jit(type(goals).in_groups)(goals)), strict=True))
