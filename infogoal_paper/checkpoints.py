"""Checkpoints of batches, in FOLDER/unfinished: of what is not finished, and of what is trained and not yet measured.

A checkpoint names its runs, and a batch goes on from any one that has all of its own: which other runs a process was
asked for makes no difference. A checkpoint is deleted when each of its runs is finished and measured.
"""

import functools
import hashlib
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from infogoal_jax.config import TrainConfig
from infogoal_jax.envs.environment import data_of
from infogoal_jax.errors import UserError
from infogoal_jax.files import from_json, open_to_read
from infogoal_jax.hyperparameters import values_of
from infogoal_jax.runner.training import describe
from infogoal_jax.runs import checkpoint, disk
from infogoal_jax.runs.configuration import from_dict
from infogoal_jax.runs.folder import remove_abandoned
from infogoal_paper import batches, files
from infogoal_paper.manifest import Run
from infogoal_paper.plan import is_trained, program_key

UNFINISHED = "unfinished"
MOST_OF_HEADER = 2**28
"""Bytes of the first line of a checkpoint."""


def path_of(folder: Path, batch: batches.Batch) -> Path:
    """The file in which a batch is kept."""
    names = "\n".join(sorted(run.name for run in batch.runs.values()))
    return folder / UNFINISHED / hashlib.sha256(names.encode()).hexdigest()[:16]


def headers(folder: Path) -> dict[Path, dict[str, Any]]:
    """The headers of the checkpoints in a folder, the longest trained first; without those that cannot be read."""
    found = []
    for path in sorted((folder / UNFINISHED).glob("[0-9a-f]*")):
        try:
            with open_to_read(path) as file:
                header = from_json(file.readline(MOST_OF_HEADER))
            found.append((header["evaluations"], set(header["runs"]), path, header))
        except (OSError, ValueError, KeyError, TypeError):
            continue  # Of an earlier version, damaged, or deleted by another process at this moment.
    return {path: header for *_, path, header in sorted(found, key=lambda each: each[0], reverse=True)}


def kept(folder: Path) -> dict[Path, set[str]]:
    """The checkpoints in a folder with the names of their runs, in the order of `headers`."""
    return {path: set(header["runs"]) for path, header in headers(folder).items()}


def has(folder: Path, run: Run) -> bool:
    """Whether there is a checkpoint with this run."""
    return any(run.name in names for names in kept(folder).values())


def apart(folder: Path, runs: Sequence[Run]) -> list[list[Run]]:
    """The runs, apart by the checkpoint that has them; last those of which there is none."""
    left, found = list(runs), []
    for names in kept(folder).values():
        found.append([run for run in left if run.name in names])
        left = [run for run in left if run.name not in names]
    return [each for each in (*found, left) if each]


def program_of(training: batches.Training) -> dict[str, Any]:
    """What the checkpoint of a batch has to agree in: the program, but for its number of epochs, and the versions."""
    config = settings_of(training.batch.config)
    return {"config": config, "versions": describe(training.batch.config, training.batch.envs[0], [0]).versions}


def settings_of(config: TrainConfig) -> dict[str, Any]:
    """What decides the program, but for its number of epochs."""
    return json.loads(program_key(config)) | {"num_epochs": None}


def members_of(training: batches.Training) -> dict[str, dict[str, Any]]:
    """Where each run stands in a batch, and what its members are of: floats, seeds and data."""
    floats = batches.floats_of(training.batch)
    return {
        run.name: {
            "place": place,
            "lanes": [which.start, which.stop],
            "of": [floats[which.start], list(run.seeds), data_of(training.batch.envs[place])],
        }
        for run, (place, which) in training.batch.places.items()
    }


def save(path: Path, training: batches.Training) -> None:
    """Write the checkpoint of a batch. Raises `UserError` if the disk refuses."""
    header = {
        "runs": members_of(training),
        "program": program_of(training),
        "evaluations": training.evaluations,
        "history": {name: np.stack(values).tolist() for name, values in training.history.items()},
        "finite": training.finite.tolist(),
        "seconds": [training.compile_seconds, training.run_seconds],
        "spans": training.spans_until_now(),
        "costs": training.costs,
    }
    disk.make_folder(path.parent)
    checkpoint.save(path, header, training.states)


