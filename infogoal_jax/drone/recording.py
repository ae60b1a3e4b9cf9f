"""Recording flights in the form that `infogoal data import` takes (docs/datasets.md), and a policy that explores."""

import csv
import io
from pathlib import Path

import cv2
import numpy as np

from infogoal_jax.data.archives import regular
from infogoal_jax.drone.envelope import STEP, Whereabouts
from infogoal_jax.drone.pictures import Picture
from infogoal_jax.errors import UserError, require

COLUMNS = ("image", "trajectory", "time", "action", "state", "x", "y", "objects")
TABLE = "moves.csv"
STRAIGHT_ON = 0.75
"""Probability that the explorer repeats its move where it may."""


def check_recordings(folder: Path, trajectory: str) -> None:
    """Raise `UserError` if a flight of this name cannot be added to the recordings of this folder."""
    try:
        require(
            not (folder / trajectory).exists(),
            "record",
            str(folder),
            f"holds {trajectory} already; give another folder, or let --out end in another name",
        )
        table = folder / TABLE
        with open(regular(table), encoding="utf-8", errors="replace", newline="") as file:
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
            (folder / trajectory).mkdir(parents=True, exist_ok=False)
        except OSError as error:
            raise cannot_write(folder, error.strerror) from error

    def visit(self, picture: Picture, place: Whereabouts, in_view: set[str], move: str) -> None:
        """Keep a picture. move: made from there, "" after the last."""
        if self.last is not None and place == self.last[0]:
            self.rows.pop()  # Its move was refused: this picture stands for the place.
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
        if len(self.rows) < 2:
            return 0
        self.rows[-1]["action"] = ""
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, COLUMNS)
        try:
            with open(self.folder / TABLE, "ab") as file:
                before = file.tell()
                if before == 0:
                    writer.writeheader()
                writer.writerows(self.rows)
                try:
                    file.write(text.getvalue().encode())
                    file.flush()
                except OSError:
                    file.truncate(before)  # No half row.
                    raise
        except OSError as error:
            raise cannot_write(self.folder, error.strerror) from error
        return len(self.rows) - 1


class Explorer:
    """A policy that looks at nothing: mostly straight on, as recorded flights are flown by hand."""

    def __init__(self, seed: int):
        self.random, self.last = np.random.default_rng(seed), -1

    def __call__(self, picture: np.ndarray, mask: np.ndarray) -> int:
        """The next move, among the allowed ones."""
        if self.last < 0 or not mask[self.last] or self.random.random() > STRAIGHT_ON:
            self.last = int(self.random.choice(np.flatnonzero(mask)))
        return self.last
