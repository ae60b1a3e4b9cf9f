"""Fetch with image goals: what counts as reached and as achieved, corrupted training goals, and mistakes named before
anything is compiled."""

from types import SimpleNamespace

import hand_made
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import make_train, networks, presets
from infogoal_jax.agents.dqn import DQNConfig
from infogoal_jax.agents.hrac import HRACConfig
from infogoal_jax.cli.main import main
from infogoal_jax.data import goal_images
from infogoal_jax.envs.fetch.environment import DISTANCE_THRESHOLD, Fetch
from infogoal_jax.envs.fetch.image_goals import from_data
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.errors import UserError
from infogoal_jax.goals import corrupt
from infogoal_jax.learners.encoding import GoalEncoding, encode_all
from infogoal_jax.learners.learner import GoalCode
from infogoal_jax.runs.low_level import shipped
from infogoal_jax.train.evaluation import corrupted_images
from infogoal_jax.train.parts import Setup, training_view

GRIDS = {}


@pytest.fixture(
    params=[
        pytest.param(task, marks=[] if task in ("fetch_reach", "fetch_push") else pytest.mark.long)
        for task in presets.FETCH_TASKS
    ]
)
def grid(request):
    """The shipped goals of each task over a robot that is only a point, and the positions [N, 3] of the grid among
    them."""
    if request.param not in GRIDS:
        bank = goal_images.load(goal_images.shipped(request.param), request.param)
        blank = SimpleNamespace(
            train=np.zeros((1, 64, 64, 3), np.uint8), test=np.zeros((1, 64, 64, 3), np.uint8), source="blank"
        )
        env = from_data(hand_made_points.Point(), bank, blank, bank.uses.astype(int) - 1)
        GRIDS[request.param] = env, bank.positions[bank.uses == goal_images.GRID]
    return GRIDS[request.param]


@pytest.fixture(scope="module")
def env():
    return hand_made_points.points()


def test_a_position_counts_as_the_nearest_goal_of_the_grid(grid):
    env, positions = grid
    generator = np.random.default_rng(0)
    around = np.concatenate(
        [
            generator.uniform(positions.min(0), positions.max(0), (700, 3)),
            generator.uniform(positions.min(0) - 0.9 * env.spacing, positions.max(0) + 0.9 * env.spacing, (300, 3)),
        ]
    )
    distance = np.linalg.norm(around[:, None] - positions, axis=-1)
    goals_of = jax.jit(env.goals_of)
    found = np.asarray(goals_of(jnp.asarray(around, jnp.float32)))
    assert found.shape == (1000, 1) and (found >= 0).all()
    # Two may be as near.
    np.testing.assert_allclose(distance[np.arange(1000), found[:, 0]], distance.min(1), atol=1e-5)
    np.testing.assert_array_equal(goals_of(jnp.asarray(positions))[:, 0], np.arange(len(positions)))


@pytest.mark.parametrize("axis", range(3))
def test_a_position_far_outside_of_the_grid_achieves_nothing(grid, axis):
    env, positions = grid
    low, high = positions.min(0), positions.max(0)
    outside = np.repeat((low + high)[None] / 2, 2, axis=0)
    outside[:, axis] = low[axis] - 1.01 * env.spacing, high[axis] + 1.01 * env.spacing
    assert (env.goals_of(jnp.asarray(outside)) == -1).all()
    assert (env.goals_of(jnp.full((2, 3), jnp.nan)) == -1).all()


def test_a_goal_is_reached_within_5_cm_of_it_whatever_grid_goal_is_nearest(grid):
    env, _ = grid
    goals = np.repeat(np.asarray(env.goals.evaluated), 20)
    direction = np.random.default_rng(0).normal(size=(len(goals), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    at = env.unwrapped.positions[goals]
    near, far = at + 0.99 * DISTANCE_THRESHOLD * direction, at + 1.01 * DISTANCE_THRESHOLD * direction
    assert env.reached(near, goals).all() and not env.reached(far, goals).any()
    assert (env.goals_of(near) != env.goals_of(at)).any()


def test_each_use_has_goals_of_its_own_and_the_grid_is_never_desired(grid):
    env, positions = grid
    masks = np.stack([env.goals.train_mask, env.goals.validation_mask, env.goals.test_mask])
    assert masks.sum(0).max() == 1 and masks.sum(1).tolist() == [8, 8, 32]
    assert not masks[:, : len(positions)].any() and masks[:, len(positions) :].any(0).all()
    np.testing.assert_array_equal(env.goals.training_goals, np.flatnonzero(masks[0]))
    np.testing.assert_array_equal(env.goals.evaluated, np.flatnonzero(masks.any(0)))


def test_episodes_are_for_training_goals_each_as_often_as_the_others(env):
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 400))
    goals, count = np.unique(states.desired_goal, return_counts=True)
    np.testing.assert_array_equal(goals, env.goals.training_goals)
    assert count.min() > 60
    np.testing.assert_array_equal(states.robot.desired_goal, env.unwrapped.positions[states.desired_goal])


