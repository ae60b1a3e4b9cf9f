"""The link to a Tello through djitellopy, which is used as it is published: commands, state and video.

Commands are sent once and never again behind the caller's back: djitellopy's own retries would make a move twice whose
answer got lost. Nothing keeps the drone awake either: if this program hangs, the firmware lands after 15 s.
"""

import logging
import math
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from infogoal_drone.records import Log
from infogoal_drone.vision import Picture, reduced
from infogoal_jax.errors import UserError

INSTALL = "pip install 'infogoal-jax[drone]' && pip install --no-deps djitellopy==2.5.0"
POLL_SECONDS = 0.004
"""Between two looks at what djitellopy received."""
KEPT_SECONDS = 4.0
"""How long pictures are kept."""
NO_IMAGE_YET = (300, 400)
"""Height and width of what djitellopy gives before the first image of the video, which has another size."""
SPACING_SECONDS = 0.1
"""Between an answer and the next command, as djitellopy has it: a Tello may not hear what comes at once."""
LEAST_SECONDS = 0.5
"""Of this machine, for which an answer is waited for at least, however fast a simulation is."""
REFUSALS = ("error", "out of range")
"""How the answers begin that say that a command is not obeyed."""
PACKETS_AT_REST, REST_SECONDS = 25, 2.0
"""State packets in a row, ten a second, whose time of the motors, in whole seconds, is the same where these rest; and
between the first and the last of them, so that late packets which come at once do not count."""


class Address(NamedTuple):
    """Where the drone takes commands, and the ports of this machine that it sends to."""

    host: str = "192.168.10.1"
    port: int = 8889
    local_ports: tuple[int, int, int] = (8889, 8890, 11111)
    """For answers, state and video; a Tello knows no others."""


class Answer(NamedTuple):
    """What came of a command.

    outcome: made, refused or unanswered.
    text: of the answer.
    sent, received: s.
    """

    outcome: str
    text: str
    sent: float
    received: float


def outcome_of(text: str) -> str:
    """What an answer says: a number answers a query. What is neither yes nor no leaves open what the drone does."""
    if text.lower() == "ok" or text.isdigit():
        return "made"
    return "refused" if text.lower().startswith(REFUSALS) else "unanswered"


def import_djitellopy():
    """The class Tello. Raises `UserError` if the libraries are not installed."""
    try:
        from djitellopy import Tello
    except ImportError as error:
        raise UserError(f"flying needs djitellopy and its libraries ({error}): {INSTALL}") from error
    return Tello


def check_ports(ports: tuple[int, int, int]) -> None:
    """Raise `UserError` if another program holds one of the ports: it may be flying the drone."""
    for port in ports:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
            try:
                trial.bind(("", port))
            except OSError as error:
                raise UserError(
                    f"port {port} of this machine is taken ({error.strerror}): another program controls the drone; "
                    "end it first"
                ) from error


