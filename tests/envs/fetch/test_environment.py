"""The Fetch environments' promises: fresh resets, observations in the reference's order, ends of episodes, divergence,
bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax import envs, presets
from infogoal_jax.envs.fetch.environment import euler_angles
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.errors import UserError
from infogoal_jax.train.rollout import collect

BATCH = 8


@pytest.fixture(scope="module")
def reach():
    """FetchReach with compiled, batched functions."""
    env = envs.load("fetch_reach", FetchConfig(episode_length=5))
    return env, jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))


def keys(seed, number=BATCH):
    """Typed keys [number]."""
    return jax.random.split(jax.random.key(seed), number)


def test_every_episode_has_a_goal_of_its_own(reach):
    """Different keys, different goals; the same key, the same bits."""
    _, reset, _ = reach
    first, again, other = reset(keys(0)), reset(keys(0)), reset(keys(1))
    assert len(np.unique(np.array(first.desired_goal), axis=0)) == BATCH
    np.testing.assert_array_equal(first.desired_goal, again.desired_goal)
    assert (np.array(first.desired_goal) != np.array(other.desired_goal)).any(1).all()


def test_actions_move_the_grip_along_their_axes(reach):
    """A positive displacement moves the grip that way, by less than the 5 cm asked for, and hardly any other way."""
    env, reset, step = reach
    for axis in range(3):
        states = reset(keys(2))
        moved = step(states, jnp.zeros((BATCH, 4)).at[:, axis].set(1.0))
        shift = np.array(env.observe(moved) - env.observe(states))[:, :3]
        assert (shift[:, axis] > 0.01).all() and (shift[:, axis] < 0.05).all()
        assert (np.abs(np.delete(shift, axis, 1)) < 0.005).all()


@pytest.mark.long
def test_actions_beyond_one_are_clipped(reach):
    """An action of 7 is an action of 1."""
    _, reset, step = reach
    states = reset(keys(3))
    np.testing.assert_array_equal(
        step(states, jnp.full((BATCH, 4), 7.0)).observation, step(states, jnp.ones((BATCH, 4))).observation
    )


def test_reaching_the_goal_ends_the_episode_and_time_truncates_it(reach):
    """Terminated and truncated are never both set; the goal counts at less than 5 cm."""
    env, reset, step = reach
    states = reset(keys(4))
    grip = states.observation[:, :3]
    near = states.replace(desired_goal=grip + jnp.array([0.0, 0.0, 0.049]))
    far = states.replace(desired_goal=grip + jnp.array([0.0, 0.0, 0.3]))
    assert step(near, jnp.zeros((BATCH, 4))).terminated.all()
    for number in range(5):
        far = step(far, jnp.zeros((BATCH, 4)))
        assert far.truncated.all() == (number == 4)
    assert not far.terminated.any()
    assert np.array(env.reached(jnp.zeros(3), jnp.array([[0.0, 0.0, 0.0499], [0.0, 0.0, 0.0501]]))).tolist() == [
        True,
        False,
    ]
    assert np.array(env.reward(jnp.zeros(3), jnp.array([[0.0, 0.0, 0.0499], [0.0, 0.0, 0.0501]]))).tolist() == [
        0.0,
        -1.0,
    ]


@pytest.fixture
def spoilt(reach):
    """States at a start, and the same with one robot's state spoilt."""
    states = reach[1](keys(5))
    return states, states.replace(motion=states.motion.replace(velocity=states.motion.velocity.at[3].set(jnp.nan)))


def test_a_diverged_simulation_ends_its_own_episode(reach, spoilt):
    """Its step is taken back and its episode ends, marked; the others go on untouched."""
    (_, _, step), (states, spoilt) = reach, spoilt
    after, untouched = step(spoilt, jnp.ones((BATCH, 4))), step(states, jnp.ones((BATCH, 4)))
    assert np.flatnonzero(after.diverged).tolist() == [3] == np.flatnonzero(after.truncated).tolist()
    assert np.isfinite(after.observation).all()
    others = np.delete(np.arange(BATCH), 3)
    np.testing.assert_array_equal(after.observation[others], untouched.observation[others])


@pytest.mark.long
def test_a_diverged_simulation_leaves_no_trace(reach, spoilt):
    """Its transition is not valid."""
    (env, _, _), (_, spoilt), others = reach, spoilt, np.delete(np.arange(BATCH), 3)

    def policy(observation, goal, key):
        return jnp.ones((BATCH, 4))

    following, rows = collect(env, spoilt, policy, jax.random.key(0), 4)
    assert np.isfinite(rows.observation).all() and np.isfinite(following.observation).all()
    # The diverged step, the reset, and then a sound episode.
    assert not rows.valid[3, :2].any() and rows.valid[3, 2:].all()
    assert rows.valid[others].all() and np.isfinite(following.motion.velocity).all()


