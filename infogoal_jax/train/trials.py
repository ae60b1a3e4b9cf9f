"""What a search tries, how far it came, and what accompanies it."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from infogoal_jax.config import TrainConfig
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.runs.description import Description


@dataclasses.dataclass(frozen=True)
class Trial:
    """One setting. number: in the search that drew it; values: of the fields searched; success, loss: [evaluations so
    far][seeds], of the scored goals and of the agent at that time; diverged: seeds whose loss or gradient stopped being
    finite."""

    number: int
    values: dict[str, float]
    success: list[list[float]]
    loss: list[list[float]]
    diverged: list[int]

    @property
    def score(self) -> float:
        """Success at the last evaluation, mean over seeds."""
        return float(np.mean(self.success[-1]))

    @property
    def order(self) -> tuple:
        """What trials are compared by: seeds that did not diverge, score, then how early there was success, then the
        preset first."""
        return -len(self.diverged), self.score, float(np.mean(self.success)), -self.number


@dataclasses.dataclass(frozen=True)
class TuneResult:
    """A search or final, as far as it came. group: of the goals that scores are of, `validation` or `train`; epochs: of
    the evaluations so far."""

    config: TrainConfig
    group: str
    fields: tuple[str, ...]
    seeds: list[int]
    epochs: list[int]
    trials: list[Trial]
    compile_seconds: float
    run_seconds: float
    about: Description

    @property
    def finished(self) -> bool:
        """Whether there was the last evaluation."""
        return len(self.epochs) == self.config.num_evaluations

    @property
    def best(self) -> Trial:
        """The trial of the highest score; among equals the one that was good earliest, then the preset."""
        return max(self.trials, key=lambda trial: trial.order)

    def config_of(self, trial: Trial) -> TrainConfig:
        """The configuration with a trial's values."""
        return dataclasses.replace(self.config, hyper=with_values(self.config.hyper, trial.values))


class Watch(NamedTuple):
    """What accompanies a search. folder: where it leaves its files; command: of the command line that goes on with it;
    compiling: called before the program is compiled; evaluated: called after each evaluation."""

    folder: Path
    command: str = "tune"
    compiling: Callable[[], None] = lambda: None
    evaluated: Callable[[TuneResult], None] = lambda result: None
