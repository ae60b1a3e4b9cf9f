"""A tiny synthetic house, for every file of tests on it."""

import json

import pytest
from hand_made_dataset import TINY_HOUSE

from infogoal_jax.stand_ins import house


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """Folder of a tiny house: 64 x 36 pixels, nodes 1.2 m apart."""
    root = tmp_path_factory.mktemp("tiny_house")
    house.build_house(root, seed=3, **TINY_HOUSE)
    return root


@pytest.fixture(scope="module")
def annotations(tiny):
    return json.loads((tiny / "Home_101_1" / "annotations.json").read_text())
