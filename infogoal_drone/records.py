"""What a flight leaves behind: its log, a line of JSON for every image, command, answer, decision and fault, flushed as
it happens; and recordings in the form that `infogoal data import` takes (docs/reference/datasets.md), with a policy
that explores."""

import contextlib
import csv
import dataclasses
import io
import json
import threading
import time
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from infogoal_drone.envelope import FARTHEST, STEP, Whereabouts
from infogoal_drone.vision import Picture
from infogoal_jax import files
from infogoal_jax.errors import UserError, require
from infogoal_jax.files import append, open_to_read
from infogoal_jax.runs.disk import Place, decode, parse_lines, read_bytes

NAME = "flight.jsonl"
COLUMNS = ("image", "trajectory", "time", "action", "state", "x", "y", "objects")
TABLE = "moves.csv"
LONGEST = 10**6
"""Seconds of a flight that no drone makes."""
STRAIGHT_ON = 0.75
"""Probability that the explorer repeats its move where it may."""


class Log:
    """Writes the log. Times are seconds since its start, by a clock that never jumps.

    Writing raises nothing, because a disk that refuses must not keep a drone in the air: the first error stays in
    `failed`, and the flight ends for it.
    """

    def __init__(self, folder: Path):
        self.path, self.failed, self.lock = folder / NAME, None, threading.RLock()
        self.began = time.monotonic()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.file = open(self.path, "x", encoding="utf-8")  # noqa: SIM115, `close` closes it
        except OSError as error:
            raise UserError(
                f"out = {str(folder)!r}: {error.strerror}; give a new folder that can be written to"
            ) from error
        self.write("start", date=time.strftime("%Y-%m-%dT%H:%M:%S%z"))

    def write(self, event: str, at: float | None = None, **values: Any) -> None:
        """Write an event. at: when it happened, by `time.monotonic`; None: now."""
        at = time.monotonic() if at is None else at
        line = json.dumps({"time": round(at - self.began, 4), "event": event, **values}) + "\n"
        try:
            with self.lock:
                if not self.file.closed:
                    self.file.write(line)
                    self.file.flush()
        except OSError as error:
            self.failed = self.failed or error

    def close(self) -> None:
        """Close the file."""
        with self.lock:
            self.file.close()


