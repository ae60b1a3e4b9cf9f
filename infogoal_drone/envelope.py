"""Where the drone may be: an envelope of steps around the place where it hovered first, and which moves stay inside.
And what ends a flight, apart from its object: limits, and signals (Ctrl-C, the end of the terminal, a polite kill).

An answer that never came leaves open whether the move was made. The place is therefore kept as an interval, and a move
is allowed only if it stays inside from wherever the drone may be.
"""

import contextlib
import dataclasses
from collections.abc import Sequence

import numpy as np

from infogoal_jax import stopping
from infogoal_jax.errors import require

STEP = 20
"""Length of a move in cm; the least that the SDK takes [P]."""
FARTHEST = 10**4
"""Steps from where it hovered first that no flight makes."""
MARGIN = 40
"""Centimetres around the outermost steps for what no command says: the hover drifts, moves end beside their place, and
another controller may move the drone once before this one lands it."""
MOVES = {"left": (-1, 0), "right": (1, 0), "up": (0, 1), "down": (0, -1)}
"""Columns and rows that each move adds."""
TAKEOFF_RESERVE = 10
"""Per cent of the battery above its floor that a take-off needs."""
LOWEST = 40
"""Centimetres that must lie below the drone after a move down, by its own sensor."""


@dataclasses.dataclass(frozen=True)
class Envelope:
    """How many steps of 20 cm the drone may go from where it hovered first."""

    left: int = 3
    """Steps to the left."""
    right: int = 3
    """Steps to the right."""
    up: int = 2
    """Steps up."""
    down: int = 1
    """Steps down."""

    def check(self) -> None:
        """Raise `UserError` for numbers of steps out of range."""
        for name, steps in dataclasses.asdict(self).items():
            require(0 <= steps <= FARTHEST, name, steps, f"give a number of steps of 20 cm from 0 to {FARTHEST:,}")

    def centimetres(self) -> dict[str, int]:
        """How far the drone may ever be from where it hovered first, cm by direction, the margin included."""
        return {name: steps * STEP + MARGIN for name, steps in dataclasses.asdict(self).items()}


@dataclasses.dataclass(frozen=True)
class Whereabouts:
    """Where the drone may be, in steps from where it hovered first: the least and the greatest column and row."""

    low: tuple[int, int] = (0, 0)
    high: tuple[int, int] = (0, 0)

    @property
    def certain(self) -> bool:
        """Whether it is one place."""
        return self.low == self.high

    def after(self, move: str, answer: str) -> "Whereabouts":
        """After a move that was made, refused, or never answered."""
        step = np.array(MOVES[move])
        low, high = np.array(self.low), np.array(self.high)
        if answer == "made":
            low, high = low + step, high + step
        elif answer == "unanswered":
            low, high = np.minimum(low, low + step), np.maximum(high, high + step)
        return Whereabouts(tuple(low.tolist()), tuple(high.tolist()))


def allowed(envelope: Envelope, place: Whereabouts, moves: Sequence[str], below: float | None = None) -> np.ndarray:
    """Which of the moves stay inside from wherever the drone may be, bool [A]. below: cm to what lies under the drone,
    None if it is not known."""

    def stays(move: str) -> bool:
        there = place.after(move, "made")
        inside = -envelope.left <= there.low[0] and there.high[0] <= envelope.right
        inside = inside and -envelope.down <= there.low[1] and there.high[1] <= envelope.up
        return inside and not (move == "down" and below is not None and below - STEP < LOWEST)

    return np.array([stays(move) for move in moves])


@dataclasses.dataclass(frozen=True)
class Limits:
    """What ends a flight."""

    steps: int = 50
    """Moves that are tried at most [P]."""
    battery_floor: int = 25
    """Per cent of the battery at which it lands."""
    confidence: float = 0.5
    """Of the detector, from which an object counts as seen."""

    def check(self) -> None:
        """Raise `UserError` for values out of range."""
        require(self.steps > 0, "steps", self.steps, "give a whole number greater than 0")
        most = 100 - TAKEOFF_RESERVE
        require(15 <= self.battery_floor <= most, "battery_floor", self.battery_floor, f"give 15 to {most} per cent")
        require(0 < self.confidence <= 1, "confidence", self.confidence, "give a number in (0, 1]")


class Interrupted(Exception):  # noqa: N818, it is no error
    """A signal asks the program to land."""


class Signals:
    """Within, every signal that asks the command to stop is noted and does nothing else: not even the second one may
    end a program whose drone is in the air. The flight looks at `count` wherever it waits."""

    def __init__(self, words: str = "Landing. The propellers still turn."):
        """words: are said at every signal."""
        self.words, self.count, self.landing = words, 0, False

    def __enter__(self) -> "Signals":
        self.stack = contextlib.ExitStack()
        self.request = self.stack.enter_context(stopping.stop_on_signal(at_once=self.note))
        self.before = self.request.at_once, self.request.finishing
        self.request.at_once, self.request.finishing = self.note, ""
        return self

    def __exit__(self, *raised) -> None:
        self.request.at_once, self.request.finishing = self.before
        self.stack.close()

    def note(self, request: stopping.StopRequest) -> None:
        """Count a signal."""
        self.count += 1
        stopping.say(self.words)

    def asked(self) -> bool:
        """Whether a signal came and the landing has not begun: nothing is waited for any more."""
        return self.count > 0 and not self.landing

    def check(self) -> None:
        """Raise `Interrupted` if a signal came and the landing has not begun."""
        if self.asked():
            raise Interrupted
