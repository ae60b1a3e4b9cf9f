"""The physics of a Fetch task: one control step of 40 ms of one robot, to be batched by `jax.vmap`.

MJX computes the multibody dynamics (kinematics, inertia, bias forces); contacts and constraints of this one robot and their solver are ours
(contacts.py, constraints.py, solver.py). Semi-implicit Euler with joint damping taken implicitly, as in the reference.
"""

import contextlib
import functools
import io
import threading

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

with contextlib.redirect_stdout(io.StringIO()):  # MJX prints that its other backend, Warp, is not installed.
    from mujoco import mjx
    from mujoco.mjx._src import scan

from infogoal_jax.envs.fetch import constraints, contacts, model, solver
from infogoal_jax.envs.fetch.constraints import ContactKind, Softness
from infogoal_jax.envs.fetch.tasks import Task

GRIPPER_TURN = np.array([1.0, 0.0, 1.0, 0.0], np.float32)
FINGER_GAIN = 30000.0


@flax.struct.dataclass
class Motion:
    """position [nq], velocity [nv] and, to start the solver from, the last acceleration [nv]; units m, rad, s."""

    position: jax.Array
    velocity: jax.Array
    acceleration: jax.Array


@flax.struct.dataclass
class Pose:
    """What the observation is made of: gripper position [3] and quaternion [4], grip position [3] and velocity [3] (m/s),
    object position [3], rotation [3, 3], velocity [3] and angular velocity [3] (rad/s; zeros without an object)."""

    gripper: jax.Array
    gripper_quaternion: jax.Array
    grip: jax.Array
    grip_velocity: jax.Array
    thing: jax.Array
    thing_rotation: jax.Array
    thing_velocity: jax.Array
    thing_turning: jax.Array


_tracing = threading.RLock()


@contextlib.contextmanager
def shallow_fusions():
    """Keep XLA:CPU from multiplying work along the kinematic tree, while MJX is traced inside this block.

    XLA's CPU fusions compute a parent's transform anew for every level below it, so that the work doubles from joint to joint: 500 times slower for
    this arm. A barrier behind each walk over the tree stops that. MJX has no hook for it, so its private function is replaced for the time of
    tracing; tests/test_fetch_physics.py pins this to the installed version.
    """
    with _tracing:
        walk = scan.body_tree

        def body_tree(m, function, *rest, **options):
            def barred(*arguments):
                return jax.lax.optimization_barrier(function(*arguments))

            return walk(m, barred, *rest, **options)

        scan.body_tree = body_tree
        try:
            yield
        finally:
            scan.body_tree = walk


