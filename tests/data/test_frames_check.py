"""`infogoal data check` names every fault of an image dataset with its place and what to do about it."""

import numpy as np
import pytest
from hand_made_dataset import MOVES, planted, small

from infogoal_jax.cli.main import main
from infogoal_jax.data import frames, frames_check
from infogoal_jax.errors import UserError


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
