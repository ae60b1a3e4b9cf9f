"""The tables of our offline agents beside OGBench."""

import dataclasses
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from places import ROOT

from infogoal_jax import UserError
from infogoal_paper import goal_encoders, jaxgcrl, ogbench, trial_numbers
from infogoal_paper.ogbench import Outcome


def outcome(side="ours", seeds=(0, 1), rate=None, updates=(), success=0.5, agent="crl", **changes):
    """A program whose seeds have this success in the first of two tasks, and none in the other."""
    found = [[[success, 0.0] for _ in updates] for _ in seeds]
    return dataclasses.replace(
        Outcome(side, agent, "none", list(seeds), "data", "a GPU", rate, 1.0, list(updates), found, []), **changes
    )


def write(path, *outcomes):
    path.write_text("".join(json.dumps(dataclasses.asdict(each)) + "\n" for each in outcomes))
    return path


@pytest.fixture
def numbers(tmp_path, monkeypatch):
    """Empty numbers."""
    monkeypatch.setattr(ogbench, "NUMBERS", tmp_path / "kept.jsonl.xz")
    return ogbench.NUMBERS


def test_sides_are_compared_after_equal_updates():
    ours = outcome(updates=(10, 20), rate=900.0)
    ours.success = [[[0.5, 0.0], [1.0, 1.0]], [[0.7, 0.0], [1.0, 1.0]]]
    alone = outcome(seeds=(0,), rate=600.0)
    theirs = [outcome("theirs", (seed,), 300.0 if seed == 0 else None, (10,), 0.4) for seed in (0, 1)]
    _, _, row, _, said = ogbench.peers([ours, alone, *theirs]).splitlines()
    assert row == "| `offline_crl` | 900 (3.0x) | 600 (2.0x) | 300 | 0.30±0.64 | 0.20±0.00 |"
    assert said.startswith("Data; a GPU. Success after 10 updates. 2 seeds")


def test_a_side_without_an_evaluation_leaves_its_cell_empty():
    row = ogbench.peers([outcome(rate=900.0), outcome("theirs", (0,), 300.0, (10,))]).splitlines()[2]
    assert row == "| `offline_crl` | 900 (3.0x) |  | 300 |  | 0.25 (1) |"


def test_what_is_taken_again_replaces_what_was_there_and_the_best_speed_stays(numbers, tmp_path):
    assert ogbench.tables() == {}
    first = write(tmp_path / "1.jsonl", outcome(rate=900.0), outcome(rate=900.0, updates=(10,)))
    second = write(tmp_path / "2.jsonl", outcome(rate=100.0, updates=(10, 20), success=0.8), outcome(rate=200.0))
    ogbench.take([first])
    ogbench.take([second])
    (kept,) = ogbench.read([numbers]).values()
    assert kept.rate == 900.0 and kept.updates == [10, 20] and kept.success[0][1] == [0.8, 0.0]
    assert len(trial_numbers.read_text(numbers).splitlines()) == 1


def test_small_sizes_are_not_kept(numbers, tmp_path):
    ogbench.take([write(tmp_path / "first.jsonl", outcome(updates=(10,)))])
    before = numbers.read_bytes()
    with pytest.raises(UserError, match="batch 8.*OGBench's sizes"):
        ogbench.take(
            [write(tmp_path / "toy.jsonl", outcome(seeds=(0,), updates=(10,), sizes="batch 8", own_sizes=True))]
        )
    assert numbers.read_bytes() == before


def test_datasets_have_tables_of_their_own():
    cube = "cube-single-play-v0"
    outcomes = [outcome(updates=(10,)), outcome(updates=(10,), success=0.2, dataset=cube)]
    outcomes += [outcome("theirs", (0,), updates=(10,), **named) for named in ({}, {"dataset": cube})]
    found = ogbench.groups(outcomes, held_out=False)
    assert list(found) == ["pointmaze-medium", "cube-single"] and "0.10±0.00" in ogbench.peers(found["cube-single"])


def test_goal_encoders_are_judged_on_held_out_tasks_apart():
    plain = outcome(updates=(10,), held_out=[2], noise=1.0)
    plain.noisy = [[[0.2, 0.0]], [[0.2, 0.0]]]
    other = outcome(updates=(10,), held_out=[2], agent="gciql", seeds=(0,))
    head, _, row, _, said = ogbench.encoders([plain, other]).splitlines()
    assert head == "| goal encoder | `offline_crl` | `gciql` |"
    assert row == "| none | 0.50±0.00, 0.00±0.00, 0.10±0.00 | 0.50, 0.00 (1) |"
    assert "2 seeds" in said and "told wrong by 1 " in said
    free = [outcome(updates=(10,)), outcome("theirs")]
    assert ogbench.groups([plain, *free], held_out=True) == {"pointmaze-medium": [plain]}
    assert ogbench.groups([plain, *free], held_out=False) == {"pointmaze-medium": free}


