"""Fly the simulated drone with everything that may go wrong, and see that it lands, where, and what its log says.

    python benchmarks/fidelity/drone_faults.py --times 20 --out FOLDER

A flight is a process of `infogoal fly` whose policy goes to and fro. Its fault begins after one or two moves. The
script writes faults.json; `python -m infogoal_paper.pages drone --take FOLDER` puts it into docs/results/drone.json.xz
and the page. Flights that are in FOLDER already are not flown again. tests/drone/test_fly.py flies the same, fewer of
them.
"""

import argparse
import contextlib
import importlib.metadata
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

from infogoal_drone import records
from infogoal_drone.envelope import Envelope
from infogoal_drone.simulated_tello import SimulatedTello, Started, start
from infogoal_jax.report.statistics import describe_machine

SPEED = 4.0
ENVELOPE = Envelope(left=3, right=3, up=2, down=2)
START = (17, 4)
QUESTION = "Where is it?"
NOWHERE = "soccer ball"
"""An object that is out of view from everywhere in the envelope."""
FAR_AWAY = 1e9
ATTEMPTS = 3
"""Of a flight that landed before its fault came, as a busy machine may make it."""


class Fault(NamedTuple):
    """What goes wrong, and the words of which one must be in the log as the reason of the landing."""

    name: str
    words: tuple[str, ...]
    simulated: tuple[dict[str, Any], ...] = ()
    """Faults of the simulated drone."""
    act: str = ""
    """What is done to the program that flies, or to the drone, once it has moved twice."""
    landed_by: tuple[str, ...] = ("command land",)
    """What the drone may land by: by its firmware where commands do not arrive."""

    @property
    def moves(self) -> int:
        """After how many moves it begins."""
        return 2 if self.act else max(one["after"] for one in self.simulated)


