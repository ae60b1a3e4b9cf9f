"""The physics of a Fetch task: one control step of 40 ms of one robot, to be batched by `jax.vmap`.

A physics step puts together the multibody dynamics (multibody.py), the shapes that touch (model.py), constraint rows
(constraints.py) and their solver (solver.py). Semi-implicit Euler with joint damping taken implicitly, as in the
reference.
"""

import functools

import flax.struct
import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from infogoal_jax.envs.fetch import constraints, model, solver
from infogoal_jax.envs.fetch.constraints import Limits, RowKinds, Softness, Weld
from infogoal_jax.envs.fetch.contacts import Box
from infogoal_jax.envs.fetch.model import Shapes, joint_of, moving_dofs
from infogoal_jax.envs.fetch.multibody import Axes, Frames, Multibody
from infogoal_jax.envs.fetch.tasks import Task
from infogoal_jax.envs.fetch.vectors import Quaternion, Rotation, Vector, once, vectors

GRIPPER_TURN = np.array([1.0, 0.0, 1.0, 0.0], np.float32)
FINGER_GAIN = 30000.0


@flax.struct.dataclass
class Motion:
    """position [nq], velocity [nv] and, to start the solver from, the last acceleration [nv]; units m, rad, s. frames:
    where the robot's bodies are at this position; `Physics.motion` works them out."""

    position: jax.Array
    velocity: jax.Array
    acceleration: jax.Array
    frames: Frames


@flax.struct.dataclass
class Pose:
    """What the observation is made of: gripper position [3] and quaternion [4], grip position [3] and velocity [3]
    (m/s), object position [3], rotation [3, 3], velocity [3] and angular velocity [3] (rad/s; zeros without an
    object)."""

    gripper: jax.Array
    gripper_quaternion: jax.Array
    grip: jax.Array
    grip_velocity: jax.Array
    thing: jax.Array
    thing_rotation: jax.Array
    thing_velocity: jax.Array
    thing_turning: jax.Array


