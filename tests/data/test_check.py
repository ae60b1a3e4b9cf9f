"""`infogoal data check` finds every fault of a folder of the Active Vision Dataset, and of an image dataset, in one
pass, names it with its place and what to do about it, and finds nothing in a sound one."""

import json
import shutil

import numpy as np
import pytest
from hand_made_frames import MOVES, changed, planted, small

from infogoal_jax.cli.main import main
from infogoal_jax.data import check as check_module
from infogoal_jax.data import frames, frames_check, members
from infogoal_jax.data.active_vision import ACTIONS
from infogoal_jax.data.check import check_active_vision
from infogoal_jax.errors import UserError
from infogoal_jax.stand_ins import house

SCENE = "Home_101_1"


@pytest.fixture
def copy(tiny_house, tmp_path):
    return shutil.copytree(tiny_house, tmp_path / "copy")


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def test_a_sound_dataset_has_no_fault(tiny_house):
    assert check_active_vision(tiny_house) == []


def plant_everything(root):
    """One fault of every kind in one scene. Returns what is to be found: severity, part of `where` and of `problem`."""
    expected = []
    scene = root / SCENE
    annotations = json.loads((scene / "annotations.json").read_text())
    names = sorted(annotations)
    images = scene / "jpg_rgb"

    cut(images / names[0])
    expected.append(("error", names[0], "not a whole JPEG"))
    (images / names[1]).unlink()
    expected.append(("error", names[1], "missing, but annotated"))

    annotations[names[40]]["left"] = "010119999990101.jpg"
    expected.append(("error", names[40], "left leads to 010119999990101.jpg, which is not there"))
    annotations[names[101]]["right"] = 7
    expected.append(("error", names[101], "right is 7"))

    annotations[names[110]]["bounding_boxes"].append([0, 0, 9, 9, 77, 1])
    expected.append(("error", names[110], "id 77 is not in the instance map"))
    annotations[names[111]]["bounding_boxes"].append([0, 0, 65, 9, 1, 1])
    expected.append(("error", names[111], "outside the image of 64 x 36 pixels"))
    annotations[names[112]]["bounding_boxes"].append([9, 0, 5, 9, 1, 1])
    expected.append(("error", names[112], "inverted"))
    annotations[names[113]]["bounding_boxes"].append([1, 2, 3])
    expected.append(("error", names[113], "wants [xmin"))
    annotations[names[115]] = []
    expected.append(("error", names[115], "not a dictionary"))

    unseen, lonely = house.INSTANCE_IDS["red_cup"], house.INSTANCE_IDS["red_bull"]
    island = "010110099990101.jpg"
    annotations[island] = {"bounding_boxes": [[0, 0, 30, 30, lonely, 1]]} | dict.fromkeys(ACTIONS, "")
    (images / island).write_bytes((images / names[2]).read_bytes())
    assert unseen != lonely
    with open(scene / "present_instance_names.txt", "a") as file:
        file.write("red_cup\nred_bull\nno_such_object\n")
    expected.append(("error", "red_cup", "can be seen from nowhere"))
    expected.append(("error", "red_bull", "can be reached from nowhere"))
    expected.append(("error", "present_instance_names.txt", "'no_such_object' is not in the instance map"))

    (scene / "annotations.json").write_text(json.dumps(annotations))
    cut(scene / "image_structs.mat")
    expected.append(("error", "image_structs.mat", "cut short"))
    with open(root / "all_instance_id_map.txt", "a") as file:
        file.write("three words 5\nred_cup 98\n")
    expected.append(("error", "all_instance_id_map.txt:34", "is not `name id`"))
    expected.append(("error", "all_instance_id_map.txt:35", "given before"))

    for number, damage in ((201, "missing"), (202, "cut short")):  # further scenes that have no annotations
        other = root / f"Home_{number}_1"
        (other / "jpg_rgb").mkdir(parents=True)
        if damage == "cut short":
            (other / "annotations.json").write_text('{"0101')
            expected.append(("error", "Home_202_1/annotations.json", "cut short"))
        else:
            expected.append(("error", "Home_201_1/annotations.json", "missing"))
    (root / "Home_203_1").mkdir()
    expected.append(("error", "Home_203_1/jpg_rgb", "missing"))
    return expected


