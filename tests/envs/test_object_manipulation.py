"""Object manipulation: poses, aliases, goals that never count as each other, moves, and the low level's target
states."""

import dataclasses

import hand_made
import hand_made_frames
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from infogoal_jax import make_train, presets
from infogoal_jax.angles import geodesic, wrapped
from infogoal_jax.data import pictures
from infogoal_jax.envs import object_manipulation
from infogoal_jax.envs.environment import draws_itself
from infogoal_jax.envs.object_manipulation import ObjectManipulationConfig, from_data
from infogoal_jax.envs.target_states import Cells, JointSpace
from infogoal_jax.errors import UserError
from infogoal_jax.loading import traits_seen
from infogoal_jax.replay import Transitions
from infogoal_jax.train.parts import Networks
from infogoal_jax.train.update import agent_batch


@pytest.fixture(scope="module")
def env():
    """The hand-made arm: 216 settings of its joints."""
    return hand_made_frames.manipulation()


@pytest.fixture(scope="module")
def data():
    """Its dataset."""
    return hand_made_frames.arm()


def test_goals_are_the_different_orientations(env, data):
    """Every image shows exactly one goal, images of one goal show one rotation, and images of two goals two."""
    orientation = np.asarray(env.goals_of(jnp.arange(len(data.frames))))[:, 0]
    apart = geodesic(data.rotation[:, None], data.rotation[None]) > 1e-3
    np.testing.assert_array_equal(orientation[:, None] != orientation[None], apart)
    assert env.goals.num_goals == len(set(orientation.tolist())) < len(data.frames)  # There are aliases.


def test_a_smaller_range_leaves_images_whose_joints_lie_within_it_and_the_moves_between_them(data):
    config = ObjectManipulationConfig(num_goals=(2, 1, 2), joint_range=60.0)
    cut = object_manipulation.turned_within(data, config)
    np.testing.assert_allclose(np.unique(np.degrees(cut.joints)), [-60, 0, 60], atol=1e-3)
    assert len(cut.frames) == 27 and len(cut.frame) == 3 * 2 * 2 * 9  # Of each joint two moves forth, two back.
    turn = np.abs(wrapped(cut.joints[cut.next_frame] - cut.joints[cut.frame]))
    np.testing.assert_allclose(turn.sum(1), np.pi / 3, atol=1e-5)
    env = from_data(cut, hand_made_frames.backgrounds(), config)
    assert len(env.quaternion) == 27 and "joints within 60 degrees" in env.source
    # The place of a joint that slides is no angle.
    sliding = dataclasses.replace(data, joint_names=(*data.joint_names[:2], "rail_m"))
    assert len(object_manipulation.turned_within(sliding, config).frames) == 9 * hand_made_frames.STEPS
    with pytest.raises(UserError, match="env.joint_range = 10.0: leaves no move: give more than 0 degrees"):
        object_manipulation.turned_within(data, dataclasses.replace(config, joint_range=10.0))
    with pytest.raises(UserError, match="env.joint_range = 60.0: env.dataset tells no joint angles"):
        object_manipulation.turned_within(dataclasses.replace(data, joints=None), config)
    with pytest.raises(UserError, match="env.joint_range = 0.0: give degrees, more than 0 and at most 180"):
        presets.load("object_manipulation", "none", env=ObjectManipulationConfig(joint_range=0.0))


def test_a_goal_is_seen_as_an_image_that_shows_it(env, data):
    """Goal images are frames of the dataset, held once, of the orientation that they stand for."""
    rows = np.asarray(env.goals.rows)
    np.testing.assert_array_equal(np.asarray(env.orientation)[rows], np.arange(env.goals.num_goals))
    np.testing.assert_array_equal(env.goals.inputs_of(jnp.arange(5)), data.frames[rows[:5]])
    np.testing.assert_array_equal(env.render(env.observe_frame(jnp.arange(4))), data.frames[:4])


