"""What a run with continuous goals gives: evaluation and episodes at any goal, a policy in a file that takes any, and
figures over the goal space."""

import io
import json

import flax.struct
import hand_made
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import assert_drawn
from rich.console import Console

from infogoal_jax import UserError, envs, evaluate, load_run, make_train, policy_file, presets, rollout
from infogoal_jax.cli.main import main
from infogoal_jax.envs.goal_task import GoalTask
from infogoal_jax.envs.plane import PlaneConfig
from infogoal_jax.goals import GoalBox
from infogoal_jax.report import export
from infogoal_jax.report.figures import draw_figures, read_subject
from infogoal_jax.report.goal_space_figures import corners_of, success_over_goals
from infogoal_jax.report.summary import evaluate_run, goal_table, typed_goal
from infogoal_jax.runner import training
from infogoal_jax.train.contracts import with_checked_inputs

SMALL = {
    "num_epochs": 1,
    "epochs_per_evaluation": 1,
    "num_envs": 4,
    "rollout_steps": 20,
    "updates_per_epoch": 2,
    "batch_size": 16,
    "buffer_steps": 400,
    "evaluation_starts": 2,
}
SEEDS = [0, 1]


CONFIG = presets.load("point_maze", "none", env=PlaneConfig(episode_length=20), **SMALL)
"""The maze, hardly trained."""


@pytest.fixture(scope="module")
def maze():
    return envs.load("point_maze", CONFIG.env)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, maze):
    return training.run(CONFIG, SEEDS, tmp_path_factory.mktemp("vectors") / "run", env=maze).folder


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["1.2"], r"goal = '1.2': give 2 numbers: 0 to 3, 0 to 3"),
        (["1", "2", "3"], "give 2 numbers"),
        (["one", "2"], "give 2 numbers"),
        (["3.5", "1"], r"goal = \[3.5, 1.0\]: lies outside; give 0 to 3, 0 to 3"),
        (["nan", "1"], r"goal\[0\] = nan: give finite numbers"),
        (["1", "1e39"], "lies outside"),
    ],
)
def test_a_typed_goal_that_is_none_is_refused_in_one_line(words, said, maze):
    with pytest.raises(UserError, match=said) as error:
        typed_goal(maze.goals, words)
    assert "\n" not in str(error.value)


@pytest.mark.long
@pytest.mark.parametrize("word", ["1" * 5000, "9" * 18, "-1", "nan", "", "0 0"])
def test_a_number_of_any_length_is_a_goal_of_a_list_or_none(word):
    """Python reads numbers of 4,300 digits at most."""
    with pytest.raises(UserError, match="^goal = .*(no goal|the task has the goals 0 to)") as error:
        typed_goal(hand_made.environment().goals, word.split(" "))
    assert len(str(error.value)) < 500 and "\n" not in str(error.value)


@pytest.mark.parametrize("columns", [["success_rate", "episode_length"], ["success_rate", "spl", "episode_length"]])
def test_a_row_of_a_goal_has_the_numbers_that_the_task_has(columns, maze):
    console = Console(file=io.StringIO(), width=100)
    scores = {column: np.array([[number, number + 0.5]]) for number, column in enumerate(columns)}
    console.print(goal_table(maze.goals, np.array([[0.5, 0.5], [2.5, 0.4]], np.float32), scores))
    first, second = (line.split() for line in console.file.getvalue().splitlines()[2:])
    assert first[:3] == ["0.5,", "0.5", "training"] and second[:3] == ["2.5,", "0.4", "test"]
    assert [float(word) for word in first[3:]] == list(range(len(columns)))
    assert [float(word) for word in second[3:]] == [number + 0.5 for number in range(len(columns))]


@pytest.mark.long
def test_typed_goals_are_evaluated_as_the_public_function_does(folder, maze, capsys):
    """A row for each goal with its use, and the numbers of every seed in a file."""
    words = [("0.5", "0.5"), ("2.5", "0.4")]
    console = Console(file=io.StringIO(), width=100)
    found = evaluate_run(folder, 3, 1, 0.0, env=maze, console=console, goals=words)
    written = json.loads((folder / "evaluation.json").read_text())
    assert written["goals"] == pytest.approx(np.array(words, float)) and written["seeds"] == SEEDS
    assert written["metrics"]["success_rate"] == found["success_rate"].tolist()
    rows = [line.split() for line in console.file.getvalue().splitlines() if line.startswith(("0.5,", "2.5,"))]
    assert [row[:3] for row in rows] == [["0.5,", "0.5", "training"], ["2.5,", "0.4", "test"]]
    run = load_run(folder)
    again = jax.jit(lambda: [evaluate(run.policy(seed), run.env, np.array(words, float), 3, 1) for seed in SEEDS])()
    np.testing.assert_allclose(found["success_rate"], [scores.success.mean(-1) for scores in again])
    np.testing.assert_allclose(found["episode_length"], [scores.steps.mean(-1) for scores in again], rtol=1e-6)
    assert main(["evaluate", str(folder), "--goal", "0.5", "9", "--goal", "1", "1"]) == 2
    assert capsys.readouterr().err.splitlines() == ["infogoal: goal = [0.5, 9.0]: lies outside; give 0 to 3, 0 to 3"]


@pytest.mark.long
def test_an_episode_goes_to_a_typed_goal(folder):
    run = load_run(folder)
    episode = jax.jit(lambda key: rollout(run.env, run.policy(1), [1.2, 0.7], key))(jax.random.key(0))
    assert episode.observations.shape == (21, 2)
    with pytest.raises(UserError, match="goal = .*lies outside"):
        rollout(run.env, run.policy(), [1.2, 3.7], jax.random.key(0))


