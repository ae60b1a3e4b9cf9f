"""What a study keeps: the numbers of all its runs, every seed and every evaluation, in one npz.

    about               json as bytes: {"runs": {NAME: ...}, "baselines": {PLACE: {metric: value}}}
    NAME/metrics        float32 [seeds, evaluations, metrics]
    NAME/first_reached  integer [seeds, evaluations, goals, starts]: steps until a goal was reached, the longest episode
    + 1 where it never was.
                        For the runs that recorded it

NAME is the folder of the run inside the study, such as `fetch_reach/infogoal`. In the json each run has

    seeds, epochs       seeds, and the epoch of each evaluation
    metrics             names of the last axis: success_rate, spl, episode_length of each kind of goals, env_steps, and
    beta and accuracy of learners
                        that have them, at the epochs of the evaluations. Of a search: trial_N/success_rate
    config              the resolved configuration; data, versions, device as in the run's config.json (old runs of
    house_study kept only data) result              of a finished run: machine, versions and date in words, seconds, and
    what the study measured besides learned             what beta and accuracy ended with, in words, of old runs of
    which no curve was kept

and PLACE is a folder with a baselines.json: scores of a random policy and of shortest paths.
"""

import dataclasses
import json
from pathlib import Path

import numpy as np

from infogoal_jax.report import tables

FILE = "numbers.npz"


@dataclasses.dataclass(frozen=True)
class StudyRun:
    """about: what the json says of the run; evaluations: its metrics by name, [seeds, evaluations, ...]."""

    about: dict
    evaluations: tables.Table

    @property
    def finished(self) -> bool:
        """Whether the run came to its end, and what it took is known."""
        return "result" in self.about


@dataclasses.dataclass(frozen=True)
class Study:
    """Runs by name, and baselines by place."""

    runs: dict[str, StudyRun] = dataclasses.field(default_factory=dict)
    baselines: dict[str, dict[str, float]] = dataclasses.field(default_factory=dict)

    def finished(self, place: str, names) -> dict[str, StudyRun]:
        """Those of the finished runs PLACE/NAME that are there, by name, in the order of the names."""
        return {
            name: self.runs[f"{place}/{name}"]
            for name in names
            if f"{place}/{name}" in self.runs and self.runs[f"{place}/{name}"].finished
        }


def learned_names(about: dict) -> list[str]:
    """Names of the metrics beta and accuracy of the run's learner, which not every learner has."""
    return [f"{about['config']['learner']['name']}/{name}" for name in ("beta", "accuracy")]


def read_run(folder: Path) -> StudyRun:
    """The finished run in this folder."""
    about = json.loads((folder / "config.json").read_text()) | {
        "result": json.loads((folder / "result.json").read_text())
    }
    evaluations, epochs = tables.read(folder, "evaluations"), tables.read(folder, "epochs")
    places = np.searchsorted(epochs.epochs, evaluations.epochs)
    curves = {name: epochs.values[name][:, places] for name in learned_names(about) if name in epochs.values}
    return StudyRun(about, dataclasses.replace(evaluations, values=evaluations.values | curves))


def collect(folder: Path) -> Study:
    """The study in this folder: what its numbers.npz holds already, and every finished run and baseline below it."""
    study = load(folder / FILE) if (folder / FILE).exists() else Study()
    return Study(
        study.runs
        | {str(path.parent.relative_to(folder)): read_run(path.parent) for path in sorted(folder.rglob("result.json"))},
        study.baselines
        | {
            str(path.parent.relative_to(folder)): json.loads(path.read_text())
            for path in sorted(folder.rglob("baselines.json"))
        },
    )


def save(study: Study, path: Path) -> None:
    """Write the study; equal numbers give equal bytes."""
    arrays, about = {}, {}
    for name, run in study.runs.items():
        values = dict(run.evaluations.values)
        first_reached = values.pop("first_reached", None)
        names = sorted(values)
        arrays[f"{name}/metrics"] = np.stack([values[metric] for metric in names], -1).astype(np.float32)
        if first_reached is not None:
            arrays[f"{name}/first_reached"] = first_reached.astype(np.min_scalar_type(int(first_reached.max())))
        about[name] = run.about | {
            "seeds": run.evaluations.seeds,
            "epochs": run.evaluations.epochs.tolist(),
            "metrics": names,
        }
    text = json.dumps({"runs": about, "baselines": study.baselines})
    np.savez_compressed(path, about=np.frombuffer(text.encode(), np.uint8), **arrays)


def load(path: Path) -> Study:
    """The study in this file."""
    with np.load(path) as file:
        about = json.loads(file["about"].tobytes())
        runs = {}
        for name, known in about["runs"].items():
            values = dict(zip(known["metrics"], np.moveaxis(file[f"{name}/metrics"].astype(float), -1, 0), strict=True))
            if f"{name}/first_reached" in file:
                values["first_reached"] = file[f"{name}/first_reached"].astype(float)
            runs[name] = StudyRun(known, tables.Table(known["seeds"], np.asarray(known["epochs"], int), values))
        return Study(runs, about["baselines"])
