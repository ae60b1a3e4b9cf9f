"""What a run reports: intervals over seeds, tables that leave out and name diverged seeds, and figures that show
something."""

import dataclasses
import io
import json
import math
import shutil

import hand_made
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console
from scipy import stats

from infogoal_jax.errors import UserError
from infogoal_jax.report import fetch_figures, house_figures, image_goal_episodes, image_goal_figures, tables, walks
from infogoal_jax.report.figures import beta_and_accuracy, draw_figures, evaluated_mask, read_subject, success_within
from infogoal_jax.report.goal_codes import principal_components, representations
from infogoal_jax.report.statistics import mean_interval, paired_difference
from infogoal_jax.report.summary import evaluate_run, print_run, print_summary
from infogoal_jax.train import host
from infogoal_jax.train.evaluation import EVALUATION_SEED
from infogoal_jax.train.program import make_train
from infogoal_jax.train.settings import corrupted_view

SEEDS = [3, 4, 5]
EVERY_TASKS_FIGURES = {
    "learning_curves",
    "beta_and_accuracy",
    "representations",
    "success_by_length",
    "success_by_goal",
}
FIGURES = EVERY_TASKS_FIGURES | {"trajectories", "intrinsic_reward"}
IMAGE_GOAL_FIGURES = EVERY_TASKS_FIGURES | {"goal_images", "codes_and_trajectories"}


def house_from_above():
    """The hand-made task with its plan: a cross of places 0.6 m apart, room r at r quarter turns."""
    position = np.zeros((4 * (1 + hand_made.ROOMS * hand_made.DEPTH), 3), np.float32)
    for state in range(len(position)):
        place, heading = divmod(state, 4)
        room, depth = divmod(place - 1, hand_made.DEPTH)
        distance, angle = (0.6 * (depth + 1) if place else 0.0), room * math.pi / 2
        position[state] = distance * math.cos(angle), distance * math.sin(angle), heading * math.pi / 2
    return hand_made.environment().replace(position=jnp.asarray(position))


@pytest.fixture(scope="module")
def env():
    return house_from_above()


@pytest.fixture(scope="module")
def sweep(tmp_path_factory, env):
    return host.run(hand_made.config(), SEEDS, tmp_path_factory.mktemp("report") / "run", env=env)