def test_a_privileged_agent_sees_poses(env, data):
    """Rotation matrices stand in place of images, of observations and of goals, and joints beside the agent's own.
    Goals and starts are the same, and there are no backgrounds to corrupt with."""
    privileged = hand_made_frames.manipulation(privileged=True)
    seen, joints = privileged.render(privileged.observe_frame(jnp.arange(4))), data.joints[:4]
    np.testing.assert_array_equal(seen[:, :9], data.rotation.reshape(-1, 9)[:4])
    np.testing.assert_allclose(seen[:, 9:], np.concatenate([np.cos(joints), np.sin(joints)], 1), atol=1e-6)
    shown = privileged.goals.inputs_of(jnp.arange(env.goals.num_goals))
    np.testing.assert_allclose(shown, env.goal_positions, atol=1e-6)
    np.testing.assert_array_equal(privileged.goals.evaluated, env.goals.evaluated)
    np.testing.assert_array_equal(privileged.starts, env.starts)
    assert privileged.train_backgrounds is None and privileged.test_backgrounds is None
    assert "poses are seen in place of images" in privileged.source and "backgrounds" not in privileged.source
    config = ObjectManipulationConfig(num_goals=(3, 1, 4), privileged=True)
    assert traits_seen(privileged) == object_manipulation.traits(config)
    assert traits_seen(env) == object_manipulation.traits(dataclasses.replace(config, privileged=False))
    with pytest.raises(UserError, match="env.backgrounds = 'cifar10': goals are not images with env.privileged"):
        presets.load("object_manipulation", "her", env=ObjectManipulationConfig(privileged=True, backgrounds="cifar10"))


def test_what_is_drawn_is_the_photograph_and_of_poses_alone_nothing(env, data):
    state = jax.tree.map(lambda leaf: leaf[0], jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 1)))
    np.testing.assert_array_equal(env.draw(state), data.frames[state.node])
    assert draws_itself(env) and not draws_itself(hand_made_frames.manipulation(privileged=True))


def test_grey_photographs_have_grey_backgrounds(data):
    """They are drawn in three equal colours, as everything is."""
    grey = dataclasses.replace(data, frames=data.frames[..., :1])
    behind, config = hand_made_frames.backgrounds(), ObjectManipulationConfig(num_goals=(2, 1, 2))
    env = from_data(grey, behind, config)
    assert env.train_backgrounds.shape[1:] == grey.frames.shape[1:] and env.train_backgrounds.dtype == jnp.uint8
    size = data.frames.shape[1:3]
    shown = np.stack([pictures.resized(image, *size) for image in behind.train])
    expected = shown @ [0.299, 0.587, 0.114]
    np.testing.assert_allclose(env.train_backgrounds[..., 0], expected, atol=0.5 + 1e-6)
    picture = env.draw(env.reset(jax.random.key(0)))
    assert picture.shape == (*size, 3) and (picture == picture[..., :1]).all()


@pytest.mark.long
def test_a_privileged_agent_trains_on_poses():
    """Numbers are finite, and none is of corrupted goals."""
    train = make_train(
        hand_made_frames.privileged_config(relabelling="her"), hand_made_frames.manipulation(privileged=True)
    )
    result = jax.jit(train)(jax.random.key(0))
    assert all(np.isfinite(value).all() for value in jax.device_get(result.epochs).values())
    assert "test_goal/success_rate" in result.metrics
    assert not [name for name in result.metrics if "corrupted" in name]


def test_reached_is_the_angle_between_poses(env, data):
    """Within 10 degrees on SO(3), for every image and every goal, whatever joints made the pose."""
    rotation = Rotation.from_matrix(data.rotation)
    goals = np.asarray(env.goals.evaluated)
    target = Rotation.from_matrix(data.rotation[np.asarray(env.goals.rows)[goals]])
    angle = np.stack([(each.inv() * rotation).magnitude() for each in target], axis=1)
    np.testing.assert_array_equal(
        env.reached(jnp.arange(len(data.frames))[:, None], goals[None]), angle < np.deg2rad(10)
    )
    np.testing.assert_array_equal(np.asarray(env.distance).T == 0, angle < np.deg2rad(10))


