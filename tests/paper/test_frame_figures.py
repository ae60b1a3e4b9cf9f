"""Figures, summary and video of tasks whose world is a dataset of frames: ways to poses, and flights before a shelf.
The report of one flight of a drone says what its log says, also where the program was killed."""

import dataclasses
import io
import json
import os
import re

import cv2
import hand_made_frames
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.image import imread
from places import EVERY_TASKS_FIGURES
from rich.console import Console
from scipy.spatial.transform import Rotation

from infogoal_drone import figures as flight
from infogoal_drone.records import NAME
from infogoal_jax.cli.main import main
from infogoal_jax.errors import UserError
from infogoal_jax.report import figures
from infogoal_jax.report.summary import print_run
from infogoal_jax.report.video import policy_video
from infogoal_jax.runner import training
from infogoal_jax.train.evaluation import EVALUATION_SEED
from infogoal_paper import house_figures, image_goal_figures, shelf_figures, trajectory_figures, walks

POSE_FIGURES = EVERY_TASKS_FIGURES | {"goal_images", "codes_and_trajectories", "poses_on_the_way"}
SHELF_FIGURES = EVERY_TASKS_FIGURES | {"codes_and_trajectories", "intrinsic_reward"}


@pytest.fixture(scope="module")
def poses(tmp_path_factory):
    """A run of object manipulation."""
    folder = tmp_path_factory.mktemp("poses") / "run"
    return training.run(hand_made_frames.manipulation_config(), [0], folder, env=hand_made_frames.manipulation())


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """A run of embodied question answering, offline."""
    config = hand_made_frames.qa_config(num_epochs=4, epochs_per_evaluation=2, updates_per_epoch=3)
    return training.run(config, [0], tmp_path_factory.mktemp("flights") / "run", env=hand_made_frames.qa())


@pytest.fixture(scope="module")
def pose_subject(poses):
    return figures.read_subject(poses.folder, poses.train.env)


@pytest.fixture(scope="module")
def shelf_subject(flights):
    return figures.read_subject(flights.folder, flights.train.env)


@pytest.mark.long
@pytest.mark.parametrize(("run", "names"), [("poses", POSE_FIGURES), ("flights", SHELF_FIGURES)])
def test_every_figure_is_drawn_and_says_that_its_data_are_a_stand_in(run, names, request, monkeypatch):
    """Files that are not blank, whose small print names the data."""
    drawn, real_save, sweep = {}, figures.save, request.getfixturevalue(run)

    def save(figure, path, captions):
        drawn[path] = figure
        real_save(figure, path)

    monkeypatch.setattr(figures, "save", save)
    paths = figures.draw_figures(sweep.folder, sweep.train.env)
    assert {path.stem for path in paths} == names
    for path in paths:
        assert path.parent == sweep.folder / "figures" and "hand-made, a stand-in" in drawn[path].get_supxlabel()
        picture = imread(path)[..., :3]
        assert (picture.min(-1) < 0.9).mean() > 0.01, f"{path.name} is blank"


def summary_of(subject) -> str:
    """What is printed of a run."""
    console = Console(file=io.StringIO(), width=150)
    print_run(subject.run.folder, console)
    return console.file.getvalue()


@pytest.mark.long
def test_what_learns_offline_is_shown_against_epochs(shelf_subject):
    """It takes no environment steps, and its summary does not say so either."""
    axes = figures.learning_curves(shelf_subject).axes
    assert {each.get_xlabel() for each in axes} == {"epochs of 3 updates, offline"}
    assert axes[0].lines[0].get_xdata().tolist() == [2, 4]
    printed = summary_of(shelf_subject)
    assert "720 recorded steps" in printed and "environment steps/s" not in printed


@pytest.mark.long
def test_what_acts_is_shown_against_environment_steps_and_has_no_plan(pose_subject):
    assert {each.get_xlabel() for each in figures.learning_curves(pose_subject).axes} == {"environment steps"}
    printed = summary_of(pose_subject)
    assert "environment steps a seed" in printed and "environment steps/s" in printed
    assert shelf_figures.draw_shelves(pose_subject) == house_figures.draw_plans(pose_subject) == {}


@pytest.mark.long
def test_angles_on_the_way_are_those_of_the_turns_to_the_goal(pose_subject):
    """By scipy's rotations; a goal is reached at the first angle below 10 degrees, and not before."""
    env, data = pose_subject.train.env, hand_made_frames.arm()
    goals = np.flatnonzero(np.asarray(env.goals.test_mask))
    (episodes,) = image_goal_figures.policy_episodes(pose_subject, goals, [0.0], EVALUATION_SEED)
    rotation = Rotation.from_matrix(data.rotation)
    for goal, frames, steps, success, angle in zip(
        goals,
        episodes.observations.frame,
        episodes.steps,
        episodes.success,
        trajectory_figures.angles_to_goals(env, goals, episodes),
        strict=True,
    ):
        target = rotation[int(env.goals.rows[goal])]
        np.testing.assert_allclose(
            angle, np.rad2deg((target.inv() * rotation[frames[: steps + 1]]).magnitude()), atol=0.1
        )
        assert len(angle) == steps + 1 and (angle[:-1] > 10).all() and (angle[-1] < 10) == success


