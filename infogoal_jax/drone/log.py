"""The log of a flight: a line of JSON for every image, command, answer, decision and fault, flushed as it happens."""

import json
import threading
import time
from pathlib import Path
from typing import Any

from infogoal_jax.errors import UserError

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


def read(path: Path) -> list[dict[str, Any]]:
    """The events of a log; a last line that was cut off is left out. Raises `UserError` for a file that is none."""
    events = []
    lines = path.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, 1):
        try:
            events.append(json.loads(line))
        except ValueError as error:
            if number < len(lines):
                raise UserError(f"{path}: line {number} is no log of a flight ({error})") from error
    return events


def events_of(events: list[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """The events of this kind, in order."""
    return [event for event in events if event["event"] == name]
