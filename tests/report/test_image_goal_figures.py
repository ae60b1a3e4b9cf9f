"""What a run with image goals reports: a row and a figure for each kind of goals and code, clean and corrupted; and
videos of episodes, files that are whole or not there."""

import dataclasses
import io
import itertools
import json
import math
import re
import subprocess
import sys

import cv2
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import EVERY_TASKS_FIGURES, assert_drawn, printed
from rich.console import Console

from infogoal_jax import envs
from infogoal_jax.cli.main import main
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.errors import UserError
from infogoal_jax.loading import make_train
from infogoal_jax.report import image_goals, trajectory_figures
from infogoal_jax.report.figures import beta_and_accuracy, draw_figures, read_subject, success_within
from infogoal_jax.report.runs import evaluated_masks, table_of
from infogoal_jax.report.statistics import mean_interval
from infogoal_jax.report.summary import evaluate_run, print_run
from infogoal_jax.report.video import can_draw, drawn_video, write_video
from infogoal_jax.runner import training
from infogoal_jax.train.evaluation import EVALUATION_SEED, corrupted_view
from infogoal_jax.train.parts import Setup

IMAGE_GOAL_FIGURES = EVERY_TASKS_FIGURES | {"goal_images", "codes_and_trajectories"}


@pytest.fixture(scope="module")
def points(tmp_path_factory):
    """A run with image goals, without physics: most goals are never evaluated, and there are none for validation."""
    env = hand_made_points.steered()
    return training.run(hand_made_points.config(), [6, 7], tmp_path_factory.mktemp("points") / "run", env=env)


@pytest.fixture(scope="module")
def points_subject(points):
    return read_subject(points.folder, points.train.env)


def rows_of(text: str) -> list[list[str]]:
    """The first two cells of each row of the table, which stands below a line."""
    lines = iter(text.splitlines())
    while not next(lines).startswith("─"):
        pass
    return [re.split(r"  +", line)[:2] for line in itertools.takewhile(lambda line: "±" in line, lines)]


@pytest.mark.long
def test_summary_of_a_fetch_run_has_a_row_for_each_kind_of_goals_and_code(reach_run):
    text, scores = printed(print_run, reach_run.folder), table_of(reach_run.folder, "evaluations").last()
    kinds = ("training", "validation", "test", "training, corrupted", "test, corrupted")
    assert rows_of(text) == [[kind, code] for kind in kinds for code in ("sampled", "mean")]
    for words in (
        "48 goals x 1 starts",
        "background of weight 0.4",
        "rendered goal images",
        "stand-in",
        "MuJoCo physics in JAX",
    ):
        assert words in text
    assert "SPL" not in text and mean_interval(scores["corrupted_test_goal_mean_code/episode_length"]).show(1) in text


@pytest.mark.long
def test_every_figure_of_image_goals_is_drawn_and_shows_something(points):
    assert_drawn(draw_figures(points.folder, env=points.train.env), points.folder, IMAGE_GOAL_FIGURES)


@pytest.mark.long
def test_a_method_with_codes_that_are_not_random_has_figures_of_image_goals(points_subject):
    config, env = hand_made_points.config("none"), points_subject.train.env
    train = make_train(config, env)
    params = jax.jit(train.initial)(jax.random.key(0), config.hyper, env).params
    run = dataclasses.replace(points_subject.run, config=config)
    subject = dataclasses.replace(points_subject, run=run, train=train, params=params)
    assert beta_and_accuracy(subject) is None
    figure = image_goals.draw_image_goals(subject)["codes_and_trajectories"]
    # Codes under growing corruption are compared: one unit is as long in all panels and on both axes.
    codes = [axes for axes in figure.axes if "background of weight" in axes.get_title()]
    assert len(codes) == 4 and len({(axes.get_xlim(), axes.get_ylim()) for axes in codes}) == 1
    assert np.ptp(codes[0].get_xlim()) == pytest.approx(np.ptp(codes[0].get_ylim())) and codes[0].get_aspect() == 1


@pytest.mark.long
def test_evaluation_takes_another_corruption_and_the_clean_goals_do_not_see_it(points):
    console, env = Console(file=io.StringIO(), width=150), points.train.env
    scores = {}
    for weight in (0.0, 0.8, None):
        scores[weight] = evaluate_run(points.folder, 3, 1, 0.0, weight, env=env, console=console)
        used = points.train.config.test_corruption if weight is None else weight
        assert json.loads((points.folder / "evaluation.json").read_text())["corruption"] == used
        assert f"background of weight {used:g}" in console.file.getvalue()
    assert "8 goals x 3 starts" in console.file.getvalue() and "test, far" in console.file.getvalue()
    np.testing.assert_allclose(scores[0.0]["far_test_goal/success_rate"], scores[0.0]["test_goal/success_rate"], 1e-6)
    for group in ("train", "test"):
        steps = [of_weight[f"{group}_goal_mean_code/episode_length"] for of_weight in scores.values()]
        assert (steps[0] == steps[1]).all() and (steps[0] == steps[2]).all()
        np.testing.assert_array_equal(scores[0.0][f"corrupted_{group}_goal_mean_code/episode_length"], steps[0])
    for weight in (1.5, -0.1, math.nan):
        with pytest.raises(UserError, match=f"corruption = {weight}"):
            evaluate_run(points.folder, 1, 1, 0.0, weight, env=env)


