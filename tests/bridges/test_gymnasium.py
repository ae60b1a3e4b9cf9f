"""The bridge to Gymnasium keeps what Gymnasium promises its users: the API, spaces and infos, also for a batch."""

import importlib
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from infogoal_jax import UserError
from infogoal_jax.bridges import gymnasium as bridge
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig

NOTHING = np.zeros(4, np.float32)


@pytest.fixture(scope="module")
def reach():
    """FetchReach for one robot; what is compiled for it serves every environment of the task."""
    return bridge.make("fetch_reach", render_mode="rgb_array")


@pytest.fixture(scope="module")
def vector():
    """Three robots whose episodes take four steps."""
    return bridge.TaskVector("fetch_reach", 3, FetchConfig(ends_at_goal=False, episode_length=4))


def test_gymnasium_finds_nothing_to_warn_of(reach):
    check_env(reach)


@pytest.mark.parametrize("task", list(TASKS))
def test_each_task_is_registered_with_the_reference_s_spaces(task):
    env = gymnasium.make(bridge.id_of(task))
    assert isinstance(env.unwrapped, bridge.TaskGymnasium) and env.spec.id == bridge.id_of(task)
    assert env.spec.max_episode_steps == gymnasium.spec(bridge.id_of(task)).max_episode_steps == 50
    dense = gymnasium.make(bridge.id_of(task).replace("-v0", "Dense-v0")).unwrapped
    assert (env.unwrapped.reward_type, dense.reward_type) == ("sparse", "dense")
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
    shapes = {name: space.shape for name, space in env.observation_space.items()}
    assert shapes == {
        "observation": (10 if task == "fetch_reach" else 25,),
        "achieved_goal": (3,),
        "desired_goal": (3,),
    }


def test_rewards_are_those_that_hindsight_computes(reach):
    seen, info = reach.reset(seed=1)
    assert info == {}
    steps = []
    for _ in range(20):  # Straight to the goal, so that both rewards occur.
        seen, reward, terminated, truncated, info = reach.step(
            np.append(10 * (seen["desired_goal"] - seen["achieved_goal"]), 0.0).clip(-1, 1)
        )
        steps.append((seen["achieved_goal"], seen["desired_goal"], reward, info["is_success"]))
        assert not (terminated or truncated or info["diverged"])
    achieved, desired, rewards, success = (np.array(part) for part in zip(*steps, strict=True))
    assert set(rewards) == {-1.0, 0.0} and np.array_equal(rewards == 0, success == 1)
    assert np.array_equal(reach.compute_reward(achieved, desired, {}), rewards)
    assert reach.compute_reward(achieved.reshape(4, 5, 3), desired.reshape(4, 5, 3), {}).shape == (4, 5)
    assert not reach.compute_terminated(achieved, desired, {}).any()


def test_an_episode_is_truncated_after_fifty_steps_and_never_terminated_even_at_the_goal(reach):
    start, _ = reach.reset(seed=2)
    reach.reset(seed=2, options={"goal": start["achieved_goal"]})
    ends = [reach.step(NOTHING) for _ in range(50)]
    assert [step[2] for step in ends] == [False] * 50
    assert [step[3] for step in ends] == [False] * 49 + [True]
    assert all(step[4]["is_success"] == 1.0 for step in ends)


def test_the_goal_can_be_given_and_must_lie_in_the_workspace(reach):
    seen, _ = reach.reset(seed=0, options={"goal": [1.3, 0.7, 0.5]})
    assert np.allclose(seen["desired_goal"], [1.3, 0.7, 0.5])
    drawn, _ = reach.reset(seed=0)
    assert not np.allclose(drawn["desired_goal"], [1.3, 0.7, 0.5])
    wrong = [
        ([9.0, 0.7, 0.5], "lies outside; give 1.05 to"),
        ([1.3, 0.7], "a goal as numbers .3."),
        ("home", "a goal as numbers .3."),
        ([[1.3, 0.7, 0.5]], "a goal as numbers .3."),
    ]
    for goal, message in wrong:
        with pytest.raises(UserError, match=message):
            reach.reset(options={"goal": goal})
    with pytest.raises(UserError, match="golf"):
        reach.reset(options={"golf": [1.3, 0.7, 0.5]})


