"""`infogoal check-fetch`: a faulty recording is named with its file, array and remedy; a sound one is replayed and
measured. `infogoal video` of a folder that is named like a task."""

import json
import os

import jax
import numpy as np
import pytest

from infogoal_jax.cli.main import main
from infogoal_jax.envs import load
from infogoal_jax.envs.fetch.parity import Replayed, compare, replay
from infogoal_jax.envs.fetch.recordings import Recording, load_recordings
from infogoal_jax.report import fetch_parity as parity

EPISODES, STEPS = 2, 3


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def sound(task: str = "fetch_reach", episodes: int = EPISODES, steps: int = STEPS) -> dict[str, np.ndarray]:
    """The arrays of a recording in which nothing moves."""
    width, first = (10, 0) if task == "fetch_reach" else (25, 3)
    observation = np.zeros((episodes, steps + 1, width), np.float32)
    observation[..., :6] = 0.5
    return {
        f"{task}/observation": observation,
        f"{task}/achieved_goal": observation[..., first : first + 3],
        f"{task}/desired_goal": np.full((episodes, 1, 3), 0.5, np.float32),
        f"{task}/action": np.zeros((episodes, steps, 4), np.float32),
        f"{task}/reward": np.zeros((episodes, steps), np.float32),
    }


def not_finite(array: np.ndarray) -> np.ndarray:
    array = array.copy()
    array[1, 2, 3] = np.nan
    return array


REACH, PUSH = sound(), sound("fetch_push")
FAULTS = {
    "no known task": (
        {"fetch_pus/observation": np.zeros(3)},
        ["fetch_pus", "Did you mean 'fetch_push'", "fetch_pick_and_place"],
    ),
    "no task at all": ({"observation": np.zeros(3)}, ["no episodes of a Fetch task", "TASK/observation"]),
    "array missing": (
        {name: value for name, value in REACH.items() if "reward" not in name},
        ["fetch_reach/reward is missing", "desired_goal"],
    ),
    "one task of two whole": (
        {**REACH, "fetch_push/action": PUSH["fetch_push/action"]},
        ["fetch_push/observation is missing"],
    ),
    "pickled": (REACH | {"fetch_reach/reward": np.array([{}], object)}, ["fetch_reach/reward", "pickled objects"]),
    "texts": (
        REACH | {"fetch_reach/action": np.full((EPISODES, STEPS, 4), "0")},
        ["fetch_reach/action", "<U1", "real numbers"],
    ),
    "complex": (
        REACH | {"fetch_reach/reward": np.zeros((EPISODES, STEPS), complex)},
        ["fetch_reach/reward", "complex128"],
    ),
    "actions of 3": (
        REACH | {"fetch_reach/action": np.zeros((EPISODES, STEPS, 3))},
        ["fetch_reach/action", "(2, 3, 3)", "[E, T, 4]"],
    ),
    "no episodes": (sound(episodes=0), ["fetch_reach/action", "(0, 3, 4)", "at least one episode"]),
    "no steps": (sound(steps=0), ["fetch_reach/action", "(2, 0, 4)", "at least one step"]),
    "reach with an object": (
        REACH | {"fetch_reach/observation": PUSH["fetch_push/observation"]},
        ["fetch_reach/observation", "(2, 4, 25)", "give (2, 4, 10)"],
    ),
    "push without an object": (
        PUSH | {"fetch_push/observation": REACH["fetch_reach/observation"]},
        ["fetch_push/observation", "(2, 4, 10)", "give (2, 4, 25)"],
    ),
    "last observation missing": (
        REACH | {"fetch_reach/observation": REACH["fetch_reach/observation"][:, 1:]},
        ["fetch_reach/observation", "(2, 3, 10)", "give (2, 4, 10)"],
    ),
    "one reward short": (
        REACH | {"fetch_reach/reward": np.zeros((EPISODES, STEPS - 1))},
        ["fetch_reach/reward", "(2, 2)", "give (2, 3)"],
    ),
    "a goal for every step": (
        REACH | {"fetch_reach/desired_goal": np.zeros((EPISODES, STEPS + 1, 3))},
        ["fetch_reach/desired_goal", "(2, 4, 3)", "give (2, 1, 3)"],
    ),
    "other episodes": (
        REACH | {"fetch_reach/desired_goal": np.zeros((3, 1, 3))},
        ["fetch_reach/desired_goal", "(3, 1, 3)", "2 episodes of 3 steps"],
    ),
    "not finite": (
        REACH | {"fetch_reach/observation": not_finite(REACH["fetch_reach/observation"])},
        ["fetch_reach/observation = nan", "[1, 2, 3]", "finite"],
    ),
    "dense reward": (
        REACH | {"fetch_reach/reward": np.full((EPISODES, STEPS), -0.3)},
        ["fetch_reach/reward", "-0.3", "sparse reward"],
    ),
    "achieved elsewhere": (
        PUSH | {"fetch_push/achieved_goal": PUSH["fetch_push/achieved_goal"] + 0.1},
        ["fetch_push/achieved_goal", "0.1 m", "fetch_push/observation"],
    ),
}


