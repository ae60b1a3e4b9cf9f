"""Image datasets: the file keeps every bit, `infogoal data check` finds every planted fault in one pass, and the cache
costs nothing but time."""

import dataclasses

import cv2
import numpy as np
import pytest

from infogoal_jax.cli.main import main
from infogoal_jax.data import archives, frames, frames_check
from infogoal_jax.data.frames import FrameDataset
from infogoal_jax.errors import UserError
from infogoal_jax.stand_ins import cube


def small(**changes) -> FrameDataset:
    """Six frames of five states in a row; two trajectories: 0 1 2 3 to the right, 4 5 0 to the left."""
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 10, 3), np.uint8)
    turns = [cv2.Rodrigues(np.array([0.1, 0.2, 0.3]) * row)[0] for row in range(6)]
    fields = {
        "frames": pixels,
        "state": np.array([0, 1, 2, 3, 4, 4], np.int32),
        "actions": ("right", "left ←"),
        "frame": np.array([0, 1, 2, 4, 5], np.int32),
        "action": np.array([0, 0, 0, 1, 0], np.int32),
        "next_frame": np.array([1, 2, 3, 5, 0], np.int32),
        "trajectory": np.array([3, 3, 3, 7, 7], np.int32),
        "time": np.array([0, 1, 2, 0, 1], np.int32),
        "terminal": np.array([False, False, True, False, True]),
        "about": {"name": "a row of five", "stand_in": True, "made_by": "a test", "seed": 3},
        "rotation": np.array(turns, np.float32),
        "joints": np.arange(12, dtype=np.float32).reshape(6, 2),
        "joint_names": ("shoulder", "rail_m"),
        "position": np.arange(12, dtype=np.float32).reshape(6, 2) / 3,
        "detected": np.eye(6, 2, dtype=bool),
        "objects": ("a red mug", "una caña"),
    }
    return FrameDataset(**(fields | changes))


MOVES = ("frame", "action", "next_frame", "trajectory", "time", "terminal")
OPTIONAL = {"rotation": None, "joints": None, "position": None, "detected": None, "objects": (), "joint_names": ()}


def planted(path, **changes) -> None:
    """A file of `small` with other members; None leaves one out."""
    members = frames.members_of(small()) | changes
    np.savez(path, **{name: value for name, value in members.items() if value is not None})


@pytest.mark.parametrize("changes", [{}, OPTIONAL, {"frames": small().frames[..., :1]}], ids=["all", "few", "grey"])
def test_what_is_saved_is_loaded_bit_by_bit(changes, tmp_path):
    saved = small(**changes)
    path = tmp_path / "new" / "row"  # numpy would add an ending to the name
    frames.save(path, saved)
    loaded = frames.load(path)
    for field in dataclasses.fields(FrameDataset):
        one, other = getattr(saved, field.name), getattr(loaded, field.name)
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
        else:
            assert one == other and type(one) is type(other)
    frames.save(tmp_path / "again", loaded)
    assert (tmp_path / "again").read_bytes() == path.read_bytes()
    assert [file.name for file in path.parent.iterdir()] == ["row"]


def test_next_state_follows_the_moves_and_stays_where_none_is_recorded():
    table = frames.next_state(small())
    assert table.dtype == np.int32
    np.testing.assert_array_equal(table, [[1, 0], [2, 1], [3, 2], [3, 3], [0, 4]])


def test_next_state_names_the_two_moves_that_contradict_each_other():
    contradicting = small(state=np.array([0, 1, 2, 3, 0, 4], np.int32), action=np.zeros(5, np.int32))
    with pytest.raises(
        UserError, match=r"a row of five: next_frame\[3\]: moves 0 and 3 are both action 0 in state 0.* states 1 and 4"
    ):
        frames.next_state(contradicting)


def changed(name: str, row, value) -> dict:
    """The member of `small` with another value in a row."""
    array = np.array(frames.members_of(small())[name])
    array[row] = value
    return {name: array}