class Physics:
    """The functions of one task in one setting. Everything it holds is constant and small, so it is compiled into the program."""

    def __init__(self, task: Task, setting: model.Setting):
        self.task, self.setting = task, setting
        self.mujoco_model = model.load(task, setting)
        self.model = mjx.put_model(self.mujoco_model)
        self.has_object = task.object_height is not None
        self.joints = self.mujoco_model.nv - 6 * self.has_object  # The object's free joint comes after those of the robot.
        self.one_hand = task.blocks_fingers and not setting.whole_body
        self.fingers = slice(self.joints - 2, self.joints)
        mj, timestep = self.mujoco_model, setting.timestep
        nv = mj.nv
        self.gripper_site, self.grip_site = mj.site("gripper").id, mj.site("grip").id
        self.wrist = mj.body("wrist_roll").id
        self.damping = jnp.asarray(timestep * mj.dof_damping, jnp.float32)
        self.roots = mj.body_rootid[mj.dof_bodyid]

        def chain(body: int) -> np.ndarray:
            mask = np.zeros(nv, np.float32)
            while body:
                first, count = mj.body_dofadr[body], mj.body_dofnum[body]
                mask[first : first + count] = 1
                body = mj.body_parentid[body]
            return mask

        def kind(pair: model.Pair, first: str, second: str) -> ContactKind:
            weight = sum(model.INVERSE_WEIGHT[geom][0] for geom in (first, second))
            if self.one_hand and not {first, second}.isdisjoint(model.FINGERS):
                weight = weight / 2  # One block is as stiff as two fingers side by side.
            dofs = chain(mj.geom(second).bodyid[0]) - chain(mj.geom(first).bodyid[0])
            return ContactKind(dofs, pair.friction, pair.torsion, pair.margin, weight, Softness(pair.reference, pair.impedance, timestep))

        self.arm_dofs = chain(self.wrist)
        self.weld = Softness(tuple(mj.eq_solref[0]), tuple(mj.eq_solimp[0]), model.REFERENCE_TIMESTEP)
        if timestep != model.REFERENCE_TIMESTEP:
            self.weld = constraints.lengthened(self.weld, timestep, model.CONTROL_STEP)
        self.limits = []
        for joint in range(mj.njnt):
            if mj.jnt_limited[joint]:
                softness = Softness(tuple(mj.jnt_solref[joint]), tuple(mj.jnt_solimp[joint]), timestep)
                self.limits.append((joint, mj.jnt_range[joint], model.JOINT_INVERSE_WEIGHT[mj.joint(joint).name], softness))
        self.table = contacts.block(model.table_of(task))
        fingers = model.FINGERS[:1] if self.one_hand else model.FINGERS
        self.finger_on_table = [kind(model.FINGER_AND_THING, "table", finger) for finger in fingers]
        self.palm_on_table = kind(model.MESH_AND_TABLE, "table", "palm")
        self.robot_on_robot = {pair: kind(model.ROBOT_AND_ROBOT, *pair) for pair in model.ROBOT_PAIRS} if setting.whole_body else {}
        if self.has_object:
            self.thing_on_ground = kind(model.PUCK_AND_TABLE if task.puck else model.THING_AND_GROUND, "table", "object")
            self.finger_on_thing = [kind(model.FINGER_AND_THING, finger, "object") for finger in fingers]
        self.template = mjx.make_data(self.model)

    def start(self) -> Motion:
        """Where every episode starts, before the object is placed."""
        trunk = model.TRUNK.values() if self.setting.whole_body else ()
        position, velocity = np.array([*trunk, *zip(*self.task.start, strict=True)][: self.joints]).T
        if self.has_object:
            position = np.concatenate([position, [1.25, 0.53, self.task.start_height or self.task.object_height, 1, 0, 0, 0]])
            velocity = np.concatenate([velocity, np.zeros(6)])
        velocity = jnp.asarray(velocity, jnp.float32)
        return Motion(jnp.asarray(position, jnp.float32), velocity, jnp.zeros_like(velocity))

    def place_object(self, motion: Motion, place: jax.Array) -> Motion:
        """The motion with the object at rest at a place [2] (m) on the table, or at a position [3]."""
        first = self.joints
        return motion.replace(position=motion.position.at[first : first + place.shape[0]].set(place), velocity=motion.velocity.at[first:].set(0.0))

    def finger_state(self, motion: Motion) -> tuple[jax.Array, jax.Array]:
        """Positions [2] (m) and velocities [2] (m/s) of the right and the left finger; zero for fingers that are one block."""
        if self.one_hand:
            return jnp.zeros(2), jnp.zeros(2)
        return motion.position[self.fingers], motion.velocity[self.fingers]

    def kinematics(self, position: jax.Array, velocity: jax.Array) -> mjx.Data:
        """Poses of all bodies, and the joints' axes."""
        data = self.template.replace(qpos=position, qvel=velocity)
        return mjx.com_pos(self.model, mjx.kinematics(self.model, data))

    def pose(self, motion: Motion, age: float) -> Pose:
        """The pose `age` seconds ago (the reference reads its positions one substep late), with the velocities of now."""
        with shallow_fusions():
            data = self.kinematics(integrate(motion.position, motion.velocity, -age), motion.velocity)
        centers = data.subtree_com[self.roots]
        jacobian = constraints.point_jacobian(data, centers, data.site_xpos[self.grip_site][None])[0] * self.arm_dofs[:, None]
        zero = jnp.zeros(3)
        thing = (zero, jnp.eye(3), zero, zero)
        if self.has_object:
            rotation = data.xmat[-1]
            thing = (data.xpos[-1], rotation, motion.velocity[self.joints : self.joints + 3], rotation @ motion.velocity[self.joints + 3 :])
        return Pose(
            data.site_xpos[self.gripper_site], data.xquat[self.wrist], data.site_xpos[self.grip_site],
            (jacobian * motion.velocity[:, None]).sum(0), *thing,
        )

    def dynamics(self, motion: Motion) -> tuple[mjx.Data, jax.Array, jax.Array]:
        """Poses of all bodies, the inertia matrix [nv, nv], and the passive and bias forces [nv]."""
        with shallow_fusions():
            data = mjx.crb(self.model, self.kinematics(motion.position, motion.velocity))
            data = mjx.passive(self.model, mjx.com_vel(self.model, data))
            data = mjx.rne(self.model, data)
        return data, data._impl.M, data.qfrc_passive - data.qfrc_bias

    def rows(self, data: mjx.Data, target: jax.Array, target_quaternion: jax.Array) -> solver.Rows:
        """All constraint rows at this position and velocity."""
        centers = data.subtree_com[self.roots]
        table = self.table
        parts = [constraints.weld_rows(
            data, centers, self.arm_dofs, data.site_xpos[self.gripper_site], data.xquat[self.wrist], target, target_quaternion,
            model.INVERSE_WEIGHT["gripper"], self.weld,
        )]
        parts += [constraints.limit_row(data, *limit) for limit in self.limits]
        for (fixed, moving), kind in self.robot_on_robot.items():
            touch = contacts.capsule_on_capsule(self.capsule(data, fixed), self.capsule(data, moving))
            parts.append(constraints.contact_rows(data, centers, touch, kind))
        palm = self.mujoco_model.geom("palm")
        touch = contacts.sphere_on_box(table, data.geom_xpos[palm.id], palm.size[0])
        parts.append(constraints.contact_rows(data, centers, touch, self.palm_on_table))
        fingers = self.hands(data)
        for finger, kind in zip(fingers, self.finger_on_table, strict=True):
            parts.append(constraints.contact_rows(data, centers, contacts.box_on_table(table, finger), kind))
        if self.has_object:
            position, rotation = data.xpos[-1], data.xmat[-1]
            if self.task.puck:
                on_ground = contacts.puck_on_ground(table, position, rotation, model.PUCK_RADIUS, model.PUCK_HALF_HEIGHT)
                on_fingers = [contacts.box_on_puck(finger, position, rotation, model.PUCK_RADIUS, model.PUCK_HALF_HEIGHT) for finger in fingers]
            else:
                cube = contacts.Box(position, rotation, jnp.asarray(model.CUBE_HALF))
                on_ground = contacts.box_on_ground(table, cube)
                on_fingers = [contacts.box_on_box(finger, cube) for finger in fingers]
            parts.append(constraints.contact_rows(data, centers, on_ground, self.thing_on_ground))
            for touch, kind in zip(on_fingers, self.finger_on_thing, strict=True):
                parts.append(constraints.contact_rows(data, centers, touch, kind))
        return constraints.stack(*parts)

    def capsule(self, data: mjx.Data, name: str) -> contacts.Capsule:
        """A capsule of the robot where it is now."""
        geom = self.mujoco_model.geom(name)
        return contacts.Capsule(data.geom_xpos[geom.id], data.geom_xmat[geom.id][:, 2] * geom.size[1], geom.size[0])

    def hands(self, data: mjx.Data) -> list[contacts.Box]:
        """The two fingers where they are now, or the block of both."""
        geoms = [self.mujoco_model.geom(name) for name in model.FINGERS]
        boxes = [contacts.Box(data.geom_xpos[geom.id], data.geom_xmat[geom.id], jnp.asarray(geom.size, jnp.float32)) for geom in geoms]
        if not self.one_hand:
            return boxes
        right, left = geoms
        half = np.array(right.size) + np.abs(np.array(right.pos) - np.array(left.pos)) / 2
        return [contacts.Box((boxes[0].center + boxes[1].center) / 2, boxes[0].rotation, jnp.asarray(half, jnp.float32))]

    def substep(self, motion: Motion, target: jax.Array, target_quaternion: jax.Array, grasp: jax.Array) -> Motion:
        """One physics step with the mocap body at the target pose and the fingers' servos at `grasp` [2] (m)."""
        data, inertia, force = self.dynamics(motion)
        rows = self.rows(data, target, target_quaternion)
        if not self.task.blocks_fingers:
            force = force.at[self.fingers].add(FINGER_GAIN * (grasp - motion.position[self.fingers]))
        acceleration, constraint_force = solver.solve(inertia, force, rows, motion.acceleration, self.task.solver_steps)
        damped = solver.cholesky(inertia + jnp.diag(self.damping))
        velocity = motion.velocity + self.setting.timestep * solver.cholesky_solve(damped, force + constraint_force)
        return Motion(integrate(motion.position, velocity, self.setting.timestep), velocity, acceleration)

    def control_step(self, motion: Motion, gripper: jax.Array, quaternion: jax.Array, action: jax.Array) -> Motion:
        """One step of 40 ms under an action [4] in [-1, 1]: the displacement in units of 5 cm from the gripper's pose, and the opening of the
        fingers."""
        target = gripper + 0.05 * action[:3]
        target_quaternion = quaternion + GRIPPER_TURN
        target_quaternion = target_quaternion / jnp.sqrt((target_quaternion**2).sum())
        grasp = jnp.clip(motion.position[self.fingers] + action[3], 0.0, 0.2)  # No servo drives fingers that are kept closed.
        motion = jax.lax.fori_loop(0, self.setting.substeps, lambda _, state: self.substep(state, target, target_quaternion, grasp), motion)
        if self.task.blocks_fingers and not self.one_hand:
            motion = motion.replace(position=motion.position.at[self.fingers].set(0.0))
        return motion


def integrate(position: jax.Array, velocity: jax.Array, time: float) -> jax.Array:
    """The position [nq] after moving for `time` seconds at this velocity [nv]; a free joint at the end has its quaternion turned and normalised."""
    if position.shape == velocity.shape:
        return position + time * velocity
    straight = velocity.shape[0] - 3
    turn = time * velocity[straight:]
    angle = jnp.sqrt((turn**2).sum() + 1e-20)
    half = jnp.concatenate([jnp.cos(angle / 2)[None], jnp.sin(angle / 2) / angle * turn])
    quaternion = constraints.quaternion_product(position[straight:], half)
    return jnp.concatenate([position[:straight] + time * velocity[:straight], quaternion / jnp.sqrt((quaternion**2).sum())])


@functools.cache
def load(task: Task, setting: model.Setting) -> Physics:
    """The physics of a task, made once a process for each setting."""
    return Physics(task, setting)
