"""The bridges keep what the other library promises its users: Gymnasium's API, spaces and infos; brax's keys, resets
and truncations."""

import base64
import importlib
import json
import re
import sys
import zlib

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from infogoal_jax import UserError
from infogoal_jax.bridges import gymnasium as bridge
from infogoal_jax.bridges.brax import FetchBrax, brax_training, render_html
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig

NOTHING = np.zeros(4, np.float32)


@pytest.fixture(scope="module")
def reach():
    """FetchReach for one robot; what is compiled for it serves every environment of the task."""
    return bridge.make("fetch_reach", render_mode="rgb_array")


@pytest.fixture(scope="module")
def vector():
    """Three robots whose episodes take four steps."""
    return bridge.FetchVector("fetch_reach", 3, FetchConfig(ends_at_goal=False, episode_length=4))


def test_gymnasium_finds_nothing_to_warn_of(reach):
    check_env(reach)


@pytest.mark.parametrize("task", list(TASKS))
def test_each_task_is_registered_with_the_reference_s_spaces(task):
    env = gymnasium.make(bridge.IDS[task])
    assert isinstance(env, bridge.FetchGymnasium) and env.spec.id == bridge.IDS[task]
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
        ([9.0, 0.7, 0.5], "outside of the workspace"),
        ([1.3, 0.7], "3 numbers"),
        ("home", "3 numbers"),
        ([[1.3, 0.7, 0.5]], "shape"),
    ]
    for goal, message in wrong:
        with pytest.raises(UserError, match=message):
            reach.reset(options={"goal": goal})
    with pytest.raises(UserError, match="golf"):
        reach.reset(options={"golf": [1.3, 0.7, 0.5]})


def test_goals_follow_the_seed_and_go_on_without_one(reach):
    first, again, other = (reach.reset(seed=seed)[0]["desired_goal"] for seed in (3, 3, 4))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    assert not np.array_equal(reach.reset()[0]["desired_goal"], reach.reset()[0]["desired_goal"])


def test_a_simulation_that_diverges_truncates_the_episode_and_stays_finite(reach):
    before, _ = reach.reset(seed=5)
    seen, _, terminated, truncated, info = reach.step(np.full(4, np.nan, np.float32))
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
    with pytest.raises(UserError, match="render_mode"):
        bridge.FetchGymnasium("fetch_reach", render_mode="human")
    fresh = bridge.make("fetch_reach", render_mode="rgb_array")
    for call in (lambda: fresh.step(NOTHING), fresh.render):
        with pytest.raises(UserError, match="reset"):
            call()
    reach.reset()
    with pytest.raises(UserError, match="4 numbers"):
        reach.step(np.zeros(3))
    with pytest.raises(UserError, match="positions"):
        reach.compute_reward(np.zeros((2, 3)), np.zeros(3), {})


def test_without_gymnasium_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "infogoal_jax.bridges.gymnasium")
    with pytest.raises(UserError, match=r"pip install 'infogoal-jax\[gymnasium\]'"):
        importlib.import_module("infogoal_jax.bridges.gymnasium")


@pytest.mark.long
def test_a_batch_starts_its_next_episodes_in_gymnasium_s_next_step_mode(vector):
    assert vector.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    start, _ = vector.reset(seed=0)
    assert vector.observation_space.contains(start)
    steps = [vector.step(np.ones((3, 4), np.float32)) for _ in range(9)]
    assert all(vector.observation_space.contains(step[0]) for step in steps)
    goals = np.array([step[0]["desired_goal"] for step in steps])
    assert [step[3].all() for step in steps] == [number in (3, 8) for number in range(9)]
    assert not any(step[2].any() for step in steps)
    assert np.array_equal(goals[:4], np.broadcast_to(start["desired_goal"], (4, 3, 3)))
    assert len(np.unique(goals[[0, 4]].reshape(6, 3), axis=0)) == 6
    seen, reward, _, _, info = steps[4]
    assert (
        np.allclose(seen["achieved_goal"], start["achieved_goal"], atol=1e-6)
        and not reward.any()
        and not info["_is_success"].any()
    )
    seen, reward, _, _, info = steps[3]
    assert (
        np.array_equal(reward, vector.compute_reward(seen["achieved_goal"], seen["desired_goal"], {}))
        and info["_is_success"].all()
    )


