"""`infogoal fly` over the real protocol: djitellopy as it is published, a simulated Tello in a process of its own.

In two hundred and more flights in which something goes wrong the drone ends on the ground, inside of its envelope, and
the log says why; and a trained policy answers as many test questions as in the evaluation inside of the program.
"""

import json
import os
import subprocess
import sys

import flights
import pytest
from places import ROOT

pytest.importorskip("djitellopy", reason="needs the extra drone and djitellopy (docs/drone.md)")
pytest.importorskip("av", reason="needs the extra drone and djitellopy (docs/drone.md)")

from infogoal_jax.data import frames_import
from infogoal_jax.drone import log, simulated_tello
from infogoal_jax.drone.recording import TABLE

TIMES, ATTEMPTS = 20, 3
NAMES = {fault.name: fault for fault in (*flights.FAULTS, *flights.MORE_FAULTS)}
FLIGHTS, WITHIN = 100, 0.05
SCRIPT = ROOT / "benchmarks" / "fidelity" / "drone_flights.py"


@pytest.fixture(scope="module")
def drone():
    """A simulated Tello."""
    started = simulated_tello.start(flights.settings((0, 0, 0)))
    yield started
    started.stop()


def fly(drone, folder, policy, *more, **settings):
    """A flight to its end: its output, its log and the truth about the drone."""
    ports = flights.free_ports()
    drone.restart(flights.settings(ports, **settings))
    process = flights.begin_flight(folder / "flight", policy, drone, ports, 0, *more)
    output, _ = process.communicate(timeout=120)
    truth = flights.wait_for(drone, lambda truth: truth["phase"] == "ground", 20)
    return process.returncode, output, log.read(folder / "flight" / log.NAME), truth


def test_it_finds_the_object_lands_and_leaves_a_recording(drone, tmp_path):
    """The alarm clock of the generated shelf is wholly in view from the second or third place to the right."""
    policy = flights.write_policy(tmp_path / "policy.npz", objects=["alarm clock"])
    first, recordings = (0.5 + 0.2 * 31, 0.4 + 0.2 * 8), tmp_path / "recordings"
    code, output, events, truth = fly(drone, tmp_path, policy, "--record", str(recordings), first=first)
    (end,) = log.events_of(events, "end")
    assert code == 0 and end["found"] and end["landed"], output
    assert (truth["phase"], truth["crashed"], truth["why_landed"]) == ("ground", False, "command land")
    steps = log.events_of(events, "step")
    assert [step["move"] for step in steps] == ["right"] * len(steps) and 1 <= len(steps) <= 3
    data = frames_import.import_folder(recordings, recordings / TABLE, tmp_path / "mine.npz", size=(48, 64))
    assert len(data.frame) == len(steps) and data.objects == ("alarm clock",) and data.detected[-1, 0]


def test_ctrl_c_lands(drone, tmp_path):
    """While it flies, from a terminal."""
    policy = flights.write_policy(tmp_path / "policy.npz")
    fault = next(fault for fault in flights.FAULTS if fault.name == "Ctrl-C")
    assert flights.fly_with(fault, tmp_path / "flight", policy, drone, 0) == []


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_every_flight_with_this_fault_ends_on_the_ground(drone, tmp_path, name):
    policy = flights.write_policy(tmp_path / "policy.npz")
    found = {}
    for seed in range(TIMES):
        for attempt in range(ATTEMPTS):
            folder = tmp_path / f"flight_{seed}_{attempt}"
            found[seed] = flights.fly_with(NAMES[name], folder, policy, drone, seed)
            if found[seed] != [flights.NOT_TRIED]:
                break
    assert not {seed: broken for seed, broken in found.items() if broken}


@pytest.mark.long
def test_a_hundred_flights_beside_the_evaluation(tmp_path):
    """The same questions from the same starts; the difference may be off by its standard error."""
    train = "train embodied_qa --method none --env.hovering --num-epochs 30 --no-figures --out"
    words = [sys.executable, "-m", "infogoal_jax", *train.split(), str(tmp_path / "run")]
    subprocess.run(words, check=True, env=os.environ | {"XLA_FLAGS": ""}, stdout=subprocess.DEVNULL)
    words = [
        sys.executable,
        str(SCRIPT),
        str(tmp_path / "run"),
        "--flights",
        str(FLIGHTS),
        "--out",
        str(tmp_path / "out"),
    ]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    result = json.loads((tmp_path / "out" / "flights.json").read_text())
    assert result["landed"] == FLIGHTS
    assert abs(result["difference"]) <= WITHIN + result["difference_standard_error"]
