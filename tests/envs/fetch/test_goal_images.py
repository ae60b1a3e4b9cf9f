"""Banks of goal images: the shipped ones, the file format and everything that can be wrong with a file."""

import dataclasses
import json
import zipfile

import numpy as np
import pytest

from infogoal_jax import presets
from infogoal_jax.data import goal_images
from infogoal_jax.data.goal_images import GRID, TEST, TRAIN, VALIDATION, GoalImages
from infogoal_jax.envs.fetch.tasks import TASKS
from infogoal_jax.errors import UserError
from infogoal_paper import goal_rendering

SHAPES = {"fetch_reach": (13, 13, 13), "fetch_push": (13, 13, 1), "fetch_pick_and_place": (13, 13, 19)}

each_task = pytest.mark.parametrize("name", presets.FETCH_TASKS)


@each_task
def test_a_shipped_bank_is_small_and_has_its_goals(banks, name):
    bank = banks[name]
    assert goal_images.shipped(name).stat().st_size < 5e6
    assert bank.images.dtype == np.uint8 and bank.images.shape == (len(bank.positions), 64, 64, 3)
    assert bank.positions.dtype == np.float32
    assert [len(bank.rows(use)) for use in (GRID, TRAIN, VALIDATION, TEST)] == [np.prod(SHAPES[name]), 8, 8, 32]
    assert bank.about["task"] == name and bank.about["seed"] == 0 and bank.about["gymnasium-robotics"] == "1.4.2"


@each_task
def test_the_grid_fills_the_goal_space_in_steps_of_25_mm(banks, name):
    bank, task = banks[name], TASKS[name]
    assert bank.grid_shape == SHAPES[name] and bank.spacing == pytest.approx(0.025)
    grid = bank.positions[bank.rows(GRID)]
    low, high = np.array(task.start_grip) - 0.15, np.array(task.start_grip) + 0.15
    if task.object_height is not None:
        low[2], high[2] = task.object_height, task.object_height + (0.45 if task.goals_in_air else 0)
    for axis in range(3):
        values = np.unique(grid[:, axis])
        assert values[[0, -1]] == pytest.approx([low[axis], high[axis]], abs=1e-6)
        assert len(values) == SHAPES[name][axis]
        assert np.diff(values) == pytest.approx(0.025, abs=1e-6)


@each_task
def test_every_drawn_goal_lies_near_a_cell_and_test_goals_near_a_training_goal(banks, name):
    bank = banks[name]
    drawn = bank.positions[bank.rows(GRID).size :]
    to_cell = np.abs(bank.positions[bank.rows(GRID)] - drawn[:, None]).max(-1).min(-1)
    assert to_cell.max() <= 0.0125 + 1e-6
    training = bank.positions[bank.rows(TRAIN)]
    for use in (VALIDATION, TEST):
        distance = np.linalg.norm(bank.positions[bank.rows(use), None] - training, axis=-1).min(1)
        assert distance.max() < 0.2 + 1e-6


@each_task
def test_neighbours_can_be_told_apart_and_no_image_comes_twice(banks, name, differing_pixels):
    bank = banks[name]
    grid = bank.images[bank.rows(GRID)].reshape(*bank.grid_shape, 64, 64, 3)
    for axis in range(3):
        if bank.grid_shape[axis] > 1:
            steps = np.moveaxis(grid, axis, 0)
            assert differing_pixels(steps[1:], steps[:-1]).min() >= 5
    assert len({image.tobytes() for image in bank.images}) == len(bank.images)


@each_task
def test_the_camera_sees_the_whole_goal_space_and_a_step_is_a_pixel(banks, name):
    camera = goal_rendering.CAMERAS[name]
    pixels = camera.project(banks[name].positions)
    assert pixels.min() > 4 and pixels.max() < 60
    least, most = goal_rendering.pixel_shifts(name)
    assert 1.0 <= least <= most < 5.0
    assert camera.words() == banks[name].about["camera"]


def test_the_object_is_seen_where_the_camera_puts_it(banks):
    """In fetch_push all but the object stands still, so what differs from the median image is the object."""
    bank = banks["fetch_push"]
    still = np.median(bank.images, 0)
    pixels = goal_rendering.CAMERAS["fetch_push"].project(bank.positions)
    centres = [np.argwhere(np.abs(image - still).max(-1) > 40).mean(0) for image in bank.images]
    off = np.linalg.norm(np.array(centres) + 0.5 - pixels, axis=1)
    assert np.median(off) < 0.5 and off.max() < 4  # A few pixels where the gripper hides half of it.