MIRROR = np.diag([1, 1, -1]).astype(np.float32)
FAULTS = {  # What is changed in a sound file, and what the message must say: where, what is wrong, what to do.
    "no frames": ({"frames": None}, ["frames: missing", "frames.save"]),
    "no moves": (
        {name: np.zeros(0, bool if name == "terminal" else np.int32) for name in MOVES},
        ["frame: has no moves"],
    ),
    "wrong type": ({"action": np.zeros(5)}, ["action: is float64", ".astype(np.int32)"]),
    "floats in frames": ({"frames": np.zeros((6, 8, 10, 3))}, ["frames: is float64", "uint8"]),
    "no channels": (
        {"frames": np.zeros((6, 8, 10), np.uint8)},
        ["frames: has the shape [6, 8, 10]", "[K, H, W, 1 or 3]"],
    ),
    "four channels": ({"frames": np.zeros((6, 8, 10, 4), np.uint8)}, ["frames: has the shape [6, 8, 10, 4]"]),
    "fewer states than frames": ({"state": np.arange(5, dtype=np.int32)}, ["state: has 5 frames, but frames has 6"]),
    "fewer actions than moves": ({"action": np.zeros(4, np.int32)}, ["action: has 4 moves, but frame has 5"]),
    "a name short": ({"joint_names": np.array(["shoulder"])}, ["joints: has 2 joints, but joint_names has 1"]),
    "detected without objects": ({"objects": None}, ["objects: missing, but there is detected"]),
    "an empty name": ({"actions": np.array(["right", " "])}, ["actions[1]: is empty"]),
    "a name twice": ({"actions": np.array(["right", "right"])}, ["actions[1]: 'right' is actions[0]"]),
    "from nowhere": (changed("frame", 3, 6), ["frame[3]: is 6, which is not there; give 0 to 5"]),
    "to nowhere": (changed("next_frame", 4, -1), ["next_frame[4]: is -1, which is not there"]),
    "no such action": (changed("action", 2, 2), ["action[2]: is 2, which is not there; give 0 to 1"]),
    "a gap in the states": (changed("state", [4, 5], 9), ["state[4]: is 9, but no frame shows state 4"]),
    "a negative state": (changed("state", 2, -1), ["state[2]: is -1; count states from 0"]),
    "contradicting moves": (
        changed("state", 4, 1) | changed("action", 3, 0),
        ["moves 1 and 3 are both action 0 in state 1", "2 and 4; remove"],
    ),
    "trajectories mixed": (changed("trajectory", 0, 8), ["trajectory[1]: is 3 after 8; sort"]),
    "time does not begin": (changed("time", 3, 1), ["time[3]: is 1, but trajectory 7 begins here; count time from 0"]),
    "a gap in time": (changed("time", 2, 5), ["time[2]: is 5 after 1, a gap in trajectory 3; split it"]),
    "frames that do not join": (
        changed("next_frame", 0, 5),
        ["next_frame[0]: is 5, but the next move of trajectory 3 starts at frame[1] = 1"],
    ),
    "an end in the middle": (changed("terminal", 1, True), ["terminal[1]: is true in the middle of trajectory 3"]),
    "no end": (changed("terminal", 4, False), ["terminal[4]: is false, but trajectory 7 has no later move; set it"]),
    "a stretched rotation": (
        changed("rotation", 1, 1.01 * np.eye(3)),
        ["rotation[1]: is no rotation; give orthogonal"],
    ),
    "a mirror": (changed("rotation", 5, MIRROR), ["rotation[5]: is no rotation"]),
    "an infinite joint": (changed("joints", 2, np.inf), ["joints[2]: is [inf, inf]; give finite numbers, radians"]),
    "no position": (changed("position", 0, np.nan), ["position[0]: is [nan, nan]; give finite numbers, metres"]),
    "about is no JSON": ({"about": np.array("by hand")}, ["about: is no JSON"]),
    "about without a name": (
        {"about": np.array('{"stand_in": true, "made_by": "x"}')},
        ["about: its name is None; give words"],
    ),
    "another version": ({"format_version": np.array(2)}, ["format_version: is 2; this program reads 1"]),
    "pickles": ({"detected": np.array([{}] * 6, object)}, ["detected: unreadable", "pickled objects", "frames.save"]),
}


