"""Which images may be trusted: faults are noticed, and a hovering camera is not taken for one. Detectors: boxes that
are cut off, YOLO's results, and libraries and files that are missing."""

import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from infogoal_jax.drone import simulated_drone, vision
from infogoal_jax.drone.vision import Detection, Picture, fault_of
from infogoal_jax.errors import UserError
from infogoal_jax.stand_ins import shelf

RATE = 30
SIZE = (48, 64)
IMAGE = np.zeros((72, 96, 3), np.uint8)


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
    assert fault_of(found, now_of(found), 0.0, 1.0, before) == ""


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
    assert fault_of(frozen, now_of(frozen), 0.0, 1.0, elsewhere) == "frozen"
    drifting = hover(world, 20)
    assert fault_of(drifting, now_of(drifting), 0.0, 1.0, drifting[-1].small) == "frozen"
    assert fault_of(frozen, now_of(frozen), 0.0, 1.0, None) == "", "on the ground nothing moves"


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


def test_missing_weights_and_missing_ultralytics(monkeypatch, tmp_path, weights):
    with pytest.raises(UserError, match="no such file"):
        vision.yolo_detector(tmp_path / "none.pt")
    monkeypatch.setitem(sys.modules, "ultralytics", None)
    with pytest.raises(UserError, match="yolo"):
        vision.yolo_detector(weights)
