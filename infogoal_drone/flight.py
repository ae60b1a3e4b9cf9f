"""One flight: pictures in, moves of 20 cm out, until the object is in view or the steps are used up; then the landing.

Whatever happens after the command `takeoff` was sent, the flight ends in `land`: an answer that does not come, a fault
of the video, a dead link, an error in any part of the program, Ctrl-C, the end of the terminal.
"""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from infogoal_drone.envelope import STEP, TAKEOFF_RESERVE, Envelope, Interrupted, Limits, Signals, Whereabouts, allowed
from infogoal_drone.link import Answer, Link
from infogoal_drone.records import Log
from infogoal_drone.vision import STALE_SECONDS, Detector, Picture, fault_of, seen
from infogoal_jax.errors import require
from infogoal_jax.stopping import say

MOVE_SECONDS, TAKEOFF_SECONDS, QUERY_SECONDS, LAND_SECONDS = 7.0, 20.0, 2.0, 1.0
"""How long an answer to each kind of command is waited for; `land`, which does no harm twice, is then sent again."""
LOOK_SECONDS, REST_SECONDS = 0.02, 0.5
"""Between two looks at pictures and state; after the answer to a move, until images show the place that it led to: the
video is late, the drone swings."""
PICTURE_SECONDS = 5.0
"""How long a picture that can be trusted is waited for."""
LINK_SECONDS, LINK_LOST_SECONDS = 1.0, 4.0
"""Without a state packet: no move is made; the flight ends so much later, also while an answer is awaited."""
MACHINE_SECONDS, LONGEST_PATIENCE = 2.5, 10.0
"""A simulation that is faster than time gives a busy machine so many of its own seconds for pictures and state packets,
and the drone no more than this, which is less than the firmware's silence."""
SILENT_SECONDS, LANDING_SECONDS = 30.0, 120.0
"""While landing: without a state packet the firmware has landed by itself; and how long `land` is sent to a drone that
never says that its motors rest."""
FOREIGN_SPEED = 2
"""dm/s of the state packet from which the drone moves, rather than drifts."""
HEIGHT_OFF = 30
"""Centimetres that the height may be off from what the moves add up to."""
MOST_REFUSALS, MOST_UNANSWERED = 3, 3
"""Moves refused in a row, and moves unanswered in a flight, that end it."""
FOREIGN = "another controller, or its own landing"
AT_ONCE = ("auto land", "motor stop", "imu")
"""Answers after which no move is tried again."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a flight ended. reason: of the landing; landed: whether the drone said that it is on the ground."""

    found: bool
    steps: int
    reason: str
    landed: bool


class Landing(Exception):  # noqa: N818, it is no error
    """Ends the steps of a flight; its text is the reason."""


Policy = Callable[[np.ndarray, np.ndarray], int]
"""A reduced picture uint8 [H, W, 3] and the allowed moves bool [A] to a move."""
Visit = Callable[[Picture, Whereabouts, set[str], str], None]
"""Is told the picture, the place, the objects in view and the move that follows ("" for the last); again from the same
place where that is not made."""


