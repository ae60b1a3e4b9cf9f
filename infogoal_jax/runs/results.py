"""timing.json and evaluation.json: numbers about a run that are no part of it."""

import dataclasses
from pathlib import Path
from typing import Any

from infogoal_jax.runs import disk
from infogoal_jax.runs.decoding import Place, decode, parse, read_bytes


@dataclasses.dataclass(frozen=True)
class Timing:
    """Seconds of compiling and running in the last session of a run, and rates over all seeds."""

    compile_seconds: float
    run_seconds: float
    env_steps_per_second: float
    updates_per_second: float


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """What `infogoal evaluate` found. epoch: of the parameters; starts: a goal; corruption: weight of the backgrounds,
    None for goals that are not images; seeds: those that did not diverge; diverged: the others, with the epoch;
    metrics: {name: [seeds, ...]}."""

    epoch: int
    starts: int
    start_seed: int
    test_epsilon: float
    corruption: float | None
    seeds: list[int]
    diverged: dict[int, int]
    data: str
    metrics: dict[str, Any]


def write_timing(folder: Path, timing: Timing) -> None:
    """Write RUN/timing.json."""
    disk.write_json(folder / "timing.json", dataclasses.asdict(timing))


def read_timing(folder: Path) -> Timing | None:
    """The times of the last session of a run; None if no session got past a chunk. Raises `UserError` for a file that
    holds something else."""
    place = Place(
        folder / "timing.json", remedy="delete it: it is not needed to go on, or bring back a copy of the file"
    )
    if not place.path.exists():
        return None
    return decode(Timing, parse(read_bytes(place, f"{place.path}: not there"), place), place)


def write_evaluation(folder: Path, evaluation: Evaluation) -> None:
    """Write RUN/evaluation.json."""
    disk.write_json(folder / "evaluation.json", dataclasses.asdict(evaluation))