@pytest.fixture
def refused(capsys, monkeypatch):
    """Runs the command and returns what it prints when it refuses, without a traceback and before anything is
    compiled."""

    def no_replay(*arguments):
        raise AssertionError("replayed before the mistake was found")

    monkeypatch.setattr(parity, "replay", no_replay)

    def run(*arguments: str) -> str:
        assert main(["check-fetch", *arguments]) == 2
        printed = capsys.readouterr().err
        assert printed.startswith("infogoal: ")
        return printed

    return run


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_recording_is_named_with_its_file_and_array(fault, refused):
    arrays, expected = FAULTS[fault]
    np.savez("faulty.npz", **arrays)
    printed = refused("faulty.npz")
    for words in ("faulty.npz", *expected):
        assert words in printed


def test_a_file_that_cannot_be_read_is_named(tmp_path, refused):
    assert "no such file" in refused("not_there.npz")
    assert "cannot be read" in refused(str(tmp_path))
    (tmp_path / "text.npz").write_text("no numbers")
    assert "not an npz" in refused("text.npz")
    (tmp_path / "empty.npz").write_bytes(b"")
    assert "not an npz" in refused("empty.npz")
    np.save("single.npy", np.zeros(3))
    assert "not an npz" in refused("single.npy")
    np.savez("whole.npz", **REACH)
    whole = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    assert "cut short" in refused("cut.npz")


def test_flags_out_of_range_are_named(refused):
    np.savez("whole.npz", **REACH)
    assert "kinds = 'random,,held'" in refused("whole.npz", "--kinds", "random,,held")
    assert "kinds = 'all'" in refused("whole.npz", "--kinds", "all")
    assert f"out = 'no{os.sep}file.json'" in refused("whole.npz", "--out", f"no{os.sep}file.json")


def test_pickled_arrays_are_never_run(tmp_path, refused):
    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "trapped"),)

    np.savez("trap.npz", **REACH, note=np.array([Trap()], object))
    assert "pickled objects" in refused("trap.npz")
    assert not (tmp_path / "trapped").exists()


def test_recordings_of_any_length_are_read_and_actions_clipped():
    arrays = sound("fetch_slide", episodes=5, steps=7) | sound(episodes=1, steps=1) | sound("their_own_task")
    arrays["fetch_slide/action"] = np.full((5, 7, 4), -1.5)
    np.savez("several.npz", **arrays, source="made by hand")
    found = load_recordings("several.npz")
    assert {task: (recording.episodes, recording.steps) for task, recording in found.tasks.items()} == {
        "fetch_reach": (1, 1),
        "fetch_slide": (5, 7),
    }
    assert found.skipped == ("their_own_task",) and found.source == "made by hand"
    assert (found.tasks["fetch_slide"].action == -1).all() and found.tasks["fetch_slide"].action.dtype == np.float32


