"""The shipped banks of goal images, for every file of tests on them."""

import numpy as np
import pytest

from infogoal_jax import presets
from infogoal_jax.data import goal_images


@pytest.fixture(scope="module")
def banks():
    return {name: goal_images.load(goal_images.shipped(name), name) for name in presets.FETCH_TASKS}


@pytest.fixture(scope="session")
def differing_pixels():
    """In how many pixels images [..., H, W, 3] differ by more than 16 of 255 in some colour."""

    def count(images, others):
        difference = np.maximum(images, others) - np.minimum(images, others)  # Of bytes, without going below 0.
        return (difference.max(-1) > 16).sum((-1, -2))

    return count