@each_task
def test_goals_depend_on_the_seed_and_on_nothing_else(banks, name):
    task = TASKS[name]
    positions, uses = goal_rendering.choose_goals(task, 0)
    np.testing.assert_array_equal(positions, banks[name].positions)
    np.testing.assert_array_equal(uses, banks[name].uses)
    others, _ = goal_rendering.choose_goals(task, 1)
    in_grid = int((uses == GRID).sum())
    np.testing.assert_array_equal(positions[:in_grid], others[:in_grid])
    assert not (positions[in_grid:] == others[in_grid:]).all(1).any()


def small_bank(**changes) -> dict:
    """The fields of a bank of two grid goals and one for training, as they stand in a file."""
    positions = np.array([[1.0, 0.5, 0.4], [1.0, 0.525, 0.4], [1.01, 0.5, 0.4]], np.float32)
    images = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), np.uint8)
    fields = {
        "task": "fetch_push",
        "about": json.dumps({"seed": 3}),
        "spacing": 0.025,
        "grid_low": positions[0],
        "grid_shape": np.array([1, 2, 1]),
        "uses": np.array([0, 0, 1], np.uint8),
        "positions": positions,
        "images": images,
    }
    return {field: value for field, value in (fields | changes).items() if value is not None}


def test_what_is_saved_is_loaded_again_and_cannot_be_changed(tmp_path):
    np.savez(tmp_path / "plain.npz", **small_bank())
    bank = goal_images.load(tmp_path / "plain.npz", "fetch_push")
    goal_images.save(tmp_path / "new" / "bank.npz", bank)
    again = goal_images.load(tmp_path / "new" / "bank.npz", "fetch_push")
    for field in dataclasses.fields(GoalImages):
        np.testing.assert_array_equal(getattr(bank, field.name), getattr(again, field.name))
    assert again.about == {"seed": 3} and again.grid_shape == (1, 2, 1)
    assert again.describe() == "2 grid, 1 train, 0 validation, 0 test goals, grid of 2.5 cm, seed 3"
    assert dataclasses.replace(again, about={}).describe().endswith("grid of 2.5 cm")
    with pytest.raises(ValueError, match="read-only"):
        again.images[0] = 0
    goal_images.save(tmp_path / "second.npz", again)
    assert (tmp_path / "second.npz").read_bytes() == (tmp_path / "new" / "bank.npz").read_bytes()
    assert sorted(path.name for path in tmp_path.rglob("*.npz")) == ["bank.npz", "plain.npz", "second.npz"]


def test_a_bank_that_cannot_be_written_leaves_no_file(tmp_path):
    np.savez(tmp_path / "plain.npz", **small_bank())
    bank = goal_images.load(tmp_path / "plain.npz", "fetch_push")
    with pytest.raises(UserError, match="cannot be written.*give another place"):
        goal_images.save(tmp_path / "plain.npz" / "bank.npz", bank)
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError, match="cannot be written"):
        goal_images.save(tmp_path / "folder", bank)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "plain.npz"]


