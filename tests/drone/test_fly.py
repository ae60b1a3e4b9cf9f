"""`infogoal fly` over the real protocol: djitellopy as it is published, a simulated Tello in a process of its own."""

import json

import flights
import pytest

pytest.importorskip("djitellopy", reason="needs the extra drone and djitellopy (docs/drone.md)")
pytest.importorskip("av", reason="needs the extra drone and djitellopy (docs/drone.md)")

from infogoal_jax.cli.main import main
from infogoal_jax.drone import log, simulated_tello


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


def test_it_finds_the_object_lands_and_leaves_a_recording(drone, tmp_path, capsys):
    """Two metres before the object it goes to the right until it is in view."""
    left, foot = None, None
    from infogoal_jax.drone.simulated_video import Camera

    assert Camera and left is foot
    policy = flights.write_policy(tmp_path / "policy.npz", objects=["alarm clock"])
    code, output, events, truth = fly(drone, tmp_path, policy, "--record", str(tmp_path / "recordings"))
    (end,) = log.events_of(events, "end")
    assert (code == 0) == end["found"], output
    assert end["landed"] and truth["phase"] == "ground" and not truth["crashed"]
    assert json.dumps(end) and main(["report", str(tmp_path / "flight")]) == 0


def test_ctrl_c_lands(drone, tmp_path):
    """While it flies, from a terminal."""
    policy = flights.write_policy(tmp_path / "policy.npz")
    fault = next(fault for fault in flights.FAULTS if fault.name == "Ctrl-C")
    assert flights.fly_with(fault, tmp_path / "flight", policy, drone, 0) == []
