"""Which images may be trusted: faults are noticed, and a hovering camera is not taken for one."""

import cv2
import numpy as np
import pytest

from infogoal_jax.drone import pictures, simulated_body
from infogoal_jax.drone.pictures import Picture, fault_of
from infogoal_jax.stand_ins import shelf

RATE = 30
SIZE = (48, 64)


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
    keep = np.exp(-1 / RATE / simulated_body.DRIFT_SECONDS)
    for number in range(count):
        drift = keep * drift + np.sqrt(1 - keep**2) * random.normal(0, pixels, 2)
        left, top = at + int(drift[0]), 100 + int(drift[1])
        image = world[top : top + 720, left : left + 960]
        found.append(Picture(begin + number / RATE, pictures.reduced(image, SIZE), None))
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
    assert fault_of(found, now_of(found) + pictures.STALE_SECONDS, 0.0) == "stale"
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