@pytest.mark.parametrize("task", presets.FETCH_TASKS)
def test_networks_see_numbers_of_the_order_of_one(task):
    robot = SimpleNamespace(task=TASKS[task])
    centre, scale = Fetch.units.fget(robot)
    assert centre.shape == scale.shape == ((10,) if robot.task.object_height is None else (25,)) and (scale > 0).all()
    np.testing.assert_array_equal(centre[:3], robot.task.start_grip)
    reach = np.abs((np.array(robot.task.start_grip) + 0.15 - centre[:3]) / scale[:3])
    assert (reach > 0.5).all() and (reach < 3).all()


@pytest.mark.parametrize("method", [pytest.param("infogoal", marks=pytest.mark.long), "none"])
def test_training_goals_have_the_same_codes_whichever_way_they_are_encoded(method, env):
    train = make_train(hand_made_points.config(method), hand_made_points.steered(env))
    learner = train.parts.learner
    example = hand_made.example(env.goals.inputs)
    params, _ = hand_made.initial(learner, jax.random.key(0), example, train.config.hyper.learner)
    goals = env.goals.training_goals[jnp.array([[3, 0], [1, 1]])]

    def every_way(params):
        ways = [
            encode(GoalEncoding(learner, params, env.goals, limit))(goals)
            for limit in (1, 1000)
            for encode in (GoalEncoding.of_desired_goals, GoalEncoding.of_any)
        ]
        one_by_one = learner.encode(params, env.goals.inputs[goals])
        return one_by_one, [*ways, encode_all(learner, params, env.goals)[goals]]

    one_by_one, others = jax.jit(every_way)(params)
    for codes in others:
        jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, atol=1e-5), codes, one_by_one)


def test_training_corrupts_with_training_backgrounds_drawn_for_each_goal():
    levels = np.arange(0, 200, 10, dtype=np.uint8)[:, None, None, None] * np.ones((1, 16, 16, 3), np.uint8)
    env = hand_made_points.points(levels, np.full((1, 16, 16, 3), 255, np.uint8))
    pixels = SimpleNamespace(encode=lambda params, images: GoalCode(images.astype(jnp.float32), jnp.zeros(())))
    goals = jnp.repeat(env.goals.training_goals, 50)
    parts = SimpleNamespace(config=SimpleNamespace(training_corruption=0.5), learner=SimpleNamespace(augment=None))
    assert (
        training_view(
            Setup(SimpleNamespace(config=SimpleNamespace(training_corruption=0.0), learner=parts.learner), None, env),
            augmented=True,
        )
        is None
    )
    view = training_view(Setup(parts, None, env), augmented=True)
    encoding = GoalEncoding(pixels, None, env.goals, 1000, view, jax.random.key(0))
    for encode in (encoding.of_desired_goals(), encoding.of_any()):
        seen = encode(goals).mean
        behind = np.asarray(2 * seen - env.goals.inputs[goals].astype(jnp.float32))
        level = behind.mean((1, 2, 3))
        assert (behind.max((1, 2, 3)) - behind.min((1, 2, 3)) <= 2).all()  # One background each, up to rounding.
        assert (abs(level - 10 * np.round(level / 10)) <= 1).all() and level.max() < 200
        assert len(set(np.round(level / 10))) > 15
    assert not np.array_equal(encoding._replace(key=jax.random.key(1)).of_any()(goals).mean, seen)


def test_corruption_of_weight_0_is_the_image_and_of_weight_1_the_background(env):
    images, backgrounds = env.goals.inputs[:20], env.test_backgrounds
    np.testing.assert_array_equal(corrupt(images, backgrounds, 0.0), images)
    np.testing.assert_array_equal(corrupt(images, backgrounds, 1.0), backgrounds)
    half = np.asarray(corrupt(images, backgrounds, 0.5), float)
    np.testing.assert_allclose(half, (np.asarray(images, float) + np.asarray(backgrounds, float)) / 2, atol=0.5)


def test_validation_goals_have_other_backgrounds_than_tests(env):
    """So that what is chosen by them has seen none of the tests'."""
    chosen_by = jnp.zeros(env.goals.num_goals, bool).at[-2:].set(True)
    env = env.replace(goals=env.goals.replace(validation_mask=chosen_by, test_mask=env.goals.test_mask & ~chosen_by))
    goals = env.goals.evaluated
    shown = np.asarray(corrupted_images(env, goals, 2, 1.0))  # Backgrounds alone.
    of_validation = np.asarray(chosen_by)[goals]
    assert of_validation.sum() == 2 and len(goals) == 8
    for bank, images in ((env.train_backgrounds, shown[of_validation]), (env.test_backgrounds, shown[~of_validation])):
        known = {image.tobytes() for image in np.asarray(bank)}
        assert all(image.tobytes() in known for image in images.reshape(-1, *images.shape[2:]))
    assert not {image.tobytes() for image in np.asarray(env.train_backgrounds)} & {
        image.tobytes() for image in np.asarray(env.test_backgrounds)
    }


