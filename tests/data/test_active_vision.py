"""The reader of the Active Vision Dataset's format, and its cache."""

import json
import os
import shutil

import cv2
import numpy as np
import pytest
import scipy.io

from infogoal_jax.data import active_vision, pictures
from infogoal_jax.data.active_vision import ACTIONS
from infogoal_jax.data.splits import AUTHORS_SPLIT
from infogoal_jax.errors import UserError
from infogoal_jax.stand_ins import house

OBJECTS = AUTHORS_SPLIT.objects
FIRST, SECOND = "000110000010101.jpg", "000110000020101.jpg"


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def loaded(tiny_house, cache):
    return active_vision.load(tiny_house, objects=OBJECTS, cache_dir=cache)


@pytest.fixture
def copy(tiny_house, tmp_path):
    """A copy of the tiny house to be damaged."""
    return shutil.copytree(tiny_house, tmp_path / "copy")


def write_pair(root, boxes=(), width=1920, height=1080, scene="Home_001_1", **fields):
    """A scene of two full-size images, a turn apart; `boxes` are those of the first."""
    folder = root / scene / "jpg_rgb"
    folder.mkdir(parents=True)
    edges = dict.fromkeys(ACTIONS, "")
    records = {
        FIRST: {"bounding_boxes": list(boxes), **edges, "rotate_cw": SECOND, "rotate_ccw": SECOND, **fields},
        SECOND: {"bounding_boxes": [], **edges, "rotate_cw": FIRST, "rotate_ccw": FIRST},
    }
    (root / scene / "annotations.json").write_text(json.dumps(records))
    (root / "all_instance_id_map.txt").write_text("red_cup 33\npaper_plate 32\n")
    gradient = np.linspace(0, 255, width).astype(np.uint8)[None, :, None].repeat(height, 0).repeat(3, 2)
    for name, picture in ((FIRST, gradient), (SECOND, gradient[:, ::-1])):
        cv2.imwrite(str(folder / name), picture)
    return root


def test_load_gives_what_was_written(tiny_house, loaded):
    annotations = json.loads((tiny_house / "Home_101_1" / "annotations.json").read_text())
    names = sorted(annotations)
    assert loaded.images.shape == (len(names), 32, 32)
    assert loaded.images.dtype == np.uint8
    ids = [house.INSTANCE_IDS[name] for name in OBJECTS]
    for index, name in enumerate(names):
        for column, action in enumerate(ACTIONS):
            assert names[loaded.next_state[index, column]] == (annotations[name][action] or name)
        clear = {
            identity
            for left, top, right, bottom, identity, difficulty in annotations[name]["bounding_boxes"]
            if min(right - left, bottom - top) >= active_vision.DEFAULT_MIN_BOX_SIZE * 36 and difficulty <= 4
        }
        assert [identity in clear for identity in ids] == loaded.visible[index].tolist()


def test_positions_are_metres_and_headings_radians(loaded):
    node = loaded.position.reshape(-1, 12, 3)
    assert (node[:, :, :2] == node[:, :1, :2]).all()
    assert (np.ptp(loaded.position[:, :2], axis=0) < 15).all()
    assert (np.ptp(loaded.position[:, :2], axis=0) > 5).all()
    assert np.abs(loaded.position[:, 2]).max() <= np.pi + 1e-6