def test_a_simulation_that_diverges_truncates_the_episode_and_stays_finite(reach):
    before, _ = reach.reset(seed=5)
    reach.state = reach.state.replace(gripper=reach.state.gripper * np.nan)
    seen, _, terminated, truncated, info = reach.step(NOTHING)
    assert truncated and not terminated and info["diverged"]
    assert np.array_equal(seen["observation"], before["observation"])


def test_pictures_follow_the_robot(reach):
    reach.reset(seed=6)
    first = reach.render()
    reach.step(np.ones(4, np.float32))
    assert first.shape == (480, 640, 3) and first.dtype == np.uint8 and not np.array_equal(first, reach.render())
    assert bridge.make("fetch_reach").render() is None


def test_wrong_calls_are_explained(reach):
    with pytest.raises(UserError, match="Did you mean 'fetch_push'"):
        bridge.make("fetch_pusch")
    with pytest.raises(UserError, match="config = 'dict': fetch_reach needs a FetchConfig"):
        bridge.make("fetch_reach", config={"episode_length": 5})
    with pytest.raises(UserError, match="task = 'fetch_reach': its goals form a finite set"):
        bridge.make("fetch_reach", FetchConfig(goals="images"))
    with pytest.raises(UserError, match="render_mode"):
        bridge.TaskGymnasium("fetch_reach", render_mode="human")
    fresh = bridge.make("fetch_reach", render_mode="rgb_array")
    for call in (lambda: fresh.step(NOTHING), fresh.render):
        with pytest.raises(UserError, match="reset"):
            call()
    reach.reset()
    with pytest.raises(UserError, match="4 numbers"):
        reach.step(np.zeros(3))
    with pytest.raises(UserError, match="of one shape"):
        reach.compute_reward(np.zeros((2, 3)), np.zeros(3), {})


def test_dense_rewards_are_minus_the_distance():
    env = gymnasium.make("infogoal/FetchReachDense-v0").unwrapped
    reward = env.compute_reward(np.zeros((2, 3)), np.array([[0.0, 0.0, 0.0], [0.3, 0.4, 0.0]]), {})
    assert reward.dtype == np.float32 and np.allclose(reward, [0.0, -0.5])
    with pytest.raises(UserError, match="reward_type = 'both': give one of sparse, dense"):
        bridge.TaskGymnasium("fetch_reach", reward_type="both")


def test_without_gymnasium_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "infogoal_jax.bridges.gymnasium")
    with pytest.raises(UserError, match=r"pip install 'infogoal-jax\[gymnasium\]'"):
        importlib.import_module("infogoal_jax.bridges.gymnasium")


@pytest.mark.long
def test_a_batch_repeats_itself_under_one_seed_and_takes_goals(vector):
    runs = []
    for _ in range(2):
        vector.reset(seed=7)
        runs.append([vector.step(np.ones((3, 4), np.float32))[0] for _ in range(6)])
    assert all(np.array_equal(one[name], two[name]) for one, two in zip(*runs, strict=True) for name in one)
    seen, _ = vector.reset(options={"goal": [1.3, 0.7, 0.5]})
    assert np.allclose(seen["desired_goal"], [1.3, 0.7, 0.5])
    each = np.array([[1.3, 0.7, 0.5], [1.2, 0.7, 0.5], [1.3, 0.6, 0.5]], np.float32)
    assert np.array_equal(vector.reset(options={"goal": each})[0]["desired_goal"], each)
    with pytest.raises(UserError, match="give one, or 3"):
        vector.reset(options={"goal": each[:2]})
    with pytest.raises(UserError, match="num_envs"):
        bridge.TaskVector("fetch_reach", 0)


@pytest.mark.long
def test_stable_baselines_trains_with_hindsight():
    sb3 = pytest.importorskip("stable_baselines3")
    model = sb3.SAC(
        "MultiInputPolicy",
        bridge.make("fetch_reach"),
        replay_buffer_class=sb3.HerReplayBuffer,
        learning_starts=100,
        seed=0,
        policy_kwargs={"net_arch": [32, 32]},
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
    )
    model.learn(300)
    batch = model.replay_buffer.sample(256)
    near = (batch.next_observations["achieved_goal"] - batch.next_observations["desired_goal"]).norm(dim=1) < 0.05
    assert 0.1 < near.float().mean() < 0.9
    assert ((batch.rewards[:, 0] == 0) == near).float().mean() > 0.99
