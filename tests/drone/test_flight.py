"""A flight without a network: whatever goes wrong after the take-off, it lands, and the log says why."""

import os
import signal
import threading
import time

import cv2
import numpy as np
import pytest

from infogoal_drone import flight as flight_module
from infogoal_drone import vision
from infogoal_drone.envelope import MOVES, Envelope, Limits
from infogoal_drone.flight import Flight
from infogoal_drone.link import Answer
from infogoal_drone.records import NAME, Log, events_of, read
from infogoal_drone.vision import Detection, Picture
from infogoal_jax import stopping
from infogoal_jax.errors import UserError

SPEED = 200.0
IMAGE = np.zeros((48, 64, 3), np.uint8)
TARGET = Detection("mug", (10.0, 10.0, 30.0, 30.0))


class ScriptedLink:
    """A drone that answers what the script says. script: answers by command, "" for none; then ok."""

    def __init__(self, log: Log, script=None):
        self.log, self.speed = log, SPEED
        self.script = {word: list(answers) for word, answers in (script or {}).items()}
        self.sent, self.in_air, self.answers = [], False, True
        self.packet = {"bat": 80, "h": 80, "tof": 170, "vgx": 0, "vgy": 0, "vgz": 0}
        self.age, self.height = 0.0, 80

    def connect(self, give_up):
        pass

    def send(self, command, seconds, give_up=None):
        self.sent.append(command)
        answers = self.script.get(command.split()[0])
        text = answers.pop(0) if answers else "ok"
        if callable(text):
            text = text()
        if command == "takeoff":
            self.in_air = True
        if text == "ok" and command.split()[0] in ("up", "down"):
            self.height += {"up": 20, "down": -20}[command.split()[0]]
            self.packet = self.packet | {"h": self.height}
        if command == "land" and text == "ok":
            self.in_air = False
        outcome = {"ok": "made", "": "unanswered"}.get(text, "refused")
        now = time.monotonic()
        self.log.write("command", command=command)
        return Answer(outcome, text, now, now)

    def resynchronise(self, seconds, give_up=None):
        self.sent.append("battery?")
        return self.answers

    def state(self):
        return self.packet, self.age

    def pictures(self):
        return [Picture(time.monotonic(), IMAGE, IMAGE)]

    def on_ground(self):
        return not self.in_air


OPEN_LOGS: list[Log] = []


@pytest.fixture(autouse=True)
def trusted_pictures(monkeypatch):
    """Pictures are trusted: tests/drone/test_simulated_drone.py is about them. Logs are closed in the end."""
    monkeypatch.setattr(flight_module, "fault_of", lambda found, now, since, *more: "" if now > since else "waiting")
    monkeypatch.setattr(flight_module, "STALE_SECONDS", np.inf)  # A busy machine makes them old at this pace.
    yield
    while OPEN_LOGS:
        OPEN_LOGS.pop().close()


def go_right(picture, mask):
    """A policy that goes to the right as far as it may."""
    return int(np.argmax(mask * np.array([1, 2, 0.5, 0.5])))


def make_flight(tmp_path, script=None, policy=go_right, detect=lambda image: [], steps=4, **link):
    """A flight over a scripted link."""
    log = Log(tmp_path)
    OPEN_LOGS.append(log)
    drone = ScriptedLink(log, script)
    for name, value in link.items():
        setattr(drone, name, value)
    flight = Flight(drone, policy, tuple(MOVES), detect, "mug", Envelope(3, 3, 2, 2), Limits(steps), log)
    return flight, drone


def moves_of(drone) -> list[str]:
    """The moves that were sent."""
    return [command.split()[0] for command in drone.sent if command.split()[0] in MOVES]


def reason_in_log(tmp_path) -> str:
    """Why the log says that it ended."""
    (end,) = events_of(read(tmp_path / NAME), "end")
    return end["reason"]


def test_it_lands_where_it_sees_the_object(tmp_path):
    seen = iter([[], [], [], [TARGET]])  # The first is on the ground.
    flight, drone = make_flight(tmp_path, detect=lambda image: next(seen))
    outcome = flight.fly()
    assert outcome.found and outcome.landed and outcome.steps == 2
    assert drone.sent == ["takeoff", "right 20", "right 20", "land"]


