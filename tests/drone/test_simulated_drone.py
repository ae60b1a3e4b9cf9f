"""What the drone does and sees. Where moves lead: which the envelope allows, and what is known of the place after
answers that did not come; what the simulated firmware answers, and the landings that it makes by itself. Pictures:
faults are noticed, and a hovering camera is not taken for one. Detectors: boxes that are cut off, YOLO's results, and
libraries and files that are missing."""

import itertools
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from infogoal_drone import simulated_drone, vision
from infogoal_drone.envelope import MOVES, Envelope, Whereabouts, allowed
from infogoal_drone.simulated_drone import Body
from infogoal_drone.vision import Detection, Picture, fault_of
from infogoal_jax.errors import UserError
from infogoal_jax.stand_ins import shelf

NAMES = tuple(MOVES)
SMALL = Envelope(left=1, right=2, up=1, down=0)
FIRST = np.array([4.0, 1.2])
RATE = 30
SIZE = (48, 64)
IMAGE = np.zeros((72, 96, 3), np.uint8)


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


def test_a_take_off_that_is_broken_off_ends_on_the_stand():
    """Which is then still there, just below the drone's sensor."""
    body = Body(FIRST, np.random.default_rng(0))
    body.obey("takeoff", 0.0)
    let_pass(body, 1.0)
    body.obey("land", body.time)
    let_pass(body, 5.0)
    assert body.phase == "ground" and body.tof() == 10 and body.position[1] == body.stand_top


def test_the_shelf_may_have_its_objects_gathered():
    apart, gathered = (simulated_drone.Camera(0, np.random.default_rng(0), value).places for value in (False, True))
    expected = shelf.furnish(np.random.default_rng([0, shelf.GENERATOR_VERSION]), True)
    assert all((gathered[name] == expected[name]).all() for name in expected)
    assert any((apart[name] != expected[name]).any() for name in expected)


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


@pytest.fixture(scope="module")
def world() -> np.ndarray:
    """A wall with soft spots, larger than what the camera sees, uint8 [H, W, 3]."""
    random = np.random.default_rng(0)
    coarse = random.uniform(0, 255, (24, 36, 3)).astype(np.float32)
    return np.clip(cv2.resize(coarse, (1440, 960), interpolation=cv2.INTER_CUBIC), 0, 255).astype(np.uint8)


def hover(world, count: int, seed: int = 0, begin: float = 0.0, at: int = 100) -> list[Picture]:
    """Pictures of a camera that drifts as the simulated drone's does."""
    random, found, drift = np.random.default_rng(seed), [], np.zeros(2)
    pixels = shelf.DRIFT * shelf.PIXELS_PER_METRE
    keep = np.exp(-1 / RATE / simulated_drone.DRIFT_SECONDS)
    for number in range(count):
        drift = keep * drift + np.sqrt(1 - keep**2) * random.normal(0, pixels, 2)
        left, top = at + int(drift[0]), 100 + int(drift[1])
        image = world[top : top + 720, left : left + 960]
        found.append(Picture(begin + number / RATE, vision.reduced(image, SIZE), None))
    return found


def now_of(found: list[Picture]) -> float:
    """Just after the last picture."""
    return found[-1].time + 0.01


@pytest.mark.parametrize("seed", range(5))
def test_a_hovering_camera_is_trusted(world, seed):
    found = hover(world, 90, seed)
    before = hover(world, 1, seed, at=100 + round(0.2 * shelf.PIXELS_PER_METRE))[0].small
    assert fault_of(found, now_of(found), 0.0, 1.0, True, before) == ""


def test_late_images(world):
    found = hover(world, 30)
    assert fault_of([], 0.0, 0.0) == "stale"
    assert fault_of(found, now_of(found) + vision.STALE_SECONDS, 0.0) == "stale"
    assert fault_of(found, now_of(found) + 0.3, 0.0, speed=4.0) == "stale"


def test_images_from_before_the_drone_came_to_rest(world):
    found = hover(world, 30)
    assert fault_of(found, now_of(found), found[-2].time) == "waiting"
    assert fault_of(found, now_of(found), found[-3].time) == ""


@pytest.mark.parametrize("level", [0, 128])
def test_black_and_empty_images(world, level):
    found = [*hover(world, 30), Picture(1.0, np.full((*SIZE, 3), level, np.uint8), None)]
    assert fault_of(found, now_of(found), 0.0) == "black"