@pytest.mark.parametrize("task, size", [("fetch_reach", 10), ("fetch_pick_and_place", 25)])
def test_observation_is_laid_out_as_the_references(task, size):
    """Sizes, and the parts that can be told from one another at the start: grip, object, their difference, and the
    object at rest."""
    env = envs.load(task)
    state = jax.jit(env.reset)(jax.random.key(0))
    assert state.observation.shape == (size,) == (env.observation_size,)
    np.testing.assert_allclose(state.observation[:3], env.task.start_grip, atol=1e-4)
    if size == 25:
        np.testing.assert_allclose(state.observation[6:9], state.observation[3:6] - state.observation[:3], atol=1e-6)
        assert np.linalg.norm(state.observation[3:5] - state.observation[:2]) >= 0.1
        np.testing.assert_allclose(state.observation[14:17], -state.observation[20:23], atol=1e-6)
        np.testing.assert_array_equal(env.achieved(state), state.observation[3:6])


def test_euler_angles():
    """The angles of turns about one axis, and of the reference's convention for two."""
    cosine, sine = np.cos(0.3), np.sin(0.3)
    about_x = jnp.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    about_z = jnp.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    np.testing.assert_allclose(euler_angles(about_x), [0.3, 0, 0], atol=1e-6)
    np.testing.assert_allclose(euler_angles(about_z), [0, 0, 0.3], atol=1e-6)
    np.testing.assert_allclose(euler_angles(about_x @ about_z), [0.3, 0, 0.3], atol=1e-6)


@pytest.mark.parametrize(("task", "share"), [("fetch_reach", 1 / 8), ("fetch_push", 1 / 4), ("fetch_slide", 1 / 4)])
def test_an_octant_is_held_out_of_the_axes_on_which_goals_vary(task, share):
    """On the table all have one height, above whose middle none lies."""
    goals = envs.load(task, FetchConfig(held_out="octant")).goals
    drawn = jax.jit(jax.vmap(goals.sampler))(jax.random.split(jax.random.key(1), 4000))
    held_out = ~np.asarray(jax.jit(goals.is_training_goal)(drawn))
    assert held_out.mean() == pytest.approx(share, abs=0.03) and goals.groups == ("train", "test")


@pytest.mark.parametrize(
    ("fields", "known", "said"),
    [
        ({"goal_images": "mine.npz"}, "visited", "env.goal_images = 'mine.npz': goals are positions"),
        ({"backgrounds": "cifar10"}, "visited", "env.backgrounds = 'cifar10': goals are positions"),
        ({"goals": "images"}, "train", "known_goals = 'train': .* none of those is a training goal"),
    ],
)
def test_what_goals_of_one_kind_do_not_have_is_refused(fields, known, said):
    with pytest.raises(UserError, match=said):
        presets.load("fetch_reach", "none", env=FetchConfig(**fields), known_goals=known)


def test_goals_outside_of_the_goal_space_are_refused(reach):
    """The error names the goal and the corners; inside a jitted function, where values are unknown, nothing is
    checked."""
    env, _, _ = reach
    with pytest.raises(UserError, match=r"goal = \[3.0, 0.7, 0.5\]: lies outside; give 1.05 to 1.55, 0.4 to 1.1"):
        env.reset_to(jax.random.key(0), jnp.array([3.0, 0.7, 0.5]))
    with pytest.raises(UserError, match=r"give a goal as numbers \[3\]"):
        env.reset_to(jax.random.key(0), jnp.zeros(2))
    state = jax.jit(env.reset_to)(jax.random.key(0), jnp.array([1.3, 0.7, 0.5]))
    np.testing.assert_allclose(state.desired_goal, [1.3, 0.7, 0.5])


def test_a_length_of_zero_is_refused():
    """Before anything is compiled."""
    with pytest.raises(UserError, match="env.episode_length = 0: give a whole number greater than 0"):
        envs.load("fetch_push", FetchConfig(episode_length=0))


@pytest.mark.long
def test_other_tasks_do_not_import_mujoco():
    """Importing the environments costs nothing that a search task does not need, and prints nothing."""
    import subprocess
    import sys

    code = "import sys; from infogoal_jax import envs; assert 'mujoco' not in sys.modules; envs.load('fetch_reach')"
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