def test_a_box_that_is_cut_off_does_not_count(tmp_path):
    flight, _ = make_flight(tmp_path, detect=lambda image: [TARGET._replace(box=(0.0, 10.0, 30.0, 30.0))])
    assert not flight.fly().found


def test_steps_are_used_up_inside_of_the_envelope(tmp_path):
    flight, drone = make_flight(tmp_path, steps=5)
    assert "steps" in flight.fly().reason
    assert moves_of(drone) == ["right", "right", "right", "left", "right"]


@pytest.mark.parametrize("where", ["policy", "detect"])
def test_an_error_lands_and_is_raised(tmp_path, where):
    flight, drone = make_flight(tmp_path)

    def fail(*arguments):
        if drone.in_air:
            raise ZeroDivisionError("oh")

    setattr(flight, where, fail)
    with pytest.raises(ZeroDivisionError):
        flight.fly()
    assert drone.sent[-1] == "land" and not drone.in_air
    assert reason_in_log(tmp_path) == "error: ZeroDivisionError: oh"


@pytest.mark.parametrize("where", ["policy", "detect"])
def test_what_cannot_run_is_found_on_the_ground(tmp_path, where):
    def fail(*arguments):
        raise ZeroDivisionError("oh")

    flight, drone = make_flight(tmp_path, **{where: fail})
    with pytest.raises(ZeroDivisionError):
        flight.fly()
    assert not drone.sent and reason_in_log(tmp_path) == "refused on the ground: oh"


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_signals_land(tmp_path, monkeypatch, name):
    """The second and the third, while it lands, end nothing; and the old handlers are back after it."""
    monkeypatch.setattr(stopping, "ECHO", 0.0)
    before = signal.getsignal(signal.SIGINT)

    def interrupt():
        os.kill(os.getpid(), getattr(signal, name))
        return "ok"

    def interrupt_and_fail():
        interrupt()
        return "error"

    flight, drone = make_flight(tmp_path, {"right": [interrupt], "land": [interrupt_and_fail, interrupt]})
    outcome = flight.fly()
    assert outcome.landed and outcome.reason == "interrupted"
    assert moves_of(drone) == ["right"]
    (end,) = events_of(read(tmp_path / NAME), "end")
    assert end["signals"] == 3
    assert signal.getsignal(signal.SIGINT) is before


def test_a_signal_while_a_network_is_tried_on_the_ground_stays_there(tmp_path):
    """Its first use takes seconds, in which a person may see what is wrong."""

    def interrupt(image):
        os.kill(os.getpid(), signal.SIGINT)
        return []

    flight, drone = make_flight(tmp_path, detect=interrupt)
    with pytest.raises(KeyboardInterrupt):
        flight.fly()
    assert not drone.sent and reason_in_log(tmp_path) == "interrupted on the ground"


def test_a_take_off_that_is_not_answered_lands(tmp_path):
    flight, drone = make_flight(tmp_path, {"takeoff": [""]})
    assert "takeoff was unanswered" in flight.fly().reason
    assert drone.sent == ["takeoff", "land"]


def test_an_ok_alone_is_no_landing(tmp_path):
    """It may be the late answer to a move: the drone must say that its motors rest."""
    flight, drone = make_flight(tmp_path, {"land": ["error", "", "ok"]})
    assert flight.fly().landed
    assert drone.sent[-3:] == ["land"] * 3


def test_a_drone_that_never_says_that_its_motors_rest_is_left_to_its_firmware(tmp_path, monkeypatch):
    """The program ends all the same, and the log says so."""
    monkeypatch.setattr(ScriptedLink, "on_ground", lambda drone: False)
    flight, drone = make_flight(tmp_path)
    assert not flight.fly().landed
    assert drone.sent.count("land") > 1 and drone.sent[-1] == "land"
    assert any("motors rest" in note["text"] for note in events_of(read(tmp_path / NAME), "note"))


def test_a_dead_link_is_waited_for_and_then_given_up(tmp_path):
    flight, drone = make_flight(tmp_path)

    def die():
        drone.age = 100.0
        return ""

    drone.script = {"right": [die], "land": [""] * 50}
    outcome = flight.fly()
    assert not outcome.landed and "link lost" in outcome.reason
    assert moves_of(drone) == ["right"]