@pytest.fixture
def diverged_run(sweep, tmp_path):
    """A copy of the run in which seed 4 diverged at epoch 3."""
    folder = tmp_path / "run"
    shutil.copytree(sweep.folder, folder)
    rows = [json.loads(line) for line in (folder / "epochs.jsonl").read_text().splitlines()]
    for row in rows:
        if row["seed"] == 4 and row["epoch"] >= 3:
            row["agent/loss"] = math.nan
    (folder / "epochs.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def printed(show, *arguments) -> str:
    """What a function prints on a console of its own."""
    console = Console(file=io.StringIO(), width=120)
    show(*arguments, console=console)
    return console.file.getvalue()


def assert_drawn(paths, folder, names):
    """These figures were drawn, and none is blank."""
    assert {path.stem for path in paths} == names
    for path in paths:
        picture = imread(path)[..., :3]
        assert path.parent == folder / "figures" and min(picture.shape[:2]) > 300
        assert (picture.min(-1) < 0.9).mean() > 0.01, f"{path.name} is blank"


def test_interval_is_students_t():
    values = [0.2, 0.5, 0.6, 0.9]
    interval = mean_interval(values)
    low, high = stats.t.interval(0.95, 3, loc=np.mean(values), scale=stats.sem(values))
    np.testing.assert_allclose((interval.mean, interval.low, interval.high), (0.55, low, high))
    # By hand: t(0.975, 1) = 12.706, and the standard error of two numbers is half of their difference.
    assert mean_interval([1.0, 3.0]).half_width == pytest.approx(12.7062, abs=1e-4)


def test_interval_is_taken_at_each_point_of_a_curve():
    curves = np.random.default_rng(0).normal(size=(5, 7))
    interval = mean_interval(curves)
    assert interval.mean.shape == interval.half_width.shape == (7,)
    assert interval.half_width[2] == pytest.approx(mean_interval(curves[:, 2]).half_width)


def test_one_seed_has_no_interval_and_none_has_no_mean():
    one, none = mean_interval([0.52]), mean_interval([])
    assert one.mean == 0.52 and math.isnan(one.half_width) and one.show() == "0.52"
    assert math.isnan(none.mean) and none.show() == "-"
    assert mean_interval([0.5, 0.5]).show() == "0.50 ± 0.00"


def test_paired_difference_is_first_minus_second_and_forgets_what_seeds_share():
    luck = np.random.default_rng(1).normal(size=8)
    difference = paired_difference(luck + 0.3 + 0.01 * np.arange(8), luck)
    assert difference.mean == pytest.approx(0.335)
    assert difference.low > 0 > paired_difference(luck, luck + 0.3 + 0.01 * np.arange(8)).high
    assert difference.half_width < mean_interval(luck).half_width / 10
    with pytest.raises(UserError, match="same seeds"):
        paired_difference([1.0, 2.0], [1.0])


def test_summary_names_data_seeds_and_times(sweep):
    text = printed(print_summary, sweep)
    scores = tables.read(sweep.folder, "evaluations").last()
    for word in (
        "hand-made graph",
        "3 seeds",
        "compiling",
        "running",
        "beta",
        str(sweep.folder),
        mean_interval(scores["test_goal/spl"]).show(),
    ):
        assert word in text
    assert "diverged" not in text
    from_disk = printed(print_run, sweep.folder)
    assert text == from_disk


def test_diverged_seed_is_named_and_left_out(sweep, diverged_run, env):
    everything, left = (
        tables.read(sweep.folder, "evaluations"),
        tables.read(diverged_run, "evaluations", tables.diverged_seeds(diverged_run)),
    )
    assert tables.diverged_seeds(diverged_run) == {4: 3}
    assert left.seeds == [3, 5]
    name = "train_goal/episode_length"
    np.testing.assert_array_equal(left.values[name], everything.values[name][[0, 2]])
    text = printed(print_run, diverged_run)
    assert "seed 4 diverged at epoch 3" in text and "2 seeds" in text
    assert mean_interval(left.last()[name]).show(1) in text
    scores = evaluate_run(diverged_run, 2, 1, -1.0, env=env, console=Console(file=io.StringIO()))
    assert all(value.shape == (2,) for value in scores.values())


def test_run_whose_seeds_all_diverged_still_reports(diverged_run, env):
    rows = [
        json.loads(line) | {"agent/loss": math.inf} for line in (diverged_run / "epochs.jsonl").read_text().splitlines()
    ]
    (diverged_run / "epochs.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    text = printed(print_run, diverged_run)
    assert "every seed diverged" in text and all(f"seed {seed} diverged at epoch 1" in text for seed in SEEDS)
    assert draw_figures(diverged_run, env=env) == []


def test_evaluation_again_depends_on_its_seed_alone(sweep, env):
    quiet = Console(file=io.StringIO())
    first, again, other = (evaluate_run(sweep.folder, 4, seed, 0.5, env=env, console=quiet) for seed in (1, 1, 2))
    assert {
        "train_goal/spl",
        "train_goal_mean_code/spl",
        "test_goal/success_rate",
        "test_goal_mean_code/episode_length",
    } <= first.keys()
    assert all((first[name] == again[name]).all() for name in first)
    assert any((first[name] != other[name]).any() for name in first)
    written = json.loads((sweep.folder / "evaluation.json").read_text())
    assert (written["starts"], written["start_seed"], written["test_epsilon"], written["seeds"]) == (4, 2, 0.5, SEEDS)
    assert written["metrics"]["test_goal/spl"] == pytest.approx(other["test_goal/spl"].tolist())


def test_evaluation_refuses_what_makes_no_sense(sweep, env):
    for starts, seed, epsilon, field in (
        (0, 1, 0.0, "starts"),
        (5, -1, 0.0, "start_seed"),
        (5, 1, 1.5, "test_epsilon"),
    ):
        with pytest.raises(UserError, match=field):
            evaluate_run(sweep.folder, starts, seed, epsilon, env=env)
    with pytest.raises(UserError, match="goals of object_search are not images"):
        evaluate_run(sweep.folder, 5, 1, 0.0, 0.4, env=env)


def test_every_figure_is_drawn_and_shows_something(sweep, env):
    assert_drawn(draw_figures(sweep.folder, env=env), sweep.folder, FIGURES)


def test_house_without_positions_has_no_plans(sweep, env):
    unknown = read_subject(sweep.folder, env.replace(position=jnp.full_like(env.position, jnp.nan)))
    assert house_figures.draw_plans(unknown) == {}


def test_plan_knows_places_and_the_length_of_a_move(env):
    plan = house_figures.make_plan(env)
    assert len(np.unique(plan.place)) == 1 + hand_made.ROOMS * hand_made.DEPTH and len(np.unique(plan.part)) == 1
    assert all(len(set(plan.place[4 * place : 4 * place + 4])) == 1 for place in range(13))
    assert plan.spacing == pytest.approx(0.6)


def test_intrinsic_reward_is_highest_where_the_goal_itself_is_in_view(sweep, env):
    subject = read_subject(sweep.folder, env)
    reward, in_view = walks.reward_of_images(subject, 0), np.asarray(env.in_view)
    np.testing.assert_array_equal(np.isnan(reward), ~in_view.any(1))
    assert np.nanmean(reward) == pytest.approx(-1)
    np.testing.assert_allclose(reward[in_view[:, 0]], 0, atol=1e-6)


def test_walks_are_those_of_the_last_evaluation(sweep, env):
    subject = read_subject(sweep.folder, env)
    first_reached = subject.evaluations.last()["first_reached"][0]
    found = walks.walks_of_policy(subject)
    steps = [
        [len(walk.nodes) - 1 if walk.success else env.episode_length + 1 for walk in of_goal]
        for of_goal in found.values()
    ]
    np.testing.assert_array_equal(steps, first_reached)


def test_success_by_length_ends_at_the_success_rate(sweep, env):
    scores = tables.read(sweep.folder, "evaluations").last()
    curve = success_within(scores["first_reached"], np.asarray(env.goals.test_mask), env.episode_length)
    assert curve.shape == (len(SEEDS), env.episode_length + 1)
    np.testing.assert_allclose(curve[:, -1], scores["test_goal/success_rate"], atol=1e-6)
    assert (np.diff(curve, axis=1) >= 0).all() and (curve[:, 0] == 0).all()


def test_principal_components_find_the_plane_of_the_points():
    plane = np.linalg.qr(np.random.default_rng(2).normal(size=(6, 2)))[0].T
    coordinates = np.random.default_rng(3).normal(size=(20, 2)) * [5, 1]
    centre, axes, shares = principal_components(3.0 + coordinates @ plane)
    np.testing.assert_allclose(axes @ axes.T, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(
        ((3.0 + coordinates @ plane) - centre) @ axes.T @ axes + centre, 3.0 + coordinates @ plane, atol=1e-12
    )
    assert shares.sum() == pytest.approx(1) and shares[0] > shares[1]


def test_method_without_beta_and_intrinsic_reward_has_no_such_figures(sweep, env):
    config, subject = hand_made.config("none"), read_subject(sweep.folder, env)
    train = make_train(config, env)
    params = {"goal": train.parts.learner.init(jax.random.key(0), hand_made.example(env.goals.inputs), config.hyper)[0]}
    subject = dataclasses.replace(
        subject, run=dataclasses.replace(subject.run, config=config), train=train, params=params
    )
    assert beta_and_accuracy(subject) is None
    assert house_figures.intrinsic_reward(subject, house_figures.make_plan(env), {}) is None
    assert representations(subject) is not None


@pytest.fixture(scope="module")
def points(tmp_path_factory):
    """A run with image goals, without physics: most goals are never evaluated, and there are none for validation."""
    env = hand_made_points.steered()
    return host.run(hand_made_points.config(), [6, 7], tmp_path_factory.mktemp("points") / "run", env=env)


@pytest.fixture(scope="module")
def points_subject(points):
    return read_subject(points.folder, points.train.env)


def rows_of(text: str) -> list[list[str]]:
    """The first two cells of each row of a table."""
    return [[cell.strip() for cell in line.split("│")[1:3]] for line in text.splitlines() if line.startswith("│")]


@pytest.mark.long
def test_summary_of_a_fetch_run_has_a_row_for_each_kind_of_goals_and_code(reach_run):
    text, scores = printed(print_run, reach_run.folder), tables.read(reach_run.folder, "evaluations").last()
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


def test_every_figure_of_image_goals_is_drawn_and_shows_something(points):
    assert_drawn(draw_figures(points.folder, env=points.train.env), points.folder, IMAGE_GOAL_FIGURES)


def test_a_method_with_codes_that_are_not_random_has_figures_of_image_goals(points_subject):
    config, env = hand_made_points.config("none"), points_subject.train.env
    train = make_train(config, env)
    params = jax.jit(train.initial)(jax.random.key(0), config.hyper, env).params
    subject = dataclasses.replace(
        points_subject, run=dataclasses.replace(points_subject.run, config=config), train=train, params=params
    )
    assert beta_and_accuracy(subject) is None
    assert image_goal_figures.draw_image_goals(subject)["codes_and_trajectories"] is not None


def test_evaluation_takes_another_corruption_and_the_clean_goals_do_not_see_it(points):
    console, env = Console(file=io.StringIO(), width=150), points.train.env
    scores = {}
    for weight in (0.0, 0.8, None):
        scores[weight] = evaluate_run(points.folder, 3, 1, 0.0, weight, env=env, console=console)
        used = points.train.config.test_corruption if weight is None else weight
        assert json.loads((points.folder / "evaluation.json").read_text())["corruption"] == used
        assert f"background of weight {used:g}" in console.file.getvalue()
    assert "8 goals x 3 starts" in console.file.getvalue()
    for group in ("train", "test"):
        steps = [of_weight[f"{group}_goal_mean_code/episode_length"] for of_weight in scores.values()]
        assert (steps[0] == steps[1]).all() and (steps[0] == steps[2]).all()
        np.testing.assert_array_equal(scores[0.0][f"corrupted_{group}_goal_mean_code/episode_length"], steps[0])
    for weight in (1.5, -0.1, math.nan):
        with pytest.raises(UserError, match=f"corruption = {weight}"):
            evaluate_run(points.folder, 1, 1, 0.0, weight, env=env)


@pytest.mark.long
def test_success_by_length_of_evaluated_goals_ends_at_the_success_rate(reach_run):
    env, scores = reach_run.train.env, tables.read(reach_run.folder, "evaluations").last()
    for group in env.goals.groups:
        mask = evaluated_mask(env.goals, group)
        assert len(mask) == 48 and mask.sum() == {"train": 8, "validation": 8, "test": 32}[group]
        curve = success_within(scores["first_reached"], mask, env.episode_length)
        np.testing.assert_allclose(curve[:, -1], scores[f"{group}_goal/success_rate"], atol=1e-6)


@pytest.mark.long
def test_goals_of_the_trajectories_lie_in_different_regions(reach_run):
    env = reach_run.train.env
    apart = fetch_figures.distances_of_goals(env)
    chosen = image_goal_figures.spread_goals(env.goals, env.goals.test_mask, 4, apart)
    assert len(set(np.asarray(env.goals.regions)[chosen])) == 4 and np.asarray(env.goals.test_mask)[chosen].all()
    assert len(image_goal_figures.spread_goals(env.goals, env.goals.train_mask, 100, apart)) == 8


def test_episodes_that_are_drawn_go_to_their_goals_and_depend_on_the_corruption(points, points_subject):
    env = points.train.env
    goals = np.flatnonzero(np.asarray(env.goals.test_mask))[::-1]
    clean, again, corrupted = image_goal_episodes.policy_episodes(
        points_subject, goals, [0.0, 0.0, 1.0], EVALUATION_SEED
    )
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
        image_goal_episodes.seen_images(env, np.array([5, 3]), weight, 7).astype(float) for weight in (0.0, 0.5, 1.0)
    )
    np.testing.assert_array_equal(clean, np.asarray(env.goals.inputs)[[5, 3]])
    assert np.abs(half - (clean + background) / 2).max() <= 0.5
    assert all((np.asarray(env.test_backgrounds) == image).all((1, 2, 3)).any() for image in background)


def test_images_that_are_shown_are_those_that_the_policy_sees(points, points_subject):
    """The learner of the run, asked what it encodes."""
    seen, learner = [], points.train.parts.learner

    def encode(params, inputs):
        seen.append(np.asarray(inputs))
        return learner.encode(params, inputs)

    some, env = np.array([126, 130]), points.train.env
    parts = points.train.parts._replace(learner=learner._replace(encode=encode))
    corrupted_view(parts, points_subject.params, env, jnp.asarray(some), 1, 0.4, 9)
    np.testing.assert_array_equal(seen[-1], image_goal_episodes.seen_images(env, some, 0.4, 9))


@pytest.mark.long
def test_goal_images_can_be_drawn_without_a_run(reach_run, tmp_path):
    image_goal_figures.save_goal_images(reach_run.train.env.env, tmp_path / "goals.png")
    assert imread(tmp_path / "goals.png").std() > 0.1
