"""The physics of the Fetch tasks against MJX and MuJoCo: the same dynamics, constraint rows and minimum."""

import contextlib
import io

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from infogoal_jax.envs.fetch import constraints, model, physics, solver
from infogoal_jax.envs.fetch.tasks import TASKS
from infogoal_jax.runner.compilation import QUICKLY, known


@pytest.fixture(scope="module")
def reach():
    """FetchReach with the whole body, as the reference."""
    return physics.load(TASKS["fetch_reach"], model.FAITHFUL)


@pytest.fixture(scope="module")
def twin(reach):
    """The same robot for MuJoCo's own constraint code: the pairs that this project works out itself, and the
    reference's inverse weights."""
    spec = mujoco.MjSpec.from_file(str(model.ARM_XML))
    spec.option.timestep, spec.option.iterations, spec.option.tolerance = model.FAITHFUL.timestep, 100, 0
    low, high = model.table_of(TASKS["fetch_reach"])
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(low + high) / 2,
        size=(high - low) / 2,
        contype=0,
        conaffinity=0,
    )
    for names, pair in (
        [(names, model.ROBOT_AND_ROBOT) for names in model.ROBOT_PAIRS]
        + [(("table", "palm"), model.MESH_AND_TABLE)]
        + [(("table", finger), model.FINGER_AND_THING) for finger in model.FINGERS]
    ):
        sliding, torsional = pair.friction
        spec.add_pair(
            geomname1=names[0],
            geomname2=names[1],
            condim=4 if pair.torsion else 3,
            friction=[sliding, sliding, torsional, 0, 0],
            margin=pair.margin,
            solref=pair.reference,
            solimp=pair.impedance,
        )
    twin = spec.compile()
    twin.eq_data[:] = reach.mujoco_model.eq_data
    for joint in range(twin.njnt):
        twin.dof_invweight0[joint] = model.JOINT_INVERSE_WEIGHT[twin.joint(joint).name]
    for geom, weight in model.INVERSE_WEIGHT.items():
        if geom not in ("gripper", "object", "table", "palm"):
            twin.body_invweight0[twin.geom(geom).bodyid[0]] = weight
    twin.body_invweight0[twin.body("wrist_roll").id] = model.INVERSE_WEIGHT["gripper"]
    return twin


# Arm poses (torso, head pan and tilt, seven joints, fingers): free above the table; both fingers on it; the upper arm
# at the head.
POSES = {
    "free": [0.0013, 0, 0.06, 0.0099, -0.8256, -0.0036, 1.4439, 0.0031, 0.9532, 0.0055, 0.001, -0.0002],
    "fingers on the table": [0.0013, 0, 0.06, 0.0123, -0.5854, -0.0054, 1.4531, 0.0021, 0.6991, 0.0076, 0.0, 0.0002],
    "arm at the head": [0.0040, 0, 0.06, -0.3754, -1.2424, 0.4484, 1.7637, -0.0521, 1.3939, 0.0744, 0.0, 0.0],
}


def forward(reach, twin, position):
    """MuJoCo's data at this position and a drawn velocity, with the mocap body a little away from the gripper; and the
    same for our code."""
    data = mujoco.MjData(twin)
    data.qpos[:], data.qvel[:] = position, np.random.default_rng(0).normal(size=twin.nv) * 0.1
    mujoco.mj_forward(twin, data)
    target = data.site("gripper").xpos + np.array([-0.02, 0.01, 0.03])
    quaternion = data.xquat[twin.body("wrist_roll").id] + [1, 0, 1, 0]
    data.mocap_pos[0], data.mocap_quat[0] = target, quaternion / np.linalg.norm(quaternion)
    mujoco.mj_forward(twin, data)
    return (
        data,
        reach.motion(data.qpos, data.qvel),
        jnp.asarray(target, jnp.float32),
        jnp.asarray(data.mocap_quat[0], jnp.float32),
    )


@pytest.fixture(scope="module")
def constraint_rows(reach):
    """(motion, target, quaternion) -> (inertia, force, rows), compiled once."""

    @jax.jit
    def found(motion, target, quaternion):
        axes, inertia, force = reach.multibody.dynamics(motion.frames, None, motion.position, motion.velocity)
        return inertia, force, reach.rows(motion, axes, None, target, quaternion)

    return found