@pytest.mark.long
def test_success_by_length_of_evaluated_goals_ends_at_the_success_rate(reach_run):
    env, scores = reach_run.train.env, table_of(reach_run.folder, "evaluations").last()
    for group in env.goals.groups:
        mask = evaluated_masks(env.goals)[group]
        assert len(mask) == 48 and mask.sum() == {"train": 8, "validation": 8, "test": 32}[group]
        curve = success_within(scores["first_reached"], mask, env.episode_length)
        np.testing.assert_allclose(curve[:, -1], scores[f"{group}_goal/success_rate"], atol=1e-6)


@pytest.mark.long
def test_goals_of_the_trajectories_lie_in_different_regions(reach_run):
    env = reach_run.train.env
    apart = trajectory_figures.distances_of_goals(env)
    chosen = image_goals.spread_goals(env.goals, env.goals.test_mask, 4, apart)
    assert len(set(np.asarray(env.goals.regions)[chosen])) == 4 and np.asarray(env.goals.test_mask)[chosen].all()
    assert len(image_goals.spread_goals(env.goals, env.goals.train_mask, 100, apart)) == 8


@pytest.mark.long
def test_episodes_that_are_drawn_go_to_their_goals_and_depend_on_the_corruption(points, points_subject):
    env = points.train.env
    goals = np.flatnonzero(np.asarray(env.goals.test_mask))[::-1]
    clean, again, corrupted = image_goals.policy_episodes(points_subject, goals, [0.0, 0.0, 1.0], EVALUATION_SEED)
    path = np.asarray(env.unwrapped.robot.achieved(clean.observations))
    assert path.shape == (4, env.episode_length + 1, 3)
    nearest = np.linalg.norm(path - np.asarray(env.unwrapped.positions)[goals][:, None], axis=-1).min(1)
    np.testing.assert_array_equal(nearest < 0.05, clean.success)
    np.testing.assert_array_equal(np.asarray(clean.observations.goal)[:, 0], np.asarray(env.unwrapped.positions)[goals])
    np.testing.assert_array_equal(path, env.unwrapped.robot.achieved(again.observations))
    assert not np.array_equal(path, env.unwrapped.robot.achieved(corrupted.observations))


@pytest.mark.long
def test_images_that_are_shown_mix_in_backgrounds_of_the_test(reach_run):
    env = reach_run.train.env
    clean, half, background = (
        image_goals.seen_images(env, np.array([5, 3]), weight, 7).astype(float) for weight in (0.0, 0.5, 1.0)
    )
    np.testing.assert_array_equal(clean, np.asarray(env.goals.inputs)[[5, 3]])
    assert np.abs(half - (clean + background) / 2).max() <= 0.5
    assert all((np.asarray(env.test_backgrounds) == image).all((1, 2, 3)).any() for image in background)


@pytest.mark.long
def test_images_that_are_shown_are_those_that_the_policy_sees(points, points_subject):
    """The learner of the run, asked what it encodes."""
    seen, learner = [], points.train.parts.learner

    def encode(params, inputs):
        seen.append(np.asarray(inputs))
        return learner.encode(params, inputs)

    some, env = np.array([126, 130]), points.train.env
    parts = points.train.parts._replace(learner=learner._replace(encode=encode))
    corrupted_view(Setup(parts, None, env), points_subject.params, jnp.asarray(some), 1, 0.4, 9)
    np.testing.assert_array_equal(seen[-1], image_goals.seen_images(env, some, 0.4, 9))


SIZE = (96, 128)
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
from infogoal_jax.report.video import write_video
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


def test_a_run_whose_goals_are_positions_becomes_a_video(tmp_path):
    """The scene with the goal in it; an episode has reached its goal where its last state has."""
    env = envs.load("fetch_reach_positions", dataclasses.replace(CONFIG, goals="positions", episode_length=2))
    towards = jax.vmap(lambda observation, goal: jnp.append(10 * (goal - observation[:3]), 0.0).clip(-1, 1))

    def steer(seen, goals, key):
        return towards(seen, goals)

    assert can_draw(env)
    reached = drawn_video(
        env, lambda seen, goals, key: towards(seen, goals), tmp_path / "episode.mp4", episodes=2, seed=0, height=96
    )
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
    outcomes = image_goals.policy_video(subject, tmp_path / "policy.mp4", episodes=2, seed=3, corruption=0.8, size=SIZE)
    found = read(tmp_path / "policy.mp4")
    assert len(outcomes) == 2 and 2 * (2 + 25) <= len(found) <= 2 * (11 + 25)
    test = np.flatnonzero(np.asarray(reach_run.train.env.goals.test_mask))
    shown = np.random.default_rng(3).permutation(test)[:2]
    images = image_goals.seen_images(reach_run.train.env, shown, 0.8, 3)
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
            image_goals.policy_video(subject, tmp_path / "a.mp4", **changes)