def test_errors_are_measured_in_millimetres_and_outcomes_counted():
    """Three pushes of two steps. The second is 3 mm off at the end; the third falls off here and stays on the table in
    the recording."""
    observation = np.zeros((3, 3, 25), np.float32)
    observation[..., 2], observation[..., 5] = 0.5, 0.425
    observation[1, -1, 5] = 0.5
    thing = observation[..., 3:6].copy()
    thing[1, -1] += (0.003, 0, 0)
    thing[2, -1, 2] = 0.025
    reward = np.full((3, 2), -1, np.float32)
    recording = Recording(
        "fetch_push", observation, np.zeros((3, 3), np.float32), np.zeros((3, 2, 4), np.float32), reward
    )
    replayed = Replayed(
        observation[..., :3] + np.float32([0.001, 0, 0]),
        thing,
        np.array([[-1, -1], [-1, 0], [-1, -1.0]]),
        np.zeros(3, bool),
    )
    everything, first, second = compare(recording, replayed, ("first", "second"))
    assert (everything.episodes, first.episodes, second.episodes) == (3, 2, 1)
    assert everything.grip.mean == pytest.approx(1, abs=1e-3) and everything.grip.end == pytest.approx(1, abs=1e-3)
    assert (second.thing.mean, second.thing.largest, second.thing.end) == pytest.approx((1.5, 3, 3), abs=1e-3)
    assert first.thing.end == pytest.approx(200, abs=1e-3) and first.thing.median == pytest.approx(0, abs=1e-3)
    assert (everything.fallen.recorded, everything.fallen.here, everything.fallen.both) == (0, 1, 0)
    assert (second.lifted.recorded, second.lifted.here, second.lifted.both) == (1, 1, 1)
    assert everything.equal_rewards == pytest.approx(5 / 6)


@pytest.mark.long
def test_a_recording_of_our_own_environment_is_met_exactly(tmp_path, capsys):
    """A recording made of a replay: from the command line its distances are zero, and its rewards those of the goals in
    it."""
    env, arrays = load("fetch_reach"), sound()
    start = env.begin(env.physics.start(), jax.numpy.zeros(3)).observation
    arrays["fetch_reach/observation"][:, 0] = start
    arrays["fetch_reach/action"] = np.random.default_rng(0).uniform(-1, 1, (EPISODES, STEPS, 4)).astype(np.float32)
    np.savez("ours.npz", **arrays)
    grip = replay(env, load_recordings("ours.npz").tasks["fetch_reach"]).grip
    assert (
        np.abs(grip[:, 0] - start[:3]).max() < 1e-6 and np.linalg.norm(grip[:, -1] - grip[:, 0], axis=-1).min() > 0.005
    )
    arrays["fetch_reach/observation"][..., :3] = arrays["fetch_reach/achieved_goal"] = grip
    arrays["fetch_reach/desired_goal"] = np.stack([grip[0, -1:], grip[1, -1:] + 1])
    distance = np.linalg.norm(
        arrays["fetch_reach/observation"][:, 1:, :3] - arrays["fetch_reach/desired_goal"], axis=-1
    )
    arrays["fetch_reach/reward"] = -(distance > 0.05).astype(np.float32)
    np.savez("ours.npz", **arrays)
    assert main(["check-fetch", "ours.npz", "--kinds", "near,far", "--out", "out.json"]) == 0
    printed = capsys.readouterr().out
    assert "fetch_reach" in printed and "1 near" in printed and "100.0%" in printed
    written = json.loads((tmp_path / "out.json").read_text())
    assert written["setting"] == "default"
    everything, near, far = written["tasks"]["fetch_reach"]["kinds"]
    assert (everything["episodes"], near["episodes"], far["episodes"]) == (2, 1, 1)
    assert everything["grip"]["largest"] < 0.01 and everything["equal_rewards"] == 1 and everything["thing"] is None
    assert len(np.unique(arrays["fetch_reach/reward"])) == 2
    assert [row["kind"] for row in written["tasks"]["fetch_reach"]["episodes"]] == ["near", "far"]


def test_the_folder_of_the_user_is_known_behind_a_flag_too(tmp_path, monkeypatch, capsys):
    """A shell leaves `--out=~/run` as it is."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text("mine")
    assert main(["train", "object_search", "--out=~/run"]) == 2
    assert f"out = '{tmp_path}/run': holds a run already" in capsys.readouterr().err
    assert main(["evaluate", "~/run"]) == 2
    assert f"{tmp_path}/run/config.json: is damaged" in capsys.readouterr().err


def test_the_run_in_a_folder_comes_before_the_task_of_its_name(tmp_path, monkeypatch, capsys):
    """`infogoal train fetch_reach --out fetch_reach` leaves such a folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fetch_reach").mkdir()
    (tmp_path / "fetch_reach" / "config.json").write_text("{")
    assert main(["video", "fetch_reach", "--out", "episode.mp4"]) == 2
    assert "config.json: is damaged" in capsys.readouterr().err
