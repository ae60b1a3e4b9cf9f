"""The link without a network: what counts as an answer, when the drone is on the ground, and what is noted of state and
video. A stub stands for djitellopy's class."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

from infogoal_drone import flight as flight_module
from infogoal_drone import link as link_module
from infogoal_drone.envelope import MOVES, Envelope, Limits
from infogoal_drone.flight import Flight, Landing
from infogoal_drone.link import NO_IMAGE_YET, Address, Link
from infogoal_drone.records import NAME, Log, events_of, read
from infogoal_drone.vision import Picture
from infogoal_jax.errors import UserError

SPEED = 10.0


class StubTello:
    """A drone behind djitellopy's interface: its motors turn from `takeoff` to `land`.

    answers: by the first word of a command, those to the first, the second and so on, each (seconds, text) pairs; then
    "ok" at once. lost: commands by their first word, of which so many are lost.
    """

    def __init__(self, answers=None, lost=None):
        self.answers = {word: list(given) for word, given in (answers or {}).items()}
        self.lost, self.sent, self.due, self.responses = dict(lost or {}), [], [], []
        self.began, self.motor_seconds, self.turning_since = self.clock(), 0.0, None
        self.packet_number, self.packet, self.silent = -1, {}, False

    def clock(self):
        return time.monotonic() * SPEED

    def get_own_udp_object(self):
        arrived = [answer for answer in self.due if answer[0] <= self.clock()]
        for answer in arrived:
            self.due.remove(answer)
            self.responses.append(answer[1].encode())
        return {"responses": self.responses}

    def send_command_without_return(self, command):
        self.sent.append(command)
        word = command.split()[0]
        if self.lost.get(word, 0) > 0:
            self.lost[word] -= 1
            return
        if word == "takeoff":
            self.turning_since = self.clock()
        given = self.answers.get(word)
        answers = given.pop(0) if given else [(0.0, "87" if word == "battery?" else "ok")]
        if word == "land" and self.turning_since is not None and answers[0][1] == "ok":
            self.motor_seconds, self.turning_since = self.motor_time(), None
        self.due += [(self.clock() + seconds, text) for seconds, text in answers]

    def motor_time(self):
        turning = 0.0 if self.turning_since is None else self.clock() - self.turning_since
        return self.motor_seconds + turning

    def get_current_state(self):
        """Ten packets a second."""
        number = int((self.clock() - self.began) * 10)
        if number > self.packet_number and not self.silent:
            self.packet_number = number
            self.packet = {"bat": 80, "h": 80, "tof": 170, "vgx": 0, "vgy": 0, "vgz": 0, "time": int(self.motor_time())}
        return self.packet

    def get_frame_read(self):
        worker = SimpleNamespace(join=lambda timeout: None)
        self.reader = SimpleNamespace(frame=np.zeros((*NO_IMAGE_YET, 3), np.uint8), stopped=False, worker=worker)
        self.reader.stop = lambda: setattr(self.reader, "stopped", True)
        return self.reader


@pytest.fixture
def connect(tmp_path, monkeypatch):
    """Connects a link to a stub; everything is closed in the end."""
    monkeypatch.setattr(link_module, "LEAST_SECONDS", 0.0)
    opened = []

    def connect(answers=None, lost=None):
        stub = StubTello(answers, lost)

        def tello_class(host, retry_count, vs_udp):
            assert retry_count == 1, "djitellopy sends nothing again"
            return stub

        tello_class.LOGGER = SimpleNamespace(setLevel=lambda level: None)
        monkeypatch.setattr(link_module, "import_djitellopy", lambda: tello_class)
        monkeypatch.setattr(link_module, "check_ports", lambda ports: None)
        log = Log(tmp_path / str(len(opened)))
        link = Link(Address(), (48, 64), log, SPEED)
        opened.append(link)
        link.connect()
        return link, stub

    yield connect
    for link in opened:
        link.close()
        link.log.close()


def logged(link, name: str) -> list:
    """The events of this kind in the log."""
    return events_of(read(link.log.path.parent / NAME), name)


def wait_for(condition, seconds: float = 3.0) -> bool:
    """Whether it holds within so many seconds."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.005)
    return True


def test_a_drone_that_does_not_answer(connect):
    with pytest.raises(UserError, match="'command' was not answered with ok"):
        connect(lost={"command": 9})


def test_images_and_packets_are_noted_when_they_arrive(connect, monkeypatch):
    """Every one once; pictures are kept for some seconds; what djitellopy shows before the first is none."""
    monkeypatch.setattr(link_module, "KEPT_SECONDS", 2.0)
    link, stub = connect()
    assert wait_for(lambda: link.state()[0].get("bat") == 80)
    assert link.pictures() == [] and link.state()[1] < 3.0
    for count in range(1, 4):
        stub.reader.frame = np.full((720, 960, 3), count, np.uint8)
        assert wait_for(lambda count=count: len(logged(link, "image")) == count)
    assert [int(picture.small.mean()) for picture in link.pictures()] == [1, 2, 3]
    assert link.pictures()[-1].small.shape == (48, 64, 3)
    time.sleep(2.5 / SPEED)
    stub.reader.frame = np.full((720, 960, 3), 4, np.uint8)
    assert wait_for(lambda: [int(picture.small.mean()) for picture in link.pictures()] == [4])
    stub.silent = True
    time.sleep(2.0 / SPEED)
    assert link.state()[1] > 1.5
    packets = len(logged(link, "state"))
    assert 1 < packets <= stub.packet_number + 1


def test_closing_turns_the_video_off_and_ends_the_reading(connect):
    link, stub = connect()
    link.close()
    assert stub.sent[-1] == "streamoff" and stub.reader.stopped and not link.watcher.is_alive()


