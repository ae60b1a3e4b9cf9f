"""The file of a run: its numbers and the pictures made of it in one npz, which is whole or not there.

FOLDER/runs/RUN.npz           a finished run
FOLDER/runs/RUN.failed.json   why a run failed
FOLDER/runs/RUN.lock          the run is being trained, by the process that holds the lock of this file
FOLDER/unfinished/            checkpoints of what is not finished or not yet measured
"""

import dataclasses
import functools
import io
import json
import operator
import os
import shlex
from pathlib import Path
from typing import Any, Literal

import numpy as np

from infogoal_jax.config import TrainConfig
from infogoal_jax.data import archives
from infogoal_jax.errors import UserError, require
from infogoal_jax.files import from_json, read_bytes
from infogoal_jax.runs import disk
from infogoal_jax.runs.configuration import from_dict, to_dict
from infogoal_jax.runs.disk import decode
from infogoal_paper import plan
from infogoal_paper.manifest import FETCH, PRESET, Run, Setting
from infogoal_paper.plan import GOAL_SET_FIELDS

FORMAT = 1
REMEDY = "run it again"
GOAL_IMAGES = "GOAL_IMAGES"
"""Stands in commands for the folder of the further goal images of Fetch, wherever it lies."""
ADDED = {"agent": None, "known_goals": "visited"}
"""Fields of a run that files of the paper's runs do not have, and what they mean then."""
Status = Literal["done", "not measured", "damaged", "other settings", "failed", "left"]


def home_of(run: Run) -> str:
    """The table or figure whose command makes the run; others that it is shown in find it there."""
    if not run.of_paper:
        return "all_goals"
    if run.explorer is not None:
        return "fig8"
    if run.setting.name == PRESET[0]:
        return "table1"
    return "fig15" if run.method == "infogoal" and run.task in FETCH else "fig9"


def command_of(run: Run) -> list[str]:
    """The words of the command line that makes a run, with those of its study that share its flags."""
    study = home_of(run)
    method = f"{run.method}+all_goals" if run.relabelling == "all_goals" else run.method
    words = ["infogoal", "reproduce", study, "--tasks", run.task, "--methods", method]
    if study == "all_goals":
        words += ["--known-goals", run.known_goals, "--sets", str(run.goal_set), "--seeds", str(len(run.seeds))]
    elif study == "table1":
        words += ["--variants", "her" if run.relabelling == "her" else "paper", "--sets", str(run.goal_set)]
        words += ["--seeds", str(len(run.seeds))]
    elif len(run.seeds) > 1:
        words += ["--seeds", str(len(run.seeds))]
    if run.task in FETCH and run.goal_set:
        words += ["--goal-images", GOAL_IMAGES]
    return words + ["--quick"] * run.toy


@dataclasses.dataclass(frozen=True)
class Result:
    """What a run came to.

    about: machine, data, versions, times, configuration.
    evaluations: {metric: [seeds, E]}.
    arrays: `first_reached` int [seeds, E, M, starts], `uses` int [M] of the evaluated goals, on Fetch `near` bool [M],
        and those of pictures.
    """

    run: Run
    about: dict[str, Any]
    evaluations: dict[str, np.ndarray]
    arrays: dict[str, np.ndarray]

    @property
    def command(self) -> str:
        """The command line that makes the run, in the words that it has today; the file keeps those of its time."""
        return shlex.join(command_of(self.run))

    @property
    def kept(self) -> list[int]:
        """The places of the seeds that did not diverge."""
        return [place for place, seed in enumerate(self.run.seeds) if seed not in self.about["diverged"]]

    @functools.cached_property
    def has_former_settings(self) -> bool:
        """Whether the preset has changed since the run was made."""
        return not was_made_with(self, plan.config_of(self.run, Path()))

    def missing(self) -> list[str]:
        """What is to be measured of the run and was not."""
        return plan.missing(self.run, self.about["learner_share"], self.arrays)


def path_of(folder: Path, run: Run, ending: str = "npz") -> Path:
    """The file of a run in the folder of a reproduction."""
    return folder / "runs" / f"{run.name}.{ending}"


def recorded_config(config: TrainConfig) -> dict[str, Any]:
    """The configuration as JSON values, without what depends on the machine: where data lie."""
    values = json.loads(json.dumps(to_dict(config)))
    paths = {name: "" for name in GOAL_SET_FIELDS if isinstance(values["env"].get(name), str)}
    return values | {"env": values["env"] | paths}


def was_made_with(result: "Result", config: TrainConfig) -> bool:
    """Whether a run was made with this configuration. How long is the budget's affair, and fields that were added since
    have the value of what was done before."""
    try:
        recorded = from_dict(result.about["config"])
    except UserError:
        return False
    return operator.eq(*(recorded_config(each) | {"num_epochs": None} for each in (recorded, config)))


def run_values(run: Run) -> dict[str, Any]:
    """A run as JSON values, without what is as it is in the paper."""
    fields = {"lane" if name == "setting" else name: value for name, value in dataclasses.asdict(run).items()}
    values = json.loads(json.dumps(fields))
    return {name: value for name, value in values.items() if name not in ADDED or value != ADDED[name]}


def run_from(values: dict[str, Any]) -> Run:
    """The run of `run_values`. Raises `UserError` for values that are of none, and for names that would lead out of a
    folder of runs."""
    fields = decode(RunFields, values, PLACE.within("run"))
    values = dict(vars(fields))
    name, floats = values.pop("lane")
    run = Run(**values, setting=Setting(name, tuple(floats)))
    parts = Path(run.name).parts
    safe = len(parts) == 5 and ".." not in parts and not os.path.isabs(run.name) and bool(run.seeds)
    require(safe, "run", run.name, f"is no name of a run; {REMEDY}")
    return run


