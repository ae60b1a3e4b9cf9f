"""The generated shelf: detections follow from boxes, flights cover it, the same seed gives the same shelf, and the task
is not too easy."""

import itertools

import numpy as np
import pytest

from infogoal_jax.data import frames, splits
from infogoal_jax.envs.graph import distances
from infogoal_jax.stand_ins import shelf

SEEDS = (0, 1, 2)
EPISODE = 50
OPPOSITE = (1, 0, 3, 2)  # Of left, right, up, down.


@pytest.fixture(scope="module")
def whole():
    """The shelf of seed 0 as it is shipped, with small images."""
    return shelf.build(0, size=(12, 16))


@pytest.fixture
def corner(monkeypatch):
    """`build` for 6 x 3 places only: drawing all of them several times takes minutes."""
    monkeypatch.setattr(shelf, "COLUMNS", 6)
    monkeypatch.setattr(shelf, "ROWS", 3)
    return shelf.build


@pytest.fixture(scope="module", params=SEEDS)
def detected(request):
    """Which objects are detected from where, bool [S, 24], without drawing."""
    places = shelf.furnish(np.random.default_rng([request.param, shelf.GENERATOR_VERSION]))
    views = [shelf.camera(place, 0.0) for place in centres()]
    return np.array([[shelf.in_view(view, box) for box in shelf.boxes(places)] for view in views])


def centres() -> np.ndarray:
    """Where the camera is in each state, float [S, 2], m."""
    row, column = np.divmod(np.arange(shelf.ROWS * shelf.COLUMNS), shelf.COLUMNS)
    return shelf.FIRST + shelf.STEP * np.stack([column, row], axis=-1)


def random_success(table: np.ndarray, goal: np.ndarray, steps: int) -> float:
    """Chance that uniformly random moves reach `goal`, bool [S], within `steps`, from a uniform state outside it.
    Exact: no episodes are drawn."""
    exists = table != np.arange(len(table))[:, None]
    chance = goal.astype(float)
    for _ in range(steps):
        after = np.where(exists, chance[table], 0).sum(1) / exists.sum(1)
        chance = np.where(goal, 1.0, after)
    return float(chance[~goal].mean())


@pytest.mark.long
def test_an_object_is_detected_where_its_whole_box_is_in_the_view(whole):
    """Of a level camera the view is a rectangle of 1.04 x 0.78 m around its position: half the field of view's tangent
    on either side."""
    places = shelf.furnish(np.random.default_rng([0, shelf.GENERATOR_VERSION]))
    assert tuple(places) == whole.objects
    half = np.tan(np.radians([55.0, 42.8]) / 2)
    boxes = np.array(shelf.boxes(places))  # [24, 4, 2]
    away = np.abs(boxes[None] - whole.position[:, None, None].astype(float))
    wanted = (away <= half).all((2, 3))
    on_the_edge = (np.abs(away - half) < 1e-6).any((2, 3))
    assert not (wanted != whole.detected)[~on_the_edge].any()
    assert whole.detected.any(0).all()


def test_six_objects_stand_in_each_region_apart_from_each_other():
    asked = splits.load_questions(splits.SHIPPED_QUESTIONS)
    for seed in range(20):
        places = shelf.furnish(np.random.default_rng([seed, shelf.GENERATOR_VERSION]))
        boxes = np.array(shelf.boxes(places))
        low, high = boxes.min(1), boxes.max(1)
        assert (low >= 0).all() and (high <= shelf.SIZE).all()
        apart = ((low[:, None] >= high[None]) | (high[:, None] <= low[None])).any(-1)
        assert apart[~np.eye(len(apart), dtype=bool)].all()
        for name, room in zip(asked.objects, asked.rooms, strict=True):
            middle = (boxes[asked.objects.index(name)].mean(0) > shelf.SIZE / 2).tolist()
            assert middle == ["right" in asked.room_names[room], "upper" in asked.room_names[room]]


def test_moves_are_steps_of_20_cm_that_can_be_undone_and_end_at_the_edges():
    table, position = shelf.moves(), centres()
    for state, action in np.argwhere(table != np.arange(len(table))[:, None]):
        after = table[state, action]
        np.testing.assert_allclose(position[after] - position[state], shelf.STEP * shelf.STEPS[action])
        assert table[after, OPPOSITE[action]] == state
    missing = (table == np.arange(len(table))[:, None]).reshape(shelf.ROWS, shelf.COLUMNS, 4)
    rows, columns = np.ogrid[: shelf.ROWS, : shelf.COLUMNS]
    for action, edge in enumerate((columns == 0, columns == shelf.COLUMNS - 1, rows == shelf.ROWS - 1, rows == 0)):
        assert (missing[..., action] == edge).all()


