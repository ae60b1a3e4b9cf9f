"""The log of a flight: a line of JSON for every image, command, answer, decision and fault, flushed as it happens."""

import dataclasses
import json
import threading
import time
from pathlib import Path
from typing import Any, Literal

from infogoal_jax.errors import UserError
from infogoal_jax.runs.decoding import Place, decode, parse_lines, read_bytes

NAME = "flight.jsonl"


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


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Moves that are allowed in each direction."""

    left: int
    right: int
    up: int
    down: int


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
    """The events of a log, at least one; a last line that was cut off is left out. Raises `UserError` for a file that
    is none."""
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