def test_a_batch_repeats_itself_under_one_seed_and_takes_goals(vector):
    runs = []
    for _ in range(2):
        vector.reset(seed=7)
        runs.append([vector.step(np.ones((3, 4), np.float32))[0] for _ in range(6)])
    assert all(np.array_equal(one[name], two[name]) for one, two in zip(*runs, strict=True) for name in one)
    seen, _ = vector.reset(options={"goal": [1.3, 0.7, 0.5]})
    assert np.allclose(seen["desired_goal"], [1.3, 0.7, 0.5])
    with pytest.raises(UserError, match="shape"):
        vector.reset(options={"goal": np.full((2, 3), [1.3, 0.7, 0.5])})
    with pytest.raises(UserError, match="num_envs"):
        bridge.FetchVector("fetch_reach", 0)


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


EPISODE = 4


@pytest.fixture(scope="module")
def brax_reach():
    """The environment in brax's own training wrappers, with its compiled reset and step."""
    from brax.envs.wrappers.training import wrap

    env = FetchBrax("fetch_reach")
    wrapped = wrap(env, episode_length=EPISODE)
    return env, jax.jit(wrapped.reset), jax.jit(wrapped.step)


@pytest.fixture(scope="module")
def brax_states(brax_reach):
    """Nine steps of three environments, from raw keys."""
    _, reset, step = brax_reach
    states = [reset(jax.random.split(jax.random.PRNGKey(0), 3))]
    for _ in range(9):
        states.append(step(states[-1], jnp.zeros((3, 4))))
    return states


@pytest.mark.long
def test_brax_s_keys_may_be_raw_or_typed(brax_reach):
    env, _, _ = brax_reach
    reset = jax.jit(env.reset)
    raw, typed = reset(jax.random.PRNGKey(3)), reset(jax.random.key(3))
    assert np.array_equal(raw.obs, typed.obs) and raw.obs.shape == (env.observation_size,) == (13,)
    assert env.action_size == 4 and raw.reward.shape == raw.done.shape == ()


@pytest.mark.long
def test_every_episode_under_brax_s_own_wrappers_has_a_fresh_goal(brax_states):
    goals = np.array([state.obs[:, -3:] for state in brax_states])
    done = np.array([state.done for state in brax_states]).astype(bool)
    for env in range(3):
        assert done[:, env].sum() >= 2
        for step in range(1, len(goals)):
            assert np.array_equal(goals[step, env], goals[step - 1, env]) != done[step, env]
    per_env = [len(np.unique(goals[:, env], axis=0)) for env in range(3)]
    assert len(np.unique(goals.reshape(-1, 3), axis=0)) == sum(per_env) == done.sum() + 3


@pytest.mark.long
def test_brax_sees_the_first_observation_of_the_next_episode_and_what_ended_the_last(brax_states):
    """brax stores it in place of the last one's end, and leaves it out of targets: by `truncation` at the time limit,
    by `done` at the goal."""
    start = np.asarray(brax_states[0].obs[0, :10])
    for state in brax_states[1:]:
        ended = np.asarray(state.done, bool)
        assert np.allclose(np.asarray(state.obs)[ended, :10], start, atol=1e-6)
        at_goal = np.asarray(state.metrics["success"], bool)
        out_of_time = np.asarray(state.info["steps"]) == EPISODE
        assert np.array_equal(np.asarray(state.info["truncation"], bool), out_of_time & ~at_goal)
        assert np.array_equal(ended, out_of_time | at_goal)
        assert np.array_equal(np.asarray(state.reward), np.where(at_goal, 0.0, -1.0))


def test_reaching_the_goal_ends_the_episode_as_done_and_not_as_truncated(brax_reach):
    _, reset, step = brax_reach
    state = reset(jax.random.split(jax.random.PRNGKey(1), 3))
    inner = state.pipeline_state.fetch
    goals = inner.goal.at[0].set(inner.observation[0, :3])
    state = state.replace(pipeline_state=state.pipeline_state.replace(fetch=inner.replace(goal=goals)))
    after = step(state, jnp.zeros((3, 4)))
    assert (
        after.done[0] == 1
        and after.info["truncation"][0] == 0
        and after.reward[0] == 0
        and after.metrics["success"][0] == 1
    )
    assert not np.allclose(after.obs[0, -3:], goals[0]) and not np.allclose(after.obs[0, -3:], state.obs[0, -3:])