@pytest.mark.parametrize("row", [8, 20, 36])
def test_torn_images(world, row):
    """Below a row they show another place; whichever of the last three it is."""
    for which in (-1, -2):
        found = hover(world, 30)
        torn = found[which].small.copy()
        torn[row:] = hover(world, 1, at=400)[0].small[row:]
        found[which] = found[which]._replace(small=torn)
        assert fault_of(found, now_of(found), 0.0) == "torn"


def test_a_band_that_a_decoder_filled(world):
    found = hover(world, 30)
    filled = [picture.small.copy() for picture in found]
    for image in filled:
        image[30:] = 128
    found = [picture._replace(small=image) for picture, image in zip(found, filled, strict=True)]
    assert fault_of(found, now_of(found), 0.0) == "torn"


def test_a_frozen_video(world):
    """The same image for two seconds, or the image from before the move."""
    found = hover(world, 1)
    frozen = [found[0]._replace(time=number / RATE) for number in range(90)]
    elsewhere = hover(world, 1, at=400)[0].small
    assert fault_of(frozen, now_of(frozen), 0.0, 1.0, True, elsewhere) == "frozen"
    drifting = hover(world, 20)
    assert fault_of(drifting, now_of(drifting), 0.0, 1.0, True, drifting[-1].small) == "frozen"
    assert fault_of(frozen, now_of(frozen), 0.0, 1.0, True, None) == "frozen", "before the first move, too"
    assert fault_of(frozen, now_of(frozen), 0.0, 1.0, False, elsewhere) == "", "on the ground nothing moves"


class Boxes(list):
    """A column of YOLO's results."""

    def tolist(self):
        return list(self)


class StubYOLO:
    """What is used of ultralytics' class: names, and predict on BGR images."""

    def __init__(self, weights):
        self.names = {0: "mug", 1: "clock"}

    def predict(self, image, device, verbose):
        assert device == "cpu" and image[0, 0].tolist() == [3, 2, 1], "ultralytics takes BGR"
        boxes = SimpleNamespace(
            cls=Boxes([1.0, 0.0]), xyxy=Boxes([[5, 5, 20, 20], [0, 5, 20, 20]]), conf=Boxes([0.9, 0.8])
        )
        return [SimpleNamespace(boxes=boxes, names=self.names)]


@pytest.fixture
def weights(tmp_path):
    """A file that stands for weights."""
    (tmp_path / "best.pt").write_bytes(b"weights")
    return tmp_path / "best.pt"


def test_what_counts_as_seen():
    found = [
        Detection("mug", (5, 5, 20, 20), 0.9),
        Detection("clock", (5, 5, 95.5, 20), 0.9),
        Detection("vase", (5, 5, 20, 20), 0.3),
    ]
    assert vision.seen(found, IMAGE, 0.5) == {"mug"}


def test_yolo(monkeypatch, weights):
    """Its classes, boxes and confidences; the image in the order of colours that it takes."""
    monkeypatch.setitem(sys.modules, "ultralytics", SimpleNamespace(YOLO=StubYOLO))
    detect = vision.yolo_detector(weights)
    found = detect(np.broadcast_to(np.array([1, 2, 3], np.uint8), IMAGE.shape))
    assert found == [Detection("clock", (5, 5, 20, 20), 0.9), Detection("mug", (0, 5, 20, 20), 0.8)]
    assert vision.seen(found, IMAGE, 0.5) == {"clock"}
    vision.check_known("mug", detect)
    with pytest.raises(UserError, match="Did you mean 'mug'"):
        vision.check_known("mgu", detect)


def test_weights_that_cannot_be_read(monkeypatch, weights):
    """Whatever ultralytics raises, the refusal is one line and names the file."""

    def fail(path):
        raise RuntimeError("Invalid magic number;\ncorrupt file?")

    monkeypatch.setitem(sys.modules, "ultralytics", SimpleNamespace(YOLO=fail))
    with pytest.raises(UserError, match="weights = .*best.pt.*Invalid magic number; corrupt file") as refused:
        vision.yolo_detector(weights)
    assert "\n" not in str(refused.value)


def test_missing_weights_and_missing_ultralytics(monkeypatch, tmp_path, weights):
    with pytest.raises(UserError, match="no such file"):
        vision.yolo_detector(tmp_path / "none.pt")
    monkeypatch.setitem(sys.modules, "ultralytics", None)
    with pytest.raises(UserError, match="yolo"):
        vision.yolo_detector(weights)
