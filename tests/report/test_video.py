"""Videos of episodes, files that are whole or not there."""

import dataclasses
import subprocess
import sys

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import envs
from infogoal_jax.cli.main import main
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.errors import UserError
from infogoal_jax.report.figures import read_subject
from infogoal_jax.report.video import drawn_goals, drawn_video, policy_video, write_video
from infogoal_paper.image_goal_figures import seen_images

CONFIG = FetchConfig(ends_at_goal=False, episode_length=3)


def frames(count: int = 5) -> list[np.ndarray]:
    """Pictures of one grey each, brighter and brighter."""
    return [np.full((32, 48, 3), 40 * number, np.uint8) for number in range(count)]


def read(path) -> list[np.ndarray]:
    """The pictures of a video, RGB."""
    capture, found = cv2.VideoCapture(str(path)), []
    while True:
        there, frame = capture.read()
        if not there:
            return found
        found.append(frame[..., ::-1])


@pytest.mark.parametrize("ending", ["mp4", "gif"])
def test_a_video_holds_the_frames_in_order(ending, tmp_path):
    write_video(tmp_path / f"grey.{ending}", frames())
    found = read(tmp_path / f"grey.{ending}")
    assert [frame.shape for frame in found] == [(32, 48, 3)] * 5
    assert np.allclose([frame.mean() for frame in found], [0, 40, 80, 120, 160], atol=4)


@pytest.mark.long
@pytest.mark.parametrize("ending", ["mp4", "gif"])
def test_a_full_disk_is_an_error_and_the_old_video_stays(ending, tmp_path):
    """The encoder itself says nothing of it. A limit on file sizes, in a process of its own, is the disk that
    refuses."""
    (tmp_path / f"a.{ending}").write_bytes(b"old")
    code = f"""
import resource, signal
import numpy as np
from infogoal_jax.errors import UserError
from infogoal_jax.report.video import drawn_goals, drawn_video, policy_video, write_video
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
noise = np.random.default_rng(0)
try:
    write_video({str(tmp_path / f"a.{ending}")!r}, (noise.integers(0, 255, (96, 128, 3), np.uint8) for _ in range(50)))
except UserError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert f"a.{ending}" in done.stdout and "could not be written" in done.stdout
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


def test_colours_are_not_swapped(tmp_path):
    red = np.zeros((32, 32, 3), np.uint8)
    red[..., 0] = 200
    write_video(tmp_path / "red.mp4", [red] * 3)
    assert np.abs(read(tmp_path / "red.mp4")[1].mean((0, 1)) - [200, 0, 0]).max() < 25


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("missing/a.mp4", frames(), "folder is not there"),
        ("a.avi", frames(), "mp4"),
        ("a.mp4", [], "at least one"),
        ("a.mp4", [np.zeros((1, 16, 3), np.uint8)], "frames = '1 x 16': a .mp4 has sides of at least 2; give larger"),
        ("a.gif", [np.zeros((0, 4, 3), np.uint8)], "frames = '0 x 4': a .gif has sides of at least 1"),
        ("a.mp4", [np.zeros((32, 48))], "uint8"),
        ("a.mp4", [*frames(2), np.zeros((48, 32, 3), np.uint8)], r"frames\[2\]"),
    ],
)
def test_what_cannot_be_written_is_said_and_leaves_nothing_behind(tmp_path, name, given, message):
    with pytest.raises(UserError, match=message):
        write_video(tmp_path / name, given)
    assert not list(tmp_path.iterdir())


def test_an_old_video_survives_a_new_one_that_fails(tmp_path):
    path = tmp_path / "a.mp4"
    write_video(path, frames())
    before = path.read_bytes()

    def broken():
        yield from frames(2)
        raise RuntimeError("the simulation stopped")

    with pytest.raises(RuntimeError, match="simulation"):
        write_video(path, broken())
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


@pytest.mark.long  # Pictures of the robot are in bridges/test_gymnasium.py, a video by `draw` in cli/test_import.py.
def test_a_run_whose_goals_are_positions_becomes_a_video(tmp_path):
    """The scene with the goal in it; an episode has reached its goal where its last state has."""
    env = envs.load("fetch_reach_positions", dataclasses.replace(CONFIG, goals="positions", episode_length=2))
    towards = jax.vmap(lambda observation, goal: jnp.append(10 * (goal - observation[:3]), 0.0).clip(-1, 1))

    def steer(seen, goals, key):
        return towards(seen, goals)

    reached = drawn_video(env, steer, tmp_path / "episode.mp4", drawn_goals(env, 2, seed=0), seed=0, height=96)
    shown = read(tmp_path / "episode.mp4")
    assert len(reached) == 2 and len(shown) == 2 * (3 + 25) and shown[0].shape == (96, 128, 3)
    assert cv2.VideoCapture(str(tmp_path / "episode.mp4")).get(cv2.CAP_PROP_FPS) == 25  # Its own speed.
    assert not np.array_equal(shown[0], shown[3])  # The arm moves.


def test_the_command_says_what_it_cannot_draw(tmp_path, capsys):
    assert main(["video", "fetch_reech", "--out", str(tmp_path / "a.mp4")]) == 2
    assert "fetch_reach" in capsys.readouterr().err


@pytest.mark.long
def test_a_random_policy_becomes_a_video_by_the_command(tmp_path, capsys):
    path = str(tmp_path / "random.gif")
    assert main(["video", "fetch_reach", "--out", path, "--height", "64"]) == 0
    assert "1 episode of a random policy; the goal is reached at the end of" in capsys.readouterr().out


@pytest.mark.long
def test_a_trained_policy_becomes_a_video_with_its_goal_in_the_corner(reach_run, tmp_path):
    subject = read_subject(reach_run.folder, reach_run.train.env)
    outcomes = policy_video(subject, tmp_path / "policy.mp4", episodes=2, seed=3, corruption=0.8, height=96)
    found = read(tmp_path / "policy.mp4")
    assert len(outcomes) == 2 and 2 * (2 + 25) <= len(found) <= 2 * (11 + 25)
    test = np.flatnonzero(np.asarray(reach_run.train.env.goals.test_mask))
    shown = np.random.default_rng(3).permutation(test)[:2]
    images = seen_images(reach_run.train.env, shown, 0.8, 3)
    for frame, image in ((found[0], images[0]), (found[-1], images[1])):
        corner = frame[4:36, -36:-4].astype(float)
        assert np.abs(corner.mean((0, 1)) - image.mean((0, 1))).max() < 15


@pytest.mark.long
def test_a_video_of_a_run_refuses_what_it_cannot_draw(reach_run, tmp_path):
    subject = read_subject(reach_run.folder, reach_run.train.env)
    for changes, message in (
        ({"episodes": 0}, "episodes = 0"),
        ({"corruption": -0.1}, "corruption = -0.1"),
        ({"seed": -1}, "seed = -1"),
    ):
        with pytest.raises(UserError, match=message):
            policy_video(subject, tmp_path / "a.mp4", **changes)