BAD_FIELDS = {  # What is changed in a good file, and what the message must say.
    "another task": ({"task": "fetch_reach"}, ["task = 'fetch_reach'", "another task than 'fetch_push'"]),
    "no images": ({"images": None}, ["images missing"]),
    "no positions and uses": ({"positions": None, "uses": None}, ["uses, positions missing"]),
    "pickled images": ({"images": np.array([None, {}], object)}, ["images = unreadable", "pickled"]),
    "pickled about": ({"about": np.array({"seed": 1}, object)}, ["about = unreadable", "pickled"]),
    "about is no JSON": ({"about": "built by hand"}, ["about = 'built by hand'", "no JSON"]),
    "about is a list": ({"about": "[1]"}, ["about = 'list'", "dict of words"]),
    "images of 32 x 32": (
        {"images": np.zeros((3, 32, 32, 3), np.uint8)},
        ["images: has the shape [3, 32, 32, 3]", "[images, 64, 64, 3]"],
    ),
    "grey images": (
        {"images": np.zeros((3, 64, 64), np.uint8)},
        ["images: has the shape [3, 64, 64]", "[images, 64, 64, 3]"],
    ),
    "images of four channels": (
        {"images": np.zeros((3, 64, 64, 4), np.uint8)},
        ["[3, 64, 64, 4]", "[images, 64, 64, 3]"],
    ),
    "images of floats": ({"images": np.zeros((3, 64, 64, 3), np.float32)}, ["float32", "uint8"]),
    "too many": (
        {
            "images": np.zeros((8193, 64, 64, 3), np.uint8),
            "uses": np.ones(8193, np.uint8),
            "positions": np.zeros((8193, 3)),
        },
        ["images = 8193", "8192"],
    ),
    "fewer images than positions": (
        {"images": np.zeros((2, 64, 64, 3), np.uint8)},
        ["uses: has 3 images, but images has 2"],
    ),
    "more uses than images": ({"uses": np.array([0, 0, 1, 1], np.uint8)}, ["uses: has 4 images, but images has 3"]),
    "uses of floats": ({"uses": np.array([0.0, 0.0, 1.0])}, ["uses: is float64; give integer"]),
    "an unknown use": ({"uses": np.array([0, 0, 7], np.uint8)}, ["uses = 7", "3 (test)"]),
    "no training goal": ({"uses": np.array([0, 0, 3], np.uint8)}, ["no training goal"]),
    "positions not finite": (
        {"positions": np.array([[1, 0.5, 0.4], [1, np.nan, 0.4], [1, 1, 1]], np.float32)},
        ["positions[1]: is [1.0, nan", "finite"],
    ),
    "positions in a plane": (
        {"positions": np.zeros((3, 2), np.float32)},
        ["positions: has the shape [3, 2]; give [images, 3]"],
    ),
    "positions as text": ({"positions": np.full((3, 3), "1.0")}, ["positions: is <U3; give number"]),
    "grid does not come first": ({"uses": np.array([1, 0, 0], np.uint8)}, ["uses = ", "first"]),
    "grid of another size": ({"grid_shape": np.array([1, 3, 1])}, ["grid_shape = (1, 3, 1)", "2 goals of the grid"]),
    "grid of four axes": ({"grid_shape": np.array([1, 2, 1, 1])}, ["grid_shape: has the shape [4]; give [3]"]),
    "grid without goals": ({"grid_shape": np.array([0, 2, 1])}, ["grid_shape = (0, 2, 1)"]),
    "grid in the other direction": (
        {"grid_shape": np.array([2, 1, 1])},
        ["positions = [1.0, 0.525, 0.4]", "off the grid"],
    ),
    "grid elsewhere": (
        {"grid_low": np.array([1.0, 0.5, 0.5], np.float32)},
        ["positions = [1.0, 0.5, 0.4]", "off the grid"],
    ),
    "grid_low not finite": ({"grid_low": np.array([1.0, np.inf, 0.5])}, ["grid_low[1]: is inf; give finite"]),
    "spacing of zero": ({"spacing": 0.0}, ["spacing = 0.0", "greater than 0"]),
    "spacing not finite": ({"spacing": np.nan}, ["spacing: is nan; give finite"]),
    "spacing as text": ({"spacing": "wide"}, ["spacing: is <U4; give number"]),
}


@pytest.mark.parametrize("case", BAD_FIELDS)
def test_a_bad_file_is_named_with_the_field_and_the_remedy(case, tmp_path):
    changes, expected = BAD_FIELDS[case]
    save = np.savez_compressed if case == "too many" else np.savez
    save(tmp_path / "bank.npz", **small_bank(**changes))
    with pytest.raises(UserError) as caught:
        goal_images.load(tmp_path / "bank.npz", "fetch_push")
    message = str(caught.value)
    assert all(part in message for part in ["bank.npz", *expected]), message


def damaged(path, case: str):
    """Something at `path` that is no bank."""
    if case == "a folder":
        path.mkdir()
    elif case == "an array":
        with open(path, "wb") as file:
            np.save(file, np.zeros(3))
    elif case == "text":
        path.write_text("goal images")
    elif case == "nothing":
        path.write_bytes(b"")
    elif case == "a zip of something else":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("readme.txt", "goal images")
    else:
        content = goal_images.shipped("fetch_push").read_bytes()
        if case == "cut short":
            path.write_bytes(content[: len(content) // 2])
        elif case == "a byte changed":
            middle = len(content) // 2
            path.write_bytes(content[:middle] + bytes([content[middle] ^ 255]) + content[middle + 1 :])


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ("no file", "no such file; build a bank"),
        ("a folder", "cannot be read"),
        ("an array", "not an npz"),
        ("text", "not an npz"),
        ("nothing", "not an npz"),
        ("a zip of something else", "images, uses, positions missing; build a bank"),
        ("cut short", "not an npz"),
        ("a byte changed", "images = unreadable"),
    ],
)
def test_a_damaged_file_is_named(case, expected, tmp_path):
    path = tmp_path / "bank.npz"
    damaged(path, case)
    with pytest.raises(UserError, match=expected) as caught:
        goal_images.load(path, "fetch_push")
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "expected"),
    [("fetch_slide", "no goal images of this task"), ("fetch_reech", "Did you mean 'fetch_reach'")],
)
def test_a_task_without_goal_images_is_named(name, expected):
    with pytest.raises(UserError, match=expected):
        goal_rendering.build(name)