@pytest.mark.parametrize("case", FAULTS)
def test_a_fault_is_named_with_file_field_row_and_remedy(case, tmp_path):
    changes, expected = FAULTS[case]
    planted(tmp_path / "row.npz", **changes)
    with pytest.raises(UserError) as caught:
        frames.load(tmp_path / "row.npz")
    message = str(caught.value)
    assert all(part in message for part in ["row.npz: ", *expected, "infogoal data check"]), message
    errors = [finding for finding in frames_check.check_frames(tmp_path / "row.npz") if finding.severity == "error"]
    assert f"{errors[0].where}: {errors[0].problem};" in message, errors


def test_every_planted_fault_is_found_in_one_pass(tmp_path, capsys):
    cases = [
        "a name twice",
        "from nowhere",
        "no such action",
        "a gap in the states",
        "time does not begin",
        "frames that do not join",
        "no end",
        "a mirror",
        "an infinite joint",
        "about is no JSON",
        "another version",
        "pickles",
    ]
    planted(tmp_path / "row.npz", **{name: value for case in cases for name, value in FAULTS[case][0].items()})
    problems = [f"{finding.where}: {finding.problem}" for finding in frames_check.check_frames(tmp_path / "row.npz")]
    missing = [case for case in cases if not any(FAULTS[case][1][0] in problem for problem in problems)]
    assert not missing, problems
    assert main(["data", "check", str(tmp_path / "row.npz")]) == 1
    printed = capsys.readouterr().out
    assert all(problem in printed for problem in problems) and "errors, " in printed.splitlines()[-1]


def test_a_sound_file_has_no_finding_and_is_summed_up(tmp_path, capsys):
    frames.save(tmp_path / "row.npz", small())
    assert frames_check.check_frames(tmp_path / "row.npz") == []
    assert main(["data", "check", str(tmp_path / "row.npz")]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].endswith("0 errors, 0 warnings")
    assert (
        "a row of five; 6 frames of 8 x 10 x 3, 5 states, 5 moves of 2 actions; 0.0 MB on disk, 0.0 MB on the device"
        in printed[1]
    )


def test_what_may_surprise_is_a_warning_and_no_error(tmp_path):
    sound = small()
    pixels = sound.frames.copy()
    pixels[4] = pixels[1]
    surprising = {
        "frames": pixels,
        "detected": np.zeros((6, 2), bool),
        "actions": np.array(["right", "left", "up"]),
        "rotations": sound.rotation,
        **{name: getattr(sound, name)[:3] for name in MOVES},
    }
    planted(tmp_path / "row.npz", **surprising)
    frames.load(tmp_path / "row.npz")
    findings = frames_check.check_frames(tmp_path / "row.npz")
    assert {finding.severity for finding in findings} == {"warning"}
    problems = [f"{finding.where}: {finding.problem}" for finding in findings]
    expected = [
        "rotations: nothing reads it. Did you mean 'rotation'?",
        "objects[0]: 'a red mug' is detected in no frame",
        "objects[1]",
        "state[4]: no move leaves or reaches state 4",
        "actions[2]: 'up' is the action of no move",
        "frames[4]: has the pixels of frames[1]",
    ]
    for part in expected:
        assert any(part in problem for problem in problems), (part, problems)


def test_many_faults_of_one_kind_are_counted(tmp_path):
    planted(tmp_path / "row.npz", rotation=np.zeros((6, 3, 3), np.float32), joints=np.full((6, 2), np.nan, np.float32))
    assert len(frames_check.check_frames(tmp_path / "row.npz")) == 12
    planted(tmp_path / "long.npz", frame=np.full(50, 77, np.int32))
    problems = [f"{finding.where}: {finding.problem}" for finding in frames_check.check_frames(tmp_path / "long.npz")]
    assert sum("frame[" in problem for problem in problems) == frames_check.MOST_FINDINGS
    assert any("frame: 40 more rows" in problem for problem in problems)


