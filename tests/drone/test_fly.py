"""`infogoal fly` over the real protocol: djitellopy as it is published, a simulated Tello in a process of its own.

With every fault the drone ends on the ground, inside of its envelope, and the log says why; a policy answers as many
test questions as in the evaluation inside of the program. The long tests fly a few of the flights that the scripts of
benchmarks/fidelity fly (docs/guides/drone.md).
"""

import json
import subprocess
import sys

import numpy as np
import pytest
from places import ROOT

pytest.importorskip("djitellopy", reason="needs the extra drone and djitellopy (docs/guides/drone.md)")
pytest.importorskip("av", reason="needs the extra drone and djitellopy (docs/guides/drone.md)")

from infogoal_drone import records, simulated_tello
from infogoal_drone.records import TABLE
from infogoal_jax.data import frames, frames_import, splits

sys.path.insert(0, str(ROOT / "benchmarks" / "fidelity"))
import drone_faults as faults

NAMES = {fault.name: fault for fault in (*faults.FAULTS, *faults.MORE_FAULTS)}
FLIGHTS, WITHIN = 12, 0.05


@pytest.fixture(scope="module")
def drones():
    """The simulated Tellos of this file, the last of which may fly."""
    started = []
    yield started
    for one in started:
        one.stop()


@pytest.fixture
def drone(drones):
    """A simulated Tello that is there: one that nobody asked for a minute has ended, and another is started."""
    if not drones or drones[-1].process.poll() is not None:
        drones.append(simulated_tello.start(faults.settings((0, 0, 0))))
    return drones[-1]


def fly(drone, folder, policy, *more, **settings):
    """A flight to its end: its output, its log and the truth about the drone."""
    ports = faults.free_ports()
    drone.restart(faults.settings(ports, **settings))
    process = faults.begin_flight(folder / "flight", policy, drone, ports, 0, *more)
    output, _ = process.communicate(timeout=120)
    truth = faults.wait_for(drone, lambda truth: truth["phase"] == "ground", 20)
    return process.returncode, output, records.read(folder / "flight" / records.NAME), truth


@pytest.mark.long
def test_record_train_and_fly(tmp_path):
    """The way of docs/guides/drone.md, with two short recordings of the same place and a policy that has hardly
    learned."""
    recordings, mine, run, policy = (tmp_path / name for name in ("recordings", "mine.npz", "run", "policy.npz"))
    place = ("--simulate", "--start", 26, 7, "--speed", 4, "--left", 2, "--right", 2, "--up", 1, "--down", 1)
    for seed in range(2):
        ports = ("--ports", *faults.free_ports())
        assert infogoal("record", recordings, *place, *ports, "--seed", seed, "--out", tmp_path / f"log_{seed}") == 0
    assert infogoal("data", "import", recordings, recordings / TABLE, "--out", mine, "--size", 48, 64) == 0
    objects, shipped = frames.load(mine).objects, json.loads(splits.SHIPPED_QUESTIONS.read_text())["objects"]
    assert len(objects) >= 2
    asked = {name: shipped[name] | {"use": "test" if number else "train"} for number, name in enumerate(objects)}
    (tmp_path / "mine.json").write_text(json.dumps({"objects": asked}))
    data = (f"--env.dataset={mine}", f"--env.questions={tmp_path / 'mine.json'}")
    budget = ("--num-epochs=1", "--epochs-per-evaluation=1", "--updates-per-epoch=50", "--no-figures")
    assert infogoal("train", "embodied_qa", "--method=none", *data, *budget, "--out", run) == 0
    assert infogoal("export", run, "--out", policy) == 0
    question, flown = asked[objects[1]]["questions"][0], tmp_path / "flown"
    ports = ("--ports", *faults.free_ports())
    status = infogoal("fly", policy, "--question", question, *place, *ports, "--steps", 4, "--out", flown)
    events = records.read(flown / records.NAME)
    (settings,), (end,) = records.events_of(events, "settings"), records.events_of(events, "end")
    assert settings["target"] == objects[1] and end["landed"] and status == (0 if end["found"] else 1)
    assert infogoal("report", flown) == 0 and (flown / "figures" / "flight.png").exists()


@pytest.mark.long
def test_it_finds_the_object_lands_and_leaves_a_recording(drone, tmp_path):
    """The alarm clock of the generated shelf is wholly in view from the second or third place to the right."""
    policy = faults.write_policy(tmp_path / "policy.npz", objects=["alarm clock"])
    first, recordings = (0.5 + 0.2 * 31, 0.4 + 0.2 * 8), tmp_path / "recordings"
    few = {"first": first, "frames_per_second": 12}
    code, output, events, truth = fly(drone, tmp_path, policy, "--record", str(recordings), **few)
    (end,) = records.events_of(events, "end")
    assert code == 0 and end["found"] and end["landed"], output
    assert (truth["phase"], truth["crashed"], truth["why_landed"]) == ("ground", False, "command land")
    steps = records.events_of(events, "step")
    assert [step["move"] for step in steps] == ["right"] * len(steps) and 1 <= len(steps) <= 3
    data = frames_import.import_folder(recordings, recordings / TABLE, tmp_path / "mine.npz", size=(48, 64))
    assert len(data.frame) == len(steps) and data.objects == ("alarm clock",) and data.detected[-1, 0]


def infogoal(*words) -> int:
    """The exit status of a command."""
    return subprocess.run([sys.executable, "-m", "infogoal_jax", *map(str, words)], check=False).returncode


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_a_flight_with_this_fault_ends_on_the_ground(drone, tmp_path, name):
    policy = faults.write_policy(tmp_path / "policy.npz")
    flights = faults.fly_with(NAMES[name], tmp_path, policy, drone, 0)
    assert faults.broken(flights) == [] and flights[-1]["came"], flights


@pytest.mark.long
def test_flights_succeed_as_often_as_the_evaluation(tmp_path):
    """The shipped policy, the same questions from the same starts; so few flights are off by some standard errors."""
    script = ROOT / "benchmarks" / "fidelity" / "drone_flights.py"
    words = [sys.executable, script, "shipped/embodied_qa", "--flights", str(FLIGHTS), "--out", tmp_path]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    flown = json.loads((tmp_path / "flights.json").read_text())["flights"]
    assert len(flown) == FLIGHTS and all(flight["landed"] for flight in flown)
    difference = np.array([flight["found"] - flight["inside"] for flight in flown])
    assert abs(difference.mean()) <= WITHIN + 2.5 * difference.std(ddof=1) / np.sqrt(FLIGHTS), flown