@pytest.mark.parametrize("pose", POSES)
def test_rows_and_acceleration_are_mujocos(reach, twin, constraint_rows, pose):
    """Jacobian, stiffness and reference of every active row, and the acceleration at the minimum, agree with MuJoCo's
    engine in C.

    Its newer versions add a velocity term to the weld's reference that MJX does not have (mjx_notes); so the weld's
    reference is compared with MJX.
    """
    data, motion, target, quaternion = forward(reach, twin, POSES[pose])
    inertia, force, rows = constraint_rows(motion, target, quaternion)
    active = np.flatnonzero(np.array(rows.stiffness) > 0)
    jacobian = data.efc_J.reshape(-1, twin.nv)
    assert len(active) == len(jacobian)
    mine = np.concatenate([np.array(rows.jacobian).T, np.array(rows.stiffness)[:, None]], 1)[active]
    theirs = np.concatenate([jacobian, data.efc_D[:, None]], 1)
    unmatched = list(range(len(theirs)))  # Contacts come in another order.
    for row in mine:
        distance = [np.abs((row - theirs[other]) / [*[1] * twin.nv, row[-1]]).max() for other in unmatched]
        assert min(distance) < 0.02, row
        unmatched.pop(int(np.argmin(distance)))
    minimum = solver.solve(inertia, reach.damping, force, rows, motion.acceleration, 30)[0]
    cost = cost_of(inertia, force, rows)
    assert cost(minimum) <= cost(jnp.asarray(data.qacc, jnp.float32)) + 1e-3 * abs(cost(minimum))


def cost_of(inertia, force, rows):
    """MuJoCo's primal cost as a function of the acceleration, in float64 by numpy."""
    inertia, force = np.array(inertia, float), np.array(force, float)
    jacobian, stiffness, reference = (
        np.array(part, float) for part in (rows.jacobian.T, rows.stiffness, rows.reference)
    )

    def cost(acceleration):
        acceleration = np.array(acceleration, float)
        away = jacobian @ acceleration - reference
        counts = (np.arange(len(away)) < solver.EQUALITIES) | (away < 0)
        return (
            0.5 * acceleration @ inertia @ acceleration
            - acceleration @ force
            + 0.5 * (stiffness * away**2 * counts).sum()
        )

    return cost


@pytest.mark.long
def test_free_step_is_mjx_step(reach):
    """Without contact, one physics step is `mjx.step`."""
    weights = reach.mujoco_model
    weights.opt.iterations, weights.opt.ls_iterations = 50, 50
    for joint in range(weights.njnt):
        weights.dof_invweight0[joint] = model.JOINT_INVERSE_WEIGHT[weights.joint(joint).name]
    weights.body_invweight0[weights.body("wrist_roll").id] = model.INVERSE_WEIGHT["gripper"]
    mjx = import_mjx()
    theirs_model = mjx.put_model(weights)
    start = reach.start()
    pose = reach.pose(start, 0.0)
    target, quaternion = pose.gripper + jnp.array([0.03, -0.02, 0.01]), pose.gripper_quaternion
    data = mjx.make_data(theirs_model).replace(
        qpos=start.position, qvel=start.velocity, mocap_pos=target[None], mocap_quat=quaternion[None]
    )
    # XLA's CPU fusions compute a parent's transform anew for every level of the tree below it: MJX would take a second
    # for this step.
    theirs = jax.jit(mjx.step, compiler_options=known(QUICKLY["cpu"]))(theirs_model, data)
    ours = jax.jit(reach.substep)(start, target, quaternion, jnp.zeros(2))
    np.testing.assert_allclose(ours.position, theirs.qpos, atol=2e-6)
    np.testing.assert_allclose(ours.velocity, theirs.qvel, atol=2e-4)


def import_mjx():
    """MJX, without what it prints about its other backend."""
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


def random_problem(seed, size=8, count=40):
    """A solvable problem of some degrees of freedom and rows, six of them equalities."""
    draw = np.random.default_rng(seed)
    root = draw.normal(size=(size, size))
    rows = solver.ConstraintRows(
        *(
            jnp.asarray(part, jnp.float32)
            for part in (draw.normal(size=(count, size)).T, draw.uniform(10, 500, count), draw.normal(size=count) * 50)
        )
    )
    return (
        jnp.asarray(root @ root.T + np.eye(size), jnp.float32),
        jnp.asarray(draw.normal(size=size) * 10, jnp.float32),
        rows,
    )


