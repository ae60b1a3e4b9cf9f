"""The robot's own kinematics, dynamics and contacts against MuJoCo's engine in C, and what keeps the programs made of
them small. Contacts of boxes and capsules: where they touch, how deep, and in which direction."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from benchmarks.speed.training import operations
from infogoal_jax.envs import load
from infogoal_jax.envs.fetch import contacts, model, physics
from infogoal_jax.envs.fetch.environment import LATE
from infogoal_jax.envs.fetch.tasks import TASKS
from infogoal_jax.envs.fetch.vectors import Rotation, Vector

CASES = [
    pytest.param(("fetch_reach", model.FAST), marks=pytest.mark.long),
    pytest.param(("fetch_reach", model.FAITHFUL), marks=pytest.mark.long),
    ("fetch_pick_and_place", model.FAITHFUL),
    ("fetch_slide", model.FAST),
]
"""The fewest joints, the trunk's branch, fingers and a cube, and a puck, whose inertia differs between axes."""
UPRIGHT = np.eye(3)
TABLE = contacts.block(np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]], np.float32))


@pytest.fixture(scope="module", params=CASES, ids=lambda case: f"{case[0]}-{case[1].substeps}")
def compared(request):
    """Our results and MuJoCo's data for eight drawn positions and velocities of a task."""
    name, setting = request.param
    ours, draw = physics.load(TASKS[name], setting), np.random.default_rng(0)
    mj = ours.mujoco_model

    @jax.jit
    def work_out(position, velocity):
        motion = ours.motion(position, velocity)
        return motion.frames, ours.multibody.dynamics(motion.frames, ours.shapes.thing_at(position), position, velocity)

    results = []
    for _ in range(8):
        position, velocity = mj.qpos0 + draw.uniform(-0.8, 0.8, mj.nq), draw.normal(size=mj.nv)
        if ours.has_object:
            position[-7:-4] = draw.normal([1.3, 0.7, 0.5], 0.1)
            position[-4:] /= np.linalg.norm(position[-4:])
        data = mujoco.MjData(mj)
        data.qpos[:], data.qvel[:] = position.astype(np.float32), velocity.astype(np.float32)
        mujoco.mj_forward(mj, data)
        results.append((data, *work_out(jnp.asarray(position, jnp.float32), jnp.asarray(velocity, jnp.float32))))
    return ours, results


def test_bodies_are_where_mujoco_puts_them(compared):
    """Positions within 2 micrometres, quaternions with MuJoCo's sign, rotations."""
    ours, results = compared
    bodies = ours.mujoco_model.jnt_bodyid[: ours.joints]
    for data, frames, _ in results:
        np.testing.assert_allclose(frames.position.array, data.xpos[bodies], atol=2e-6)
        np.testing.assert_allclose(frames.quaternion.array, data.xquat[bodies], atol=2e-6)
        np.testing.assert_allclose(frames.rotation.array, data.xmat[bodies].reshape(-1, 3, 3), atol=2e-6)


def test_inertia_and_forces_are_mujocos(compared):
    """The inertia matrix, and passive less bias forces: stiffness, damping, gravity, Coriolis and the puck's
    gyration."""
    ours, results = compared
    for data, _, (_, inertia, force) in results:
        theirs = np.zeros((data.qvel.size, data.qvel.size))
        mujoco.mj_fullM(ours.mujoco_model, data, theirs)
        np.testing.assert_allclose(inertia, theirs, atol=5e-5)
        expected = data.qfrc_passive - data.qfrc_bias
        np.testing.assert_allclose(force, expected, atol=1e-3, rtol=1e-6)


def test_axes_are_the_jacobian_of_every_point(compared):
    """Linear velocity of the grip under each joint, as MuJoCo's Jacobian has it."""
    ours, results = compared
    for data, _, (axes, _, _) in results:
        theirs, turning = np.zeros((2, 3, data.qvel.size))
        mujoco.mj_jacSite(ours.mujoco_model, data, theirs, turning, ours.mujoco_model.site("grip").id)
        lever = data.site("grip").xpos - np.array(ours.multibody.origin.array)
        moves = np.array(axes.linear.array) + np.cross(np.array(axes.angular.array), lever)
        on_chain = np.abs(theirs).sum(0) + np.abs(turning).sum(0) > 0
        np.testing.assert_allclose(moves[on_chain], theirs.T[on_chain], atol=5e-6)