def test_no_move_follows_an_unanswered_one_before_the_drone_answers(tmp_path):
    flight, drone = make_flight(tmp_path, {"right": [""]}, steps=2)
    flight.fly()
    assert drone.sent[:4] == ["takeoff", "right 20", "battery?", "right 20"]
    flight, drone = make_flight(tmp_path / "again", {"right": [""]}, answers=False)
    assert "no longer answers" in flight.fly().reason
    assert moves_of(drone) == ["right"]


def test_unanswered_moves_end_the_flight(tmp_path):
    flight, drone = make_flight(tmp_path, {"right": [""] * 9, "left": [""] * 9}, steps=9)
    assert "never answered" in flight.fly().reason
    assert len(moves_of(drone)) == flight_module.MOST_UNANSWERED


def test_a_refused_move_is_not_tried_again_from_there(tmp_path):
    flight, drone = make_flight(tmp_path, {"right": ["error"]}, steps=3)
    flight.fly()
    assert moves_of(drone) == ["right", "left", "right"]


def test_where_all_that_is_left_was_refused_the_log_says_so(tmp_path):
    flight, _ = make_flight(tmp_path, {"right": ["error"], "left": ["error"]})
    flight.envelope = Envelope(1, 1, 0, 0)
    assert "refused" in flight.fly().reason
    flight, _ = make_flight(tmp_path / "again")
    flight.envelope = Envelope(0, 0, 0, 0)
    assert flight.fly().reason == "no move stays inside of the envelope"


@pytest.mark.parametrize(("answer", "moves"), [("out of range", 3), ("error Auto land", 1), ("error No valid imu", 1)])
def test_refusals_end_the_flight(tmp_path, answer, moves):
    flight, drone = make_flight(tmp_path, {name: [answer] * 9 for name in MOVES}, steps=9)
    assert "refused" in flight.fly().reason
    assert len(moves_of(drone)) == moves


@pytest.mark.parametrize(
    ("change", "words"),
    [({"bat": 25}, "battery"), ({"vgy": 3}, "another controller"), ({"h": 140}, "another controller")],
)
def test_the_state_is_watched(tmp_path, change, words):
    flight, drone = make_flight(tmp_path)

    def disturb():
        drone.packet = drone.packet | change
        return "ok"

    drone.script = {"right": [disturb]}
    assert words in flight.fly().reason
    assert moves_of(drone) == ["right"]


@pytest.mark.parametrize("packet", [{"bat": 30}, {}])
def test_it_is_refused_on_the_ground(tmp_path, packet):
    flight, drone = make_flight(tmp_path, packet=packet, age=0.0 if packet else 9.0)
    with pytest.raises(UserError):
        flight.fly()
    assert not drone.sent and "refused on the ground" in reason_in_log(tmp_path)


def test_a_link_that_dies_while_a_network_is_tried_on_the_ground_stays_there(tmp_path):
    """Its first use takes seconds."""
    flight, drone = make_flight(tmp_path)

    def die(image):
        drone.age = 3.0
        return []

    flight.detect = die
    with pytest.raises(UserError, match="no state"):
        flight.fly()
    assert not drone.sent


def test_pictures_that_cannot_be_trusted_end_it(tmp_path, monkeypatch):
    faults = iter(["", ""])
    monkeypatch.setattr(flight_module, "fault_of", lambda *arguments: next(faults, "frozen"))
    flight, _ = make_flight(tmp_path)
    assert flight.fly().reason == "video frozen"


@pytest.mark.parametrize("where", ["policy", "visit"])
def test_no_move_is_made_on_a_picture_that_became_old(tmp_path, monkeypatch, where):
    """While the policy was thinking, or a disk kept the picture."""
    monkeypatch.setattr(flight_module, "STALE_SECONDS", 1.0)
    flight, drone = make_flight(tmp_path, steps=2, speed=10.0)
    pauses = [0.2, 0.0, 0.2, 0.0]

    def pause(*given):
        time.sleep(pauses.pop(0) if drone.in_air and pauses else 0.0)
        return go_right(*given) if where == "policy" else None

    setattr(flight, where, pause)
    flight.fly()
    steps = events_of(read(tmp_path / NAME), "step")
    assert len(steps) == 2 and all(step["latency"] < 0.2 for step in steps)


