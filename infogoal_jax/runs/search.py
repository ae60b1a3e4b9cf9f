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
from infogoal_jax.errors import UserError
from infogoal_jax.hyperparameters import search_space, with_values
from infogoal_jax.imports import typed_command
from infogoal_jax.presets.loading import train_flags
from infogoal_jax.runs import configuration, disk
from infogoal_jax.runs.configuration import OF_A_SEARCH, Description
from infogoal_jax.runs.disk import Place, decode, decode_value, parse_lines, read_bytes

GIVE_A_SEARCH = "give the folder of an `infogoal tune` or `infogoal final`"


@dataclasses.dataclass(frozen=True)
class Trial:
    """One setting, and what came of it.

    trial: its number in the search that drew it; 0 is the preset.
    values: of the fields searched.
    success, loss: [evaluations so far][seeds], of the scored goals and of the agent at that time.
    diverged: seeds whose loss or gradient stopped being finite.
    """

    trial: int
    values: dict[str, float]
    success: list[list[float]] = dataclasses.field(default_factory=list)
    loss: list[list[float]] = dataclasses.field(default_factory=list)
    diverged: list[int] = dataclasses.field(default_factory=list)

    @property
    def score(self) -> float:
        """Success at the last evaluation, mean over seeds."""
        return float(np.mean(self.success[-1]))

    @property
    def order(self) -> tuple:
        """What trials are compared by: seeds that did not diverge, score, then how early there was success, then the
        preset first."""
        return -len(self.diverged), self.score, float(np.mean(self.success)), -self.trial

    def drawn(self) -> dict[str, Any]:
        """Number and values, as config.json has them."""
        return {"trial": self.trial, "values": self.values}


@dataclasses.dataclass(frozen=True)
class TuneResult:
    """A search or final, as far as it came.

    about: what it is of.
    group: of the goals that scores are of, `validation` or `train`.
    """

    about: Description
    group: str
    trials: list[Trial]
    compile_seconds: float = 0.0
    run_seconds: float = 0.0

    @property
    def config(self) -> TrainConfig:
        """The configuration that trials differ from in their values."""
        return self.about.config

    @property
    def seeds(self) -> list[int]:
        """Of each trial."""
        return self.about.seeds

    @property
    def fields(self) -> tuple[str, ...]:
        """The hyperparameters that are searched."""
        return tuple(self.trials[0].values)

    @property
    def epochs(self) -> list[int]:
        """Of the evaluations so far."""
        every = self.config.epochs_per_evaluation
        return [every * number for number in range(1, len(self.trials[0].success) + 1)]

    @property
    def finished(self) -> bool:
        """Whether there was the last evaluation."""
        return len(self.epochs) == self.config.num_evaluations

    @property
    def best(self) -> Trial:
        """The trial of the highest score; among equals the one that was good earliest, then the preset."""
        return max(self.trials, key=lambda trial: trial.order)

    @property
    def flags(self) -> list[str]:
        """Those of `infogoal train` that train with the best trial's values."""
        return train_flags(self.config_of(self.best))

    @property
    def command(self) -> str:
        """The command that trains with the best trial's values."""
        return typed_command("train", self.config.task, *self.flags)

    def config_of(self, trial: Trial) -> TrainConfig:
        """The configuration with a trial's values."""
        return dataclasses.replace(self.config, hyper=with_values(self.config.hyper, trial.values))


def write_plan(folder: Path, result: TuneResult) -> None:
    """Write config.json of a search: what it is of, and the trials that it is to run."""
    space = search_space(result.config.hyper)
    drawn = {
        "trials": len(result.trials),
        "space": {field: space[field]._asdict() for field in result.fields},
        OF_A_SEARCH: [trial.drawn() for trial in result.trials],
    }
    configuration.write(folder, result.about, **drawn)


def read_plan(folder: Path) -> tuple[Description, list[Trial]]:
    """What a search or a final is of, and the trials that it was to run. Raises `UserError` for a folder that holds
    none."""
    values, place = configuration.read_values(folder, "resume", GIVE_A_SEARCH)
    about = configuration.from_values(values, place)
    if OF_A_SEARCH not in values:
        raise UserError(f"resume = {str(folder)!r}: is not of a search; {GIVE_A_SEARCH}")
    trials = decode_value(list[Trial], values[OF_A_SEARCH], OF_A_SEARCH, place)
    check_trials(trials, place)
    return about, trials


def write_scores(folder: Path, result: TuneResult) -> None:
    """Write trials.jsonl, what each trial came to so far, and best.json, the best."""
    lines = [
        dataclasses.asdict(trial)
        | {
            "preset": trial.trial == 0,
            "seeds": result.seeds,
            "goals": result.group,
            "epochs": result.epochs,
            "score": trial.score,
        }
        for trial in result.trials
    ]
    disk.write_text(folder / "trials.jsonl", "".join(json.dumps(line) + "\n" for line in lines))
    best = {
        "trial": result.best.trial,
        "score": result.best.score,
        "score_of_preset": result.trials[0].score,
        "goals": result.group,
        "epoch": result.epochs[-1],
        "finished": result.finished,
        "values": result.best.values,
        "task": result.config.task,
        "flags": result.flags,
        "command": result.command,
        "compile_seconds": result.compile_seconds,
        "run_seconds": result.run_seconds,
    }
    disk.write_json(folder / "best.json", best, indent=2)


def read_trials(folder: Path) -> tuple[Description, list[Trial]]:
    """What a search that came to its end is of, and its trials 0, 1, 2, ... Raises `UserError` if the folder holds
    none."""
    place = Place(folder / "trials.jsonl", remedy="bring back a copy of the file, or search again")
    content = read_bytes(
        place,
        f"search = {str(folder)!r}: holds no trials.jsonl; give the folder of a search, the --out of an `infogoal "
        "tune`",
    )
    about = configuration.read(folder, "search", GIVE_A_SEARCH)
    trials = [decode(Trial, values, at) for at, values in parse_lines(content, place)]
    if not trials or [trial.trial for trial in trials] != list(range(len(trials))):
        raise place.refusal(
            "it should have the trials 0, 1, 2, ...; a final has others, and there is no final of a final"
        )
    check_trials(trials, place, about.seeds)
    done, last = len(trials[0].success), about.config.num_evaluations
    if done < last:
        raise UserError(
            f"search = {str(folder)!r}: was stopped after {done} of {last} evaluations; go on with: "
            f"{typed_command('tune', '--resume', folder)}"
        )
    return about, trials


def check_trials(trials: list[Trial], place: Place, seeds: list[int] | None = None) -> None:
    """Raise `UserError` for none, for trials of different fields, or for scores that are not of the same number of
    evaluations and seeds, which are none before the first."""
    if not trials or any(trial.values.keys() != trials[0].values.keys() for trial in trials):
        raise place.refusal("its trials have different fields, or there are none")
    evaluations, count = len(trials[0].success), len(seeds or ())
    for trial in trials:
        for name, scores in (("success", trial.success), ("loss", trial.loss)):
            if len(scores) != evaluations or any(len(row) != count for row in scores):
                problem = f"should be [{evaluations}][{count}]: evaluations, seeds"
                raise place.wrong(f"{name} of trial {trial.trial}", scores, problem)
