"""`check_active_vision` finds every planted fault in one pass, and nothing in a sound dataset."""

import json
import shutil

import pytest

from infogoal_jax.data import check as check_module
from infogoal_jax.data.active_vision import ACTIONS
from infogoal_jax.data.check import check_active_vision
from infogoal_jax.stand_ins import house

SCENE = "Home_101_1"


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    root = tmp_path_factory.mktemp("tiny_house")
    house.build_house(root, seed=5, node_spacing=1.2, image_width=64)
    return root


@pytest.fixture
def copy(tiny, tmp_path):
    return shutil.copytree(tiny, tmp_path / "copy")


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def test_a_sound_dataset_has_no_fault(tiny):
    assert check_active_vision(tiny) == []


class Expected:
    """The faults planted: severity, part of `where`, part of `problem`."""

    def __init__(self):
        self.faults = []

    def add(self, severity, where, problem):
        self.faults.append((severity, where, problem))


def plant_everything(root):
    """One fault of every kind in one scene. Returns what is to be found."""
    expected = Expected()
    scene = root / SCENE
    annotations = json.loads((scene / "annotations.json").read_text())
    names = sorted(annotations)
    images = scene / "jpg_rgb"

    cut(images / names[0])
    expected.add("error", names[0], "not a whole JPEG")
    (images / names[1]).unlink()
    expected.add("error", names[1], "missing, but annotated")
    (images / "stray.jpg").write_bytes(b"")
    expected.add("warning", "stray.jpg", "not annotated")

    annotations[names[40]]["left"] = "010119999990101.jpg"
    expected.add("error", names[40], "left leads to 010119999990101.jpg, which is not there")
    turned = annotations[names[41]]["rotate_cw"]
    annotations[turned]["rotate_ccw"] = ""
    expected.add("warning", names[41], f"one-way: rotate_cw leads to {turned}")
    walked = next(n for n in names[60:] if annotations[n]["forward"])
    ahead = annotations[walked]["forward"]
    annotations[ahead]["backward"] = names[-1]
    expected.add("warning", walked, f"one-way: forward leads to {ahead}")
    annotations[names[100]]["forward"] = names[100]
    expected.add("warning", names[100], "forward leads to the image itself")
    annotations[names[101]]["right"] = 7
    expected.add("error", names[101], "right is 7")

    annotations[names[110]]["bounding_boxes"].append([0, 0, 9, 9, 77, 1])
    expected.add("error", names[110], "id 77 is not in the instance map")
    annotations[names[111]]["bounding_boxes"].append([0, 0, 65, 9, 1, 1])
    expected.add("error", names[111], "outside the image of 64 x 36 pixels")
    annotations[names[112]]["bounding_boxes"].append([9, 0, 5, 9, 1, 1])
    expected.add("error", names[112], "inverted")
    annotations[names[113]]["bounding_boxes"].append([1, 2, 3])
    expected.add("error", names[113], "wants [xmin")
    annotations[names[114]]["bounding_boxes"].append([0, 0, 9, 9, 1, 12])
    expected.add("warning", names[114], "difficulty 12")
    annotations[names[115]] = []
    expected.add("error", names[115], "not a dictionary")
    annotations["0101.jpg"] = {"bounding_boxes": []} | dict.fromkeys(ACTIONS, "")
    (images / "0101.jpg").write_bytes((images / names[2]).read_bytes())
    expected.add("error", "0101.jpg", "malformed name")

    unseen, lonely = house.INSTANCE_IDS["red_cup"], house.INSTANCE_IDS["red_bull"]
    island = "010110099990101.jpg"
    annotations[island] = {"bounding_boxes": [[0, 0, 30, 30, lonely, 1]]} | dict.fromkeys(ACTIONS, "")
    (images / island).write_bytes((images / names[2]).read_bytes())
    assert unseen != lonely
    with open(scene / "present_instance_names.txt", "a") as file:
        file.write("red_cup\nred_bull\nno_such_object\n")
    expected.add("error", "red_cup", "can be seen from nowhere")
    expected.add("error", "red_bull", "can be reached from nowhere")
    expected.add("error", "present_instance_names.txt", "'no_such_object' is not in the instance map")

    (scene / "annotations.json").write_text(json.dumps(annotations))
    (scene / "cameras.txt").unlink()
    expected.add("warning", "cameras.txt", "missing")
    cut(scene / "image_structs.mat")
    expected.add("error", "image_structs.mat", "cut short")
    with open(root / "instance_id_map.txt", "a") as file:
        file.write("something 99\n")
    expected.add("warning", "instance_id_map.txt", "differs")
    with open(root / "all_instance_id_map.txt", "a") as file:
        file.write("three words 5\nred_cup 98\n")
    expected.add("error", "all_instance_id_map.txt:34", "is not `name id`")
    expected.add("error", "all_instance_id_map.txt:35", "given before")

    for number, damage in ((201, "missing"), (202, "cut short")):  # further scenes that have no annotations
        other = root / f"Home_{number}_1"
        (other / "jpg_rgb").mkdir(parents=True)
        if damage == "cut short":
            (other / "annotations.json").write_text('{"0101')
            expected.add("error", "Home_202_1/annotations.json", "cut short")
        else:
            expected.add("error", "Home_201_1/annotations.json", "missing")
    (root / "Home_203_1").mkdir()
    expected.add("error", "Home_203_1/jpg_rgb", "missing")
    return expected.faults


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


def test_images_are_read_once(tiny, monkeypatch):
    read = []
    decode = check_module._decode
    monkeypatch.setattr(check_module, "_decode", lambda path: read.append(path) or decode(path))
    check_active_vision(tiny)
    assert len(read) == len(set(read)) == len(list((tiny / SCENE / "jpg_rgb").iterdir()))


def test_wrong_folders_are_explained(tiny, tmp_path):
    (finding,) = check_active_vision(tmp_path / "nowhere")
    assert finding.problem == "no such folder"
    (finding,) = check_active_vision(tiny / SCENE)
    assert "this is a scene" in finding.problem
    assert any("no scene folder" in f.problem for f in check_active_vision(tmp_path))
