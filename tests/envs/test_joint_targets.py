"""Target states of joints: an ordinary task over the moves of a dataset, in which a turn ends where it began."""

import hand_made_frames
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from infogoal_jax.angles import wrapped
from infogoal_jax.envs import joint_targets
from infogoal_jax.envs.contract import check_contract
from infogoal_jax.envs.graph import frame_edges
from infogoal_jax.errors import UserError
from infogoal_jax.train.evaluation import evaluate

STEP = 2 * np.pi / hand_made_frames.STEPS


@pytest.fixture(scope="module")
def env() -> joint_targets.JointTargets:
    """The target states of the hand-made arm."""
    data = hand_made_frames.arm()
    return joint_targets.from_data(data.joints, frame_edges(data)[0], "an arm", 20)


def nearest_move(observation, goal, key):
    """Turn the joint that is farthest from its target."""
    turn = wrapped(goal - observation)
    joint = jnp.abs(turn).argmax(-1)
    back = jnp.take_along_axis(turn, joint[:, None], 1)[:, 0] < 0
    return (2 * joint + back).astype(jnp.int32)


def test_an_arm_that_never_moves_has_no_target_states():
    still = np.zeros((4, 2), np.float32)
    with pytest.raises(UserError, match="env.dataset = 'photographs': no move turns a joint"):
        joint_targets.from_data(still, np.zeros((4, 2), np.int32), "photographs", 20)


def test_target_states_of_joints_are_an_ordinary_task(env):
    check_contract(env)
    assert env.radius == pytest.approx(STEP / 2)
    seen = env.goals.inputs_of(env.goals.evaluated)
    assert seen.shape == env.render(env.goals.evaluated).shape == (32, 6)


def test_an_evaluation_starts_near_and_a_turn_ends_where_it_began(env):
    goals = env.goals.evaluated
    starts = jax.jit(jax.vmap(env.reset_to))(jax.random.split(jax.random.key(0), 32), goals)
    turn = np.abs(wrapped(goals - env.achieved(starts)))
    assert (turn < 3 * env.radius).all() and (turn.max(1) >= env.radius).all()  # One step: 60 degrees.
    assert env.reached(jnp.full(3, np.pi - 0.01), jnp.full(3, -np.pi + 0.01))
    scores = jax.jit(lambda: evaluate(nearest_move, env, goals, 4))()
    assert scores.success.all()
    assert scores.steps.max() == 3  # A step of each joint.


def test_training_asks_for_targets_near_and_far_that_are_not_reached_yet(env):
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 500))
    turn = np.abs(wrapped(states.desired_goal - env.achieved(states))).max(1)
    assert (turn < joint_targets.FARTHEST).all() and (turn >= env.radius).mean() > 0.99  # Of eight draws one is.
    assert (turn > 0.8 * joint_targets.FARTHEST).any() and (turn < 1.5 * env.radius).any()
