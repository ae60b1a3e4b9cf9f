"""The settings of an evaluation: clean goals, goals under backgrounds that belong to goal and start, and mean codes."""

from functools import partial

import hand_made
import hand_made_points
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import make_train
from infogoal_jax.train.evaluation import (
    GoalView,
    clean_view,
    corrupted_view,
    draw_starts,
    evaluate,
    flat,
    group_means,
    near_and_far,
)


@pytest.fixture(scope="module")
def train():
    return make_train(hand_made_points.config(), hand_made_points.steered())


@pytest.fixture(scope="module")
def params(train):
    return hand_made_points.random_params(train)


STARTS = 5


@pytest.fixture(scope="module")
def mean_code_actions(train, params):
    """What each policy of an evaluation does with mean codes, all episodes in one place: {"", "corrupted_"} to [M,
    STARTS, 3]."""

    @partial(jax.jit, static_argnums=2)
    def actions(env, key, seed):
        goals, policy = env.goals.evaluated, train.policy(params, train.config.hyper, env, use_mean=True)
        clean = clean_view(train.setup(env=env), params, goals)
        corrupted = corrupted_view(train.setup(env=env), params, goals, STARTS, 0.4, seed)
        observation = jnp.zeros_like(env.observe(jax.tree.map(flat, draw_starts(env, goals, STARTS))))
        return {
            prefix: policy(observation, jax.tree.map(repeated, view.shown), key).reshape(-1, STARTS, 3)
            for prefix, view in (("", clean), ("corrupted_", corrupted))
        }

    def repeated(leaf):
        return flat(jnp.broadcast_to(leaf, (len(leaf), STARTS, leaf.shape[-1])))

    return lambda env, key=0, seed=7: jax.tree.map(np.asarray, actions(env, jax.random.key(key), seed))


def test_an_evaluation_on_corrupted_goals_has_one_test_background_an_episode(train, mean_code_actions):
    actions = mean_code_actions(train.env)
    assert np.ptp(actions[""], axis=1).max() < 1e-5  # Clean: the same goal, the same action.
    assert (np.ptp(actions["corrupted_"], axis=1).max(-1) > 1e-5).all()  # A background of its own for each start.
    later = mean_code_actions(train.env, key=1)
    # The same from step to step, and in the next evaluation.
    jax.tree.map(np.testing.assert_array_equal, later, actions)
    other = mean_code_actions(train.env, seed=8)
    np.testing.assert_allclose(other[""], actions[""], atol=1e-5)
    assert not np.allclose(other["corrupted_"], actions["corrupted_"])

    swapped = train.env.replace(env=train.env.env.replace(train_backgrounds=255 - train.env.train_backgrounds))
    jax.tree.map(np.testing.assert_array_equal, mean_code_actions(swapped), actions)
    swapped = train.env.replace(env=train.env.env.replace(test_backgrounds=255 - train.env.test_backgrounds))
    changed = mean_code_actions(swapped)
    np.testing.assert_array_equal(changed[""], actions[""])
    assert not np.allclose(changed["corrupted_"], actions["corrupted_"])


@pytest.mark.long
def test_a_corruption_of_weight_0_leaves_the_evaluation_as_it_is(train, params):
    env = train.env
    clean = clean_view(train.setup(), params, env.goals.evaluated).shown
    unchanged = corrupted_view(train.setup(), params, env.goals.evaluated, STARTS, 0.0).shown
    jax.tree.map(partial(np.testing.assert_allclose, atol=1e-5), clean.mean + 0 * unchanged.mean, unchanged.mean)
    metrics = jax.jit(train.evaluate, static_argnums=3)(params, train.config.hyper, env, STARTS, 0.0)
    for group in ("train", "test"):
        length = "goal_mean_code/episode_length"
        assert metrics[f"corrupted_{group}_{length}"] == metrics[f"{group}_{length}"]


@pytest.mark.long
def test_scores_belong_to_goals_and_starts_in_any_order(train, params):
    """Clean and corrupted goals, whose backgrounds belong to goal and start: the episodes are run in another order."""
    env, policy = train.env, train.policy(params, train.config.hyper, train.env, use_mean=True)
    goals = env.goals.evaluated
    rows, columns = jnp.arange(len(goals))[::-1], jnp.array([3, 0, 4, 1, 2])
    starts = draw_starts(env, goals, STARTS)
    other_starts = jax.tree.map(lambda leaf: leaf[rows][:, columns], starts)
    run = jax.jit(lambda goals, starts: evaluate(policy, env, goals, starts))
    for view in (
        clean_view(train.setup(env=env), params, goals),
        corrupted_view(train.setup(env=env), params, goals, STARTS, 0.8),
    ):
        shown = jax.tree.map(lambda leaf: leaf[rows][:, columns if leaf.shape[1] > 1 else slice(None)], view.shown)
        scores, other = run(view, starts), run(GoalView(goals[rows], shown), other_starts)
        np.testing.assert_array_equal(other.steps, scores.steps[rows][:, columns])


def test_test_goals_near_a_training_goal_are_told_apart_and_nothing_else_is_counted(train):
    """A test goal is moved to 4 cm from a training goal. The parts make up the success on test goals."""
    points = train.env.unwrapped
    training, test = points.goals.training_goals[0], jnp.flatnonzero(points.goals.test_mask)
    assert not np.asarray(points.near_goals)[test].any() and np.asarray(points.near_goals)[training]
    positions = points.positions.at[test[1]].set(points.positions[training] + jnp.array([0.0, 0.04, 0.0]))
    env = train.env.replace(env=train.env.env.replace(positions=positions))
    evaluated, never = np.asarray(env.goals.evaluated), env.episode_length + 1
    first = np.full((2, len(evaluated), STARTS), never)
    first[0, evaluated == test[1]] = 3  # The first seed reaches the near one,
    first[1, evaluated == test[0]] = env.episode_length  # the second one of the far ones,
    first[:, np.isin(evaluated, points.goals.training_goals)] = 1  # and both all training goals.
    split = near_and_far(env, first)
    np.testing.assert_allclose(split["near_test_goal/success_rate"], [1, 0])
    np.testing.assert_allclose(split["far_test_goal/success_rate"], [0, 1 / 3])
    assert near_and_far(train.env, first).keys() == {"far_test_goal/success_rate"}
    assert near_and_far(hand_made.environment(), first) == {}


def test_an_oracle_of_subgoals_reaches_every_goal_and_one_that_stays_none():
    """The evaluation steps the low level, and counts every group of goals."""
    steered = hand_made_points.steered()

    def straight(observation, goal, key):
        return jnp.clip((steered.unwrapped.positions[goal] - observation[:, :3]) / steered.subgoal_scale, -1.0, 1.0)

    def stay(observation, goal, key):
        return jnp.zeros((len(goal), steered.action_size))

    goals = steered.goals.evaluated
    oracle, idle = (
        jax.jit(lambda policy=policy: evaluate(policy, steered, goals, STARTS))() for policy in (straight, stay)
    )
    assert oracle.success.shape == (8, STARTS) and oracle.success.all() and oracle.steps.max() <= 6
    assert not idle.success.any() and (idle.steps == steered.episode_length).all() and idle.spl is None
    assert set(group_means(idle, steered.goals)) == {"train", "test"}