def solved(inertia, force, rows, steps):
    """The acceleration of least cost from rest, without damping, and M^-1 (force + constraint force)."""
    return solver.solve(inertia, np.zeros(len(force), np.float32), force, rows, jnp.zeros(len(force)), steps)


@pytest.mark.long
def test_four_newton_steps_reach_the_minimum():
    """On drawn problems, far harder than a robot's, four steps bring the cost within a thousandth of the minimum found
    by many; one does not."""
    shortfall = {1: [], 4: []}
    for seed in range(20):
        inertia, force, rows = random_problem(seed)
        cost = cost_of(inertia, force, rows)
        least = cost(solved(inertia, force, rows, 40)[0])
        for steps, values in shortfall.items():
            values.append((cost(solved(inertia, force, rows, steps)[0]) - least) / abs(least))
    assert max(shortfall[4]) < 1e-3 < max(shortfall[1])


def test_gradient_vanishes_at_the_minimum():
    """M a = force + constraint force where the cost is least."""
    inertia, force, rows = random_problem(3)
    acceleration, free = solved(inertia, force, rows, 12)
    np.testing.assert_allclose(acceleration, free, atol=0.02 * np.abs(acceleration).max())


def test_damping_is_taken_implicitly():
    """The second acceleration is that of M + damping under the same forces, in float64 by numpy."""
    inertia, force, rows = random_problem(4)
    damping = np.linspace(0.5, 2.0, 8, dtype=np.float32)
    acceleration, damped = solver.solve(inertia, damping, force, rows, jnp.zeros(8), 12)
    forces = np.array(inertia, float) @ np.array(acceleration, float)  # At the minimum all forces together.
    np.testing.assert_allclose(
        damped, np.linalg.solve(np.array(inertia, float) + np.diag(damping), forces), atol=0.02 * np.abs(damped).max()
    )


@pytest.mark.parametrize(
    ("size", "count", "steps"),
    [(7, 38, 4), *(pytest.param(*each, marks=pytest.mark.long) for each in ((7, 38, 1), (18, 143, 4)))],
)
def test_the_kernel_finds_what_plain_operations_find(size, count, steps):
    """For the smallest and the largest problem of a Fetch task; the kernel runs as plain operations here."""
    inertia, force, rows = random_problem(5, size, count)
    damping, start = jnp.linspace(0.1, 1.0, size), jnp.linspace(-1.0, 1.0, size)
    problem = (inertia, damping, force, rows.jacobian, rows.stiffness, rows.reference, start)
    plain = solver.solve_anywhere(*problem, steps=steps)
    kernel = solver.solve_on_gpu(
        *problem, lengths=solver.TRIAL_LENGTHS, equalities=solver.EQUALITIES, steps=steps, interpret=True
    )
    np.testing.assert_allclose(kernel[0], plain[0], atol=1e-3 * np.abs(plain[0]).max())
    # Forces of rows that nearly cancel.
    np.testing.assert_allclose(kernel[1], plain[1], atol=0.02 * np.abs(plain[1]).max())


def test_elimination_solves_what_a_library_solves():
    """Gauss-Jordan elimination of the leading part of a padded matrix."""
    inertia, force, _ = random_problem(1)
    padded, vector = jnp.pad(inertia, (0, 8)), jnp.pad(force, (0, 8))
    solution = solver.gauss_jordan_solve(padded, vector, 8)
    np.testing.assert_allclose(solution[:8], np.linalg.solve(np.array(inertia, float), force), rtol=2e-3)


def test_a_weld_of_longer_steps_moves_as_far():
    """The violation after 40 ms is that of 20 steps of 2 ms, whatever the violation and velocity at first; with
    MuJoCo's own rule it is not."""
    short = constraints.Softness((0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0), 0.002)
    time, ratio = constraints.lengthened(short, 0.005, 0.04).reference
    after = np.linalg.matrix_power(constraints.step_map(1 / (time * ratio) ** 2, 2 / time, 0.005), 8)
    reference = np.linalg.matrix_power(constraints.step_map(1 / 0.02**2, 2 / 0.02, 0.002), 20)
    unchanged = np.linalg.matrix_power(constraints.step_map(1 / 0.02**2, 2 / 0.02, 0.005), 8)
    np.testing.assert_allclose(after[0], reference[0], rtol=1e-6)
    assert abs(unchanged[0, 0] - reference[0, 0]) > 0.02