PLANE = """
import gymnasium, numpy as np

class Plane(gymnasium.Env):
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    observation_space = gymnasium.spaces.Box(-9, 9, (2,), np.float32)
    maze_map = np.pad(np.zeros((2, 3), int), 1, constant_values=1)
    task_infos = [{"init_ij": (1, 1), "goal_ij": (2, 3), "goal_xy": (12.0, 8.0)},
                  {"init_ij": (2, 1), "goal_ij": (1, 3), "goal_xy": (12.0, 4.0)}]

    def ij_to_xy(self, ij):
        return 4.0 * ij[1], 4.0 * ij[0]

    def xy_to_ij(self, xy):
        return int(np.clip(round(xy[1] / 4), 1, 2)), int(np.clip(round(xy[0] / 4), 1, 3))

    def get_xy(self):
        return self.place

    def set_goal(self, goal_ij):
        self.cur_goal_xy = self.ij_to_xy(goal_ij)

    def reset(self, seed=None, options=None):
        info = options["task_info"] if "task_info" in options else self.task_infos[options["task_id"] - 1]
        self.place = np.array(self.ij_to_xy(info["init_ij"]))
        self.set_goal(info["goal_ij"])
        return self.place.copy(), {"goal": np.array(self.cur_goal_xy)}

    def step(self, action):
        self.place = np.clip(self.place + action, (4, 4), (12, 8))
        reached = bool(np.linalg.norm(self.place - self.cur_goal_xy) < 1)
        return self.place.copy(), 0.0, reached, False, {"success": float(reached)}

gymnasium.register("pointmaze-medium-v0", Plane, max_episode_steps=9)
"""
"""What the benchmark does with OGBench's maze, for where that is not installed."""


@pytest.fixture
def of_ogbench(tmp_path):
    """Folders: of its package, and of its agents. They are real where it is installed and `OGBENCH_IMPLS` names the
    folder `impls` of a checkout of it; else our side alone can be run, in a plane."""
    impls = os.environ.get("OGBENCH_IMPLS", "")
    if impls and importlib.util.find_spec("ogbench") is not None:
        return tmp_path, Path(impls)
    package = tmp_path / "packages" / "ogbench"
    package.mkdir(parents=True)
    for name, text in (("__init__", ""), ("locomaze", PLANE), ("manipspace", "")):
        (package / f"{name}.py").write_text(text)
    flags = "python main.py --env_name=pointmaze-medium-navigate-v0 --agent=agents/gciql.py --agent.alpha=0.003\n"
    (tmp_path / "hyperparameters.sh").write_text(flags)
    return package.parent, tmp_path


@pytest.mark.long
def test_the_benchmark_runs_at_toy_size(of_ogbench, tmp_path):
    """It collects, trains, evaluates in processes, and goes on where it stopped; both sides where OGBench is there."""
    packages, impls = of_ogbench
    sides = ["ours", "theirs"] if (impls / "agents").is_dir() else ["ours"]
    places = [str(ROOT), str(packages), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, places)), "JAX_PLATFORMS": "cpu"}
    data, results = str(tmp_path / "own.npz"), tmp_path / "results.jsonl"

    def peer(*words):
        line = [sys.executable, str(ROOT / "benchmarks" / "peers" / "ogbench_peer.py"), *map(str, words)]
        return subprocess.run(line, env=environment, cwd=tmp_path, check=True, capture_output=True, text=True)

    peer("--collect", data, "--episodes", 3, "--episode-steps", 31)
    with np.load(data) as arrays:
        assert arrays["observations"].shape == (93, 2) and arrays["terminals"].sum() == 3
        assert np.abs(arrays["actions"]).max() <= 1 and arrays["observations"].std(0).min() > 0.1
    words = ["--data", data, "--impls", impls, "--out", results, "--toy", "--agents", "gciql", "--seeds", 2]
    words += ["--held-out", 1, "--goal-noise", 1, "--sides", *sides]
    table = peer(*words).stdout
    assert "| none | " in table and "atch 8, layers (16, 16)" in table
    last = ogbench.read([results])[ogbench.FIRST, "states", "ours", "gciql", "none", (0, 1), 1]
    assert last.updates == [4, 8] and np.shape(last.success) == np.shape(last.noisy) == (2, 2, len(last.success[0][0]))
    before = results.read_text()
    assert peer(*words).stdout == table and results.read_text() == before
    words = ["--data", data, "--impls", impls, "--out", results, "--toy", "--agents", "gciql", "--seeds", 2]
    words += ["--held-out", 1, "--image-goals", "--sides", "ours", "--learners", "infogoal"]
    tables = peer(*words).stdout
    assert table.strip() in tables and "all with a background of weight 0.4" in tables
    pictured = ogbench.read([results])[ogbench.FIRST, "images", "ours", "gciql", "infogoal", (0, 1), 1]
    assert pictured.updates == [4, 8] and np.shape(pictured.noisy) == np.shape(last.noisy)