@pytest.mark.long
def test_brax_links_are_where_mujoco_puts_them_and_move_as_they_say(brax_states):
    from infogoal_jax.report.fetch_scene import body_poses

    state = jax.tree.map(lambda leaf: leaf[0], brax_states[3].pipeline_state)
    moved = np.array(state.qd) * 0 + np.linspace(-0.4, 0.4, state.qd.shape[0], dtype=np.float32)
    state = state.replace(fetch=state.fetch.replace(motion=state.fetch.motion.replace(velocity=jnp.asarray(moved))))
    poses = body_poses(FetchBrax("fetch_reach").fetch, np.asarray(state.q))
    assert np.allclose(state.x.pos, poses.xpos[1:], atol=1e-5)
    step = 1e-3
    ahead, behind = (
        body_poses(FetchBrax("fetch_reach").fetch, np.asarray(state.q) + sign * step * moved).xpos[1:]
        for sign in (1, -1)
    )
    assert np.allclose(state.xd.vel, (ahead - behind) / (2 * step), atol=1e-4)


@pytest.mark.long
def test_the_viewer_s_page_shows_the_robot_its_motion_and_the_goal(brax_reach, brax_states):
    from brax.io import html

    env, _, _ = brax_reach
    states = [jax.tree.map(lambda leaf: leaf[0], state) for state in brax_states[:4]]
    page = render_html(env, states)
    scene = max(
        (json.loads(zlib.decompress(base64.b64decode(text))) for text in re.findall(r"[A-Za-z0-9+/=]{1000,}", page)),
        key=len,
    )
    shapes = [geom["name"] for geoms in scene["geoms"].values() for geom in geoms]
    assert {"Box", "Capsule", "Sphere", "Plane"} <= set(shapes) and len(shapes) > 12
    assert len(scene["states"]["x"]) == 4 and scene["opt"]["timestep"] == pytest.approx(0.04)
    goal = scene["geoms"]["goal"][0]["link_idx"]
    assert np.allclose(scene["states"]["x"][0]["pos"][goal], states[0].pipeline_state.fetch.goal)
    assert len(html.render(env.sys, [state.pipeline_state for state in states])) > 3000
    for given, message in (([], "at least one"), (brax_states[:2], "batch")):
        with pytest.raises(UserError, match=message):
            render_html(env, given)


def test_brax_environments_explain_wrong_names():
    with pytest.raises(UserError, match="Did you mean 'fetch_slide'"):
        FetchBrax("fetch_slyde")
    with pytest.raises(UserError, match="dense"):
        FetchBrax("fetch_reach", reward="thick")


def test_jax_is_as_before_after_brax_trained():
    names = set(vars(jax))
    with brax_training():
        copies = jax.device_put_replicated({"a": jnp.arange(3)}, jax.local_devices())
        assert np.array_equal(copies["a"], np.tile(np.arange(3), (len(jax.local_devices()), 1)))
    assert set(vars(jax)) == names


@pytest.mark.long
@pytest.mark.parametrize("agent", ["sac", "ppo"])
def test_brax_trains_unchanged(agent):
    train = importlib.import_module(f"brax.training.agents.{agent}.train").train
    sizes = {
        "sac": {"num_timesteps": 400, "num_envs": 4, "batch_size": 32, "min_replay_size": 40, "max_replay_size": 1000},
        "ppo": {"num_timesteps": 400, "num_envs": 4, "batch_size": 4, "num_minibatches": 2, "unroll_length": 10},
    }[agent]
    seen = []
    with brax_training():
        train(
            environment=FetchBrax("fetch_reach", reward="dense"),
            episode_length=10,
            num_evals=2,
            num_eval_envs=4,
            normalize_observations=True,
            progress_fn=lambda steps, metrics: seen.append((steps, metrics)),
            **sizes,
        )
    steps, metrics = seen[-1]
    assert steps >= 400 and np.isfinite([float(value) for value in metrics.values()]).all()
    assert (
        metrics["eval/episode_diverged"] == 0
        and 0 <= metrics["eval/episode_success"] <= 10
        and metrics["eval/episode_reward"] < 0
    )
