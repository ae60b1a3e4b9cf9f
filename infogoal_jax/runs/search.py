"""A search or a final: what its trials came to, and its files, which say what was to be run, what each trial came to,
and the best.

config.json has, beside what it says of every run, the trials that were drawn and the ranges that they are from.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import UserError, typed
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.runs import configuration, disk
from infogoal_jax.runs.configuration import Description
from infogoal_jax.runs.disk import Place, decode, parse, parse_lines, read_bytes

GIVE_A_SEARCH = "give the folder of an `infogoal tune` or `infogoal final`"


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


@dataclasses.dataclass(frozen=True)
class Drawn:
    """A setting that is to be run: its number in the search that drew it, and the values of the fields searched."""

    trial: int
    values: dict[str, float]


@dataclasses.dataclass(frozen=True)
class Plan:
    """What config.json of a search says beside the description. space: where each field was drawn from."""

    trials: int
    space: dict[str, dict[str, Any]]
    drawn: list[Drawn]


@dataclasses.dataclass(frozen=True)
class TrialLine:
    """A line of trials.jsonl. goals: the group that scores are of; epochs: of the evaluations so far; success, loss:
    [evaluations so far][seeds]; score: success at the last; diverged: seeds."""

    trial: int
    preset: bool
    values: dict[str, float]
    seeds: list[int]
    goals: str
    epochs: list[int]
    success: list[list[float]]
    loss: list[list[float]]
    score: float
    diverged: list[int]


@dataclasses.dataclass(frozen=True)
class Best:
    """best.json: the best trial so far, and the flags that train with its values. finished: whether there was the last
    evaluation."""

    trial: int
    score: float
    score_of_preset: float
    goals: str
    epoch: int
    finished: bool
    values: dict[str, float]
    task: str
    flags: list[str]
    command: str
    compile_seconds: float
    run_seconds: float


def write_plan(folder: Path, about: Description, plan: Plan) -> None:
    """Write config.json of a search."""
    configuration.write(folder, about, **dataclasses.asdict(plan))


def read_plan(folder: Path) -> tuple[Description, Plan]:
    """What a search is of and was to run. Raises `UserError` for a folder that holds none."""
    about, place = configuration.read(folder, "search", GIVE_A_SEARCH), Place(folder / configuration.NAME)
    values = parse(read_bytes(place, f"{place.path}: not there"), place)
    if configuration.OF_A_SEARCH not in values:
        raise UserError(f"search = {str(folder)!r}: is not of a search; {GIVE_A_SEARCH}")
    plan = decode(Plan, values, place)
    check_alike(plan.drawn, place)
    return about, plan


def write_scores(folder: Path, lines: list[TrialLine], best: Best) -> None:
    """Write trials.jsonl and best.json."""
    disk.write_text(folder / "trials.jsonl", "".join(json.dumps(dataclasses.asdict(line)) + "\n" for line in lines))
    disk.write_json(folder / "best.json", dataclasses.asdict(best), indent=2)


def read_trials(folder: Path) -> tuple[Description, list[TrialLine]]:
    """What a search that came to its end is of, and its trials 0, 1, 2, ... Raises `UserError` if the folder holds
    none."""
    place = Place(folder / "trials.jsonl", remedy="bring back a copy of the file, or search again")
    content = read_bytes(
        place,
        f"search = {str(folder)!r}: holds no trials.jsonl; give the folder of a search, the --out of an `infogoal "
        "tune`",
    )
    about = configuration.read(folder, "search", GIVE_A_SEARCH)
    lines = [decode(TrialLine, values, at) for at, values in parse_lines(content, place)]
    numbers = [line.trial for line in lines]
    if not lines or numbers != list(range(len(lines))):
        raise place.refusal(
            "it should have the trials 0, 1, 2, ...; a final has others, and there is no final of a final"
        )
    check_alike(lines, place)
    for number, line in enumerate(lines, 1):
        at = place._replace(line=number)
        for name in ("success", "loss"):
            scores = getattr(line, name)
            if len(scores) != len(line.epochs) or any(len(row) != len(about.seeds) for row in scores):
                raise at.wrong(name, scores, f"should be [{len(line.epochs)}][{len(about.seeds)}]: evaluations, seeds")
    done, last = min(len(line.epochs) for line in lines), about.config.num_evaluations
    if done < last:
        raise UserError(
            f"search = {str(folder)!r}: was stopped after {done} of {last} evaluations; go on with: infogoal tune "
            f"--resume {typed(folder)}"
        )
    return about, lines


def check_alike(trials: list[Drawn] | list[TrialLine], place: Place) -> None:
    """Raise `UserError` for trials of different fields."""
    if not trials or any(trial.values.keys() != trials[0].values.keys() for trial in trials):
        raise place.refusal("its trials have different fields, or there are none")