@pytest.mark.parametrize("task", [pytest.param("fetch_reach", marks=pytest.mark.long), "fetch_pick_and_place"])
def test_the_start_needs_no_kinematics_and_is_what_kinematics_gives(task):
    """Where bodies are at the start of an episode are constants: those of the start's joint positions."""
    ours = physics.load(TASKS[task], model.FAITHFUL)
    for constant, worked_out in zip(
        jax.tree.leaves(ours.start_frames), jax.tree.leaves(ours.multibody.frames(ours.start().position)), strict=True
    ):
        np.testing.assert_allclose(constant, worked_out, atol=1e-6)
    start = ours.start()
    for constant, worked_out in zip(
        jax.tree.leaves(ours.start_pose(start)), jax.tree.leaves(ours.pose(start, 0.0)), strict=True
    ):
        np.testing.assert_allclose(constant, worked_out, atol=1e-6)


def test_a_late_pose_is_the_pose_of_the_time_before():
    """The pose 2 ms ago, worked out from velocities and accelerations, is where 2 ms of the same velocities come from,
    within a micrometre."""
    ours = physics.load(TASKS["fetch_pick_and_place"], model.FAST)
    start, draw = ours.start(), np.random.default_rng(1)

    @jax.jit
    def poses(velocity):
        now = ours.motion(physics.integrate(start.position, velocity, LATE), velocity)
        return ours.pose(now, LATE), ours.pose(start.replace(velocity=velocity), 0.0), ours.pose(now, 0.0)

    late, before, after = poses(draw.normal(size=start.velocity.shape).astype(np.float32))
    assert np.abs(np.subtract(after.grip, before.grip)).max() > 1e-4
    for name in ("gripper", "grip", "thing", "grip_velocity"):
        np.testing.assert_allclose(
            getattr(late, name), getattr(before, name), atol=3e-6 if name != "grip_velocity" else 1e-4, err_msg=name
        )
    np.testing.assert_allclose(late.gripper_quaternion, before.gripper_quaternion, atol=5e-6)


def test_closed_fingers_are_where_kinematics_puts_them():
    """Setting both fingers to closed moves their bodies too."""
    ours = physics.load(TASKS["fetch_push"], model.FAITHFUL)
    position = ours.start().position.at[ours.fingers].set(jnp.array([0.004, 0.002]))
    closed = ours.closed(ours.motion(position, ours.start().velocity))
    np.testing.assert_array_equal(closed.position[ours.fingers], 0.0)
    for moved, worked_out in zip(
        jax.tree.leaves(closed.frames), jax.tree.leaves(ours.multibody.frames(closed.position)), strict=True
    ):
        np.testing.assert_allclose(moved, worked_out, atol=1e-6)


@pytest.mark.parametrize(
    ("task", "step", "reset"),
    [
        pytest.param("fetch_reach", 3200, 500, marks=pytest.mark.long),
        pytest.param("fetch_push", 3700, 700, marks=pytest.mark.long),
        ("fetch_pick_and_place", 3900, 700),
    ],
)
def test_the_programs_stay_small(task, step, reset):
    """Operations of a control step and of a reset: a step had 19,000 to 27,500 of them, and took minutes to compile."""
    env = load(task)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    assert operations(jax.make_jaxpr(env.reset)(jax.random.key(0))) < reset
    assert operations(jax.make_jaxpr(env.step)(state, jnp.zeros(4))) < step


box_on_box = jax.jit(contacts.box_on_box)


def cube(center, rotation=UPRIGHT):
    """A cube with edges of 0.2 m."""
    half = Vector.of(np.full((1, 3), 0.1, np.float32))
    return contacts.Box(
        Vector.of(np.asarray(center, np.float32)[None]), Rotation.of(np.asarray(rotation, np.float32)[None]), half
    )


@jax.jit
def on_ground(box):
    """Contacts of the box with the table or the floor."""
    ground, handicap = contacts.ground_under(TABLE, box)
    return contacts.box_on_box(ground, box, handicap)


