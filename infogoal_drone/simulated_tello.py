"""A Tello that is simulated in a process of its own and speaks the SDK over UDP: commands, state and video.

`start(SimulatedTello(...))` starts it on this machine. A second port, which no Tello has, answers questions of the
detector and of tests in JSON: what is in view, where the drone truly is, and whether it landed.
"""

import contextlib
import dataclasses
import json
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from typing import Any

import numpy as np

from infogoal_drone.simulated_drone import DIRECTIONS, Body, Camera, Encoder, VideoFaults
from infogoal_jax.errors import UserError

STATE_RATE = 10
"""State packets a second."""
ALONE_SECONDS = 60.0
"""On the ground it ends by itself after so long without a command or a question, in real seconds."""


@dataclasses.dataclass(frozen=True)
class SimulatedTello:
    """Where it flies, what goes wrong, and where the program that flies it listens."""

    first: tuple[float, float] = (4.0, 1.2)
    """Where it hovers after it took off, m in the shelf's frame."""
    shelf_seed: int = 0
    """Seed of the generated shelf."""
    seed: int = 0
    """Of drift, roll, blur and errors of moves."""
    speed: float = 1.0
    """Simulated seconds in a second."""
    frames_per_second: int = 30
    """Images a real second."""
    battery: float = 87.0
    """Per cent at the start."""
    faults: tuple[dict[str, Any], ...] = ()
    """{"kind": ..., "after": moves, ...}: what goes wrong after so many moves were made. Kinds are loss (share), dead
    (seconds), frozen, black, torn and stopped video (seconds), refuse (answers) and battery (per cent)."""
    state_port: int = 8890
    """Port of the program to which state packets go."""
    video_port: int = 11111
    """Port of the program to which the video goes."""
    gathered: bool = False
    """Whether the objects of a region stand together on the shelf."""


@dataclasses.dataclass(frozen=True)
class Started:
    """A simulated drone that runs. port: for commands; truth_port: for questions."""

    process: subprocess.Popen
    port: int
    truth_port: int

    def ask(self, question: str) -> dict[str, Any]:
        """What the drone's second port answers. Raises `UserError` if nothing answers."""
        return ask(self.truth_port, question)

    def restart(self, settings: SimulatedTello) -> None:
        """Begin anew with these settings; shelf and rate of images stay as they are, which saves drawing the shelf."""
        self.ask(json.dumps(dataclasses.asdict(settings)))

    def stop(self) -> None:
        """End the process."""
        self.process.terminate()
        self.process.wait()
        self.process.stdout.close()


