"""Flights for tests: a policy that goes to and fro, a simulated drone, faults, and what must be true after each of
them."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from infogoal_jax.drone import log
from infogoal_jax.drone.envelope import Envelope
from infogoal_jax.drone.simulated_tello import SimulatedTello, Started

SPEED = 4.0
ENVELOPE = Envelope(left=3, right=3, up=2, down=2)
START = (17, 4)
QUESTION = "Where is nothing?"
NOWHERE = "nothing"
FAR_AWAY = 1e9
NOT_TRIED = "it landed before the fault came, as a busy machine may make it"


def write_policy(path: Path, values=(0.3, 0.4, 0.2, 0.1), objects=(NOWHERE,), size=(48, 64)) -> Path:
    """A policy whose actions always have these values, in the format of `infogoal export`."""
    about = {
        "task": "embodied_qa",
        "method": "to and fro",
        "actions": ["left", "right", "up", "down"],
        "code_size": 1,
        "samples_code": False,
        "generator_seed": 0,
        "goal_names": [QUESTION],
        "goal_objects": list(objects),
    }
    kinds = [[[*size, 3], "uint8"], [[4], "float32"], [[1], "float32"]]
    program = {"constants": 1, "inputs": [[1, 2, 3], kinds], "operations": [], "output": 0}
    np.savez(
        path,
        about=json.dumps(about),
        program=json.dumps(program),
        goals=np.zeros((1, 4), np.float32),
        constant_0=np.array(values, np.float32),
    )
    return path


class Fault(NamedTuple):
    """What goes wrong, and one of the words by which the log must say why the flight ended."""

    name: str
    words: tuple[str, ...]
    simulated: tuple[dict[str, Any], ...] = ()
    """Faults of the simulated drone."""
    act: str = ""
    """What is done to the program that flies, or to the drone, once it has moved twice."""


STEPS_USED_UP = "steps are used up"
LATE = ("video stale", "video waiting")
"""On a machine that is too busy for the pace of the simulation the video stops before anything else does."""
LOST = ("never answered", "no longer answers", "link lost", "video torn", "video frozen", "its own landing", *LATE)
FAULTS = (
    Fault("a tenth of the packets lost", (STEPS_USED_UP, *LOST), ({"kind": "loss", "after": 1, "share": 0.1},)),
    Fault("half of the packets lost", (STEPS_USED_UP, *LOST), ({"kind": "loss", "after": 1, "share": 0.5},)),
    Fault("link dead for 1 s", (STEPS_USED_UP, *LOST), ({"kind": "dead", "after": 2, "seconds": 1.0},)),
    Fault("link dead for good", LOST, ({"kind": "dead", "after": 2, "seconds": FAR_AWAY},)),
    Fault("frozen video", ("video frozen", *LATE), ({"kind": "frozen", "after": 2, "seconds": FAR_AWAY},)),
    Fault("black video", ("video black", *LATE), ({"kind": "black", "after": 2, "seconds": FAR_AWAY},)),
    Fault("a move refused", (STEPS_USED_UP,), ({"kind": "refuse", "after": 2, "answers": ["error"]},)),
    Fault("out of range", ("out of range",), ({"kind": "refuse", "after": 2, "answers": ["out of range"] * 9},)),
    Fault("battery at the floor", ("battery",), ({"kind": "battery", "after": 2, "percent": 24.0},)),
    Fault("program killed", (), act="SIGKILL"),
    Fault("Ctrl-C", ("interrupted",), act="SIGINT"),
    Fault("two controllers", ("another controller", "were refused"), act="controller"),
)
MORE_FAULTS = (
    Fault("torn video", ("video torn", *LATE), ({"kind": "torn", "after": 2, "seconds": FAR_AWAY},)),
    Fault("no more video", ("video stale",), ({"kind": "stopped", "after": 2, "seconds": FAR_AWAY},)),
    Fault("end of the terminal", ("interrupted",), act="SIGHUP"),
    Fault("polite kill", ("interrupted",), act="SIGTERM"),
    Fault("Ctrl-C three times", ("interrupted",), act="SIGINT SIGINT SIGINT"),
)
"""Beyond those that were asked for."""


def free_ports() -> tuple[int, int, int]:
    """Three UDP ports that nobody holds."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(3)]
        for one in sockets:
            one.bind(("", 0))
        return tuple(one.getsockname()[1] for one in sockets)


