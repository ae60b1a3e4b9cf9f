"""Another laboratory's recordings, from a folder of images and a CSV to a trained and evaluated policy, all by the
command line.

The two functions that make the recordings know nothing of this project: they write images and a CSV as a person with a
camera would.
"""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from infogoal_jax.cli.main import main
from infogoal_jax.data import splits
from infogoal_jax.runs import tables

TINY = """--num-epochs 1 --epochs-per-evaluation 1 --updates-per-epoch 3 --batch-size 32 --evaluation-starts 1
    --state-encoder.features 16 --no-figures"""
ON_THE_TABLE = f"""train object_manipulation --env.dataset table.npz --env.num-goals 4 0 4 --num-envs 4
    --rollout-steps 10 --out run {TINY}"""


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def photograph_turntable(folder):
    """A turntable with a tilting arm: 12 x 5 settings in steps of 30 degrees, a picture of each, and a CSV of joints
    and poses."""
    folder.mkdir()
    rows = []
    for turn in range(-180, 180, 30):
        for tilt in range(-60, 61, 30):
            picture = np.full((48, 48, 3), 200, np.uint8)
            tip = (24 + 16 * np.sin(np.deg2rad(turn)), 24 - 16 * np.cos(np.deg2rad(turn)) * np.cos(np.deg2rad(tilt)))
            cv2.line(picture, (24, 24), tuple(int(x) for x in tip), (20, 30 + tilt, 220), 5)
            name = f"t{turn + 180:03d}_{tilt + 60:03d}.png"
            cv2.imwrite(str(folder / name), picture)
            rows.append({"image": name, "joint_turn": turn, "joint_tilt": tilt, "yaw": turn, "pitch": tilt, "roll": 0})
    with open(folder / "poses.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def film_corridor(folder, objects):
    """A cart in a corridor of 12 places, filmed on eight drives; each object is seen from three places."""
    folder.mkdir()
    random, rows = np.random.default_rng(0), []
    for place in range(12):
        cv2.imwrite(str(folder / f"{place:02d}.jpg"), random.integers(0, 256, (32, 32, 3), dtype=np.uint8))
    for drive in range(8):
        place = int(random.integers(12))
        for time in range(20):
            move = "forward" if place == 0 or (place < 11 and random.random() < 0.5) else "back"
            seen = ";".join(name for number, name in enumerate(objects) if abs(place - 3 * number - 1) <= 1)
            rows.append(
                [f"{place:02d}.jpg", f"drive {drive}", time, move if time < 19 else "", place, 0.5 * place, 0.0, seen]
            )
            place += 1 if move == "forward" else -1
    with open(folder / "drives.csv", "w", newline="") as file:
        csv.writer(file).writerows([["image", "trajectory", "time", "action", "state", "x", "y", "objects"], *rows])


def run(line):
    """A command line, which must succeed."""
    assert main(line.split()) == 0


@pytest.mark.long
def test_poses_of_a_turntable(capsys):
    """Imported, checked, trained on with image goals, evaluated."""
    photograph_turntable(Path("photos"))
    run("data import photos photos/poses.csv --out table.npz --wrap turn --name turntable")
    run("data check table.npz")
    run(f"{ON_THE_TABLE} --method none --agent dqn")
    run("evaluate run --starts 2")
    config = json.loads(Path("run", "config.json").read_text())
    assert config["data"].startswith("turntable, content") and config["config"]["agent"]["name"] == "dqn"
    assert "stand-in, content" not in config["data"]  # Recorded: only the backgrounds are stand-ins.
    assert "test" in capsys.readouterr().out


@pytest.mark.long
def test_the_low_level_of_another_arm(capsys):
    """The shipped low level is refused for an arm with other joints; one that is trained for it is taken."""
    photograph_turntable(Path("photos"))
    run("data import photos photos/poses.csv --out table.npz --wrap turn")
    assert main(ON_THE_TABLE.split()) == 2
    error = capsys.readouterr().err
    assert "does not fit the 2 numbers of a target state and the 4 moves" in error and "same --env flags" in error
    run("pretrain object_manipulation --env.dataset table.npz --num-epochs 10 --seeds 1 --out low")
    assert tables.read_table(Path("low"), "evaluations")[-1]["train_goal/success_rate"] > 0.9
    run(f"{ON_THE_TABLE} --agent.low-level low")


@pytest.mark.long
def test_questions_about_a_corridor():
    """Imported, checked, learned from offline, evaluated; questions are the laboratory's choice among those that are
    embedded."""
    shipped = json.loads(splits.SHIPPED_QUESTIONS.read_text())["objects"]
    names = list(shipped)[:4]
    film_corridor(Path("film"), names)
    chosen = {
        name: shipped[name] | {"use": "train" if number % 2 == 0 else "test"} for number, name in enumerate(names)
    }
    Path("questions.json").write_text(json.dumps({"objects": chosen}))
    run("data import film film/drives.csv --out corridor.npz")
    run("data check corridor.npz")
    given = "--env.dataset corridor.npz --env.questions questions.json --env.episode-length 20"
    run(f"train embodied_qa {given} --out run {TINY}")
    run("evaluate run --starts 2")


@pytest.mark.parametrize(
    ("task", "words"), [("embodied_qa", "tells no detections"), ("object_manipulation", "tells no poses")]
)
def test_a_dataset_for_another_task(capsys, task, words):
    """Drives without poses or detections: the error names what is missing, before anything is compiled, without a
    traceback."""
    film_corridor(Path("film"), [])
    table = Path("film", "drives.csv").read_text().splitlines()
    Path("bare.csv").write_text("\n".join(",".join(line.split(",")[:5]) for line in table))
    run("data import film bare.csv --out corridor.npz")
    assert main(f"train {task} --env.dataset corridor.npz --out run".split()) == 2
    assert words in capsys.readouterr().err
