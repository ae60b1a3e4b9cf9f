"""A run as read back from its folder: configuration, seeds, tables and parameters."""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import UserError, require
from infogoal_jax.presets.saved import from_dict
from infogoal_jax.train import checkpoint
from infogoal_jax.train.evaluation import GoalView
from infogoal_jax.train.program import Train, make_train
from infogoal_jax.train.rollout import Policy
from infogoal_jax.train.settings import corrupted_view, has_image_goals


@dataclasses.dataclass(frozen=True)
class Run:
    """What config.json of a run says. data: what the dataset was, in words (a stand-in is called one)."""

    folder: Path
    config: TrainConfig
    seeds: list[int]
    data: str
    versions: dict[str, str]
    device: str

    @functools.cached_property
    def train(self) -> Train:
        """The training function of the run's configuration, with its environment."""
        return make_train(self.config)

    @property
    def env(self) -> Any:
        """The environment that the run was trained in, as its agent acts in it."""
        return self.train.env

    def policy(self, seed: int = 0, use_mean: bool = False) -> Policy:
        """The last policy of a seed, greedy: observations [E, ...], goals int32 [E] and a key to actions. use_mean: of
        the goal's code, not a sample. Codes of goals can be given in place of the goals.

        Raises `UserError` for a seed that the run does not have, or a damaged file.
        """
        return self.train.policy(self.params(seed), self.config.hyper, self.env, use_mean)

    def params(self, seed: int = 0) -> dict[str, Any]:
        """The last parameters of a seed, {"goal", "state", "agent"}. Raises `UserError` as `policy` does."""
        require(seed in self.seeds, "seed", seed, f"the run has the seeds {', '.join(map(str, self.seeds))}")
        return jax.tree.map(lambda leaf: jnp.asarray(leaf[self.seeds.index(seed)]), read_params(self, self.train))

    def corrupted_view(self, goals: jax.Array, num_starts: int, weight: float, seed: int = 0) -> GoalView:
        """These goals, int32 [M], as the encoder of a seed sees their images under test backgrounds of this weight,
        another background for each start; for `infogoal_jax.evaluate`. Raises `UserError` where goals are not images,
        and as `policy` does.
        """
        require(
            has_image_goals(self.env), "task", self.config.task, "its goals are not images; evaluate goals as they are"
        )
        return corrupted_view(self.train.parts, self.params(seed), self.env, jnp.asarray(goals), num_starts, weight)


def load_run(folder: str | Path) -> Run:
    """The run in this folder. Raises `UserError` if there is none, or its config.json cannot be read."""
    folder = Path(folder)
    path = folder / "config.json"
    try:
        values = json.loads(path.read_text())
        return Run(
            folder, from_dict(values["config"]), values["seeds"], values["data"], values["versions"], values["device"]
        )
    except FileNotFoundError as error:
        raise UserError(
            f"run = {str(folder)!r}: holds no config.json; give the folder of a run of `infogoal train`"
        ) from error
    except OSError as error:
        raise UserError(
            f"run = {str(folder)!r}: could not be read ({error.strerror}); give the folder of a run of `infogoal train`"
        ) from error
    except UserError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{path}: is damaged or from another version of infogoal ({error}); train again, or bring back a copy of "
            "the file"
        ) from error


def read_params(run: Run, train: Train) -> dict[str, Any]:
    """Parameters of all seeds, {"goal", "state", "agent"} with leaves [seeds, ...]. Raises `UserError` for a damaged or
    missing file."""
    keys = jax.vmap(jax.random.key)(jnp.zeros(len(run.seeds), jnp.uint32))
    shapes = jax.eval_shape(jax.vmap(lambda key: train.initial(key, run.config.hyper, train.env).params), keys)
    return checkpoint.load(run.folder / "policy", shapes)[1]


def read_timing(folder: Path) -> dict[str, float]:
    """Seconds spent compiling and running in the last session of a run, and its rates; empty if no session got past a
    chunk."""
    try:
        return json.loads((folder / "timing.json").read_text())
    except (FileNotFoundError, json.JSONDecodeError):
        return {}
