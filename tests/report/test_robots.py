"""Pictures of robots of other libraries: shapes where the model has them, and the goal where it has to be reached."""

import types

import jax
import mujoco
import numpy as np
import pytest
from hand_made_robots import Mass

from infogoal_jax import envs
from infogoal_jax.envs import raycast
from infogoal_jax.report.robots import RobotPainter
from infogoal_jax.report.video import drawn_goals, drawn_video
from infogoal_jax.train.evaluation import random_policy

MODEL = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 1" pos="0 0 -0.5"/>
    <geom name="wall" type="box" size="0.1 0.4 0.3" pos="1.2 0 -0.2" rgba="0 0 1 1"/>
    <geom name="contact" type="sphere" size="9" group="3"/>
    <body name="torso">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 1 0"/>
      <geom type="ellipsoid" size="0.2 0.1 0.1" rgba="0 1 0 1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.05" rgba="0 1 0 1"/>
    </body>
    <body name="target" pos="-3 0 0"><geom type="sphere" size="0.3" rgba="1 0 1 1"/></body>
  </worldbody>
</mujoco>
"""
SIZE = (120, 160)


def made(count: int = 2) -> RobotPainter:
    """A painter of a torso that slides in the plane, whose place is the goal that it achieves."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    task = types.SimpleNamespace(
        radius=0.1,
        mujoco_model=lambda: model,
        joint_positions=lambda world: world,
        achieved=lambda state: np.resize([*state.world, 0.0], count),
        reached=lambda achieved, goal: np.linalg.norm(achieved - goal) < 0.1,
    )
    return RobotPainter(task, SIZE)


def at(*place: float, goal=(0.5, -0.2), time: int = 7) -> types.SimpleNamespace:
    """A state of the torso."""
    return types.SimpleNamespace(world=np.array(place), desired_goal=np.array(goal), time=time)


def colour_at(painter: RobotPainter, frame: np.ndarray, place) -> np.ndarray:
    """What a picture shows of a place of the world."""
    seen = painter.view.seen(np.array(place, float))
    column, row = np.round(painter.view.camera.project(seen[None])[0] / raycast.SUPERSAMPLING - 0.5).astype(int)
    return frame[row, column].astype(int)


def test_shapes_and_the_goal_are_seen_where_they_are():
    painter = made()
    frame = painter(at(0.0, 0.0))
    assert frame.shape == (*SIZE, 3) and frame.dtype == np.uint8
    red, green, blue = np.moveaxis(frame.astype(int), -1, 0)
    torso = colour_at(painter, frame, [0.0, 0.0, 0.05])
    assert torso[1] > torso[[0, 2]].max() + 60
    marked = colour_at(painter, frame, [0.5, -0.2, 0.0])  # At the height of the torso, which achieves it.
    assert marked[0] > marked[1:].max() + 40
    assert (blue > red + 60).sum() > 20  # The wall, which never moves.
    # Neither the environment's own mark nor shapes for contacts.
    assert not ((red > green + 60) & (blue > green + 60)).any()
    assert colour_at(painter, frame, [0.0, 0.9, -0.5]).std() < 10


def test_the_goal_turns_green_when_it_is_reached():
    painter = made()
    away, there = (colour_at(painter, painter(at(*place)), [0.5, -0.2, 0.0]) for place in ([0.0, 0.0], [0.45, -0.2]))
    assert away[0] > away[1] + 40 and there[1] > there[0] + 40


def test_the_camera_stands_still_until_what_moves_leaves_its_view():
    painter = made()
    painter(at(0.0, 0.0))
    first = painter.view
    painter(at(0.05, 0.0))
    assert painter.view is first
    painter(at(5.0, 0.0))
    assert painter.view is not first and painter.view.radius > first.radius
    frame = painter(at(5.0, 0.0, goal=(5.1, 0.1)))  # Now the robot alone would be small in it.
    assert painter.view.radius < first.radius
    assert colour_at(painter, frame, [5.0, 0.0, 0.05])[1] > 100


def test_a_goal_that_is_no_place_is_told_in_words_alone():
    painter = made(count=4)
    frame = painter(at(0.0, 0.0, goal=(0.5, 0.5, 0.5, 0.5))).astype(int)
    assert not (frame[..., 0] > frame[..., 1:].max(-1) + 60).any() and painter.achieving is None


def test_a_robot_of_gymnasium_is_drawn_where_its_state_has_it():
    env = envs.from_gymnasium(Mass, episode_length=9, num_evaluated=2, simulators=1)
    painter, state = RobotPainter(env, SIZE), jax.jit(env.reset)(jax.random.key(0))
    for _ in range(2):
        frame = painter(state)
        place = np.append(np.asarray(env.achieved(state)), 0.0)
        np.testing.assert_allclose(painter.data.qpos, place[:2], atol=0.05)  # It sees its place a substep ago.
        assert painter.achieving is not None and frame.shape == (*SIZE, 3)
        state = jax.jit(env.step)(state, np.ones(2, np.float32))


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # Of what brax brings.
def test_a_robot_of_brax_becomes_a_video(tmp_path):
    from brax.envs import get_environment

    arm = get_environment("reacher", backend="positional")
    given = {"goal": [4, 5], "hidden": [8, 9, 10], "achieved": lambda state: state.obs[4:6] + state.obs[8:10]}
    env = envs.from_brax(arm, radius=0.02, episode_length=3, **given)
    path = tmp_path / "arm.mp4"
    reached = drawn_video(env, random_policy(env), path, drawn_goals(env, 1, seed=0), seed=0, height=96)
    assert len(reached) == 1 and path.stat().st_size > 1000
    painter = RobotPainter(env, (96, 128))
    painter(jax.jit(env.reset)(jax.random.key(0)))
    assert painter.achieving is not None  # The tip, whose place the observation tells.