def test_pictures_tell_places_apart(of_ogbench, monkeypatch):
    """They differ, more so the farther two places are apart; the robot is in the middle, and there is wall beyond."""
    monkeypatch.syspath_prepend(str(of_ogbench[0]))
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks" / "peers"))
    import ogbench_peer

    places = np.array([[8.0, 4.0], [8.5, 4.0], [12.0, 4.0], [8.0, 8.0]], np.float32)
    pictures = np.asarray(ogbench_peer.draw_places(ogbench.FIRST)(places)).astype(int)
    near, along, across = np.abs(pictures[1:] - pictures[0]).mean((1, 2, 3))
    assert pictures.shape == (4, 64, 64, 3) and 0 < near < along and near < across
    assert (pictures[0, 0, 0] == ogbench_peer.WALL).all() and (pictures[:, 32, 32] == ogbench_peer.ROBOT).all()


def test_goals_as_pictures_stand_apart_whatever_the_batch(numbers, tmp_path):
    held = {"updates": (10,), "held_out": [2]}
    pictured = outcome(**held, goals="images", sizes="batch 256", noise=0.4)
    pictured.noisy = [[[0.2, 0.0]], [[0.2, 0.0]]]
    taken = ogbench.take([write(tmp_path / "both.jsonl", outcome(**held), pictured)])
    states, pictures = ogbench.groups(taken.values(), held_out=True).items()
    assert (states[0], pictures[0]) == ("pointmaze-medium", "pointmaze-medium, pictures")
    assert "| 0.50±0.00, 0.00±0.00 |" in ogbench.encoders(states[1])
    table = ogbench.encoders(pictures[1])
    assert "0.50±0.00, 0.00±0.00, 0.10±0.00" in table and "atch 256" in table and "a background of weight 0.4." in table


def test_goal_encoders_of_both_benchmarks_share_a_table(numbers):
    offline = [
        outcome(updates=(10,), held_out=[2]),
        outcome(updates=(10,), held_out=[2], learner="cogoal", success=0.2),
    ]
    sides = {"ours": 0.1, "ours+infogoal, beta 0": 0.3, "theirs": 0.5}
    online = [
        jaxgcrl.Outcome("ant", "crl", side, "a GPU", 0, [1.0], [2.0], [[success]], 1, 9, 0.0)
        for side, success in sides.items()
    ]
    head, _, first, second, _, *notes = goal_encoders.success_table(online, offline).splitlines()
    assert head == "| task, agent | none | InfoGoal | InfoGoal, beta 0 | VAE | COGOAL |"
    assert first == "| ant, `crl` | 0.10 |  | 0.30 |  |  |"
    assert second.startswith("| pointmaze-medium, `offline_crl` | 0.50±0.00, 0.00±0.00 |  |  |  | 0.20±0.00, ")
    assert [note.partition(":")[0] for note in notes] == ["- JaxGCRL's", "- OGBench's", "- pointmaze-medium"]
    assert "after 10 updates, 2 seeds" in notes[1]


def test_infogoal_differs_clearly_where_the_interval_of_paired_differences_leaves_out_0():
    none, beta_0 = np.array([0.1, 0.5, 0.9]), np.array([0.3, 0.5, 0.7])
    own = {"none": {"held out": none, "told wrong": none}, "infogoal, beta 0": {"held out": beta_0}}
    leads, open_ones = np.array([0.20, 0.21, 0.22]), np.array([0.3, -0.3, 0.1])
    own["infogoal"] = {"held out": none + leads, "told wrong": none + open_ones}
    lines = goal_encoders.clear_table({("maze", "crl"): own, ("ant", "crl"): {"none": {"": none}}}).splitlines()
    assert lines[2:] == [
        "| maze, `crl`, held out | 0.21±0.02 | 0.21±0.52 |  |  |",
        "",
        "1 of 2 comparisons with none; 0.1 come by chance.",
    ]


def test_layers_and_the_batch_beside_states_have_to_be_ogbench_s(of_ogbench, monkeypatch):
    """The numbers are asked, not the words that a table shows of them."""
    monkeypatch.syspath_prepend(str(of_ogbench[0]))
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks" / "peers"))
    from ogbench_peer import TOY, Sizes

    own, smaller = Sizes(8, 2), Sizes(8, 2, batch_size=256)
    assert [each.are_own("states") for each in (own, smaller, TOY)] == [False, True, True]
    assert [each.are_own("images") for each in (own, smaller, TOY)] == [False, False, True]