def test_goals_that_are_drawn_lie_near_training_poses_that_are_far_apart():
    """The first region, then the one whose training pose lies farthest from it."""
    env = hand_made_frames.manipulation()
    apart = trajectory_figures.angles_between_goals(env)
    assert apart.shape == (3, 3) and (apart[~np.eye(3, dtype=bool)] > 20).all()
    regions = np.asarray(env.goals.regions)
    mask = np.isin(np.arange(env.goals.num_goals), [np.flatnonzero(regions == region)[0] for region in range(3)])
    chosen = image_goal_figures.spread_goals(env.goals, mask, 2, apart)
    assert regions[chosen].tolist() == [0, int(apart[0].argmax())]


@pytest.mark.long
def test_a_policy_that_turns_an_object_becomes_a_video(pose_subject, tmp_path):
    """Its frames with the goal's image in the corner."""
    reached = policy_video(pose_subject, tmp_path / "poses.mp4", episodes=2, height=72)
    video, count, first = cv2.VideoCapture(str(tmp_path / "poses.mp4")), 0, None
    while (read := video.read())[0]:
        first, count = read[1] if first is None else first, count + 1
    assert len(reached) == 2 and first.shape == (72, 96, 3)
    assert 2 * (2 + 10) <= count <= 2 * (13 + 10)  # Its steps, and the last picture for a second.


@pytest.mark.long
def test_a_task_whose_goals_are_texts_shows_its_frames_alone(shelf_subject, tmp_path):
    (reached,) = policy_video(shelf_subject, tmp_path / "flights.gif", height=64)
    with pytest.raises(UserError, match="corruption = 0.4: goes with image goals"):
        policy_video(shelf_subject, tmp_path / "flights.gif", corruption=0.4)
    assert isinstance(reached, bool) and (tmp_path / "flights.gif").stat().st_size > 1000


@pytest.mark.long
def test_plan_of_a_shelf_knows_its_places_and_others_have_none(shelf_subject):
    env = shelf_subject.train.env
    shelf = shelf_figures.make_shelf(env)
    assert len(shelf.places) == hand_made_frames.WIDTH * hand_made_frames.HEIGHT and shelf.side == pytest.approx(0.2)
    np.testing.assert_allclose(shelf.places[shelf.place], env.position, atol=1e-3)
    assert shelf_figures.make_shelf(env.replace(position=jnp.full_like(env.position, jnp.nan))) is None
    unknown = dataclasses.replace(
        shelf_subject, train=dataclasses.replace(shelf_subject.train, env=env.replace(position=env.position * jnp.nan))
    )
    assert shelf_figures.draw_shelves(unknown) == house_figures.draw_plans(shelf_subject) == {}
    assert image_goal_figures.draw_image_goals(shelf_subject) == {}


@pytest.mark.long
def test_border_of_two_places_side_by_side_has_six_sides(shelf_subject):
    shelf = shelf_figures.make_shelf(shelf_subject.train.env)
    second = int(np.flatnonzero(np.isclose(shelf.places - shelf.places[0], (0.2, 0.0)).all(1))[0])
    assert len(shelf_figures.outline(shelf, np.array([0])).get_segments()) == 4
    assert len(shelf_figures.outline(shelf, np.array([0, second])).get_segments()) == 6


@pytest.mark.long
def test_intrinsic_reward_of_a_place_is_highest_where_the_question_is_answered(shelf_subject):
    """And unknown where nothing that training knows is in view; images of one place count together."""
    env, shelf = shelf_subject.train.env, shelf_figures.make_shelf(shelf_subject.train.env)
    goal = int(env.goals.training_goals[0])
    (reward,), (of_image,) = (
        shelf_figures.rewards_of_places(shelf_subject, shelf, [goal]),
        walks.rewards_of_images(shelf_subject, [goal]),
    )
    np.testing.assert_allclose(reward[shelf.place], of_image)
    np.testing.assert_array_equal(np.isnan(of_image), (np.asarray(env.achieved_goals) < 0).all(1))
    np.testing.assert_allclose(of_image[np.asarray(env.in_view)[:, goal]], 0, atol=1e-6)
    together = dataclasses.replace(shelf, places=shelf.places[:1], place=np.zeros_like(shelf.place))
    np.testing.assert_allclose(
        shelf_figures.rewards_of_places(shelf_subject, together, [goal]), [[np.nanmean(of_image)]]
    )