class Flight:
    """A flight of a policy. `fly` runs it from the checks on the ground to the landing."""

    def __init__(
        self,
        link: Link,
        policy: Policy,
        moves: tuple[str, ...],
        detect: Detector,
        target: str,
        envelope: Envelope,
        limits: Limits,
        log: Log,
        visit: Visit | None = None,
    ):
        """moves: their names in the policy's order; target: the object that ends the flight, "" for none."""
        self.link, self.policy, self.moves, self.detect, self.target = link, policy, moves, detect, target
        self.envelope, self.limits, self.log, self.visit = envelope, limits, log, visit
        self.place, self.steps, self.unanswered, self.refused_in_row = Whereabouts(), 0, 0, 0
        self.refused: set[str] = set()
        self.before_move: np.ndarray | None = None
        self.in_air, self.rest_since, self.picture_fault = False, 0.0, ""
        self.hover_height: int | None = None
        self.found, self.signals = False, Signals()

    def fly(self) -> Outcome:
        """The whole flight. Raises `UserError` for what is found on the ground; an error in the air is raised after the
        landing."""
        with self.signals:
            try:
                self.check_on_ground()
            except Interrupted as end:
                self.end("interrupted on the ground", True)
                raise KeyboardInterrupt from end
            except Exception as refusal:
                self.end(f"refused on the ground: {refusal}", True)
                raise
            reason, error = self.until_landing()
            self.signals.landing = True
            landed = self.land(reason)
        self.end(reason, landed)
        if error is not None:
            raise error
        return Outcome(self.found, self.steps, reason, landed)

    def until_landing(self) -> tuple[str, BaseException | None]:
        """Take off and make the steps. Returns why it must land now, and the error if it is one."""
        try:
            self.take_off()
            self.run_steps()
        except Landing as end:
            return str(end), None
        except Interrupted:
            return "interrupted", None
        except BaseException as raised:
            return f"error: {type(raised).__name__}: {raised}", raised

    def end(self, reason: str, landed: bool) -> None:
        """The last line of the log."""
        counts = {"steps": self.steps, "signals": self.signals.count}
        self.log.write("end", reason=reason, found=self.found, landed=landed, **counts)

    def check_on_ground(self) -> None:
        """Raise `UserError` unless video, state and battery allow a take-off."""
        self.link.connect(self.signals.asked)
        self.signals.check()
        picture = self.wait(self.trusted_picture, self.patience(PICTURE_SECONDS))
        require(bool(picture), "video", self.picture_fault, "point the camera at the shelf, in light, and try again")
        self.rehearse(picture)
        self.before_move = picture.small
        # Last, because the first use of a network takes seconds.
        heard = self.wait(lambda: self.link.state()[1] < LINK_SECONDS, self.patience(3.0))
        require(heard, "drone", "no state", "let the firewall pass the state packets")
        battery, least = self.link.state()[0]["bat"], self.limits.battery_floor + TAKEOFF_RESERVE
        require(battery >= least, "battery", f"{battery} %", f"charge it: {least} % or more for a take-off")
        self.signals.check()

    def rehearse(self, picture: Picture) -> None:
        """Use detector and policy once: what they raise, and the seconds of a network's first use, belong here."""
        self.detect(picture.whole)
        self.policy(picture.small, np.ones(len(self.moves), bool))

    def take_off(self) -> None:
        """Take off and come to rest."""
        answer = self.link.send("takeoff", TAKEOFF_SECONDS, self.must_not_wait)
        self.in_air = True
        self.signals.check()
        if answer.outcome != "made":
            self.check_silence()
            raise Landing(f"takeoff was {answer.outcome}: {answer.text}")
        self.rest(answer)

    def run_steps(self) -> None:
        """Steps until one of them ends the flight. Always raises, in the end `Landing`."""
        late = 0.0
        while True:
            picture = self.await_picture()
            in_view = seen(self.detect(picture.whole), picture.whole, self.limits.confidence)
            self.found = self.target in in_view
            if self.found or self.steps >= self.limits.steps:
                self.tell(picture, in_view, "")
                raise Landing(f"found {self.target}" if self.found else f"{self.limits.steps} steps are used up")
            below = self.link.state()[0].get("tof")
            mask = allowed(self.envelope, self.place, self.moves, below)
            mask &= [move not in self.refused for move in self.moves]
            if not mask.any():
                refused = ": those that do were refused" if self.refused else ""
                raise Landing(f"no move stays inside of the envelope{refused}")
            move = self.moves[self.policy(picture.small, mask)]
            self.tell(picture, in_view, move)
            self.check_link()
            self.check_state()
            age = (time.monotonic() - picture.time) * self.link.speed
            if age > STALE_SECONDS:  # A slow detector or disk, or state packets that were waited for.
                late += age
                if late > self.patience(PICTURE_SECONDS):
                    raise Landing(f"video stale: the picture is {age:.1f} s old when the move could be made")
                continue
            late = 0.0
            self.make(move, picture)

    def make(self, move: str, picture: Picture) -> None:
        """Send one move and wait for what comes of it; the next is not sent before."""
        self.steps += 1
        answer = self.link.send(f"{move} {STEP}", MOVE_SECONDS, self.must_not_wait)
        latency = answer.sent - picture.time
        self.place = self.place.after(move, answer.outcome)
        self.log.write(
            "step", number=self.steps, move=move, outcome=answer.outcome, low=self.place.low, high=self.place.high,
            image=round(picture.time - self.log.began, 4), latency=round(latency, 4),
        )  # fmt: skip
        self.signals.check()
        if answer.outcome != "refused":  # After a missing answer it may be back where it was.
            self.before_move = picture.small if answer.outcome == "made" else None
        self.refused = self.refused | {move} if answer.outcome == "refused" else set()
        self.refused_in_row = self.refused_in_row + 1 if answer.outcome == "refused" else 0
        if answer.outcome == "refused":
            if any(words in answer.text.lower() for words in AT_ONCE):
                raise Landing(f"{move} was refused: {answer.text}")
            if self.refused_in_row >= MOST_REFUSALS:
                raise Landing(f"{MOST_REFUSALS} moves in a row were refused, the last: {answer.text}")
        if answer.outcome == "unanswered":
            self.check_silence()
            self.unanswered += 1
            if self.unanswered >= MOST_UNANSWERED:
                raise Landing(f"{self.unanswered} moves were never answered")
            answers = self.link.resynchronise(QUERY_SECONDS, self.must_not_wait)
            self.signals.check()
            if not answers:
                self.check_silence()
                raise Landing("the drone no longer answers")
        self.rest(answer)

    def rest(self, answer: Answer) -> None:
        """From here on images show where the command led to."""
        self.rest_since = answer.received + REST_SECONDS / self.link.speed

    def await_picture(self) -> Picture:
        """The last picture, once it can be trusted and a state packet came after the last move; meanwhile everything
        else is watched. Raises `Landing`."""
        began = self.clock()
        while True:
            self.check_link()
            self.check_state()
            picture = self.trusted_picture()
            if picture is not None and self.quiet():
                return picture
            if self.clock() - began > self.patience(PICTURE_SECONDS):
                raise Landing(f"video {self.picture_fault}" if picture is None else "no state packet since the move")
            time.sleep(LOOK_SECONDS / self.link.speed)

    def trusted_picture(self) -> Picture | None:
        """The last picture if it can be trusted; else `picture_fault` says in a word what is wrong with it."""
        found, now = self.link.pictures(), time.monotonic()
        self.picture_fault = fault_of(found, now, self.rest_since, self.link.speed, self.in_air, self.before_move)
        return None if self.picture_fault else found[-1]

    def check_link(self) -> None:
        """Wait while state packets are late; raise `Landing` where they stay away, and where nothing is logged any
        more."""
        self.signals.check()
        if self.log.failed is not None:
            raise Landing(f"the log cannot be written: {self.log.failed}")
        age = self.link.state()[1]
        if age < LINK_SECONDS:
            return
        self.log.write("note", text=f"no state packet for {age:.1f} s; waiting")
        self.wait(lambda: self.link.state()[1] < LINK_SECONDS or self.silent())
        self.check_silence()

    def check_silence(self) -> None:
        """Raise `Landing` where state packets stay away."""
        if self.silent():
            raise Landing(f"link lost: no state packet for {self.link.state()[1]:.0f} s")

    def silent(self) -> bool:
        """Whether state packets stay away for so long that the flight ends."""
        return self.link.state()[1] > LINK_SECONDS + self.patience(LINK_LOST_SECONDS)

    def must_not_wait(self) -> bool:
        """Whether it is time to land: no answer is awaited any more."""
        return self.signals.asked() or self.silent()

    def check_state(self) -> None:
        """Raise `Landing` for an empty battery, and for motions that nobody here asked for."""
        state, _ = self.link.state()
        if state["bat"] <= self.limits.battery_floor:
            raise Landing(f"battery at {state['bat']} %, the floor is {self.limits.battery_floor} %")
        if self.rest_since and self.quiet():
            speed = max(abs(state.get(name, 0)) for name in ("vgx", "vgy", "vgz"))
            if speed >= FOREIGN_SPEED:
                raise Landing(f"it moves at {10 * speed} cm/s without a command of this program: {FOREIGN}")
            if self.hover_height is None:
                self.hover_height = state["h"]
            low, high = (self.hover_height + STEP * row for row in (self.place.low[1], self.place.high[1]))
            if not low - HEIGHT_OFF <= state["h"] <= high + HEIGHT_OFF:
                raise Landing(f"its height is {state['h']} cm, and {low} to {high} cm by the moves: {FOREIGN}")

    def quiet(self) -> bool:
        """Whether the last state packet is from when the drone had to hover: one from during a move, after which the
        link went dead, says nothing about other controllers."""
        return time.monotonic() - self.link.state()[1] / self.link.speed > self.rest_since

    def tell(self, picture: Picture, in_view: set[str], move: str) -> None:
        """Log what is seen, and tell whoever wants to know."""
        self.log.write("seen", image=round(picture.time - self.log.began, 4), objects=sorted(in_view))
        if self.visit is not None:
            self.visit(picture, self.place, in_view, move)

    def land(self, reason: str) -> bool:
        """Land. Returns whether the drone said that it is on the ground; where the link is dead, its firmware lands.

        An "ok" is not enough: it may belong to an earlier command. The state must say that the motors rest.
        """
        self.log.write("landing", reason=reason)
        say(f"landing: {reason}")
        began = self.clock()
        while True:
            sent = self.clock()
            self.link.send("land", LAND_SECONDS)
            if self.wait(self.link.on_ground, sent + LAND_SECONDS - self.clock()):
                return True
            silent = self.link.state()[1] > SILENT_SECONDS
            if silent or self.clock() - began > LANDING_SECONDS:
                why = "no state packet while landing" if silent else "the state never says that the motors rest"
                self.log.write("note", text=f"{why}; the firmware lands 15 s after the last command")
                return False

    def patience(self, seconds: float) -> float:
        """Seconds of the drone for which pictures and state packets are waited for; of a real one those given."""
        return max(seconds, min(MACHINE_SECONDS * self.link.speed, LONGEST_PATIENCE))

    def clock(self) -> float:
        """Seconds of the drone."""
        return time.monotonic() * self.link.speed

    def wait(self, condition: Callable[[], Any], seconds: float = math.inf) -> Any:
        """Wait until the condition holds, for so many seconds of the drone at most. Returns its last value."""
        end = self.clock() + seconds
        while not (value := condition()):
            self.signals.check()
            if self.clock() > end:
                break
            time.sleep(LOOK_SECONDS / self.link.speed)
        return value