def test_no_goal_counts_as_another(env, data):
    """Goals of all uses lie more than 20 degrees apart, test and validation goals within 90 degrees of a training
    goal."""
    goals = np.asarray(env.goals.evaluated)
    rotation = data.rotation[np.asarray(env.goals.rows)]
    apart = geodesic(rotation[goals][:, None], rotation[goals][None]) + 10 * np.eye(len(goals))
    assert apart.min() > np.deg2rad(20)
    training = rotation[np.asarray(env.goals.training_goals)]
    for use, count in (("train", 3), ("validation", 1), ("test", 4)):
        mask = np.asarray(getattr(env.goals, f"{use}_mask"))
        assert mask.sum() == count
        assert geodesic(rotation[mask][:, None], training[None]).min(1).max() <= np.deg2rad(90) + 1e-3


def test_moves_turn_one_joint(env, data):
    """A step follows the recorded move; the joints say the same."""
    state, step = jax.jit(env.reset)(jax.random.key(0)), jax.jit(env.step)
    joints = jax.jit(lambda state: env.observe(state).joints)
    for action in range(6):
        after = step(state, np.int32(action))
        turned = wrapped(np.asarray(joints(after)) - np.asarray(joints(state)))
        expected = np.zeros(3)
        expected[action // 2] = np.pi / 3 * (-1) ** action
        np.testing.assert_allclose(turned, expected, atol=1e-5)
        state = after


def test_random_policy_and_shortest_path(env):
    """The oracle reaches every goal on a shortest path."""
    shortest, drawn = hand_made.shortest_and_random(env, 20)
    assert shortest.success.all() and (shortest.spl == 1.0).all()
    assert drawn.success.mean() < 1.0


def test_other_seeds_choose_other_goals(env):
    """The goal seed decides the goals, and the same seed the same."""
    again, other = hand_made_frames.manipulation(), hand_made_frames.manipulation(goal_seed=1)
    np.testing.assert_array_equal(again.goals.evaluated, env.goals.evaluated)
    assert not np.array_equal(other.goals.evaluated, env.goals.evaluated)


@pytest.mark.parametrize(
    ("change", "message"), [({"rotation": None}, "tells no poses"), ({"action": "contradiction"}, "lead")]
)
def test_datasets_that_cannot_be_used(data, change, message):
    """The error says what the dataset lacks."""
    if "action" in change:
        change = {"action": np.zeros_like(data.action)}
    with pytest.raises(UserError, match=message):
        from_data(
            dataclasses.replace(data, **change),
            hand_made_frames.backgrounds(),
            ObjectManipulationConfig(num_goals=(3, 1, 4)),
        )


def test_too_many_goals(data):
    """More goals than poses that lie apart."""
    with pytest.raises(UserError, match=r"env\.num_goals = .*give fewer"):
        from_data(data, hand_made_frames.backgrounds(), ObjectManipulationConfig(num_goals=(300, 0, 1)))


@pytest.mark.long
def test_views_of_one_state(data):
    """Where several images show a state, a step arrives at any of them, and moves are those of the state."""
    twice = dataclasses.replace(
        data,
        frames=np.concatenate([data.frames, 255 - data.frames]),
        state=np.concatenate([data.state, data.state]),
        rotation=np.concatenate([data.rotation] * 2),
        joints=np.concatenate([data.joints] * 2),
    )
    env = from_data(
        twice, hand_made_frames.backgrounds(), ObjectManipulationConfig(num_goals=(3, 1, 4), episode_length=12)
    )
    starts = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 200))
    after = jax.vmap(env.step)(starts, jnp.zeros(200, jnp.int32))
    count = len(data.frames)
    assert 0.3 < float((after.node >= count).mean()) < 0.7
    plain = hand_made_frames.manipulation()
    np.testing.assert_array_equal(after.node % count, np.asarray(plain.next_node)[np.asarray(starts.node) % count, 0])


