"""Contacts of boxes and capsules: where they touch, how deep, and in which direction, as MuJoCo says it."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from infogoal_jax.envs.fetch import contacts
from infogoal_jax.envs.fetch.vectors import Rotation, Vector

UPRIGHT = np.eye(3)
TABLE = contacts.block(np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 1.0]], np.float32))


def cube(center, rotation=UPRIGHT):
    """A cube with edges of 0.2 m."""
    half = Vector.of(jnp.full((1, 3), 0.1))
    return contacts.Box(
        Vector.of(jnp.asarray(center, jnp.float32)[None]), Rotation.of(jnp.asarray(rotation, jnp.float32)[None]), half
    )


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
    nothing = Vector.of(jnp.zeros((1, 3)))
    found = contacts.box_on_box(cube([0, 0, 0]), cube(offset, tilt), nothing)
    assert data.ncon >= 1
    np.testing.assert_allclose(found.distance.min(), min(contact.dist for contact in data.contact), atol=2e-4)
    np.testing.assert_allclose(found.normal.array[0], data.contact[0].frame[:3], atol=0.02)
    first, second = (tangent.array[0] for tangent in contacts.tangents(found.normal))
    np.testing.assert_allclose([first, second], np.array(data.contact[0].frame[3:]).reshape(2, 3), atol=0.02)
    flipped = contacts.box_on_box(cube(offset, tilt), cube([0, 0, 0]), nothing)
    np.testing.assert_allclose(flipped.normal.array[0], -found.normal.array[0], atol=1e-6)


def test_capsules_touch_where_mujoco_says():
    """Distance, point and normal of two crossing capsules."""
    first = contacts.Capsule(Vector.of(jnp.array([[0.0, 0.0, 0.0]])), Vector.of(jnp.array([[0.3, 0.0, 0.0]])), 0.05)
    second = contacts.Capsule(Vector.of(jnp.array([[0.1, 0.0, 0.12]])), Vector.of(jnp.array([[0.0, 0.2, 0.0]])), 0.04)
    found = contacts.capsule_on_capsule(first, second)
    np.testing.assert_allclose(found.distance, [0.03], atol=1e-6)
    np.testing.assert_allclose(found.normal.array[0], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(found.position.array[0], [0.1, 0.0, 0.065], atol=1e-6)
