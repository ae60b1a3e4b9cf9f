"""Tasks whose goals are vectors are Gymnasium's goal environments too, one at a time and as a batch."""

import flax.struct
import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from infogoal_jax import UserError, envs
from infogoal_jax.bridges import gymnasium as bridge
from infogoal_jax.bridges.gymnasium import TaskGymnasium, TaskVector
from infogoal_jax.envs.goal_task import GoalTask
from infogoal_jax.envs.plane import PlaneConfig
from infogoal_jax.goals import GoalBox

STEPS = 5
CONFIG = PlaneConfig(episode_length=STEPS, radius=0.4)


@pytest.fixture(scope="module")
def maze():
    return TaskGymnasium("point_maze", CONFIG)


@pytest.fixture(scope="module")
def vector():
    return TaskVector("point_maze", 3, CONFIG)


@pytest.mark.filterwarnings("ignore:.*infinity")
def test_gymnasium_finds_nothing_to_warn_of_but_open_spaces():
    env = gymnasium.make("infogoal/PointMaze-v0").unwrapped
    check_env(env, skip_render_check=True)
    spaces = {name: (space.shape, space.dtype) for name, space in env.observation_space.items()}
    assert set(spaces.values()) == {((2,), np.dtype(np.float32))} and env.action_space.shape == (2,)
    assert env.observation_space["desired_goal"].high.tolist() == [3, 3]


def test_a_task_that_draws_itself_is_rendered():
    maze = bridge.make("point_maze", CONFIG, render_mode="rgb_array")
    maze.reset(seed=0, options={"goal": [0.5, 0.5]})
    picture = maze.render()
    maze.reset(seed=0, options={"goal": [1.5, 1.5]})
    assert picture.dtype == np.uint8 and picture.shape[2] == 3 and not np.array_equal(picture, maze.render())


def test_every_task_with_continuous_goals_is_registered():
    for task in ("point_maze", "reacher", *(f"fetch_{name}_positions" for name in ("reach", "push", "slide"))):
        spec = gymnasium.spec(bridge.id_of(task))
        assert spec.kwargs["task"] == task and spec.max_episode_steps == envs.registry[task].config().episode_length


def test_rewards_are_those_that_hindsight_computes(maze):
    """Until the goal was met and time ran out once each; for one pair of goals, and for batches of any size."""
    steps, random = [], np.random.default_rng(0)
    for episode in range(200):
        seen, info = maze.reset(seed=episode)
        assert info == {} and not maze.compute_terminated(seen["achieved_goal"], seen["desired_goal"], {})
        terminated = truncated = False
        while not (terminated or truncated):
            seen, reward, terminated, truncated, info = maze.step(random.uniform(-1, 1, 2))
            steps.append((seen["achieved_goal"], seen["desired_goal"], reward, info["is_success"], terminated))
            assert maze.observation_space.contains(seen) and info["diverged"] is False
            assert maze.compute_reward(seen["achieved_goal"], seen["desired_goal"], info) == reward
        if len({step[4] for step in steps}) == 2 and episode > 5:
            break
    achieved, desired, given, success, ended = (np.array(part) for part in zip(*steps, strict=True))
    assert set(given) == {-1.0, 0.0} and np.array_equal(given == 0, success == 1)
    assert np.array_equal(ended, success == 1)
    for count in (1, 3, len(given)):
        found = maze.compute_reward(achieved[:count], desired[:count], {})
        assert found.dtype == np.float32 and np.array_equal(found, given[:count])
    assert np.array_equal(found, -(np.linalg.norm(achieved - desired, axis=-1) >= 0.4).astype(np.float32))
    assert not maze.compute_reward(achieved[None], achieved[None], {}).any()
    assert maze.compute_reward(achieved[:0], achieved[:0], {}).shape == (0,)


def test_an_episode_that_goes_on_at_its_goal_is_not_terminated():
    env = TaskGymnasium("point_maze", PlaneConfig(episode_length=3, ends_at_goal=False, radius=0.9))
    seen, _ = env.reset(seed=0)
    assert not env.compute_terminated(seen["desired_goal"], seen["desired_goal"], {})
    assert env.compute_reward(seen["desired_goal"], seen["desired_goal"], {}) == 0


def test_goals_are_given_as_vectors_and_follow_the_seed(maze):
    seen, _ = maze.reset(seed=0, options={"goal": [2.5, 0.5]})
    assert np.allclose(seen["desired_goal"], [2.5, 0.5])
    first, again = (maze.reset(seed=3)[0] for _ in range(2))
    assert all(np.array_equal(first[name], again[name]) for name in first)
    batch, each = TaskVector(maze.env, 2), [[2.5, 0.5], [0.5, 0.5]]
    for given in (each, np.array(each), jnp.array(each)):
        assert np.allclose(batch.reset(seed=0, options={"goal": given})[0]["desired_goal"], each)
    drawn = np.array([maze.reset()[0]["desired_goal"] for _ in range(30)])
    assert np.asarray(maze.env.goals.is_training_goal(drawn)).all() and len(np.unique(drawn)) > 30


