"""What a run with image goals reports: a row and a figure for each kind of goals and code, clean and corrupted."""

import dataclasses
import io
import itertools
import json
import math
import re

import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from places import EVERY_TASKS_FIGURES, assert_drawn, printed
from rich.console import Console

from infogoal_jax.errors import UserError
from infogoal_jax.loading import make_train
from infogoal_jax.report.figures import beta_and_accuracy, draw_figures, read_subject, success_within
from infogoal_jax.report.runs import evaluated_masks, table_of
from infogoal_jax.report.statistics import mean_interval
from infogoal_jax.report.summary import evaluate_run, print_run
from infogoal_jax.runner import training
from infogoal_jax.train.evaluation import EVALUATION_SEED, corrupted_view
from infogoal_jax.train.parts import Setup
from infogoal_paper import image_goal_figures, trajectory_figures

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
        "48 goals x 1 start",
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
    figure = image_goal_figures.draw_image_goals(subject)["codes_and_trajectories"]
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
    chosen = image_goal_figures.spread_goals(env.goals, env.goals.test_mask, 4, apart)
    assert len(set(np.asarray(env.goals.regions)[chosen])) == 4 and np.asarray(env.goals.test_mask)[chosen].all()
    assert len(image_goal_figures.spread_goals(env.goals, env.goals.train_mask, 100, apart)) == 8


@pytest.mark.long
def test_episodes_that_are_drawn_go_to_their_goals_and_depend_on_the_corruption(points, points_subject):
    env = points.train.env
    goals = np.flatnonzero(np.asarray(env.goals.test_mask))[::-1]
    clean, again, corrupted = image_goal_figures.policy_episodes(
        points_subject, goals, [0.0, 0.0, 1.0], EVALUATION_SEED
    )
    path = np.asarray(env.unwrapped.robot.achieved(clean.observations))
    assert path.shape == (4, env.episode_length + 1, 3)
    nearest = np.linalg.norm(path - np.asarray(env.unwrapped.positions)[goals][:, None], axis=-1).min(1)
    np.testing.assert_array_equal(nearest < 0.05, clean.success)
    np.testing.assert_array_equal(
        np.asarray(clean.observations.desired_goal)[:, 0], np.asarray(env.unwrapped.positions)[goals]
    )
    np.testing.assert_array_equal(path, env.unwrapped.robot.achieved(again.observations))
    assert not np.array_equal(path, env.unwrapped.robot.achieved(corrupted.observations))


@pytest.mark.long
def test_images_that_are_shown_mix_in_backgrounds_of_the_test(reach_run):
    env = reach_run.train.env
    clean, half, background = (
        image_goal_figures.seen_images(env, np.array([5, 3]), weight, 7).astype(float) for weight in (0.0, 0.5, 1.0)
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
    np.testing.assert_array_equal(seen[-1], image_goal_figures.seen_images(env, some, 0.4, 9))