def test_images_are_grey_and_small(tiny_house, loaded):
    sixth = sorted((tiny_house / "Home_101_1" / "jpg_rgb").iterdir())[5]
    picture = cv2.imread(str(sixth), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(loaded.images[5], cv2.resize(picture, (32, 32), interpolation=cv2.INTER_AREA))


def test_full_size_images_keep_their_content(tmp_path):
    """The decoder's own reduction changes nothing that survives at 32 x 32."""
    scenes = active_vision.load(
        write_pair(tmp_path, [[0, 0, 400, 400, 33, 1]]), objects=["red_cup"], cache_dir=tmp_path / "cache"
    )
    wanted = np.linspace(0, 255, 33)[:-1] + 4
    np.testing.assert_allclose(scenes.images[0], np.broadcast_to(wanted, (32, 32)), atol=4)
    np.testing.assert_allclose(scenes.images[1], scenes.images[0][:, ::-1], atol=4)


def test_source_says_which_data_they_were(loaded, tmp_path):
    assert loaded.source.startswith("synthetic house, seed 3")
    real = active_vision.load(
        write_pair(tmp_path, [[0, 0, 400, 400, 33, 1]]), objects=["red_cup"], cache_dir=tmp_path / "cache"
    )
    assert real.source.startswith("Active Vision Dataset")


def test_positions_are_unknown_without_the_pose_file(tmp_path):
    root = write_pair(tmp_path, [[0, 0, 400, 400, 33, 1]])
    assert np.isnan(active_vision.load(root, objects=["red_cup"], cache_dir=tmp_path / "cache").position).all()


def test_images_that_were_not_reconstructed_have_no_position(tmp_path):
    """Interpolated images of the real dataset have empty entries in image_structs.mat."""
    root = write_pair(tmp_path, [[0, 0, 400, 400, 33, 1]])
    records = np.empty((1, 2), [(field, object) for field in house.MATLAB_FIELDS])
    empty = np.zeros((0, 0))
    for index, (name, world, direction) in enumerate(
        ((FIRST, np.ones((3, 1)), np.array([[0], [0], [1]])), (SECOND, empty, empty))
    ):
        records[0, index] = tuple(
            {"image_name": name, "world_pos": world, "direction": direction}.get(f, empty) for f in house.MATLAB_FIELDS
        )
    scipy.io.savemat(root / "Home_001_1" / "image_structs.mat", {"image_structs": records, "scale": 2000.0})
    position = active_vision.load(root, objects=["red_cup"], cache_dir=tmp_path / "cache").position
    np.testing.assert_allclose(position[0], [2, 2, np.pi / 2], atol=1e-6)
    assert np.isnan(position[1]).all()


@pytest.mark.parametrize("height", [1080, 90])
@pytest.mark.parametrize(("share", "seen"), [(0.22, True), (0.18, False)])
def test_box_filter_is_the_shorter_side_in_image_heights(tmp_path, height, share, seen):
    side = round(share * height)
    boxes = [[0, 0, side, 3 * side, 33, 1], [0, 0, height, height, 32, 1]]
    root = write_pair(tmp_path, boxes, width=height * 16 // 9, height=height)
    if seen:
        scenes = active_vision.load(root, objects=["red_cup"], min_box_size=0.2, cache_dir=tmp_path / "cache")
        assert scenes.visible.tolist() == [[True], [False]]
    else:
        with pytest.raises(UserError, match="red_cup in clear view from no image"):
            active_vision.load(root, objects=["red_cup"], min_box_size=0.2, cache_dir=tmp_path / "cache")


def test_difficult_boxes_do_not_count(tmp_path):
    root = write_pair(tmp_path, [[0, 0, 500, 500, 33, 4], [0, 0, 500, 500, 32, 5]])
    options = {"objects": ["red_cup", "paper_plate"], "cache_dir": tmp_path / "cache"}
    assert active_vision.load(root, max_difficulty=5, **options).visible[0].tolist() == [True, True]
    with pytest.raises(UserError, match="paper_plate in clear view from no image"):
        active_vision.load(root, max_difficulty=4, **options)


def test_several_scenes_are_one_graph_without_moves_between_them(tiny_house, loaded, cache, tmp_path):
    root = shutil.copytree(tiny_house, tmp_path / "two")
    shutil.copytree(tiny_house / "Home_101_1", root / "Home_102_1")
    both = active_vision.load(root, objects=OBJECTS, cache_dir=tmp_path / "cache")
    count = len(loaded.images)
    np.testing.assert_array_equal(both.scene, np.repeat([0, 1], count))
    np.testing.assert_array_equal(
        both.scene[both.next_state], np.broadcast_to(both.scene[:, None], both.next_state.shape)
    )
    for half in (slice(0, count), slice(count, None)):
        np.testing.assert_array_equal(both.images[half], loaded.images)
        np.testing.assert_array_equal(both.visible[half], loaded.visible)
    one = active_vision.load(root, objects=OBJECTS, scenes=["Home_102_1"], cache_dir=tmp_path / "cache")
    np.testing.assert_array_equal(one.next_state, loaded.next_state)


def test_second_load_reads_the_cache(tiny_house, loaded, cache, monkeypatch):
    def refuse(*_):
        raise AssertionError("an image was read again")

    monkeypatch.setattr(pictures, "read_grey", refuse)
    again = active_vision.load(tiny_house, objects=OBJECTS, cache_dir=cache)
    np.testing.assert_array_equal(again.images, loaded.images)
    np.testing.assert_array_equal(again.position, loaded.position)


@pytest.mark.parametrize(
    "damage", ["cut", *(pytest.param(damage, marks=pytest.mark.long) for damage in ("empty", "rubbish"))]
)
def test_a_damaged_cache_is_made_again(tiny_house, loaded, tmp_path, damage):
    active_vision.load(tiny_house, objects=OBJECTS, cache_dir=tmp_path)
    (path,) = tmp_path.iterdir()
    data = path.read_bytes()
    path.write_bytes({"cut": data[: len(data) // 2], "empty": b"", "rubbish": b"no cache"}[damage])
    again = active_vision.load(tiny_house, objects=OBJECTS, cache_dir=tmp_path)
    np.testing.assert_array_equal(again.images, loaded.images)
    assert path.read_bytes() == data


def test_a_changed_image_is_read_again(copy, tmp_path):
    before = active_vision.load(copy, objects=OBJECTS, cache_dir=tmp_path / "cache")
    first = min((copy / "Home_101_1" / "jpg_rgb").iterdir())
    cv2.imwrite(str(first), np.zeros((36, 64, 3), np.uint8))
    after = active_vision.load(copy, objects=OBJECTS, cache_dir=tmp_path / "cache")
    assert after.images[0].max() < 10
    np.testing.assert_array_equal(after.images[1:], before.images[1:])


def test_image_size_is_part_of_the_cache(tiny_house, cache):
    assert active_vision.load(tiny_house, objects=OBJECTS, image_size=16, cache_dir=cache).images.shape[1:] == (16, 16)
    assert active_vision.load(tiny_house, objects=OBJECTS, image_size=32, cache_dir=cache).images.shape[1:] == (32, 32)


def test_a_cache_folder_that_cannot_be_written_costs_only_the_cache(tiny_house, loaded, tmp_path):
    (tmp_path / "file").write_text("not a folder")
    scenes = active_vision.load(tiny_house, objects=OBJECTS, cache_dir=tmp_path / "file" / "cache")
    np.testing.assert_array_equal(scenes.images, loaded.images)


def test_cache_goes_where_the_desktop_standard_says(tiny_house, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    active_vision.load(tiny_house, objects=OBJECTS)
    assert len(list((tmp_path / "infogoal").iterdir())) == 1


def cut(path, share=0.5):
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


def scene_of(root):
    return root / "Home_101_1"


@pytest.mark.parametrize(
    "damage",
    [
        lambda root: (root / "all_instance_id_map.txt").unlink() or (root / "instance_id_map.txt").unlink(),
        lambda root: (root / "all_instance_id_map.txt").write_text("no number"),
        lambda root: (scene_of(root) / "annotations.json").unlink(),
        lambda root: cut(scene_of(root) / "annotations.json"),
        lambda root: (scene_of(root) / "annotations.json").write_text("[]"),
        lambda root: (scene_of(root) / "annotations.json").write_text('{"a.jpg": {"forward": ""}}'),
        lambda root: cut(scene_of(root) / "image_structs.mat"),
        lambda root: shutil.rmtree(scene_of(root) / "jpg_rgb"),
        lambda root: sorted((scene_of(root) / "jpg_rgb").iterdir())[7].unlink(),
        lambda root: cut(sorted((scene_of(root) / "jpg_rgb").iterdir())[7]),
        lambda root: cut(sorted((scene_of(root) / "jpg_rgb").iterdir())[7], 0),
    ],
    ids="no_map bad_map no_annotations cut_annotations list no_fields cut_poses no_images no_image cut_image "
    "empty_image".split(),
)
def test_a_dataset_cut_short_is_refused_with_the_way_to_find_out_more(copy, tmp_path, damage):
    damage(copy)
    with pytest.raises(UserError, match=r"`infogoal data check .*copy`"):
        active_vision.load(copy, objects=OBJECTS, cache_dir=tmp_path / "cache")


def test_a_move_to_nowhere_is_refused(tmp_path):
    root = write_pair(tmp_path, [[0, 0, 400, 400, 33, 1]], forward="000110000990101.jpg")
    with pytest.raises(UserError, match="forward leads to 000110000990101.jpg, which is not there"):
        active_vision.load(root, objects=["red_cup"], cache_dir=tmp_path / "cache")


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"objects": ["red_cupp"]}, "'red_cupp' is not in the instance map.*Did you mean 'red_cup'"),
        ({"objects": []}, "give at least one"),
        ({"objects": ["red_cup", "red_cup"]}, "each once"),
        ({"scenes": ["Home_999_1"]}, "has no scene 'Home_999_1'. Did you mean .* It has Home_101_1"),
        ({"scenes": ["Home_101_1", "Home_101_1"]}, "scenes = .*: give at least one, each once; .* has Home_101_1"),
        ({"scenes": []}, r"scenes = \(\): give at least one"),
    ],
)
def test_arguments_that_cannot_be_used_are_named(tiny_house, cache, arguments, match):
    with pytest.raises(UserError, match=match):
        active_vision.load(tiny_house, **({"objects": OBJECTS, "cache_dir": cache} | arguments))


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        active_vision.load(tmp_path / "nowhere", objects=OBJECTS)
    os.makedirs(tmp_path / "empty")
    (tmp_path / "empty" / "all_instance_id_map.txt").write_text("red_cup 33\n")
    with pytest.raises(UserError, match="no scene folder"):
        active_vision.load(tmp_path / "empty", objects=["red_cup"])