STEPS_USED_UP = "steps are used up"
LATE = ("video stale", "video waiting")
"""On a machine that is too busy for the pace of the simulation the video stops before anything else does."""
LOST = ("never answered", "no longer answers", "link lost", "video torn", "video frozen", "its own landing", *LATE)
BY_ITSELF = "no command for 15 s"
FAULTS = (
    Fault("a tenth of the packets lost", (STEPS_USED_UP, *LOST), ({"kind": "loss", "after": 1, "share": 0.1},)),
    Fault(
        "half of the packets lost",
        (STEPS_USED_UP, *LOST),
        ({"kind": "loss", "after": 1, "share": 0.5},),
        landed_by=("command land", BY_ITSELF),
    ),
    Fault("link dead for 1 s", (STEPS_USED_UP, *LOST), ({"kind": "dead", "after": 2, "seconds": 1.0},)),
    Fault("link dead for good", LOST, ({"kind": "dead", "after": 2, "seconds": FAR_AWAY},), landed_by=(BY_ITSELF,)),
    Fault("frozen video", ("video frozen", *LATE), ({"kind": "frozen", "after": 2, "seconds": FAR_AWAY},)),
    Fault("black video", ("video black", *LATE), ({"kind": "black", "after": 2, "seconds": FAR_AWAY},)),
    Fault("a move refused", (STEPS_USED_UP,), ({"kind": "refuse", "after": 2, "answers": ["error"]},)),
    Fault("out of range", ("out of range",), ({"kind": "refuse", "after": 2, "answers": ["out of range"] * 9},)),
    Fault("battery at the floor", ("battery",), ({"kind": "battery", "after": 2, "percent": 24.0},)),
    Fault("program killed", (), act="SIGKILL", landed_by=(BY_ITSELF,)),
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
"""Flown by the tests alone."""


def write_policy(path: Path, values=(0.3, 0.4, 0.2, 0.1), objects=(NOWHERE,), size=(48, 64)) -> Path:
    """A policy whose actions always have these values, in the format of `infogoal export`."""
    about = {
        "format_version": 1,
        "task": "embodied_qa",
        "method": "to and fro",
        "actions": ["left", "right", "up", "down"],
        "code_size": 1,
        "samples_code": False,
        "generator_seed": 0,
        "goal_names": [QUESTION],
        "goal_objects": list(objects),
    }
    kinds = [[[*size, 3], "uint8"], [[384], "float32"], [[1], "float32"]]
    program = {"constants": 1, "inputs": [[1, 2, 3], kinds], "operations": [], "outputs": [0]}
    np.savez(
        path,
        about=json.dumps(about),
        program=json.dumps(program),
        goals=np.zeros((1, 384), np.float32),
        constant_0=np.array(values, np.float32),
    )
    return path


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
    """The truth about the drone, once the condition on it holds, or after so many seconds."""
    end = time.monotonic() + seconds
    while not condition(truth := drone.ask("truth")) and time.monotonic() < end:
        time.sleep(0.05)
    return truth


def disturb(fault: Fault, process: subprocess.Popen, drone: Started, came: threading.Event, stop: threading.Event):
    """Do to a flight what the fault says, once the drone has moved. came: is set if the flight had not ended by then;
    stop: ends it."""
    truth = wait_for(drone, lambda truth: truth["moves"] >= fault.moves or process.poll() is not None, 100)
    if truth["moves"] < fault.moves or process.poll() is not None:
        return
    came.set()
    if not fault.act:
        return
    if fault.act != "controller":
        for name in fault.act.split():
            with contextlib.suppress(ProcessLookupError):  # It may have ended by itself.
                os.killpg(process.pid, getattr(signal, name))
            time.sleep(0.1)
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        while not stop.is_set():
            other.sendto(b"up 20", ("127.0.0.1", drone.port))
            stop.wait(1.0 / SPEED)


def phase_at_end(folder: Path, process: subprocess.Popen, drone: Started, seconds: float) -> str:
    """What the drone does when the log of a flight says how it ended; "" if it does not within so many seconds."""
    log, end = folder / records.NAME, time.monotonic() + seconds
    while time.monotonic() < end:
        ended = process.poll() is not None
        if log.exists() and b'"event": "end"' in log.read_bytes()[-5000:]:
            return drone.ask("truth")["phase"]
        if ended:
            break
        time.sleep(0.05)
    return ""


def fly_once(fault: Fault, folder: Path, policy: Path, drone: Started, seed: int) -> dict[str, Any]:
    """A flight with this fault, and what came of it:

    came: whether the drone flew until the fault began; on_ground, inside: whether it ended on the ground, and stayed
    inside of the envelope; farthest: to the side and up or down, cm; reason: of the landing, in the log; explained:
    whether that is the fault's, the drone landed by what it had to, and was on the ground when the log said so, where
    the link lived; load: processes that wanted to run in the last minute, on average.
    """
    ports = free_ports()
    drone.restart(settings(ports, seed, fault.simulated))
    process = begin_flight(folder, policy, drone, ports, seed, "--steps", "6")
    came, stop = threading.Event(), threading.Event()
    disturbance = threading.Thread(target=disturb, args=(fault, process, drone, came, stop))
    disturbance.start()
    try:
        phase = phase_at_end(folder, process, drone, 120)
        process.communicate(timeout=20)
        ended = True
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        ended = False
    finally:
        stop.set()
        disturbance.join()
    truth = wait_for(drone, lambda truth: truth["phase"] == "ground", 20)
    far, farthest = ENVELOPE.centimetres(), [round(100 * one) for one in truth["farthest"]]
    ends = records.events_of(records.read(folder / records.NAME), "end") if (folder / records.NAME).exists() else []
    reason = ends[-1]["reason"] if ends else ""
    if fault.act == "SIGKILL":
        explained = not ends
    elif fault.landed_by == (BY_ITSELF,):
        explained = ended and bool(ends) and not ends[-1]["landed"]
    else:
        explained = ended and bool(ends) and ends[-1]["landed"] and phase == "ground"
    explained = explained and truth["why_landed"] in fault.landed_by
    explained = explained and (not ends or any(words in reason for words in fault.words))
    return {
        "fault": fault.name,
        "seed": seed,
        "came": came.is_set(),
        "on_ground": truth["phase"] == "ground" and not truth["crashed"],
        "inside": farthest[0] <= max(far["left"], far["right"]) and farthest[1] <= max(far["up"], far["down"]),
        "farthest": farthest,
        "reason": reason,
        "why_landed": truth["why_landed"],
        "explained": explained,
        "load": os.getloadavg()[0],
    }


def fly_with(fault: Fault, folder: Path, policy: Path, drone: Started, seed: int) -> list[dict[str, Any]]:
    """What came of a flight with this fault, and of those before it that ended before the fault came."""
    found = []
    while not found or (not found[-1]["came"] and len(found) < ATTEMPTS):
        found.append(fly_once(fault, folder / f"{seed:02d}_{len(found)}", policy, drone, seed))
    return found


def broken(flights: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The flights that did not keep a promise: those before the last ended before their fault came."""
    return [
        flight
        for flight in flights
        if not (flight["on_ground"] and flight["inside"]) or (flight is flights[-1] and not flight["explained"])
    ]


def conditions() -> dict[str, Any]:
    """Machine and versions in words, and the pace of the simulation."""
    versions = [f"{name} {importlib.metadata.version(name)}" for name in ("djitellopy", "av")]
    return {"machine": f"{', '.join(versions)}, {describe_machine()}", "speed": SPEED}


def main() -> None:
    """Fly every fault so many times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=20, help="flights with each fault")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # As in a shell's background, and flights would inherit it.
        signal.signal(signal.SIGINT, signal.default_int_handler)
    policy, drone = write_policy(options.out / "policy.npz"), start(settings((0, 0, 0)))
    flights = []
    try:
        for seed in range(options.times):
            for fault in FAULTS:
                folder = options.out / fault.name.replace(" ", "_")
                kept = folder / f"{seed:02d}.json"
                if not kept.exists():
                    folder.mkdir(exist_ok=True)
                    kept.write_text(json.dumps(fly_with(fault, folder, policy, drone, seed)))
                found = json.loads(kept.read_text())
                flights += found
                print(fault.name, seed, found[-1]["reason"], broken(found) or "", file=sys.stderr, flush=True)
    finally:
        drone.stop()
    (options.out / "faults.json").write_text(json.dumps(conditions() | {"flights": flights}, indent=0) + "\n")


if __name__ == "__main__":
    main()
