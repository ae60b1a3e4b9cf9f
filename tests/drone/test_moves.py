"""Where moves lead: which the envelope allows, and what is known of the place after answers that did not come; what the
simulated firmware answers, and the landings that it makes by itself."""

import itertools

import numpy as np
import pytest

from infogoal_jax.drone import simulated_drone
from infogoal_jax.drone.envelope import MOVES, Envelope, Whereabouts, allowed
from infogoal_jax.drone.simulated_drone import Body
from infogoal_jax.errors import UserError

NAMES = tuple(MOVES)
SMALL = Envelope(left=1, right=2, up=1, down=0)
FIRST = np.array([4.0, 1.2])


def possible(envelope: Envelope, answers) -> set[tuple[int, int]]:
    """Every place at which the drone may be after moves with these answers, each allowed when it was made."""
    known, places = Whereabouts(), {(0, 0)}
    for choice, answer in answers:
        legal = np.flatnonzero(allowed(envelope, known, NAMES))
        if not len(legal):
            break
        move = NAMES[legal[choice % len(legal)]]
        moved = {(x + MOVES[move][0], y + MOVES[move][1]) for x, y in places}
        places = {"made": moved, "refused": places, "unanswered": places | moved}[answer]
        known = known.after(move, answer)
        assert all(known.low[0] <= x <= known.high[0] and known.low[1] <= y <= known.high[1] for x, y in places)
    return places


def test_no_sequence_of_answers_leads_outside():
    """All sequences of three moves with all answers, and long ones at random."""
    one = list(itertools.product(range(4), ("made", "refused", "unanswered")))
    random = np.random.default_rng(0)
    long = [[one[index] for index in random.integers(len(one), size=30)] for _ in range(200)]
    for answers in [*itertools.product(one, repeat=3), *long]:
        for x, y in possible(SMALL, answers):
            assert -SMALL.left <= x <= SMALL.right and -SMALL.down <= y <= SMALL.up


def test_moves_at_the_edge():
    at_edge = Whereabouts((2, 0), (2, 0))
    assert dict(zip(NAMES, allowed(SMALL, at_edge, NAMES), strict=True)) == {
        "left": True,
        "right": False,
        "up": True,
        "down": False,
    }


def test_nothing_leads_down_onto_what_is_below():
    roomy = Envelope(3, 3, 3, 3)
    assert allowed(roomy, Whereabouts(), ("down",), below=80)[0]
    assert not allowed(roomy, Whereabouts(), ("down",), below=50)[0]
    assert allowed(roomy, Whereabouts(), ("left",), below=50)[0]


def test_negative_steps_are_refused():
    with pytest.raises(UserError, match="up = -1"):
        Envelope(up=-1).check()


def let_pass(body: Body, seconds: float) -> None:
    """Let the time pass in small steps."""
    for _ in range(round(seconds / 0.05)):
        body.advance(body.time + 0.05)


@pytest.fixture
def hovering() -> Body:
    """A drone that took off."""
    body = Body(FIRST, np.random.default_rng(0))
    assert body.obey("takeoff", 0.0) == ""
    let_pass(body, simulated_drone.TAKEOFF_SECONDS + 0.1)
    assert body.phase == "hovering"
    return body


@pytest.mark.parametrize("move", ["left", "right", "up", "down"])
def test_a_move_takes_its_time_and_leads_20_cm_on(hovering, move):
    before = hovering.nominal
    assert hovering.obey(f"{move} 20", hovering.time) == ""
    assert hovering.obey("right 20", hovering.time) == "error Not joystick", "the last is not finished"
    let_pass(hovering, 2.0)
    step = 0.2 * np.array(simulated_drone.DIRECTIONS[move])
    np.testing.assert_allclose(hovering.nominal - before, step, atol=5 * simulated_drone.MOVE_ERROR)


REFUSALS = {
    "up 19": "out of range",
    "up": "out of range",
    "up 501": "out of range",
    "dance": "unknown command: dance",
    "takeoff": "error",
}


@pytest.mark.parametrize(("command", "answer"), REFUSALS.items())
def test_what_cannot_be_done(hovering, command, answer):
    assert hovering.obey(command, hovering.time) == answer


def test_on_the_ground():
    body = Body(FIRST, np.random.default_rng(0))
    assert (body.obey("up 20", 0.0), body.obey("land", 0.0)) == ("error Motor stop", "error")
    assert Body(FIRST, np.random.default_rng(0), battery=9.0).obey("takeoff", 0.0) == "error"


def test_it_lands_after_15_s_without_a_command(hovering):
    """A question for the battery does not count as a command."""
    hovering.obey("up 20", hovering.time)
    last = hovering.time
    while hovering.phase != "landing":
        hovering.obey("battery?", hovering.time)
        let_pass(hovering, 0.1)
        assert hovering.time < last + 20
    assert hovering.time > last + simulated_drone.SILENCE
    let_pass(hovering, 10)
    assert (hovering.phase, hovering.why_landed) == ("ground", "no command for 15 s")


def test_it_lands_with_an_empty_battery(hovering):
    hovering.battery = 4.0
    let_pass(hovering, 10)
    assert (hovering.phase, hovering.why_landed) == ("ground", "battery empty")


def test_drift_is_that_of_the_hovering_dataset(hovering):
    drift = []
    for _ in range(4000):
        hovering.last_command = hovering.time
        hovering.battery = 80.0
        hovering.advance(hovering.time + 0.5)
        drift.append(hovering.drift)
    np.testing.assert_allclose(np.std(drift, axis=0), simulated_drone.shelf.DRIFT, rtol=0.15)


def test_the_state_is_that_of_the_sdk(hovering):
    state = dict(field.split(":") for field in hovering.state().strip().rstrip(";").split(";"))
    names = "pitch roll yaw vgx vgy vgz templ temph tof h bat baro time agx agy agz".split()
    assert list(state) == names and state["h"] == "80" and 160 < int(state["tof"]) < 180