@pytest.mark.long
def test_trains_by_dqn_with_and_without_relabelling(env):
    """A few epochs of either run through, with finite numbers."""
    for relabelling in ("none", "her"):
        train = make_train(hand_made_frames.manipulation_config(relabelling=relabelling), env)
        result = jax.jit(train)(jax.random.key(0))
        assert all(np.isfinite(value).all() for value in jax.device_get(result.epochs).values())
        assert {"test_goal/success_rate", "corrupted_test_goal/success_rate", "corrupted_train_goal/spl"} <= set(
            result.metrics
        )


@pytest.mark.parametrize("relabelling", [pytest.param("none", marks=pytest.mark.long), "her"])
def test_agents_see_the_codes_of_their_goals(env, relabelling):
    """Whatever goal a transition has, desired or relabelled, the agent is given that goal's code; batches are smaller
    than the goal space."""
    train = make_train(hand_made_frames.manipulation_config("none", relabelling=relabelling), env)
    parts, hyper = train.parts, train.config.hyper
    state = jax.jit(train.initial)(jax.random.key(0), hyper, env)
    count, goals = (
        parts.config.batch_size,
        env.goals.training_goals if relabelling == "none" else jnp.arange(env.goals.num_goals),
    )
    assert env.goals.num_goals > count
    goal = jax.random.choice(jax.random.key(1), goals, (count,))
    observation = env.observe_frame(jnp.zeros(count, jnp.int32))
    batch = Transitions(
        observation=observation,
        next_observation=observation,
        action=jnp.zeros(count, jnp.int32),
        desired_goal=goal,
        records=jnp.zeros((count, 1), jnp.int32),
        mask=jnp.ones((count, 1)),
        terminated=jnp.zeros(count, bool),
    )
    made = jax.jit(
        lambda params: agent_batch(
            train.setup(), Networks(params, params, view_key=None), batch, jnp.zeros(count), jax.random.key(2)
        )
    )(state.params)
    expected = jax.jit(lambda params: parts.learner.encode(params, env.goals.inputs_of(goal)).mean)(
        state.params["goal"]
    )
    np.testing.assert_allclose(made.code, expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(made.target_code, expected, rtol=1e-5, atol=1e-5)


def test_cells_close_in_on_themselves():
    """Angles just below and just above a half turn share a cell, and every angle has one."""
    cells = Cells.over_angles(1, np.pi / 3)
    assert cells.count == 6
    angles = np.append(np.linspace(-np.pi, np.pi, 500), [np.pi - 0.01, 0.01 - np.pi]).astype(np.float32)[:, None]
    found = np.asarray(jax.jit(cells.of)(angles))
    assert set(found.tolist()) == set(range(6)) and found[-1] == found[-2]


def test_subgoals_of_joints():
    """A subgoal is a turn of each joint by at most the scale, closed over a half turn."""
    space, observation = JointSpace(3), hand_made_frames.manipulation().observe_frame(jnp.int32(0))
    target = space.from_subgoal(observation, jnp.array([2.0, 0.5, -1.0]), 0.6)
    np.testing.assert_allclose(wrapped(target - observation.joints), [0.6, 0.3, -0.6], atol=1e-5)
    assert (jnp.abs(target) <= np.pi).all()


@pytest.mark.parametrize(
    ("task", "changes", "message"),
    [
        ("fetch_reach", {"agent": "dqn"}, "agent = 'dqn'.*give hrac"),
        ("object_search", {"agent": "hrac"}, "agent = 'hrac'.*no target states"),
        ("object_search", {"agent": "cqll"}, "agent = 'cqll'.*Did you mean 'cql'"),
        ("object_search", {"relabelling": "hers"}, "relabelling = 'hers'.*Did you mean 'her'"),
    ],
)
def test_parts_that_do_not_go_together(task, changes, message):
    """Refused by name, before anything is compiled."""
    with pytest.raises(UserError, match=message):
        make_train(presets.load(task, **changes))