@pytest.fixture(scope="module")
def policy(maze):
    """Of parameters drawn at random."""
    train = make_train(CONFIG, maze)
    return train.policy(hand_made_points.random_params(train), CONFIG.hyper, maze)


@pytest.mark.parametrize(
    ("observation", "goal", "said"),
    [
        (
            np.ones((1, 3)),
            np.ones((1, 2)),
            r"observation = .*float64 \[1, 3\].*give observations of the task, float32 \[E, 2\]",
        ),
        (np.ones(2), np.ones((1, 2)), r"observation = .*give observations of the task, float32 \[E, 2\]"),
        (np.array([[1, np.nan]]), np.ones((1, 2)), r"observation\[0, 1\] = nan: give finite numbers"),
        (np.ones((1, 2)), np.array([[1, np.nan]]), r"goal\[0, 1\] = nan: give finite numbers"),
        (np.ones((1, 2)), np.array([[1, 9.0]]), r"goal = \[1.0, 9.0\]: lies outside; give 0 to 3, 0 to 3"),
    ],
)
def test_a_policy_says_what_is_no_observation_and_no_goal(policy, observation, goal, said):
    assert policy(np.ones((1, 2)), np.ones((1, 2)), jax.random.key(0)).shape == (1, 2)
    with pytest.raises(UserError, match=said):
        policy(observation, goal, jax.random.key(0))


def test_a_policy_of_a_tree_of_one_array_says_what_is_no_observation(maze):
    seen = {"place": jax.ShapeDtypeStruct((2,), "float32")}
    policy = with_checked_inputs(lambda observation, goal, key: observation["place"], maze, seen)
    goal, place = np.ones((1, 2)), np.full((1, 2), 0.5)
    np.testing.assert_array_equal(policy({"place": place}, goal, None), place)
    for observation, said in (({"place": goal[0]}, r"observation\['place'\] = .*\[E, 2\]"), (place, "observation = ")):
        with pytest.raises(UserError, match=said):
            policy(observation, goal, None)


def test_an_exported_policy_takes_any_goal_of_the_space(maze, tmp_path, monkeypatch):
    """Places and goals go in as the task has them, and the actions are those of JAX, as what is simulated takes
    them."""
    monkeypatch.setattr(type(maze), "own_action", lambda self, action: 3 * action)
    train = make_train(CONFIG, maze)
    params = hand_made_points.random_params(train)
    policy = export.export_params(train, params, tmp_path / "policy.npz", {})
    act = jax.jit(train.policy(params, train.config.hyper, maze, use_mean=True))
    random = np.random.default_rng(0)
    places, goals = random.uniform(-1, 1, (8, 2)).astype(np.float32), random.uniform(0, 3, (8, 2)).astype(np.float32)
    expected = act(jnp.asarray(places), jnp.asarray(goals), jax.random.key(0))
    found = [policy.drive(place, goal.tolist(), 0)[0] for place, goal in zip(places, goals, strict=True)]
    np.testing.assert_allclose(found, 3 * expected, atol=1e-5)
    again = policy_file.ExportedPolicy(tmp_path / "policy.npz")
    assert again.about["goal_low"] == [0, 0] and again.about["goal_high"] == [3, 3] and again.goals is None
    for goal in ([0.5], [0.5, 3.5], [0.5, np.nan], np.zeros((1, 2))):
        with pytest.raises(ValueError, match="goal = .*give 2 numbers from"):
            again.drive(places[0], goal, 0)


@flax.struct.dataclass
class Pictured(GoalTask):
    """A point in a square that is seen in pictures."""

    action_size = 2

    def begin(self, key):
        return jax.random.uniform(key, (2,))

    def move(self, place, action):
        return (place + 0.1 * action).clip(0.0, 1.0)

    def observation(self, place):
        row, column = (place * 7).astype(jnp.int32)
        return jnp.zeros((8, 8, 1), jnp.uint8).at[row, column].set(255)

    def achieved_goal(self, place):
        return place


def test_a_policy_that_sees_pictures_and_acts_by_vectors_is_exported():
    """The observation stands where others have the floats of theirs, as `ExportedPolicy.drive` gives it."""
    env = Pictured(GoalBox.of([0.0, 0.0], [1.0, 1.0]))
    train = make_train(CONFIG, env)
    drive, given = export.driving(train, hand_made_points.random_params(train))
    observation, _, _, body, target, _ = given
    assert observation.shape == body.shape == (8, 8, 1) and observation.dtype == body.dtype == np.uint8
    assert all(found.shape == target.shape == (2,) for found in jax.eval_shape(drive, *given))


@pytest.mark.long
def test_figures_over_the_goal_space(folder, maze):
    names = {"learning_curves", "success_by_length", "success_over_goals", "representations"}
    assert_drawn(draw_figures(folder, env=maze), folder, names)


@pytest.mark.long
def test_the_map_outlines_the_rooms_that_are_held_out(folder, maze):
    """Every vertex of an outline lies at the border of its rooms."""
    (axes, _) = success_over_goals(read_subject(folder, maze)).axes
    (low, high), lines = (
        corners_of(maze.goals, np.array([0, 1])),
        [path.vertices for contour in axes.collections if hasattr(contour, "levels") for path in contour.get_paths()],
    )
    assert len(lines) == 2 and (low < 0.3).all() and (high > 2.7).all()
    for vertices in lines:
        near = np.abs(vertices - np.round(vertices)).min(-1)
        assert (near < 0.05).all()