def resume(folder: Path, training: batches.Training) -> bool:
    """Go on from the checkpoint that has all runs of this batch, the longest trained one of several. One that is
    damaged or of other settings is passed over. Returns whether there was one."""
    names = {run.name for run in training.batch.runs.values()}
    for path in (path for path, runs in kept(folder).items() if names <= runs):
        try:
            header, payload = checkpoint.read_header(path)
            if fits(header, training):
                take(path, header, payload, training)
                return True
        except UserError as error:
            print(f"infogoal: {error}; it is passed over", file=sys.stderr)
    return False


def fits(header: dict[str, Any], training: batches.Training) -> bool:
    """Whether a checkpoint has the runs of this batch, with the same settings."""
    wanted = json.loads(json.dumps(members_of(training)))
    return header["program"] == json.loads(json.dumps(program_of(training))) and all(
        header["runs"].get(name, {}).get("of") == own["of"] for name, own in wanted.items()
    )


def take(path: Path, header: dict[str, Any], payload: bytes, training: batches.Training) -> None:
    """Bring a batch to where its checkpoint was, of whose members it may have a part."""
    places, which = part_of(header["runs"], training)
    finite = np.asarray(header["finite"], bool)
    own = len(training.batch.shape)
    template = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((*finite.shape, *leaf.shape[own:]), leaf.dtype), training.shapes
    )
    states = checkpoint.arrays(path, payload, template)
    part = functools.partial(batches.part, axes=finite.ndim, places=places, members=which)
    training.go_on_with(jax.tree.map(part, states), header["evaluations"])
    training.history = {
        name: [part(values) for values in np.asarray(history)] for name, history in header["history"].items()
    }
    training.finite = part(finite)
    costs = header.get("costs", {})
    training.costs = {name: costs[name] for name in members_of(training) if name in costs}
    going_on = {name: np.ptp(own["lanes"]) for name, own in header["runs"].items() if name not in costs}
    own = sum(size for name, size in going_on.items() if name in members_of(training))
    share = own / max(1, sum(going_on.values()))  # Of what the larger batch took.
    training.compile_seconds += share * header["seconds"][0]
    training.run_seconds = share * header["seconds"][1]
    training.spans = header["spans"]


def part_of(runs: dict[str, dict[str, Any]], training: batches.Training) -> tuple[list[int], list[int]]:
    """The goal sets and the members of a checkpoint's batch that are those of this one, in its order."""
    places, which = {}, {}
    for run, (place, own) in training.batch.places.items():
        there = runs[run.name]
        places[place] = there["place"]
        which |= zip(range(own.start, own.stop), range(*there["lanes"]), strict=True)
    return [places[place] for place in sorted(places)], [which[member] for member in sorted(which)]


def tidy(folder: Path, runs: Sequence[Run]) -> None:
    """Delete what killed processes left: files that they were writing, and checkpoints of measured runs."""
    for place in {folder / UNFINISHED, *(files.path_of(folder, run).parent for run in runs)}:
        remove_abandoned(place)
    delete_measured(folder, runs)


def delete_measured(folder: Path, runs: Iterable[Run]) -> None:
    """Delete the checkpoints that have one of these runs, if each of their runs is finished and measured."""
    own = {run.name for run in runs}
    for path, header in headers(folder).items():
        if own & set(header["runs"]) and all(is_measured(folder, name, header) for name in header["runs"]):
            path.unlink(missing_ok=True)


def is_measured(folder: Path, name: str, header: dict[str, Any]) -> bool:
    """Whether the run of this name is trained to its end and measured, with the settings of this checkpoint: an older
    file of the run is not what the checkpoint is kept for."""
    path = folder / "runs" / f"{name}.npz"
    try:
        found = files.read(path)
        config = from_dict(found.about["config"])
    except UserError:  # There is none yet, or it is damaged.
        return False
    curve = found.evaluations["train_goal/success_rate"]
    of = json.loads(json.dumps([values_of(config.hyper), found.run.seeds, found.about["data"]]))
    same = settings_of(config) == header["program"]["config"] and of == header["runs"][name]["of"]
    return same and is_trained(curve, found.run.task, found.run.toy) and not found.missing()