@pytest.mark.parametrize("kept", [0, 1, 40, 0.3, 0.7, -1])
def test_a_file_cut_short_is_named(kept, tmp_path):
    path = tmp_path / "row.npz"
    frames.save(path, small())
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content)) if 0 < kept < 1 else kept])
    with pytest.raises(
        UserError, match=r"image dataset = '.*row\.npz': format = 'not an npz': the file is cut short.*data import"
    ):
        frames.load(path)
    assert [finding.problem.split(":")[0] for finding in frames_check.check_frames(path)] == ["format = 'not an npz'"]


def test_a_changed_byte_is_found(tmp_path):
    path = tmp_path / "row.npz"
    frames.save(path, small())
    content = bytearray(path.read_bytes())
    content[-len(content) // 2] ^= 255
    path.write_bytes(content)
    with pytest.raises(UserError, match="frames: unreadable"):
        frames.load(path)


def test_files_that_cannot_be_read_or_written_are_named(tmp_path, capsys):
    assert main(["data", "check", str(tmp_path / "nothing.npz")]) == 1
    assert "no such file" in capsys.readouterr().out
    with pytest.raises(UserError, match="cannot be read"):
        frames.load(tmp_path)
    with pytest.raises(UserError, match="cannot be written"):
        frames.save(tmp_path, small())
    with pytest.raises(UserError, match=r"row\.npz: rotation\[1\]: is no rotation"):
        frames.save(tmp_path / "row.npz", small(**changed("rotation", 1, 0)))
    with pytest.raises(UserError, match="give values that JSON has"):
        frames.save(tmp_path / "row.npz", small(about={"name": np.zeros(3)}))
    assert not list(tmp_path.iterdir())


def test_a_write_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    frames.save(tmp_path / "row.npz", small())

    def disk_full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(archives.os, "fsync", disk_full)
    with pytest.raises(UserError, match="No space left"):
        frames.save(tmp_path / "row.npz", small(**OPTIONAL))
    assert frames.load(tmp_path / "row.npz").objects and len(list(tmp_path.iterdir())) == 1


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The user's cache folder, moved; it is not there yet."""
    folder = tmp_path / "cache"
    monkeypatch.setattr(archives, "user_cache", lambda: folder)
    return folder


def test_a_dataset_is_built_once_and_then_comes_from_the_cache(cache, capsys):
    built = []

    def build():
        built.append(small())
        return built[-1]

    first = frames.cached("row-1", build, "a moment")
    message = capsys.readouterr().err
    assert "row-1 is not in the cache yet" in message and "takes a moment" in message and len(message.splitlines()) == 1
    second = frames.cached("row-1", build)
    np.testing.assert_array_equal(first.frames, second.frames)
    assert len(built) == 1 and capsys.readouterr() == ("", "")
    path = cache / "row-1.npz"
    path.write_bytes(path.read_bytes()[:-100])
    frames.cached("row-1", build)
    assert len(built) == 2 and "damaged" in capsys.readouterr().err
    frames.cached("row-1", build)
    assert len(built) == 2


def test_a_cache_that_cannot_be_written_to_costs_only_time(cache, capsys):
    cache.write_text("a file in the way")
    dataset = frames.cached("row-1", small)
    assert (
        len(dataset.frames) == 6
        and "cannot be written" in capsys.readouterr().err
        and cache.read_text() == "a file in the way"
    )


def test_the_command_builds_a_dataset_in_a_new_file(tmp_path, monkeypatch, capsys):
    def build(seed, physical_limits, size=64, progress=None):
        progress(0.5)
        return small(about=small().about | {"seed": seed, "physical_limits": physical_limits})

    monkeypatch.setattr(cube, "build", build)
    path = tmp_path / "cube.npz"
    assert main(["data", "build", "cube", str(path), "--seed", "5", "--physical-limits"]) == 0
    assert "6 frames" in capsys.readouterr().out
    assert frames.load(path).about["seed"] == 5 and frames.load(path).about["physical_limits"] is True
    mistakes = {
        ("cube", str(path)): "is there already",
        ("cube", "cube"): "let it end in .npz",
        ("castle",): "Known: house, cube",
    }
    for arguments, expected in mistakes.items():
        assert main(["data", "build", *arguments]) == 2
        assert expected in capsys.readouterr().err