def test_every_planted_fault_is_found_in_one_pass(copy):
    faults = plant_everything(copy)
    findings = check_active_vision(copy)
    for severity, where, problem in faults:
        found = [f for f in findings if where in f.where and problem in f.problem]
        assert found, f"not found: {where}: {problem}"
        assert {f.severity for f in found} == {severity}


def test_one_fault_is_one_finding(copy):
    """A fault does not drown in its own consequences."""
    path = copy / SCENE / "annotations.json"
    annotations = json.loads(path.read_text())
    name = sorted(annotations)[3]
    annotations[name]["bounding_boxes"].append([0, 0, 9, 9, 77, 1])
    path.write_text(json.dumps(annotations))
    (finding,) = check_active_vision(copy)
    assert (finding.severity, finding.where) == ("error", f"{SCENE}/{name}")


def test_images_are_read_once(tiny_house, monkeypatch):
    read = []
    size = check_module._size
    monkeypatch.setattr(check_module, "_size", lambda path: read.append(path) or size(path))
    check_active_vision(tiny_house)
    assert len(read) == len(set(read)) == len(list((tiny_house / SCENE / "jpg_rgb").iterdir()))


def test_wrong_folders_are_explained(tiny_house, tmp_path):
    (finding,) = check_active_vision(tmp_path / "nowhere")
    assert finding.problem.startswith("no such folder; give")
    (finding,) = check_active_vision(tiny_house / SCENE)
    assert "this is a scene" in finding.problem
    assert any("no scene folder" in f.problem for f in check_active_vision(tmp_path))


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
        ["frames: has the shape [6, 8, 10]", "[frames, rows of pixels, columns of pixels, 1 or 3]"],
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
    "an infinite joint": (changed("joints", 2, np.inf), ["joints[2]: is [inf, inf]; give finite numbers"]),
    "no position": (changed("position", 0, np.nan), ["position[0]: is [nan, nan]; give finite numbers"]),
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


def test_every_fault_of_a_file_is_found_in_one_pass(tmp_path, capsys):
    cases = (
        "a name twice, from nowhere, no such action, a gap in the states, time does not begin, frames that do not "
        "join, no end, a mirror, an infinite joint, about is no JSON, another version, pickles"
    ).split(", ")
    planted(tmp_path / "row.npz", **{name: value for case in cases for name, value in FAULTS[case][0].items()})
    problems = [f"{finding.where}: {finding.problem}" for finding in frames_check.check_frames(tmp_path / "row.npz")]
    missing = [case for case in cases if not any(FAULTS[case][1][0] in problem for problem in problems)]
    assert not missing, problems
    assert main(["data", "check", str(tmp_path / "row.npz")]) == 2
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
    surprising = {"detected": np.zeros((6, 2), bool), "rotations": sound.rotation}
    planted(tmp_path / "row.npz", **surprising)
    frames.load(tmp_path / "row.npz")
    findings = frames_check.check_frames(tmp_path / "row.npz")
    assert {finding.severity for finding in findings} == {"warning"}
    problems = [f"{finding.where}: {finding.problem}" for finding in findings]
    expected = [
        "rotations: nothing reads it. Did you mean 'rotation'?",
        "objects[0]: 'a red mug' is detected in no frame",
        "objects[1]",
    ]
    for part in expected:
        assert any(part in problem for problem in problems), (part, problems)


def test_many_faults_of_one_kind_are_counted(tmp_path):
    planted(tmp_path / "row.npz", rotation=np.zeros((6, 3, 3), np.float32), joints=np.full((6, 2), np.nan, np.float32))
    assert len(frames_check.check_frames(tmp_path / "row.npz")) == 12
    planted(tmp_path / "long.npz", frame=np.full(50, 77, np.int32))
    problems = [f"{finding.where}: {finding.problem}" for finding in frames_check.check_frames(tmp_path / "long.npz")]
    assert sum("frame[" in problem for problem in problems) == members.MOST_FAULTS
    assert any("frame: 40 more rows" in problem for problem in problems)
