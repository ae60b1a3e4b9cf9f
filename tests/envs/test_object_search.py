"""The search environment is a faithful walk over its graph."""

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax.data import splits
from infogoal_jax.envs.object_search import distances, lay_out
from infogoal_jax.errors import UserError
from infogoal_jax.train.evaluation import draw_starts, evaluate, group_means, random_policy, shortest_path_policy


@pytest.fixture(scope="module")
def env():
    return hand_made.environment()


def test_distances_are_shortest_paths(env):
    """Against relaxation over every edge until nothing changes."""
    edges, in_view = np.asarray(env.next_node), np.asarray(env.in_view)
    expected = np.where(in_view.T, 0, 10_000)
    for _ in range(len(edges)):
        expected = np.minimum(expected, expected[:, edges].min(-1) + 1)
    np.testing.assert_array_equal(distances(edges, in_view), expected)


def test_episodes_start_with_the_goal_out_of_view_and_a_training_goal(env):
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 500))
    assert not env.reached(states.node, states.goal).any()
    np.testing.assert_array_equal(np.unique(states.goal), np.flatnonzero(np.asarray(env.goals.train_mask)))
    assert len(np.unique(states.node)) > 40


def test_steps_without_an_edge_stay_in_place_and_are_masked(env):
    nodes = jnp.arange(env.num_observations)
    mask = env.action_mask(nodes)
    np.testing.assert_array_equal(env.next_node == nodes[:, None], ~mask)
    assert mask[:, 4:].all()  # Rotation is always possible here.


def test_termination_and_truncation_are_never_confused(env):
    state = env.reset_to(jax.random.key(0), jnp.asarray(0))
    ends = []
    for _ in range(env.episode_length):
        state = env.step(state, jnp.asarray(4))  # Turning on the spot.
        ends.append((bool(state.terminated), bool(state.truncated)))
    assert (True, True) not in ends
    if not any(terminated for terminated, _ in ends):
        assert ends[-1] == (False, True) and (False, True) not in ends[:-1]


def test_achieved_goals_agree_with_what_is_reached(env):
    for node in range(env.num_observations):
        goals = [int(goal) for goal in env.goals_of(jnp.asarray(node)) if goal >= 0]
        assert goals == [
            goal for goal in range(env.goals.num_goals) if bool(env.reached(jnp.asarray(node), jnp.asarray(goal)))
        ]


def test_oracle_takes_shortest_paths_and_random_does_not(env):
    goals = env.goals.evaluated
    shortest, drawn = (evaluate(policy(env), env, goals) for policy in (shortest_path_policy, random_policy))
    assert shortest.success.shape == (len(goals), 10) and shortest.success.all() and (shortest.spl == 1).all()
    assert set(group_means(drawn, env.goals)) == {"train", "test"}
    assert all(means["spl"] < 0.7 for means in group_means(drawn, env.goals).values())
    starts = draw_starts(env, goals, 10)
    np.testing.assert_array_equal(shortest.first_reached(99), jax.vmap(jax.vmap(env.shortest_path))(starts))


def test_a_failed_goal_counts_as_reached_after_the_end(env):
    stay = evaluate(lambda observation, goal, key: jnp.full(goal.shape, 4), env, env.goals.evaluated, 5)
    first = stay.first_reached(env.episode_length)
    assert not stay.success.all() and (first[~stay.success] == env.episode_length + 1).all()


def test_an_object_out_of_reach_is_named():
    scenes = hand_made.scenes()
    scenes.visible[:, 2] = False
    with pytest.raises(UserError, match="train_2"):
        lay_out(scenes, hand_made.SPLIT, np.zeros((8, 4), np.float32), 20)


def test_a_split_without_training_objects_is_refused():
    split = splits.make_split({name: ("room", "test") for name in hand_made.SPLIT.objects})
    with pytest.raises(UserError, match="training object"):
        lay_out(hand_made.scenes(), split, np.zeros((8, 4), np.float32), 20)