def ask(truth_port: int, question: str) -> dict[str, Any]:
    """The answer of a simulated drone to a question: boxes, truth. Raises `UserError` if nothing answers."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.settimeout(1.0)
        for _ in range(3):
            asking.sendto(question.encode(), ("127.0.0.1", truth_port))
            try:
                return json.loads(asking.recv(65_535))
            except (TimeoutError, ConnectionRefusedError):
                continue
    raise UserError(f"simulated drone = port {truth_port}: does not answer; its process has ended")


def start(settings: SimulatedTello) -> Started:
    """Start a simulated drone. Its process has a session of its own: Ctrl-C in the terminal does not reach it, as it
    does not reach a drone."""
    command = [sys.executable, "-m", "infogoal_drone.simulated_tello", json.dumps(dataclasses.asdict(settings))]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    line = process.stdout.readline()
    if not line:
        raise UserError(f"simulated drone: its process ended at once with status {process.wait()}; its error is above")
    return Started(process, **json.loads(line))


class Process:
    """The simulated drone's sockets and clock around its body and camera."""

    def __init__(self, settings: SimulatedTello):
        self.camera = Camera(settings.shelf_seed, np.random.default_rng([settings.seed, 2]), settings.gathered)
        self.commands, self.truth = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self.out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        for one in (self.commands, self.truth, self.out):
            one.bind(("127.0.0.1", 0))
        self.lock, self.running = threading.Lock(), True
        self.last_heard = time.monotonic()
        self.restart(settings)

    def restart(self, settings: SimulatedTello) -> None:
        """A new flight before the same shelf: a fresh battery, no client, and these faults."""
        self.settings, self.random = settings, np.random.default_rng([settings.seed, 1])
        self.body = Body(np.array(settings.first), np.random.default_rng([settings.seed, 0]), settings.battery)
        self.video_faults, self.began = VideoFaults(), time.monotonic()
        self.client: str | None = None
        self.awaiting: list[tuple[Any, str]] = []
        self.streaming, self.next_state = False, 0.0
        self.moves, self.loss, self.dead_until = 0, 0.0, -1.0
        self.faults = [dict(fault) for fault in settings.faults]
        self.begin_faults()

    def now(self) -> float:
        """Simulated seconds since the start."""
        return (time.monotonic() - self.began) * self.settings.speed

    def lost(self) -> bool:
        """Whether a packet is lost now."""
        return self.now() < self.dead_until or self.random.random() < self.loss

    def begin_faults(self) -> None:
        """Begin the faults whose moves have been made."""
        for fault in [fault for fault in self.faults if self.moves >= fault["after"]]:
            self.faults.remove(fault)
            kind, seconds = fault["kind"], fault.get("seconds") or np.inf
            if kind == "loss":
                self.loss = fault["share"]
            elif kind == "dead":
                self.dead_until = self.now() + seconds
            elif kind == "refuse":
                self.body.refusals += fault["answers"]
            elif kind == "battery":
                self.body.battery = fault["percent"]
            else:
                self.video_faults.kind, self.video_faults.until = kind, self.now() + seconds

    def receive_command(self) -> None:
        """Take a packet from the command port and answer it, now or when the motion has ended."""
        data, sender = self.commands.recvfrom(1024)
        self.last_heard = time.monotonic()
        if self.lost():
            return
        command = data.decode("utf-8", "replace").strip()
        if self.client is None:
            if command != "command":
                return
            self.client = sender[0]
        if command == "streamon":
            self.streaming = True
        if command == "streamoff":
            self.streaming = False
        answer = self.body.obey(command, self.now())
        if answer:
            self.reply(sender, answer)
        else:
            self.awaiting.append((sender, command))

    def reply(self, receiver, answer: str) -> None:
        """Send an answer, unless it is lost."""
        if not self.lost():
            self.commands.sendto(answer.encode(), receiver)

    def finish_motions(self) -> None:
        """Answer the commands whose motion has ended: one that a landing cut off is refused."""
        if self.body.motion is not None and self.body.phase != "landing":
            return
        waiting, self.awaiting = self.awaiting, []
        for sender, command in waiting:
            if command == "land" and self.body.in_air:
                self.awaiting.append((sender, command))
            elif command.split()[0] in (*DIRECTIONS, "takeoff") and self.body.phase == "landing":
                self.reply(sender, "error Auto land")
            else:
                self.reply(sender, "ok")
                if command.split()[0] in DIRECTIONS:
                    self.moves += 1
                    self.begin_faults()

    def answer_question(self) -> None:
        """Answer a question on the second port."""
        data, sender = self.truth.recvfrom(65_535)
        self.last_heard = time.monotonic()
        question, body = data.decode(), self.body
        if question.startswith("{"):
            self.restart(settings_of(question))
            answer = {}
        elif question == "boxes":
            answer = self.camera.boxes(body.position, body.roll) if body.phase == "hovering" else {}
        else:
            answer = {
                "phase": body.phase,
                "position": body.position.tolist(),
                "height": float(body.position[1] - body.ground),
                "farthest": body.farthest.tolist(),
                "why_landed": body.why_landed,
                "crashed": body.crashed,
                "moves": self.moves,
                "battery": body.battery,
                "flight_seconds": body.flight_seconds,
            }
        self.truth.sendto(json.dumps(answer).encode(), sender)

    def run(self) -> None:
        """Serve until the process is ended, or nobody asks any more and the drone is on the ground."""
        video = threading.Thread(target=self.stream, daemon=True)
        video.start()
        while self.running:
            for ready in select.select([self.commands, self.truth], [], [], 0.005)[0]:
                with self.lock:
                    self.receive_command() if ready is self.commands else self.answer_question()
            with self.lock:
                self.body.advance(self.now())
                self.finish_motions()
                if self.client is not None and self.now() >= self.next_state:
                    self.next_state = self.now() + 1 / STATE_RATE
                    if not self.lost():
                        self.out.sendto(self.body.state().encode(), (self.client, self.settings.state_port))
            if not self.body.in_air and time.monotonic() - self.last_heard > ALONE_SECONDS:
                break
        self.running = False
        video.join()  # A thread that encodes while the process ends aborts it.

    def stream(self) -> None:
        """Stream the video while it is on."""
        encoder = Encoder(self.settings.frames_per_second)
        following = time.monotonic()
        while self.running:
            following = max(following + 1 / self.settings.frames_per_second, time.monotonic())
            time.sleep(max(following - time.monotonic(), 0))
            with self.lock:
                streaming, receiver = self.streaming, (self.client, self.settings.video_port)
                position, roll, in_air = self.body.position, self.body.roll, self.body.in_air
            if not streaming:
                continue
            image = self.video_faults.spoil(self.camera.see(position, roll, in_air), self.now())
            for packet in [] if image is None else encoder.packets(image):
                if not self.lost():
                    # A full buffer loses the packet, as a radio would.
                    with contextlib.suppress(BlockingIOError, ConnectionRefusedError):
                        self.out.sendto(packet, receiver)


def settings_of(words: str) -> SimulatedTello:
    """The settings that are written down in JSON."""
    settings = json.loads(words)
    return SimulatedTello(**(settings | {"first": tuple(settings["first"]), "faults": tuple(settings["faults"])}))


def main() -> None:
    """Run the simulated drone of the JSON argument; the first line that it prints names its ports."""
    simulated = Process(settings_of(sys.argv[1]))

    def end(number, frame):
        simulated.running = False

    signal.signal(signal.SIGTERM, end)
    ports = {"port": simulated.commands.getsockname()[1], "truth_port": simulated.truth.getsockname()[1]}
    print(json.dumps(ports), flush=True)
    simulated.run()


if __name__ == "__main__":
    main()