class Physics:
    """The functions of one task in one setting. Everything it holds is constant and small, so it is compiled into the
    program."""

    def __init__(self, task: Task, setting: model.Setting):
        self.task, self.setting = task, setting
        self.mujoco_model = mj = model.load(task, setting)
        self.has_object = task.object_height is not None
        self.multibody = Multibody(mj, self.has_object, task.start_grip)
        self.joints = self.multibody.joints  # The object's free joint comes after those of the robot.
        self.shapes = Shapes(mj, task, setting)
        self.fingers = slice(self.joints - 2, self.joints)
        self.wrist = joint_of(mj, "wrist_roll")
        self.gripper_place, self.grip_place = (vectors(mj.site(name).pos) for name in ("gripper", "grip"))
        self.damping = np.float32(setting.timestep * mj.dof_damping)
        self.start_frames, self.start_hand = self.start_by_mujoco()
        self.make_constraints()

    def make_constraints(self) -> None:
        """The constants of all constraint rows, in the order in which `rows` lists them."""
        mj, timestep = self.mujoco_model, self.setting.timestep
        weld = Softness(tuple(mj.eq_solref[0]), tuple(mj.eq_solimp[0]), model.REFERENCE_TIMESTEP)
        if timestep != model.REFERENCE_TIMESTEP:
            weld = constraints.lengthened(weld, timestep, model.CONTROL_STEP)
        self.weld = Weld(moving_dofs(mj, mj.body("wrist_roll").id), weld, model.INVERSE_WEIGHT["gripper"])
        limited = np.flatnonzero(mj.jnt_limited).astype(np.int32)
        self.limits = Limits(
            limited,
            mj.jnt_range[limited],
            [
                (
                    Softness(tuple(mj.jnt_solref[joint]), tuple(mj.jnt_solimp[joint]), timestep),
                    model.JOINT_INVERSE_WEIGHT[mj.joint(joint).name],
                )
                for joint in limited
            ],
            mj.nv,
        )
        self.row_kinds = RowKinds(*self.weld.kinds, *self.limits.kinds, *self.shapes.pyramids.kinds)

    def start_by_mujoco(self) -> tuple[Frames, tuple[np.ndarray, ...]]:
        """Where the robot's bodies are at the start of every episode, and the gripper's and the grip's part of its
        `Pose`: constants."""
        mj, data = self.mujoco_model, mujoco.MjData(self.mujoco_model)
        data.qpos[:], data.qvel[: self.joints] = self.start_position(), self.robot_start()[1]
        mujoco.mj_kinematics(mj, data)
        mujoco.mj_comPos(mj, data)
        bodies, moves = mj.jnt_bodyid[: self.joints], np.zeros((3, mj.nv))
        mujoco.mj_jacSite(mj, data, moves, None, mj.site("grip").id)
        frames = Frames(
            Quaternion.of(np.float32(data.xquat[bodies])),
            Rotation.of(np.float32(data.xmat[bodies].reshape(-1, 3, 3))),
            vectors(data.xpos[bodies]),
        )
        gripper, grip = (data.site(name).xpos for name in ("gripper", "grip"))
        hand = gripper, data.xquat[bodies[self.wrist]], grip, moves @ data.qvel
        return frames, tuple(np.float32(part) for part in hand)

    def robot_start(self) -> np.ndarray:
        """Positions and velocities of the robot's joints at the start of every episode, [2, joints]."""
        trunk = model.TRUNK.values() if self.setting.whole_body else ()
        return np.array([*trunk, *zip(*self.task.start, strict=True)][: self.joints]).T

    def start_position(self) -> np.ndarray:
        """The position [nq] at the start of every episode, before the object is placed."""
        thing = [1.25, 0.53, self.task.start_height or self.task.object_height, 1, 0, 0, 0] if self.has_object else []
        return np.concatenate([self.robot_start()[0], thing])

    def start(self) -> Motion:
        """Where every episode starts, before the object is placed."""
        velocity = np.concatenate([self.robot_start()[1], np.zeros(6 * self.has_object)])
        velocity = jnp.asarray(velocity, jnp.float32)
        frames = jax.tree.map(jnp.asarray, self.start_frames)
        return Motion(jnp.asarray(self.start_position(), jnp.float32), velocity, jnp.zeros_like(velocity), frames)

    def motion(self, position: jax.Array, velocity: jax.Array) -> Motion:
        """The motion at any position [nq] and velocity [nv]."""
        position, velocity = jnp.asarray(position, jnp.float32), jnp.asarray(velocity, jnp.float32)
        return Motion(position, velocity, jnp.zeros_like(velocity), self.multibody.frames(position))

    def place_object(self, motion: Motion, place: jax.Array) -> Motion:
        """The motion with the object at rest at a place [2] (m) on the table, or at a position [3]."""
        first = self.joints
        return motion.replace(
            position=motion.position.at[first : first + place.shape[0]].set(place),
            velocity=motion.velocity.at[first:].set(0.0),
        )

    def finger_state(self, motion: Motion) -> tuple[jax.Array, jax.Array]:
        """Positions [2] (m) and velocities [2] (m/s) of the right and the left finger; zero for fingers that are one
        block."""
        if self.shapes.one_hand:
            return jnp.zeros(2, jnp.float32), jnp.zeros(2, jnp.float32)
        return motion.position[self.fingers], motion.velocity[self.fingers]

    def hand(self, frames: Frames) -> tuple[Frames, Vector]:
        """The frame of the wrist, and where the gripper is (m)."""
        hand = frames[self.wrist]
        return hand, hand.point(self.gripper_place)

    def pose(self, motion: Motion, age: float) -> Pose:
        """The pose `age` seconds ago (the reference reads its positions one substep late), with the velocities of now.

        It is worked out from where the bodies are now, their velocities and accelerations: within a micrometre for an
        age of 2 ms.
        """
        turning, moving, *changes = self.multibody.body_rates(
            motion.frames, motion.velocity, self.wrist, changes=age > 0
        )
        hand, gripper = self.hand(motion.frames)

        def aged(now: Vector) -> tuple[Vector, Vector]:
            lever = now - self.multibody.origin
            velocity = moving + turning.cross(lever)
            if not age:
                return now, velocity
            turn_rate, move_rate = changes
            acceleration = move_rate + turn_rate.cross(lever) + turning.cross(velocity)
            return now - velocity * age + acceleration * (0.5 * age**2), velocity - acceleration * age

        gripper, _ = aged(gripper)
        grip, grip_velocity = aged(hand.point(self.grip_place))
        quaternion = hand.quaternion.array
        if age:
            quaternion -= 0.5 * age * (Quaternion(0.0, turning) * hand.quaternion).array
        return Pose(gripper.array, quaternion, grip.array, grip_velocity.array, *self.thing_pose(motion, age))

    def start_pose(self, motion: Motion) -> Pose:
        """The pose of a motion in which the robot is where every episode starts."""
        return Pose(*map(jnp.asarray, self.start_hand), *self.thing_pose(motion, 0.0))

    def thing_pose(self, motion: Motion, age: float) -> tuple[jax.Array, ...]:
        """The object's part of `Pose`, `age` seconds ago."""
        if not self.has_object:
            zero = jnp.zeros(3, jnp.float32)
            return zero, jnp.eye(3, dtype=jnp.float32), zero, zero
        velocity = motion.velocity[self.joints :]
        place = integrate(motion.position[self.joints :], velocity, -age) if age else motion.position[self.joints :]
        rotation = Quaternion.of(place[3:]).rotation()
        return place[:3], rotation.array, velocity[:3], (rotation @ Vector.of(velocity[3:])).array

    def rows(
        self, motion: Motion, axes: Axes, thing: Box | None, target: jax.Array, target_quaternion: jax.Array
    ) -> solver.ConstraintRows:
        """All constraint rows at this position and velocity."""
        frames, origin, pyramids = motion.frames, self.multibody.origin, self.shapes.pyramids
        hand, gripper = self.hand(frames)
        weld, off = self.weld.wrench_and_violation(
            gripper - origin, hand.quaternion, Vector.of(target) - gripper, Quaternion.of(target_quaternion)
        )
        limits, beyond = self.limits.jacobian_and_violation(motion.position)
        touch, depth = pyramids.wrench_and_violation(origin, self.shapes.contacts(frames, thing))
        welded, limited, touching = once((weld, limits, touch))
        jacobian = jnp.concatenate(
            [welded.jacobian(axes) * self.weld.dofs, limited, touching.jacobian(axes) * pyramids.dofs], axis=1
        )
        violation = jnp.concatenate([off, beyond, depth])
        equality = np.arange(len(violation)) < solver.EQUALITIES
        # A weld gives way by the length of all that it is off.
        measure = jnp.where(equality, jnp.sqrt((off**2).sum()), violation)
        return self.row_kinds.rows(jacobian, motion.velocity, violation, measure, equality | (violation < 0))

    def substep(self, motion: Motion, target: jax.Array, target_quaternion: jax.Array, grasp: jax.Array) -> Motion:
        """One physics step with the mocap body at the target pose and the fingers' servos at `grasp` [2] (m)."""
        thing = self.shapes.thing_at(motion.position)
        axes, inertia, force = self.multibody.dynamics(motion.frames, thing, motion.position, motion.velocity)
        rows = self.rows(motion, axes, thing, target, target_quaternion)
        if not self.task.blocks_fingers:
            force = force.at[self.fingers].add(FINGER_GAIN * (grasp - motion.position[self.fingers]))
        acceleration, smoothed = solver.solve(
            inertia, self.damping, force, rows, motion.acceleration, self.task.solver_steps
        )
        velocity = motion.velocity + self.setting.timestep * smoothed
        position = integrate(motion.position, velocity, self.setting.timestep)
        return Motion(position, velocity, acceleration, self.multibody.frames(position))

    def control_step(self, motion: Motion, gripper: jax.Array, quaternion: jax.Array, action: jax.Array) -> Motion:
        """One step of 40 ms under an action [4] in [-1, 1]: the displacement in units of 5 cm from the gripper's pose,
        and the opening of the fingers."""
        target = gripper + 0.05 * action[:3]
        target_quaternion = quaternion + GRIPPER_TURN
        target_quaternion = target_quaternion / jnp.sqrt((target_quaternion**2).sum())
        # No servo drives fingers that are kept closed.
        grasp = jnp.clip(motion.position[self.fingers] + action[3], 0.0, 0.2)
        motion = jax.lax.fori_loop(
            0, self.setting.substeps, lambda _, state: self.substep(state, target, target_quaternion, grasp), motion
        )
        return self.closed(motion) if self.task.blocks_fingers and not self.shapes.one_hand else motion

    def closed(self, motion: Motion) -> Motion:
        """The motion with both fingers where they are closed."""
        opened = (self.multibody.axis * motion.position[: self.joints])[self.fingers]
        frames, hands = motion.frames, self.fingers
        moved = frames.rotation[hands] @ opened
        position = jax.tree.map(lambda leaf, change: leaf.at[hands].add(-change), frames.position, moved)
        return motion.replace(position=motion.position.at[hands].set(0.0), frames=frames.replace(position=position))


def integrate(position: jax.Array, velocity: jax.Array, time: float) -> jax.Array:
    """The position [nq] after moving for `time` seconds at this velocity [nv]; a free joint at the end has its
    quaternion turned and normalised."""
    if position.shape == velocity.shape:
        return position + time * velocity
    straight = velocity.shape[0] - 3
    turn = Vector.of(time * velocity[straight:])
    angle = jnp.sqrt(turn.dot(turn) + 1e-20)
    turned = (
        Quaternion.of(position[straight:]) * Quaternion(jnp.cos(angle / 2), turn * (jnp.sin(angle / 2) / angle))
    ).array
    return jnp.concatenate([position[:straight] + time * velocity[:straight], turned / jnp.sqrt((turned**2).sum())])


@functools.cache
def load(task: Task, setting: model.Setting) -> Physics:
    """The physics of a task, made once a process for each setting."""
    return Physics(task, setting)