def turn(axis, angle):
    """The rotation matrix of a turn about an axis (rad)."""
    quaternion, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(quaternion, np.array(axis, float), angle)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def test_a_cube_rests_on_the_table_with_its_corners():
    """Four points, 1 mm deep, below the cube's corners; the normal points up, from the table to the cube."""
    found = on_ground(cube([0.3, 0.2, 1.099]))
    np.testing.assert_allclose(found.distance, -0.001, atol=1e-6)
    places = sorted(map(tuple, np.array(found.position.array)[:, :2].round(3).astype(float).round(3).tolist()))
    assert places == [(0.2, 0.1), (0.2, 0.3), (0.4, 0.1), (0.4, 0.3)]
    np.testing.assert_allclose(found.normal.array, np.tile([0, 0, 1], (4, 1)), atol=1e-6)


def test_a_cube_over_the_edge_is_held_as_far_as_the_table_reaches():
    """The outer points lie on the table's edge, so that the cube tips over it once its center is beyond."""
    found = on_ground(cube([0.97, 0.0, 1.099]))
    np.testing.assert_allclose(found.distance, -0.001, atol=1e-6)
    np.testing.assert_allclose(np.sort(np.array(found.position.x)), [0.87, 0.87, 1.0, 1.0], atol=1e-6)


def test_a_cube_beside_the_table_meets_its_side_and_then_the_floor():
    """A box that leans against the side gets a sideways normal; one that has fallen meets the floor, one in mid-air
    nothing."""
    beside = on_ground(cube([1.099, 0.0, 0.7]))
    np.testing.assert_allclose(beside.normal.array, np.tile([1, 0, 0], (4, 1)), atol=1e-6)
    np.testing.assert_allclose(beside.distance, -0.001, atol=1e-6)
    fallen = on_ground(cube([1.5, 0.0, 0.1]))
    np.testing.assert_allclose(fallen.distance, 0.0, atol=1e-6)
    assert (on_ground(cube([1.5, 0.0, 0.7])).distance > 0.1).all()


@pytest.mark.parametrize("seed", range(6))
def test_boxes_face_to_face_have_mujocos_depth_and_normal(seed):
    """Two boxes that overlap by a little on one face: the deepest point and the normal are those of MuJoCo's box
    against box."""
    draw = np.random.default_rng(seed)
    axis = seed % 3
    offset = draw.uniform(-0.05, 0.05, 3)
    offset[axis] = 0.1995
    tilt = turn(draw.normal(size=3), 0.01)
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="one", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.1])
    body = spec.worldbody.add_body(name="other")
    body.add_freejoint()
    body.add_geom(name="other", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 0.1, 0.1])
    compiled = spec.compile()
    data = mujoco.MjData(compiled)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, tilt.ravel())
    data.qpos[:] = np.concatenate([offset, quaternion])
    mujoco.mj_forward(compiled, data)
    nothing = Vector.of(np.zeros((1, 3), np.float32))
    found = box_on_box(cube([0, 0, 0]), cube(offset, tilt), nothing)
    assert data.ncon >= 1
    np.testing.assert_allclose(found.distance.min(), min(contact.dist for contact in data.contact), atol=2e-4)
    np.testing.assert_allclose(found.normal.array[0], data.contact[0].frame[:3], atol=0.02)
    first, second = (tangent.array[0] for tangent in jax.jit(contacts.tangents)(found.normal))
    np.testing.assert_allclose([first, second], np.array(data.contact[0].frame[3:]).reshape(2, 3), atol=0.02)
    flipped = box_on_box(cube(offset, tilt), cube([0, 0, 0]), nothing)
    np.testing.assert_allclose(flipped.normal.array[0], -found.normal.array[0], atol=1e-6)


def test_capsules_touch_where_mujoco_says():
    """Distance, point and normal of two crossing capsules."""
    first = contacts.Capsule(Vector.of(jnp.array([[0.0, 0.0, 0.0]])), Vector.of(jnp.array([[0.3, 0.0, 0.0]])), 0.05)
    second = contacts.Capsule(Vector.of(jnp.array([[0.1, 0.0, 0.12]])), Vector.of(jnp.array([[0.0, 0.2, 0.0]])), 0.04)
    found = contacts.capsule_on_capsule(first, second)
    np.testing.assert_allclose(found.distance, [0.03], atol=1e-6)
    np.testing.assert_allclose(found.normal.array[0], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(found.position.array[0], [0.1, 0.0, 0.065], atol=1e-6)