def settings(ports: tuple[int, int, int], seed: int = 0, faults=(), speed: float = SPEED, **others) -> SimulatedTello:
    """A simulated drone that hovers at `START` and sends to these ports."""
    first = (0.5 + 0.2 * START[0], 0.4 + 0.2 * START[1])
    _, state_port, video_port = ports
    return SimulatedTello(
        **({"first": first} | others),
        seed=seed, speed=speed, faults=tuple(faults), state_port=state_port, video_port=video_port,
    )  # fmt: skip


def begin_flight(folder: Path, policy: Path, drone: Started, ports, seed: int = 0, *more: str) -> subprocess.Popen:
    """`infogoal fly` in a process of its own, on a simulated drone that runs."""
    words = [f"--{name}={steps}" for name, steps in vars(ENVELOPE).items()]
    command = [
        sys.executable, "-m", "infogoal_jax", "fly", str(policy), "--question", QUESTION, "--simulate",
        "--simulated", str(drone.port), str(drone.truth_port), "--ports", *map(str, ports), "--out", str(folder),
        "--seed", str(seed), "--speed", str(SPEED), "--start", *map(str, START), *words, *more,
    ]  # fmt: skip
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )


def wait_for(drone: Started, condition, seconds: float) -> dict[str, Any]:
    """The truth about the drone, once the condition on it holds. Raises `AssertionError` after so many seconds."""
    end = time.monotonic() + seconds
    while not condition(truth := drone.ask("truth")):
        assert time.monotonic() < end, truth
        time.sleep(0.05)
    return truth


def disturb(act: str, process: subprocess.Popen, drone: Started, stop: threading.Event) -> None:
    """Do to a flight what the fault says, once the drone has moved twice."""
    if not act:
        return
    wait_for(drone, lambda truth: truth["moves"] >= 2 or process.poll() is not None, 60)
    if act != "controller":
        for name in act.split():
            with contextlib.suppress(ProcessLookupError):  # It may have ended by itself.
                os.killpg(process.pid, getattr(signal, name))
            time.sleep(0.1)
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        while not stop.is_set():
            other.sendto(b"up 20", ("127.0.0.1", drone.port))
            stop.wait(1.0 / SPEED)


def fly_with(fault: Fault, folder: Path, policy: Path, drone: Started, seed: int) -> list[str]:
    """A flight with this fault. Returns what of the promises was not kept, in words: on the ground, inside of the
    envelope, and the log says why."""
    ports = free_ports()
    drone.restart(settings(ports, seed, fault.simulated))
    process, stop = begin_flight(folder, policy, drone, ports, seed, "--steps", "6"), threading.Event()
    disturbance = threading.Thread(target=disturb, args=(fault.act, process, drone, stop))
    disturbance.start()
    try:
        output, _ = process.communicate(timeout=120)
        truth = wait_for(drone, lambda truth: truth["phase"] == "ground", 20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return ["the program did not end"]
    finally:
        stop.set()
        disturbance.join()
    broken = []
    if truth["crashed"]:
        broken.append("the motors stopped in the air")
    far, (sideways, upwards) = ENVELOPE.centimetres(), (100 * one for one in truth["farthest"])
    if sideways > max(far["left"], far["right"]) or upwards > max(far["up"], far["down"]):
        broken.append(f"it was {sideways:.0f} and {upwards:.0f} cm away")
    if not broken and truth["moves"] < max([2 if fault.act else 0, *(one["after"] for one in fault.simulated)]):
        return [NOT_TRIED]
    events = log.read(folder / log.NAME)
    ends = log.events_of(events, "end")
    if fault.act == "SIGKILL":
        if ends or truth["why_landed"] != "no command for 15 s":
            broken.append(f"after a kill: {ends}, {truth['why_landed']}")
    elif not ends:
        broken.append(f"the log has no end: {output}")
    elif not any(words in ends[-1]["reason"] for words in fault.words):
        broken.append(f"the log says {ends[-1]['reason']!r}")
    elif not ends[-1]["landed"] and fault.name != "link dead for good":
        broken.append("the log does not say that it landed")
    return broken
