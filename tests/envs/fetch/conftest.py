"""The shipped banks of goal images, for every file of tests on them."""

import pytest
from goal_banks import NAMES

from infogoal_jax.data import goal_images


@pytest.fixture(scope="module")
def banks():
    return {name: goal_images.load(goal_images.shipped(name), name) for name in NAMES}
