"""Recorded flights become an image dataset by `infogoal data import`, without moves that were not made."""

import numpy as np
import pytest

from infogoal_jax.data import frames, frames_import
from infogoal_jax.drone.envelope import MOVES, Whereabouts
from infogoal_jax.drone.records import TABLE, Explorer, Recorder
from infogoal_jax.drone.vision import Picture
from infogoal_jax.errors import UserError


def record(folder, name: str, moves, origin=(0, 0), seen_from: int = 1) -> int:
    """A recorded flight of (move, answer) from the first place, and a picture after the last. seen_from: column from
    which the mug is seen."""
    recorder, place, random = Recorder(folder, name, origin), Whereabouts(), np.random.default_rng(len(moves))
    for move, answer in [*moves, ("", "")]:
        image = random.integers(0, 255, (48, 64, 3), dtype=np.uint8)
        recorder.visit(Picture(0.0, image, image), place, {"red mug"} if place.low[0] >= seen_from else set(), move)
        place = place.after(move, answer) if move else place
    return recorder.close()


def imported(folder) -> frames.FrameDataset:
    """The dataset of all recordings."""
    return frames_import.import_folder(folder, folder / TABLE, folder.parent / "mine.npz")


def test_two_flights_make_a_dataset(tmp_path):
    folder = tmp_path / "recordings"
    assert record(folder, "monday", [("right", "made"), ("up", "made")]) == 2
    assert record(folder, "tuesday", [("left", "made")], origin=(2, 0)) == 1
    data = imported(folder)
    assert (len(data.frames), len(data.frame), data.objects) == (5, 3, ("red mug",))
    assert data.state[1] == data.state[4] and data.num_states == 4, "both flights saw the place (1, 0)"
    np.testing.assert_allclose(data.position[:3, :2], [[0, 0], [0.2, 0], [0.2, 0.2]], atol=1e-6)
    assert data.detected[:, 0].tolist() == [False, True, True, False, False]
    frames.next_state(data)


def test_refused_moves_are_left_out(tmp_path):
    folder = tmp_path / "recordings"
    assert record(folder, "monday", [("right", "refused"), ("up", "made"), ("up", "refused")], seen_from=0) == 1
    data = imported(folder)
    assert [data.actions[action] for action in data.action] == ["up"] and len(data.frames) == 2


def test_an_answer_that_is_missing_ends_the_recording(tmp_path):
    folder = tmp_path / "recordings"
    assert record(folder, "monday", [("right", "made"), ("up", "unanswered"), ("left", "made")]) == 1
    assert len(imported(folder).frames) == 2


def test_a_flight_without_a_move_leaves_no_rows(tmp_path):
    assert record(tmp_path, "monday", []) == 0
    assert not (tmp_path / TABLE).exists()


def test_the_explorer_stays_within_what_is_allowed():
    explorer, random = Explorer(0), np.random.default_rng(0)
    taken = []
    for _ in range(300):
        mask = random.random(len(MOVES)) < 0.6
        mask[random.integers(len(MOVES))] = True
        taken.append(explorer(None, mask))
        assert mask[taken[-1]]
    assert set(taken) == set(range(len(MOVES)))


def test_a_name_is_not_used_twice(tmp_path):
    record(tmp_path, "monday", [("right", "made")])
    with pytest.raises(UserError, match="holds monday already; give another folder"):
        Recorder(tmp_path, "monday")


def test_a_table_of_others_is_not_added_to(tmp_path):
    (tmp_path / TABLE).write_text("my,own,columns\n1,2,3\n")
    with pytest.raises(UserError, match=f"its {TABLE} has other columns than image,trajectory"):
        Recorder(tmp_path, "monday")
    assert [path.name for path in tmp_path.iterdir()] == [TABLE]


def test_a_picture_that_the_disk_refuses_is_an_error_that_ends_the_flight(tmp_path):
    recorder, image = Recorder(tmp_path, "monday"), np.zeros((48, 64, 3), np.uint8)
    recorder.visit(Picture(0.0, image, image), Whereabouts(), set(), "right")
    (tmp_path / "monday").rename(tmp_path / "gone")
    with pytest.raises(UserError, match="record = .*monday/0001.png was refused.*free some space"):
        recorder.visit(Picture(0.0, image, image), Whereabouts().after("right", "made"), set(), "up")


def test_a_disk_that_is_full_leaves_no_half_row(tmp_path, monkeypatch):
    """/dev/full takes what is buffered and refuses to keep it."""
    assert record(tmp_path, "monday", [("right", "made")]) == 1
    (tmp_path / TABLE).unlink()
    (tmp_path / TABLE).symlink_to("/dev/full")
    monkeypatch.setattr("infogoal_jax.drone.records.check_recordings", lambda folder, trajectory: None)
    with pytest.raises(UserError, match="record = .*cannot be written .No space left"):
        record(tmp_path, "tuesday", [("right", "made")])