PUSH = goal_images.shipped("fetch_push")
MISTAKES = [
    ("train fetch_reach --env.goals positions", ["agent = 'hrac'", "target states"]),
    ("train fetch_reach --env.no-ends-at-goal", ["env.ends_at_goal = False"]),
    ("train fetch_reach --training-corruption 1", ["training_corruption = 1.0", "below 1"]),
    ("train fetch_reach --training-corruption nan", ["training_corruption = nan"]),
    ("train fetch_reach --test-corruption -0.1", ["test_corruption = -0.1", "from 0 to 1"]),
    ("train object_search --training-corruption 0.4", ["training_corruption = 0.4", "object_search"]),
    ("train fetch_reach --agent.interval 0", ["agent.interval = 0", "episode length, 50"]),
    ("train fetch_reach --agent.interval 51", ["agent.interval = 51", "episode length, 50"]),
    ("train fetch_reach --agent.subgoal-scale 0", ["agent.subgoal_scale = 0.0", "metres"]),
    ("train fetch_reach --agent.cell 0.01", ["agent.cell = 0.01"]),
    (
        f"train fetch_reach --agent.low-level {shipped('fetch_push')}",
        ["'fetch_push'", "'fetch_reach'", "infogoal pretrain fetch_reach"],
    ),
    ("train fetch_reach --agent.low-level nothing", ["'nothing'", "no such file"]),
    ("train fetch_reach --agent.low-level ~not_there", ["'~not_there'", "no such file"]),
    (f"train fetch_reach --env.goal-images {PUSH}", [str(PUSH), "task = 'fetch_push'", "'fetch_reach'"]),
    ("train fetch_reach --env.goal-images nothing.npz", ["'nothing.npz'", "no such file", "reproduce goal-images"]),
    ("train fetch_reach --env.backgrounds empty", ["backgrounds = 'empty'", "is empty"]),
    ("train fetch_reach --env.backgrounds nothing", ["backgrounds = 'nothing'", "no such folder"]),
    ("train fetch_reach --env.backgrounds ~not_there", ["backgrounds = '~not_there'", "no such folder"]),
    ("train fetch_slide", ["task = 'fetch_slide'", "no preset"]),
]


@pytest.mark.parametrize(
    ("arguments", "expected"), MISTAKES, ids=[arguments.split("/")[0] for arguments, _ in MISTAKES]
)
def test_a_mistake_is_named_before_anything_is_compiled(arguments, expected, tmp_path, monkeypatch, capsys):
    def refuse(*arguments, **options):
        raise AssertionError("compiled before the mistake was found")

    monkeypatch.setattr(jax.stages.Lowered, "compile", refuse)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    assert main(arguments.split()) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("infogoal: ") and all(words in printed for words in expected), printed
    assert not (tmp_path / "runs").exists()


def test_an_agent_and_an_environment_that_do_not_fit_are_refused(env):
    with pytest.raises(UserError, match="env.goals = 'pictures'"):
        presets.load("fetch_reach", env=FetchConfig(goals="pictures"))
    with pytest.raises(UserError, match="agent = 'dqn'.*give hrac"):
        make_train(hand_made_points.config(agent=DQNConfig()), env)
    with pytest.raises(UserError, match="agent = 'hrac'"):
        make_train(presets.load("object_search", agent=HRACConfig()))


def test_an_environment_that_is_given_gets_the_low_level_that_the_configuration_names(env):
    """`make_train(config, envs.load(...))` is the same as `make_train(config)`."""
    train = make_train(hand_made_points.config(), env)
    assert train.env.action_size == 3 and train.env.interval == hand_made_points.INTERVAL
    assert train.env.action_mask(jnp.zeros((4, 10))).shape == (4, 3)


@pytest.mark.long
def test_standardised_images_are_coded_alike_whatever_their_brightness_and_contrast():
    image = jax.random.randint(jax.random.key(0), (1, 64, 64, 3), 60, 200).astype(jnp.uint8)
    duller = jnp.round(0.5 * image.astype(jnp.float32) + 40).astype(jnp.uint8)
    for standardise in (False, True):
        encoder = networks.GoalLayers((32,), 8, standardise)
        params, apply = jax.jit(encoder.init)(jax.random.key(1), image), jax.jit(encoder.apply)
        error = np.abs(np.subtract(apply(params, image), apply(params, duller))).max()
        assert (error < 0.05) == standardise
