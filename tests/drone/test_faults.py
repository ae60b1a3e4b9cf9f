"""Two hundred and more flights in which something goes wrong: the drone ends on the ground, inside of its envelope, and
the log says why."""

import flights
import pytest

pytest.importorskip("djitellopy", reason="needs the extra drone and djitellopy (docs/drone.md)")
pytest.importorskip("av", reason="needs the extra drone and djitellopy (docs/drone.md)")

from infogoal_jax.drone import simulated_tello

TIMES, ATTEMPTS = 20, 3
NAMES = {fault.name: fault for fault in (*flights.FAULTS, *flights.MORE_FAULTS)}


@pytest.fixture(scope="module")
def drone():
    """A simulated Tello."""
    started = simulated_tello.start(flights.settings((0, 0, 0)))
    yield started
    started.stop()


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