def test_a_detector_that_is_too_slow_ends_it(tmp_path, monkeypatch):
    monkeypatch.setattr(flight_module, "STALE_SECONDS", 1.0)
    flight, drone = make_flight(tmp_path, detect=lambda image: time.sleep(0.02) or [])
    assert "video stale" in flight.fly().reason
    assert moves_of(drone) == []


def test_the_picture_that_was_checked_is_the_one_that_is_used(tmp_path, monkeypatch):
    """Another may arrive after the check, on the ground and in the air."""
    checked, used = [], []
    monkeypatch.setattr(flight_module, "fault_of", lambda found, *more: checked.append(found[-1]) or "")
    flight, _ = make_flight(tmp_path, policy=lambda small, mask: used.append(small) or go_right(small, mask))
    flight.link.pictures = lambda: [Picture(time.monotonic(), IMAGE.copy(), IMAGE)]
    flight.fly()
    assert len(used) == 5 and all(any(small is picture.small for picture in checked) for small in used)


def test_no_move_is_chosen_before_a_state_packet_says_where_it_led(tmp_path):
    """How much is below, and whether another controller moves it, is as new as the picture."""
    flight, drone = make_flight(tmp_path, speed=10.0)
    packets = []

    def state():
        return drone.packet, min((time.monotonic() - arrived) * 10 for arrived in packets)

    drone.state = state
    packets.append(time.monotonic())
    flight.rest_since = time.monotonic()
    began = time.monotonic()
    threading.Timer(0.05, lambda: packets.append(time.monotonic())).start()
    flight.await_picture()
    assert 0.04 < time.monotonic() - began < 0.5


class LiveVideo:
    """Thirty images a second of a camera that moves a little, and is elsewhere after every command. frozen_from: the
    command from which on all images are the same."""

    def __init__(self, drone, frozen_from: str):
        coarse = np.random.default_rng(0).uniform(0, 255, (12, 40, 3)).astype(np.float32)
        self.wall = cv2.resize(coarse, (640, 48), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)
        self.drone, self.frozen_from, self.found = drone, frozen_from, []
        send = drone.send

        def send_and_see(command, *more):
            answer = send(command, *more)
            self.moved += 1
            return answer

        self.moved, drone.send = 0, send_and_see

    def __call__(self):
        """The pictures until now."""
        now, step = time.monotonic(), 1 / 30 / self.drone.speed
        if not self.found:
            self.found.append(self.picture(now - 3 / self.drone.speed, 0))
        while self.found[-1].time + step <= now:
            frozen = self.frozen_from in self.drone.sent
            number = len(self.found)
            self.found.append(
                self.found[-1]._replace(time=self.found[-1].time + step)
                if frozen
                else self.picture(self.found[-1].time + step, number)
            )
        return self.found[-120:]

    def picture(self, at: float, number: int) -> Picture:
        left = 60 * self.moved + number % 3
        image = np.ascontiguousarray(self.wall[:, left : left + 64])
        return Picture(at, image, image)


@pytest.mark.parametrize(
    ("frozen_from", "answer", "moves"),
    [("takeoff", "ok", 0), ("right 20", "ok", 1), ("right 20", "error", 1), ("right 20", "", 1)],
)
def test_a_video_that_freezes_is_noticed_after_every_command(tmp_path, monkeypatch, frozen_from, answer, moves):
    monkeypatch.setattr(flight_module, "fault_of", vision.fault_of)
    monkeypatch.setattr(flight_module, "MACHINE_SECONDS", 0.0)
    flight, drone = make_flight(tmp_path, {"right": [lambda: time.sleep(2 / 5) or answer]}, speed=5.0)
    drone.pictures = LiveVideo(drone, frozen_from)
    assert flight.fly().reason == "video frozen"
    assert len(moves_of(drone)) == moves


def test_a_full_disk_lands(tmp_path):
    flight, drone = make_flight(tmp_path)

    class Full:
        closed = False

        def write(self, line):
            raise OSError("no space left")

        def close(self):
            pass

    def fill():
        flight.log.file.close()
        flight.log.file = Full()
        return "ok"

    drone.script = {"right": [fill]}
    outcome = flight.fly()
    assert outcome.landed and "no space left" in outcome.reason