@pytest.mark.long
def test_flights_that_are_drawn_are_those_of_the_last_evaluation(shelf_subject):
    """Goal by goal, though most of the goals of training are never evaluated."""
    env, found = shelf_subject.train.env, walks.walks_of_policy(shelf_subject)
    assert list(found) == np.asarray(env.goals.evaluated).tolist()
    steps = [
        [len(walk.nodes) - 1 if walk.success else env.episode_length + 1 for walk in of_goal]
        for of_goal in found.values()
    ]
    np.testing.assert_array_equal(steps, shelf_subject.evaluations.last()["first_reached"][0])
    in_view = np.asarray(env.in_view)
    assert all(in_view[walk.nodes[-1], goal] == walk.success for goal, of_goal in found.items() for walk in of_goal)
    assert all(walk.shortest <= walks.from_farthest(of_goal).shortest for of_goal in found.values() for walk in of_goal)


@pytest.mark.long
def test_codes_beside_flights_leave_out_validation_questions(shelf_subject):
    """Names, training and test questions have a mark each: what the learner knows, and what is asked of it."""
    shelf, found = shelf_figures.make_shelf(shelf_subject.train.env), walks.walks_of_policy(shelf_subject)
    figure = shelf_figures.codes_and_trajectories(shelf_subject, shelf, found)
    labels = [text.get_text() for axes in figure.axes if axes.get_legend() for text in axes.get_legend().get_texts()]
    assert {
        "mean, name of an object",
        "mean, training question",
        "mean, test question",
        "the object is in view",
    } <= set(labels)
    assert not any("validation" in label for label in labels)


SETTINGS = {
    "event": "settings",
    "target": "mug",
    "host": "127.0.0.1",
    "simulated": True,
    "envelope": {"left": 3, "right": 3, "up": 2, "down": 1},
}
STEPS = [
    {"event": "step", "move": "right", "outcome": "made", "low": [1, 0], "high": [1, 0], "latency": 0.010},
    {"event": "step", "move": "up", "outcome": "unanswered", "low": [1, 0], "high": [1, 1], "latency": 0.030},
    {"event": "step", "move": "left", "outcome": "refused", "low": [1, 0], "high": [1, 1], "latency": 0.020},
]
TIMES = [{"event": "image"}, {"event": "state"}, {"event": "command"}, {"event": "answer", "outcome": "made"}]
END = [
    {"event": "landing", "reason": "found mug"},
    {"event": "end", "reason": "found mug", "found": True, "landed": True, "steps": 3},
]


def write_log(folder, events, last: str = "") -> None:
    """A log of these events, half a second apart."""
    lines = [json.dumps({"time": 0.5 * number, **event}) for number, event in enumerate(events)]
    (folder / NAME).write_text("\n".join([*lines, last]))


def test_a_flight_is_summarised_and_drawn(tmp_path, capsys):
    write_log(tmp_path, [{"event": "start"}, SETTINGS, *TIMES, *STEPS, *END])
    assert main(["report", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "found mug; on the ground" in printed and "3: 1 made, 1 refused, 1 unanswered" in printed
    assert "20 ms in the median, 30 ms" in printed
    assert (tmp_path / "figures" / "flight.png").stat().st_size > 10_000


def test_a_program_that_was_killed(tmp_path, capsys):
    """Its log has no end, and perhaps half a line."""
    write_log(tmp_path, [{"event": "start"}, SETTINGS, *TIMES, STEPS[0]], '{"time": 9.0, "eve')
    assert flight.report_flight(tmp_path).exists()
    assert "was killed" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"words\nwords\n", "line 1: .*not JSON"),
        (b"[1]\n", "line 1: .*should be an object"),
        (b"\xff\xfe\n", "line 1: .*not UTF-8"),
        (b"", "it holds no event"),
        (b'{"time": 1}\n', "event is missing"),
        (b'{"time": "late", "event": "image"}\n', "time = 'late'"),
        (b'{"time": 1, "event": "end", "reason": "r", "found": 3, "landed": true}\n', "found = 3"),
        (b'{"time": 1, "event": "step", "outcome": "lost"}\n', "outcome = 'lost': give one of 'made', 'refused'"),
    ],
    ids=lambda value: value[:20] if isinstance(value, bytes) else "",
)
def test_a_file_that_is_no_log_is_named_with_line_and_field(content, message, tmp_path, capsys):
    (tmp_path / NAME).write_bytes(content)
    assert main(["report", str(tmp_path)]) == 2
    assert re.search(f"{NAME}.*{message}", capsys.readouterr().err) and len(list(tmp_path.iterdir())) == 1


def test_a_pipe_in_its_place_is_not_read(tmp_path, capsys):
    os.mkfifo(tmp_path / NAME)
    assert main(["report", str(tmp_path)]) == 2 and "no regular file" in capsys.readouterr().err
