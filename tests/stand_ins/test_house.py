"""The synthetic house: the same seed gives the same house, moves can be undone, and the task is not too easy."""

import functools
import shutil

import cv2
import numpy as np
import pytest
import scipy.io
from hand_made_frames import TINY_HOUSE

from infogoal_jax import envs
from infogoal_jax.data import archives, pictures
from infogoal_jax.data.check import check_active_vision
from infogoal_jax.data.splits import AUTHORS_SPLIT
from infogoal_jax.envs.object_search import ObjectSearchConfig
from infogoal_jax.errors import UserError
from infogoal_jax.stand_ins import house, house_layout

SEEDS = (0, 1, 2, 100, 101)


layout = functools.cache(house_layout.layout)


@pytest.fixture(scope="module", params=SEEDS)
def plan(request):
    return layout(request.param)


def files_of(root):
    return {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_the_same_seed_is_the_same_house_everywhere(tiny_house):
    assert envs.load("object_search", ObjectSearchConfig(dataset=str(tiny_house))).source.endswith("content f0da86dd")


@pytest.mark.long
def test_the_same_seed_writes_the_same_bytes(tiny_house, tmp_path):
    house.build_house(tmp_path, seed=3, **TINY_HOUSE)
    assert files_of(tmp_path) == files_of(tiny_house)


def test_another_seed_is_another_house():
    first, second = layout(0), layout(1)
    assert first.nodes.shape != second.nodes.shape or not np.allclose(first.nodes, second.nodes)


def test_every_move_can_be_undone(annotations):
    opposite = {"forward": "backward", "left": "right", "rotate_ccw": "rotate_cw"}
    opposite |= {back: there for there, back in opposite.items()}
    for name, record in annotations.items():
        for action, back in opposite.items():
            if record[action]:
                assert annotations[record[action]][back] == name


def test_twelve_turns_come_full_circle(annotations):
    for turn in ("rotate_cw", "rotate_ccw"):
        name = start = next(iter(annotations))
        seen = []
        for _ in range(12):
            name = annotations[name][turn]
            seen.append(name)
        assert name == start
        assert len(set(seen)) == 12


def test_moves_go_where_they_say(tiny_house, annotations):
    """A translation keeps the heading and lies within 15 degrees of the direction it is named after."""
    names = sorted(annotations)
    position = dict(zip(names, pictures.read_positions(tiny_house / "Home_101_1", names).astype(float), strict=True))
    for name, record in annotations.items():
        for action, degrees in (("forward", 0), ("left", 90), ("backward", 180), ("right", -90)):
            if record[action]:
                step = position[record[action]] - position[name]
                assert abs(step[2]) < 1e-6
                wanted = position[name][2] + np.radians(degrees)
                assert np.cos(np.arctan2(step[1], step[0]) - wanted) >= np.cos(np.radians(15)) - 1e-5
        turn = position[record["rotate_ccw"]][2] - position[name][2]
        np.testing.assert_allclose(np.exp(1j * turn), np.exp(1j * np.pi / 6), atol=1e-5)


def test_nodes_and_moves_keep_clear_of_furniture(plan):
    for index, neighbours in enumerate(plan.neighbours):
        for other in neighbours[neighbours >= 0]:
            path = np.linspace(plan.nodes[index], plan.nodes[other], 50)
            for piece in plan.furniture:
                assert not ((path > piece.lower) & (path < piece.upper)).all(1).any()


def test_every_node_is_reached_from_every_node(plan):
    reached = np.zeros(len(plan.nodes), bool)
    reached[0] = True
    for _ in plan.nodes:
        reached[plan.neighbours[reached][plan.neighbours[reached] >= 0]] = True
    assert reached.all()


def test_objects_stand_in_the_authors_rooms_beside_training_objects(plan):
    assert {placed.name for placed in plan.objects} == set(AUTHORS_SPLIT.objects)
    assert len(plan.objects) == 24
    for placed in plan.objects:
        assert AUTHORS_SPLIT.room_names[AUTHORS_SPLIT.rooms[placed.name]] == placed.room
    carriers = {placed.furniture for placed in plan.objects if placed.name in AUTHORS_SPLIT.train}
    assert len(carriers) == 8, "the two training objects of a room stand on different furniture"
    assert {placed.furniture for placed in plan.objects} == carriers, "a test object stands beside a training object"


def test_objects_do_not_overlap_and_stand_on_their_furniture(plan):
    for placed in plan.objects:
        carrier = plan.furniture[placed.furniture]
        assert (placed.foot[:2] - placed.size[:2] / 2 >= carrier.lower - 1e-9).all()
        assert (placed.foot[:2] + placed.size[:2] / 2 <= carrier.upper + 1e-9).all()
        for other in plan.objects:
            if other is not placed and other.furniture == placed.furniture:
                assert (np.abs(other.foot - placed.foot)[:2] >= (other.size + placed.size)[:2] / 2).any()


def test_pose_file_is_consistent(tiny_house):
    """The matrices are rotations with the camera looking along `direction`, and t = -R position."""
    content = scipy.io.loadmat(tiny_house / "Home_101_1" / "image_structs.mat")
    records = content["image_structs"][0]
    assert records.dtype.names == tuple(house.MATLAB_FIELDS)
    for record in records[:24]:
        np.testing.assert_allclose(record["R"] @ record["R"].T, np.eye(3), atol=1e-6)
        assert np.linalg.det(record["R"]) > 0
        np.testing.assert_allclose(record["R"] @ record["direction"], [[0], [0], [1]], atol=1e-6)
        np.testing.assert_allclose(record["t"], -record["R"] @ record["world_pos"], atol=1e-6)
        w, x, y, z = record["quat"].ravel()
        np.testing.assert_allclose([x, z], 0, atol=1e-6)
        np.testing.assert_allclose(record["R"][0, 2], 2 * w * y, atol=1e-6)
        np.testing.assert_allclose(record["R"][0, 0], 1 - 2 * y**2, atol=1e-6)


@pytest.fixture
def cache(tiny_house, tmp_path, monkeypatch):
    """An empty cache, and a builder that takes no time: the seeds of the houses that it built."""
    built = []

    def build_tiny(folder, seed):
        built.append(seed)
        shutil.copytree(tiny_house, folder, dirs_exist_ok=True)

    monkeypatch.setattr(archives, "user_cache", lambda: tmp_path / "cache")
    monkeypatch.setattr(house, "build_house", build_tiny)
    return built


def test_a_house_is_built_once_and_announced_in_one_line(cache, capsys):
    first = house.load(3, objects=AUTHORS_SPLIT.objects)
    message = capsys.readouterr().err
    assert (
        "house-3-1 is not in the cache yet" in message and "ten seconds" in message and len(message.splitlines()) == 1
    )
    second = house.load(3, objects=AUTHORS_SPLIT.objects)
    np.testing.assert_array_equal(first.images, second.images)
    assert capsys.readouterr() == ("", "")
    with pytest.raises(UserError, match="objects: 'red_bul' is not in the instance map"):
        house.load(3, objects=["red_bul"])
    assert cache == [3]
    assert not list(house.cached_folder(3).parent.glob(".*"))


@pytest.mark.long
def test_a_damaged_house_is_built_again(cache, capsys):
    first = house.load(3, objects=AUTHORS_SPLIT.objects)
    picture = sorted((house.cached_folder(3) / "Home_101_1" / "jpg_rgb").iterdir())[7]
    annotations = house.cached_folder(3) / "Home_101_1" / "annotations.json"
    for damage in (lambda: picture.write_bytes(picture.read_bytes()[:100]), annotations.unlink):
        capsys.readouterr()
        damage()
        again = house.load(3, objects=AUTHORS_SPLIT.objects)
        np.testing.assert_array_equal(first.images, again.images)
        assert "house-3-1 in the cache is damaged" in capsys.readouterr().err
    assert cache == [3] * 3


@pytest.mark.long
def test_a_cache_that_cannot_be_written_to_costs_only_time(cache, tmp_path, capsys):
    (tmp_path / "cache").write_text("a file in the way")
    assert len(house.load(3, objects=AUTHORS_SPLIT.objects).images) and "cannot be written" in capsys.readouterr().err
    assert (tmp_path / "cache").read_text() == "a file in the way"


@pytest.mark.long
def test_of_two_processes_that_build_at_once_the_first_one_counts(cache, monkeypatch):
    build = house.build_house

    def build_slowly(folder, seed):
        """While this builds, another process does."""
        build(folder, seed)
        monkeypatch.setattr(house, "build_house", build)
        house.load(3, objects=AUTHORS_SPLIT.objects)
        (house.cached_folder(3) / "first").touch()

    monkeypatch.setattr(house, "build_house", build_slowly)
    assert len(house.load(3, objects=AUTHORS_SPLIT.objects).images)
    assert cache == [3, 3] and (house.cached_folder(3) / "first").exists()


def test_a_build_that_is_stopped_leaves_nothing(cache, monkeypatch):
    def stopped(folder, seed):
        (folder / "Home_101_1").mkdir(parents=True)
        raise KeyboardInterrupt

    monkeypatch.setattr(house, "build_house", stopped)
    with pytest.raises(KeyboardInterrupt):
        house.load(3, objects=AUTHORS_SPLIT.objects)
    assert not list(house.cached_folder(3).parent.iterdir())


@pytest.fixture(scope="module", params=[pytest.param(0, marks=pytest.mark.long)])
def default(request):
    """The house that object search is in where no dataset is given: a quarter of a minute to build."""
    return house.load(request.param, objects=AUTHORS_SPLIT.objects)


def steps_to(next_state, targets):
    """Least number of moves from each state to one of the targets; -1 where there is no way."""
    distance = np.where(targets, 0, -1)
    for step in range(1, len(next_state)):
        arrives = (distance[next_state] == step - 1).any(1) & (distance < 0)
        if not arrives.any():
            break
        distance[arrives] = step
    return distance


def test_the_default_house_is_the_one_that_results_were_made_in(default):
    """Its content is in every table of docs/results."""
    name = "synthetic house, seed 0 (a stand-in for the Active Vision Dataset), 1 scene, 1872 images"
    assert envs.load("object_search").source == f"{name}, content 13a32542"
    assert check_active_vision(house.cached_folder()) == []


def test_the_default_house_is_that_of_seed_0(default):
    plan = house_layout.layout(0)
    np.testing.assert_allclose(default.position[::12, :2], plan.nodes, atol=1e-4)


def test_the_default_house_can_be_solved_but_not_by_chance(default):
    """Every goal can be reached from everywhere, a shortest path is 10 to 16 steps, a random policy finds a goal in
    fewer than a quarter of its episodes of 100 steps."""
    states, objects = default.visible.shape
    ways = default.next_state != np.arange(states)[:, None]
    order = np.argsort(~ways, axis=1, kind="stable")
    rng = np.random.default_rng(0)
    lengths, found = [], []
    for goal in range(objects):
        seen = default.visible[:, goal]
        distance = steps_to(default.next_state, seen)
        assert (distance >= 0).all()
        lengths.append(distance[~seen].mean())
        state = rng.choice(np.flatnonzero(~seen), 200)
        reached = np.zeros(200, bool)
        for _ in range(100):
            state = default.next_state[state, order[state, rng.integers(ways[state].sum(1))]]
            reached |= seen[state]
        found.append(reached.mean())
    assert 10 < np.mean(lengths) < 16 and np.mean(found) < 0.25
    assert default.visible.sum(0).min() >= 10


def test_places_of_the_default_house_look_different(default):
    """No two pictures taken more than 1.5 m apart look the same to the agent (root mean square, of 255 grey levels)."""
    pictures = default.images.reshape(len(default.images), -1).astype(np.float64)
    square = (pictures**2).sum(1)
    difference = (square[:, None] + square - 2 * pictures @ pictures.T) / pictures.shape[1]
    apart = np.linalg.norm(default.position[:, None, :2] - default.position[:, :2], axis=-1) > 1.5
    assert difference[apart].min() > 4**2


def test_no_view_of_the_default_house_shows_goals_of_two_rooms(default):
    room = np.array([AUTHORS_SPLIT.rooms[name] for name in AUTHORS_SPLIT.objects])
    assert max(len(set(room[seen])) for seen in default.visible) == 1


def test_boxes_lie_in_the_picture_and_are_not_empty(annotations, tiny_house):
    name = next(iter(annotations))
    height, width = cv2.imread(str(tiny_house / "Home_101_1" / "jpg_rgb" / name)).shape[:2]
    for record in annotations.values():
        for left, top, right, bottom, identity, difficulty in record["bounding_boxes"]:
            assert 0 <= left < right <= width
            assert 0 <= top < bottom <= height
            assert identity in house.INSTANCE_IDS.values()
            assert 1 <= difficulty <= 5