ANSWERS = {
    "ok": ("ok", "made"),
    "in capitals": ("OK\r\n", "made"),
    "error": ("error Not joystick", "refused"),
    "out of range": ("out of range", "refused"),
    "neither yes nor no": ("forced stop", "unanswered"),
}


@pytest.mark.parametrize(("text", "outcome"), ANSWERS.values(), ids=ANSWERS)
def test_what_an_answer_says(connect, text, outcome):
    link, stub = connect({"right": [[(0.1, text)]]})
    answer = link.send("right 20", 7.0)
    assert (answer.outcome, answer.text) == (outcome, text.strip())
    assert stub.sent.count("right 20") == 1


def test_a_move_that_is_not_answered_is_sent_once(connect):
    link, stub = connect({"right": [[]]})
    assert link.send("right 20", 1.0).outcome == "unanswered"
    assert stub.sent.count("right 20") == 1


def test_a_late_number_is_no_answer_to_a_move(connect):
    """It belongs to an earlier question for the battery: the move is being made."""
    link, _ = connect({"right": [[(0.1, "87"), (1.0, "ok")]]})
    assert link.send("right 20", 7.0).outcome == "made"
    assert [stray["text"] for stray in logged(link, "stray answer")] == ["87"]


def test_a_late_ok_is_no_answer_to_a_question(connect):
    link, _ = connect({"battery?": [[(0.1, "ok"), (0.5, "87")]]})
    assert link.send("battery?", 2.0).text == "87"
    assert [stray["text"] for stray in logged(link, "stray answer")] == ["ok"]


def test_what_must_not_be_sent_any_more(connect):
    link, stub = connect()
    assert link.send("right 20", 7.0, lambda: True).outcome == "unanswered"
    assert "right 20" not in stub.sent


def test_resynchronising_collects_the_answers_to_all_its_questions(connect):
    """The first comes after the second was asked; a later question must not get it."""
    link, stub = connect({"battery?": [[(2.5, "87")], [(1.0, "86")]]})
    assert link.resynchronise(2.0)
    assert stub.sent.count("battery?") == 2
    assert link.send("battery?", 2.0).text == "87", "that of the stub, which is none of the late ones"
    assert not logged(link, "stray answer") and not stub.due


def test_resynchronising_ends(connect):
    link, stub = connect(lost={"battery?": 3})
    assert not link.resynchronise(1.0)
    assert stub.sent.count("battery?") == 3


def test_it_is_on_the_ground_once_its_motors_have_rested(connect):
    link, _ = connect()
    assert wait_for(link.on_ground), "it stands there"
    link.send("takeoff", 20.0)
    assert not link.on_ground()
    assert not wait_for(link.on_ground, 0.8), "its motors turn"
    link.send("land", 1.0)
    assert not link.on_ground(), "packets from before do not count"
    assert wait_for(link.on_ground)


def test_packets_that_come_late_and_at_once_are_no_rest(connect):
    link, stub = connect()
    assert wait_for(link.on_ground)
    stub.silent, link.speed = True, 1.0  # A burst is short, also on a busy machine.
    link.send("takeoff", 20.0)
    late = [dict(stub.packet) for _ in range(40)]  # Each is another object, which the link takes for a new packet.
    stub.get_current_state = lambda: late.pop(0) if len(late) > 1 else late[0]
    assert wait_for(lambda: len(late) == 1)
    assert not link.on_ground()


def test_packets_that_do_not_say_how_long_the_motors_turned_are_no_rest(connect):
    link, stub = connect()
    packet = stub.get_current_state

    def without_time():
        return {name: value for name, value in packet().items() if name != "time"}

    stub.get_current_state = without_time
    time.sleep(0.05)
    assert not wait_for(link.on_ground, 0.5)


def flight_over(link) -> Flight:
    """A flight over this link."""
    return Flight(link, lambda picture, mask: 0, tuple(MOVES), lambda image: [], "", Envelope(), Limits(), link.log)


def land(link) -> bool:
    """The end of a flight over this link."""
    flight = flight_over(link)
    flight.signals.landing = True
    return flight.land("a test")


@pytest.mark.parametrize("command", ["takeoff", "right"])
def test_a_link_that_dies_while_an_answer_is_awaited_ends_the_flight(connect, monkeypatch, command):
    """After five seconds, not after the 20 or 7 that the answer may take."""
    monkeypatch.setattr(flight_module, "MACHINE_SECONDS", 0.0)
    link, stub = connect({command: [[]]})
    assert wait_for(lambda: link.state()[1] < 1.0)
    stub.silent, began = True, stub.clock()
    flight, image = flight_over(link), np.zeros((48, 64, 3), np.uint8)
    with pytest.raises(Landing, match="link lost"):
        flight.take_off() if command == "takeoff" else flight.make(command, Picture(time.monotonic(), image, image))
    assert 3.5 < stub.clock() - began < 12.0, "5 where the machine is quick"
    assert "battery?" not in stub.sent


def test_a_lost_land_is_sent_again_soon(connect):
    link, stub = connect(lost={"land": 2})
    link.send("takeoff", 20.0)
    began = stub.clock()
    assert land(link) and stub.turning_since is None
    assert stub.clock() - began < 20.0, "seconds of the drone, 5 where the machine is quick; it was 13 for each"


def test_a_refused_land_is_no_landing(connect):
    """As a firmware may answer that begins to take off; it stood still just before."""
    link, stub = connect({"takeoff": [[]], "land": [[(0.0, "error")]] * 4})
    assert wait_for(link.on_ground)
    link.send("takeoff", 20.0, lambda: "takeoff" in stub.sent)  # Ctrl-C came.
    assert land(link) and stub.turning_since is None