PLACE = disk.Place(Path("about"), remedy=REMEDY)
"""Of what a file says of a run; whoever reads the file names it."""


@dataclasses.dataclass(frozen=True)
class RunFields:
    """What a file says of its run: the fields of `Run`. lane: its setting, as name and (field, value) of each float."""

    task: str
    method: str
    goal_set: int
    lane: tuple[str, tuple[tuple[str, float], ...]]
    seeds: tuple[int, ...]
    relabelling: str | None = None
    explorer: str | None = None
    toy: bool = False
    agent: str | None = None
    known_goals: str = "visited"


@dataclasses.dataclass(frozen=True)
class About:
    """What is read of what a file says of itself.

    metrics: of the last axis of its evaluations.
    updates: between two of them.
    program: what all runs of its program cost together.
    """

    format: int
    metrics: list[str]
    run: dict[str, Any]
    config: dict[str, Any]
    data: str
    machine: str
    updates: int
    diverged: list[int]
    learner_share: float | None
    measuring_failed: str
    episode_length: int
    program: dict[str, Any]
    measure_seconds: float


def packed(result: Result) -> dict[str, np.ndarray]:
    """The arrays of a run's file."""
    names = sorted(result.evaluations)
    stacked = np.stack([result.evaluations[name] for name in names], -1).astype(np.float32)
    about = {"format": FORMAT, "run": run_values(result.run), "metrics": names} | result.about
    text = np.frombuffer(json.dumps(about).encode(), np.uint8)
    return {"about": text, "evaluations": stacked, **result.arrays}


def unpacked(members: dict[str, np.ndarray]) -> Result:
    """The run of these arrays. Raises `UserError` for another format, or where something is missing."""
    try:
        about = from_json(members.pop("about").tobytes())
        stacked = members.pop("evaluations")
    except (KeyError, ValueError) as error:
        raise UserError(f"about = unreadable ({error}); {REMEDY}") from error
    version = about.get("format") if isinstance(about, dict) else None
    require(version == FORMAT, "format", version, f"should be {FORMAT}; {REMEDY}")
    decode(About, about, PLACE)
    names, run = about.pop("metrics"), run_from(about.pop("run"))
    fits = stacked.ndim == 3 and stacked.shape[0] == len(run.seeds) and stacked.shape[2] == len(names)
    fits = fits and stacked.dtype.kind == "f" and stacked.shape[1] > 0 and "train_goal/success_rate" in names
    require(fits, "evaluations", stacked.shape, f"should be those of {len(run.seeds)} seeds; {REMEDY}")
    del about["format"]
    evaluations = {name: stacked[..., place].astype(float) for place, name in enumerate(names)}
    return Result(run, about, evaluations, members)


def save(folder: Path, result: Result) -> None:
    """Write the file of a finished run. Raises `UserError` if the disk refuses."""
    path, content = path_of(folder, result.run), io.BytesIO()
    np.savez_compressed(content, **packed(result))
    disk.make_folder(path.parent)
    disk.write_atomically(path, lambda file: file.write(content.getvalue()))


def read(path: Path) -> Result:
    """The run in this file, every number of it read. Raises `UserError` for a file that is missing, cut short,
    changed, or something else."""
    with archives.naming("run", path, REMEDY):
        archive = archives.read(path, REMEDY)
        return unpacked({name: archives.member(archive, name, REMEDY) for name in archive.sizes})


def is_current(result: "Result", config: TrainConfig) -> bool:
    """Whether a run was made with this configuration and trained to its end: what was stopped at a ceiling that is
    higher today was not."""
    curve = result.evaluations["train_goal/success_rate"]
    return was_made_with(result, config) and plan.is_trained(curve, result.run.task, result.run.toy)


def has_failed(folder: Path, run: Run) -> bool:
    """Whether the run failed since its file was written, if it ever was."""
    try:
        failed = path_of(folder, run, "failed.json").stat().st_mtime_ns
        return not path_of(folder, run).exists() or path_of(folder, run).stat().st_mtime_ns <= failed
    except FileNotFoundError:
        return False


def why_failed(folder: Path, run: Run) -> str:
    """Why a run failed."""
    try:
        return str(from_json(read_bytes(path_of(folder, run, "failed.json")))["why"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        return f"its report cannot be read ({error})"


def status_of(folder: Path, run: Run, config: TrainConfig) -> tuple[Status, str]:
    """Whether a run is done, and if not, why. config: that it should have been trained with."""
    if has_failed(folder, run):
        return "failed", why_failed(folder, run)
    if not path_of(folder, run).exists():
        return "left", ""
    try:
        found = read(path_of(folder, run))
    except UserError as error:
        return "damaged", str(error)
    if found.run != run or not is_current(found, config):
        return "other settings", "it was trained with other settings, or for less long, than the preset has now"
    missing = found.missing()
    return ("not measured", found.about["measuring_failed"] or f"without {missing[0]}") if missing else ("done", "")


def write_failure(folder: Path, run: Run, why: str, trace: str) -> None:
    """Write why a run failed."""
    path = path_of(folder, run, "failed.json")
    disk.make_folder(path.parent)
    disk.write_json(path, {"why": why, "trace": trace})