@pytest.mark.parametrize("goal", [3, "room", [9.0, 0.0], [0.5], [np.nan, 0.5], [[0.5, 0.5]], np.array(3), None])
def test_what_is_no_goal_is_refused(goal, maze):
    with pytest.raises(UserError, match=r'options\["goal"\]'):
        maze.reset(options={"goal": goal})


@pytest.mark.parametrize("action", [0, [0.5], [np.nan, 0.0], "left", [[0.5, 0.5]]])
def test_what_is_no_action_is_refused(action, maze):
    maze.reset(seed=0)
    with pytest.raises(UserError, match="^action"):
        maze.step(action)


def test_goals_of_another_shape_have_no_reward(maze):
    large = [1e300, 0.5]  # Float32 has none: a goal that is infinite in it was not reached, not even by itself.
    for achieved, desired in (([0.5], [0.5]), ([[0.5, 0.5]], [0.5, 0.5]), ([np.inf, 0.5], [0.5, 0.5]), (large, large)):
        with pytest.raises(UserError, match="achieved_goal"):
            maze.compute_reward(np.array(achieved), np.array(desired), {})


@flax.struct.dataclass
class Cliff(GoalTask):
    """A line whose episodes fail beyond 1.5, and on which nothing is achieved beyond 2.5."""

    action_size, can_fail = 1, True

    def begin(self, key):
        return jnp.zeros(1)

    def move(self, world, action):
        return world + action

    def observation(self, world):
        return world

    def achieved_goal(self, world):
        return jnp.where(world > 2.5, jnp.nan, world)

    def fails(self, world):
        return world[0] > 1.5


CLIFF = Cliff(GoalBox.of([0.5], [3.0]), ends_at_goal=False)


@pytest.mark.parametrize("goal", [1.0, 2.0])
def test_a_failure_at_the_goal_is_no_success(goal):
    """As in training. The reward is still the one that hindsight computes."""
    env, batch, options = TaskGymnasium(CLIFF), TaskVector(CLIFF, 2), {"goal": [goal]}
    env.reset(seed=0, options=options)
    batch.reset(seed=0, options=options)
    for _ in range(int(goal)):
        _, reward, _, truncated, info = env.step(np.ones(1))
        _, rewards, _, _, infos = batch.step(np.ones((2, 1)))
    assert reward == 0.0 and truncated == (goal == 2) and info["is_success"] == (goal == 1)
    assert np.array_equal(rewards, [0, 0]) and np.array_equal(infos["is_success"], [info["is_success"]] * 2)


def test_where_no_goal_is_achieved_an_episode_goes_on():
    """A task says so by NaN. It is no success, and hindsight may ask for it; a distance it has not."""
    env = TaskGymnasium(CLIFF.replace(episode_length=3))
    env.reset(seed=0, options={"goal": [3.0]})
    for _ in range(3):
        seen, reward, _, _, info = env.step(np.ones(1))
    assert np.isnan(seen["achieved_goal"]).all() and (reward, info["is_success"]) == (-1.0, 0.0)
    for pair in (("achieved_goal", "desired_goal"), ("desired_goal", "achieved_goal")):
        assert env.compute_reward(*(seen[name] for name in pair), {}) == -1.0
    dense = TaskGymnasium(CLIFF, reward_type="dense")
    with pytest.raises(UserError, match=r"^achieved_goal = \[nan\]: is no goal, .*give reward_type"):
        dense.compute_reward(seen["achieved_goal"], seen["desired_goal"], {})


def test_a_batch_starts_its_next_episodes_with_goals_of_their_own(vector):
    seen, info = vector.reset(seed=0, options={"goal": [0.5, 0.5]})
    assert info == {} and np.allclose(seen["desired_goal"], 0.5)
    ended, starts = np.zeros(3, bool), 0
    for _ in range(3 * STEPS):
        before = seen
        seen, reward, terminated, truncated, info = vector.step(vector.action_space.sample())
        assert vector.observation_space.contains(seen) and not (terminated & truncated).any()
        same = (seen["desired_goal"] == before["desired_goal"]).all(-1)
        assert same[~ended].all() and not same[ended].any()
        assert not reward[ended].any() and not info["_is_success"][ended].any()
        expected = vector.compute_reward(seen["achieved_goal"], seen["desired_goal"], {})
        assert np.array_equal(reward[~ended], expected[~ended])
        starts += ended.sum()
        ended = terminated | truncated
    assert starts >= 3
