"""Boxes of objects lie where the pinhole camera has them, cut by what hides them."""

import numpy as np
import pytest

from infogoal_jax.stand_ins import house, house_render


def scene_of(*blocks):
    """Boxes (lower, upper, instance) with one grey texture, seen from the origin along x by a camera of 90 degrees."""
    lower, upper, instance = zip(*blocks, strict=True)
    count = len(blocks)
    boxes = house_render.Boxes(
        np.array(lower, np.float32),
        np.array(upper, np.float32),
        np.zeros((count, 6), int),
        np.zeros((count, 2), np.float32),
        np.array(instance),
    )
    camera = house_render.Camera(80, 40, 90.0, 0.0)
    levels = house_render.texture_levels(
        np.full((1, house_render.TEXTURE_SIZE, house_render.TEXTURE_SIZE, 3), 200, np.uint8)
    )
    return house_render.render(boxes, levels, camera, np.zeros(3, np.float32), 0.0, house_render.rays(camera, 0.0))


OBJECT = ((2, -0.5, -0.25), (2.2, 0.5, 0.25), 7)


def test_an_object_is_seen_where_the_pinhole_camera_has_it():
    _, (sighting,) = scene_of(OBJECT)
    assert sighting.instance == 7
    assert sighting.box == (30, 15, 50, 25)  # 40 pixels of focal length, front face at 2 m
    assert sighting.visible_fraction > 0.97


@pytest.mark.parametrize("hidden_by", [0, 9], ids=["wall", "another object"])
def test_what_hides_an_object_cuts_its_box(hidden_by):
    hider = ((1, 0.0, -1), (1.1, 1, 1), hidden_by)  # covers the left half
    _, sightings = scene_of(OBJECT, hider)
    sighting = next(s for s in sightings if s.instance == 7)
    assert sighting.box == (40, 15, 50, 25)
    assert 0.45 < sighting.visible_fraction < 0.55
    assert house.difficulty(sighting.visible_fraction) >= 3


def test_a_hidden_object_is_not_seen():
    _, sightings = scene_of(OBJECT, ((1, -1, -1), (1.1, 1, 1), 0))
    assert sightings == []


def test_an_object_partly_outside_the_frame_counts_as_partly_visible():
    _, (sighting,) = scene_of(((2, 1.5, -0.25), (2.2, 2.5, 0.25), 7))
    assert sighting.box[0] == 0
    assert 0.4 < sighting.visible_fraction < 0.6
