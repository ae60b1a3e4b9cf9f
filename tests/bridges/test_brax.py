"""The bridge to brax keeps what brax promises its users: keys, resets, truncations and links."""

import base64
import importlib
import json
import re
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import UserError
from infogoal_jax.bridges.brax import FetchBrax, brax_training, render_html

NOTHING = np.zeros(4, np.float32)
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


@pytest.mark.long
def test_reaching_the_goal_ends_the_episode_as_done_and_not_as_truncated(brax_reach):
    _, reset, step = brax_reach
    state = reset(jax.random.split(jax.random.PRNGKey(1), 3))
    inner = state.pipeline_state.fetch
    goals = inner.desired_goal.at[0].set(inner.observation[0, :3])
    state = state.replace(pipeline_state=state.pipeline_state.replace(fetch=inner.replace(desired_goal=goals)))
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
    from infogoal_jax.envs.fetch.scene import body_poses

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
    assert np.allclose(scene["states"]["x"][0]["pos"][goal], states[0].pipeline_state.fetch.desired_goal)
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