class Link:
    """A drone that answers. `connect` first; then `send`, `state` and `pictures`.

    speed: simulated seconds in a second; durations are given in seconds of the drone.
    """

    def __init__(self, address: Address, size: tuple[int, int], log: Log, speed: float = 1.0):
        self.address, self.size, self.log, self.speed = address, size, log, speed
        self.recent: deque[Picture] = deque()
        self.state_packet: dict[str, Any] = {}
        self.state_time, self.running = -math.inf, False
        self.motor_time, self.at_rest = -1, deque(maxlen=PACKETS_AT_REST)
        self.tello = self.reader = self.watcher = None
        self.last_command, self.command_time, self.last_answer = "", 0.0, 0.0

    def connect(self, give_up: Callable[[], bool] = lambda: False) -> None:
        """Enter the SDK mode, turn the video on and begin to watch. Raises `UserError` where the drone does not
        answer."""
        tello_class = import_djitellopy()
        check_ports(self.address.local_ports)
        tello_class.LOGGER.setLevel(logging.CRITICAL)  # The log of the flight says it all.
        tello_class.CONTROL_UDP_PORT, tello_class.STATE_UDP_PORT, video_port = self.address.local_ports
        self.tello = tello_class(host=self.address.host, retry_count=1, vs_udp=video_port)
        self.tello.address = (self.address.host, self.address.port)
        for command in ("command", "streamon"):  # Either may be sent again: nothing moves.
            answers = [self.send(command, 2.0, give_up)]
            while answers[-1].outcome != "made" and len(answers) < 5 and not give_up():
                answers.append(self.send(command, 2.0, give_up))
            if answers[-1].outcome != "made":
                raise UserError(
                    f"drone = {self.address.host}: {command!r} was not answered with ok ({answers[-1].text}): turn it "
                    "on, join its Wi-Fi, and let the firewall pass UDP ports "
                    f"{', '.join(map(str, self.address.local_ports))}"
                )
        self.running = True
        self.watcher = threading.Thread(target=self.watch, daemon=True)
        self.watcher.start()
        try:
            self.reader = self.tello.get_frame_read()
        except Exception as error:  # djitellopy and PyAV raise many kinds; the drone is on the ground.
            raise UserError(
                f"drone = {self.address.host}: no video on port {video_port} ({error}): let the firewall pass it, and "
                "turn the drone off and on"
            ) from error

    def watch(self) -> None:
        """Note every image and every state packet when it arrives."""
        last_frame, last_state = None, None
        while self.running:
            now = time.monotonic()
            state = self.tello.get_current_state()
            if state is not last_state and state:
                last_state = state
                if state.get("time") != self.motor_time or state.get("vgz") != 0:
                    self.at_rest.clear()
                self.at_rest.append(now)
                self.motor_time = state.get("time", -1)  # A packet that does not say so shows no rest.
                self.state_packet, self.state_time = state, now
                self.log.write("state", now, packet=state)
            frame = self.reader.frame if self.reader is not None else None
            if frame is not None and frame is not last_frame and frame.shape[:2] != NO_IMAGE_YET:
                last_frame = frame
                self.recent.append(Picture(now, reduced(frame, self.size), frame))
                self.log.write("image", now)
                while self.recent[0].time < now - KEPT_SECONDS / self.speed:
                    self.recent.popleft()
            time.sleep(POLL_SECONDS)

    def send(self, command: str, seconds: float, give_up: Callable[[], bool] = lambda: False) -> Answer:
        """Send a command once and wait for its answer, `seconds` of the drone at most. Where `give_up` says so before
        it is sent, it is not."""
        while self.waiting:
            self.log.write("stray answer", text=self.waiting.pop(0).decode("utf-8", "replace"))
        time.sleep(max(0.0, self.last_answer + SPACING_SECONDS / self.speed - time.monotonic()))
        sent = time.monotonic()
        if give_up():
            self.log.write("note", text=f"{command} is not sent any more")
            return Answer("unanswered", "", sent, sent)
        if command != self.last_command:  # A `land` that is sent again moves nothing that rests.
            self.last_command, self.command_time = command, sent
        self.log.write("command", sent, command=command)
        try:
            self.tello.send_command_without_return(command)
            text = self.receive(command.endswith("?"), self.deadline(sent, seconds), give_up)
        except OSError as error:  # The network is gone, which is one way not to be answered.
            self.log.write("note", text=f"{command} could not be sent: {error}")
            text = ""
        received = self.last_answer = time.monotonic()
        outcome = outcome_of(text)
        self.log.write("answer", received, command=command, outcome=outcome, text=text)
        return Answer(outcome, text, sent, received)

    def deadline(self, sent: float, seconds: float) -> float:
        """Until when the answer to what was sent then is waited for."""
        return sent + max(LEAST_SECONDS, seconds / self.speed)

    def receive(self, number: bool, end: float, give_up: Callable[[], bool]) -> str:
        """Wait for an answer until `end`. Returns its text, "" for none. number: of a query, or else of a command; the
        other kind is the late answer to something else."""
        while True:
            while self.waiting:
                text = self.waiting.pop(0).decode("utf-8", "replace").strip()
                if text.isdigit() == number:
                    return text
                self.log.write("stray answer", text=text)
            if time.monotonic() > end or give_up():
                return ""
            time.sleep(POLL_SECONDS)

    @property
    def waiting(self) -> list[bytes]:
        """The answers that came and were not looked at."""
        return self.tello.get_own_udp_object()["responses"]

    def resynchronise(self, seconds: float, give_up: Callable[[], bool] = lambda: False) -> bool:
        """After a missing answer: ask for the battery until a number comes, so that a late "ok" is not taken for the
        answer to the next command. Returns whether one came."""
        for earlier in range(3):
            answer = self.send("battery?", seconds, give_up)
            if answer.outcome == "made":
                for _ in range(earlier):  # The answers to the earlier questions may be under way.
                    self.receive(True, self.deadline(answer.sent, seconds), give_up)
                return True
            if give_up():
                return False
        return False

    def state(self) -> tuple[dict[str, Any], float]:
        """The last state packet, {} before the first, and its age in seconds of the drone."""
        return self.state_packet, (time.monotonic() - self.state_time) * self.speed

    def pictures(self) -> list[Picture]:
        """The pictures of the last seconds, oldest first."""
        return list(self.recent)

    def on_ground(self) -> bool:
        """Whether the drone says that its motors rest: its last packets, all of which came after the last command, have
        the same time of the motors, and it does not sink."""
        times = list(self.at_rest)
        if len(times) < PACKETS_AT_REST or times[0] <= self.command_time:
            return False
        return (times[-1] - times[0]) * self.speed > REST_SECONDS and self.state()[1] < 1.0

    def close(self) -> None:
        """Stop watching and turn the video off. The reader ends first, while images still come: it looks whether it
        shall end only when one arrives."""
        self.running = False
        if self.watcher is not None:
            self.watcher.join()
        if self.reader is not None:
            self.reader.stop()
            self.reader.worker.join(timeout=0.5)
        if self.tello is not None:
            self.send("streamoff", 1.0)