@dataclasses.dataclass(frozen=True)
class Event:
    """What every line has: seconds since the start, and what happened."""

    time: float
    event: str

    def __post_init__(self):
        require(0 <= self.time < LONGEST, "time", self.time, f"should be from 0 to below {LONGEST:,} s")


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Moves that are allowed in each direction."""

    left: int
    right: int
    up: int
    down: int

    def __post_init__(self):
        for name, value in vars(self).items():
            require(0 <= value <= FARTHEST, name, value, f"should be from 0 to {FARTHEST:,}")


@dataclasses.dataclass(frozen=True)
class SettingsEvent(Event):
    """What is read of the settings of a flight."""

    target: str
    host: str
    simulated: bool
    envelope: Bounds


@dataclasses.dataclass(frozen=True)
class StepEvent(Event):
    """A move and what came of it. low, high: corners of the places that are possible after it; latency: seconds from
    the image to the command."""

    outcome: Literal["made", "refused", "unanswered"]
    low: tuple[float, float]
    high: tuple[float, float]
    latency: float

    def __post_init__(self):
        super().__post_init__()
        require(0 <= self.latency < LONGEST, "latency", self.latency, f"should be from 0 to below {LONGEST:,} s")
        near = all(abs(step) <= FARTHEST for step in (*self.low, *self.high))
        require(near, "low, high", (*self.low, *self.high), f"should be at most {FARTHEST:,} steps away")


@dataclasses.dataclass(frozen=True)
class LandingEvent(Event):
    """Why it landed."""

    reason: str


@dataclasses.dataclass(frozen=True)
class EndEvent(LandingEvent):
    """How it ended."""

    found: bool
    landed: bool


KINDS = {"settings": SettingsEvent, "step": StepEvent, "landing": LandingEvent, "end": EndEvent}
"""What is read of an event by its name; of others when they happened."""


def read(path: Path) -> list[dict[str, Any]]:
    """The events of a log, at least one; a last line that was cut off is left out. Raises `UserError` for a file
    that is not a log."""
    place = Place(path, remedy="give the folder of a flight of `infogoal fly` or `infogoal record`")
    events = []
    for at, values in parse_lines(read_bytes(place, f"{path}: not there; give the folder of a flight"), place):
        event = decode(Event, values, at)
        decode(KINDS.get(event.event, Event), values, at)
        events.append(values)
    if not events:
        raise place.refusal("it holds no event")
    return events


def events_of(events: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """The events of this kind, in order."""
    return [event for event in events if event["event"] == name]


def check_recordings(folder: Path, trajectory: str) -> None:
    """Raise `UserError` if a flight of this name cannot be added to the recordings of this folder."""
    usable = trajectory == trajectory.strip() and trajectory.isprintable() and trajectory not in ("", TABLE)
    require(usable, "out", trajectory, "cannot be the name of a recorded flight; let --out end in another name")
    try:
        images = folder / trajectory
        require(
            not images.exists() or (images.is_dir() and not any(images.iterdir())),
            "record",
            str(folder),
            f"holds {trajectory} already; give another folder, or let --out end in another name",
        )
        table = folder / TABLE
        with io.TextIOWrapper(open_to_read(table), encoding="utf-8-sig", errors="replace", newline="") as file:
            require(
                next(csv.reader(file), list(COLUMNS)) == list(COLUMNS),
                "record",
                str(folder),
                f"its {TABLE} has other columns than {','.join(COLUMNS)}; give another folder",
            )
    except FileNotFoundError:
        return  # The first recording.
    except (OSError, csv.Error) as error:
        raise cannot_write(folder, error) from error


def cannot_write(folder: Path, error: object) -> UserError:
    """The refusal of a folder of recordings that cannot be written to."""
    return UserError(f"record = {str(folder)!r}: cannot be written ({error}); give another folder, or free some space")


class Recorder:
    """Keeps the pictures of a flight: PNG files below the folder, and a row for each in its moves.csv.

    A move that was refused is left out. Where an answer did not come the place is unknown, and the recording stops.
    What the disk refuses is a `UserError`: the flight ends for it, with a landing.
    """

    def __init__(self, folder: Path, trajectory: str, origin: tuple[int, int] = (0, 0)):
        """trajectory: name of the flight; origin: column and row where it hovers first, in the frame of all flights."""
        self.folder, self.trajectory, self.origin = folder, trajectory, np.array(origin)
        self.rows: list[dict[str, object]] = []
        self.last: tuple[Whereabouts, str] | None = None
        self.stopped = False
        check_recordings(folder, trajectory)
        try:
            (folder / trajectory).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise cannot_write(folder, error.strerror) from error

    def visit(self, picture: Picture, place: Whereabouts, in_view: set[str], move: str) -> None:
        """Keep a picture. move: chosen there, "" after the last."""
        if self.last is not None and place == self.last[0]:
            self.rows.pop()  # Its move was not made: this picture stands for the place.
        elif self.last is not None and place != self.last[0].after(self.last[1], "made"):
            self.stopped = True
        if self.stopped or not place.certain:
            self.stopped = True
            return
        name = f"{self.trajectory}/{len(self.rows):04d}.png"
        if not cv2.imwrite(str(self.folder / name), picture.whole[..., ::-1]):
            self.stopped = True
            raise cannot_write(self.folder, f"{name} was refused")
        column, row = (np.array(place.low) + self.origin).tolist()
        x, y = column * STEP / 100, row * STEP / 100
        cells = (name, self.trajectory, len(self.rows), move, f"{column} {row}", x, y, ";".join(sorted(in_view)))
        self.rows.append(dict(zip(COLUMNS, cells, strict=True)))
        self.last = place, move

    def close(self) -> int:
        """Write the rows to the table. Returns the number of moves that were recorded. Raises `UserError` if the disk
        refuses."""
        if not self.rows:
            with contextlib.suppress(OSError):  # A flight that was refused on the ground has no pictures.
                (self.folder / self.trajectory).rmdir()
        if len(self.rows) < 2:
            return 0
        self.rows[-1]["action"] = ""
        text = io.StringIO(newline="")
        csv.DictWriter(text, COLUMNS).writerows(self.rows)
        header = f"{','.join(COLUMNS)}\r\n"
        try:
            table = self.folder / TABLE
            # All rows, or none.
            append(table, end_of_last_line(table) + text.getvalue().encode(), header.encode())
        except OSError as error:
            raise cannot_write(self.folder, error.strerror) from error
        return len(self.rows) - 1


def end_of_last_line(table: Path) -> bytes:
    """What the last line of a table lacks, which an editor may leave without an end. Raises `OSError` if it cannot be
    read."""
    content = files.read_bytes(table) if table.exists() else b""
    return b"" if not content or content.endswith(b"\n") else b"\r\n"


class Explorer:
    """A policy that looks at nothing: mostly straight on, as recorded flights are flown by hand."""

    def __init__(self, seed: int):
        self.random, self.last = np.random.default_rng([seed, 4]), -1  # Not what the simulated drone draws.

    def __call__(self, picture: np.ndarray, mask: np.ndarray) -> int:
        """The next move, among the allowed ones."""
        if self.last < 0 or not mask[self.last] or self.random.random() > STRAIGHT_ON:
            self.last = int(self.random.choice(np.flatnonzero(mask)))
        return self.last