@pytest.mark.long
def test_flights_make_every_move_of_every_state(whole):
    assert (frames.next_state(whole) == shelf.moves()).all()
    assert whole.num_states == shelf.ROWS * shelf.COLUMNS
    assert 300 <= whole.trajectory.max() + 1 <= 500


@pytest.mark.long
def test_a_flight_goes_on_where_its_last_move_ended(whole):
    going_on = whole.trajectory[1:] == whole.trajectory[:-1]
    assert (whole.next_frame[:-1] == whole.frame[1:])[going_on].all()
    assert (whole.time[1:] == np.where(going_on, whole.time[:-1] + 1, 0)).all() and whole.time[0] == 0
    assert (whole.terminal[:-1] == ~going_on).all() and whole.terminal[-1]
    assert (whole.time[whole.terminal] == shelf.FLIGHT_LENGTH - 1).all()


def test_flights_over_any_table_of_moves_cover_it():
    ring = np.stack([(np.arange(30) + 1) % 30, (np.arange(30) - 1) % 30], axis=-1)
    ring[7, 0] = 7  # A move that is missing one way only.
    flights = shelf.record_trajectories(ring, np.random.default_rng(0), length=5, at_least=1)
    made = {(int(place), int(action)) for flight in flights for place, action, _ in flight}
    assert made == {(place, action) for place in range(30) for action in range(2)} - {(7, 0)}
    assert all((flight[1:, 0] == flight[:-1, 2]).all() and len(flight) == 5 for flight in flights)


def test_a_random_policy_finds_fewer_than_three_of_ten_objects(detected):
    table = shelf.moves()
    assert np.mean([random_success(table, goal, EPISODE) for goal in detected.T]) < 0.3


def test_a_shortest_path_finds_every_object_from_everywhere(detected):
    assert detected.any(0).all()
    assert distances(shelf.moves(), detected).max() <= EPISODE


@pytest.mark.long
def test_states_look_different(whole):
    assert len(np.unique(whole.frames.reshape(len(whole.frames), -1), axis=0)) == whole.num_states


@pytest.mark.long
def test_the_same_seed_gives_the_same_dataset_and_another_seed_another(corner):
    first, again, other = corner(3), corner(3), corner(4)
    for name, value in vars(first).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, getattr(again, name))
    assert first.about == again.about != other.about
    assert (first.frames != other.frames).any((1, 2, 3)).all()
    assert (first.detected != other.detected).any() or (first.frame != other.frame).any()


def test_on_a_gathered_shelf_neighbours_of_a_region_are_seen_together():
    """Each object with the next on its board of the region, from somewhere; elsewhere few are. Objects do not overlap,
    and stay in their half."""
    asked = splits.load_questions(splits.SHIPPED_QUESTIONS)
    views = [shelf.camera(place, 0.0) for place in centres()]
    together = {}
    for gathered in (False, True):
        places = shelf.furnish(np.random.default_rng([0, shelf.GENERATOR_VERSION]), gathered)
        room = dict(zip(places, asked.rooms, strict=True))
        in_order = sorted(places, key=lambda name: (room[name], places[name][1], places[name][0]))
        neighbours = [
            (first, second)
            for first, second in itertools.pairwise(in_order)
            if room[first] == room[second] and places[first][1] == places[second][1]
        ]
        assert len(neighbours) == 4 * 2 * (shelf.SLOTS - 1)
        boxes = dict(zip(places, shelf.boxes(places), strict=True))
        seen = {name: np.array([shelf.in_view(view, box) for view in views]) for name, box in boxes.items()}
        together[gathered] = np.mean([(seen[first] & seen[second]).any() for first, second in neighbours])
        for first, second in neighbours:
            assert places[first][0] + shelf.DRAWINGS[first][0] / 100 <= places[second][0]
        for name, (left, _) in places.items():
            half = 0.0 if "left" in asked.room_names[room[name]] else shelf.SIZE[0] / 2
            assert half <= left and left + shelf.DRAWINGS[name][0] / 100 <= half + shelf.SIZE[0] / 2
    assert together[True] == 1.0 and together[False] < 0.5


@pytest.mark.long
def test_a_hovering_drone_sees_a_state_in_several_images_that_a_dataset_may_hold(corner, tmp_path):
    data = corner(3, hovering=True)
    assert (np.bincount(data.state) == shelf.VIEWS).all()
    for state in range(data.num_states):
        shown = data.frames[data.state == state]
        assert len(np.unique(shown.reshape(len(shown), -1), axis=0)) == shelf.VIEWS
    assert (frames.next_state(data) == shelf.moves()).all()
    flown = np.append(data.frame, data.next_frame[data.terminal])
    assert set(flown) == set(range(len(data.frames)))
    frames.save(tmp_path / "shelf.npz", data)
    assert (frames.load(tmp_path / "shelf.npz").frames == data.frames).all()
