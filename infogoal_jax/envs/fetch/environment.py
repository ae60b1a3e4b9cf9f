"""The Fetch tasks as environments: control, observation, resets, goals and success of Gymnasium-Robotics, version 4
(FetchReach, FetchPush, ...).

A record of pure functions over the state of one robot; batch it with `jax.vmap`. Goals are positions here, [3] in m.
"""

import dataclasses
from functools import partial

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.envs.environment import Environment
from infogoal_jax.envs.fetch import model, physics
from infogoal_jax.envs.fetch.physics import Motion, Physics, Pose
from infogoal_jax.envs.fetch.tasks import FetchConfig, Task, find
from infogoal_jax.goals import GoalBox
from infogoal_jax.keys import draw_chance, from_seed
from infogoal_jax.shapes import aligned, with_rank

DISTANCE_THRESHOLD = 0.05
"""Distance, in m, below which a goal is reached."""
NEAREST_START = 0.1
"""Smallest distance of the object's start from the grip along the table, in m."""
HIGHEST_GOAL = 0.45
"""Largest height of a goal in the air above the object's start, in m."""
LATE = 0.002
"""Delay, in s, of the positions in observations where fingers move: the reference reads them one substep late."""
WORLD = 5.0
"""Distance from the robot's base, in m, beyond which the simulation counts as diverged."""
POSITION_SCALE = 0.1
"""Unit, in m, of positions relative to the grip's start in the input of networks."""
VELOCITY_SCALE = 0.02
"""Unit, in m, of velocities times 40 ms in the input of networks. A gripper at full speed moves twice as far in a
step."""
FINGER_SCALE = 0.05
"""Unit, in m, of the fingers' opening in the input of networks: the widest opening."""
FASTEST = 1000.0
"""Speed (m/s or rad/s) beyond which the simulation counts as diverged. A puck that slips from under the fingers may
spin at a few hundred."""


def distances(record: jax.Array, goal: jax.Array) -> jax.Array:
    """Metres between positions [..., 3], float32 [...]. One of them may lack leading axes of the other."""
    record, goal = aligned(record, goal)
    return jnp.sqrt(((record - goal) ** 2).sum(-1))


@dataclasses.dataclass(frozen=True)
class GoalsOf:
    """Draws the goals of a task as the reference does."""

    task: Task

    def __call__(self, key: jax.Array) -> jax.Array:
        """A goal [3] in m."""
        around, height_key, air_key = jax.random.split(key, 3)
        task = self.task
        goal = jnp.array(task.start_grip, jnp.float32) + jax.random.uniform(
            around, (3,), jnp.float32, minval=-task.goal_range, maxval=task.goal_range
        )
        if task.object_height is None:
            return goal
        lifted = (
            draw_chance(air_key, 0.5).astype(jnp.float32)
            * jax.random.uniform(height_key, dtype=jnp.float32, maxval=HIGHEST_GOAL)
            if task.goals_in_air
            else 0.0
        )
        return jnp.array([goal[0] + task.goal_offset, goal[1], task.object_height + lifted], jnp.float32)


@dataclasses.dataclass(frozen=True)
class Seen:
    """What the goal encoder sees of the goals of a task."""

    task: Task

    def __call__(self, goals: jax.Array) -> jax.Array:
        """Goals of one position or two, [..., 3 or 6] in m, relative to the start of the grip, in units of 10 cm."""
        grip = jnp.tile(jnp.asarray(self.task.start_grip, jnp.float32), goals.shape[-1] // 3)
        return (goals - with_rank(grip, goals.ndim)) / POSITION_SCALE


@dataclasses.dataclass(frozen=True)
class InOctant:
    """Whether a goal of a task lies ahead, to the left and above the middle of all goals: there it is held out. middle:
    in m, -inf along an axis on which goals do not vary, as the height of those on the table."""

    middle: tuple[float, ...]

    def __call__(self, goal: jax.Array) -> jax.Array:
        """bool [] of a goal [3] in m."""
        return (goal > jnp.asarray(self.middle, jnp.float32)).all(-1)


@flax.struct.dataclass
class FetchState:
    """One episode. `terminated` and `truncated` are never both set."""

    motion: Motion
    """State of the simulation."""
    observation: jax.Array
    """float32 [10 or 25]."""
    gripper: jax.Array
    """float32 [3] in m, position that the next action starts from."""
    gripper_quaternion: jax.Array
    """float32 [4], orientation that the next action starts from."""
    desired_goal: jax.Array
    """float32 [3] in m."""
    time: jax.Array
    """int32, steps so far."""
    terminated: jax.Array
    """bool, the goal is reached."""
    truncated: jax.Array
    """bool, the time is up, or the simulation diverged."""
    diverged: jax.Array
    """bool, the simulation diverged, and the last step was taken back."""


@flax.struct.dataclass
class Fetch(Environment):
    """A Fetch task: pure functions over `FetchState`. A pytree without leaves: its constants are compiled in."""

    task: Task = flax.struct.field(pytree_node=False)
    physics: Physics = flax.struct.field(pytree_node=False)
    episode_length: int = flax.struct.field(pytree_node=False)
    ends_at_goal: bool = flax.struct.field(pytree_node=False)
    goals: GoalBox | None = None
    """Positions in m; None in the robot of a task with goal images."""

    action_size = 4
    discrete = False
    source = "MJX physics of the Fetch robot"

    @property
    def observation_size(self) -> int:
        """10 numbers without an object, 25 with one."""
        return 10 if self.task.object_height is None else 25

    @property
    def workspace(self) -> np.ndarray:
        """Lowest and highest corner of the space that goals may lie in, [2, 3] in m: over the table."""
        table = model.table_of(self.task)
        return np.array([[*table[0, :2], 0.35], [*table[1, :2], 0.95]])

    def reset(self, key: jax.Array) -> FetchState:
        """A new episode with a new goal and object position, drawn as in the reference."""
        goal_key, object_key = jax.random.split(key)
        return self.begin_anew(object_key, self.sample_goal(goal_key))

    def reset_to(self, key: jax.Array, goal: jax.Array) -> FetchState:
        """A new episode for this goal [3] (m). Raises `UserError` for a goal outside of the goal space, unless it is
        traced."""
        goal = goal if self.goals is None else self.goals.checked(goal, "goal", axes=0)
        return self.begin_anew(key, jnp.asarray(goal, jnp.float32))

    def sample_goal(self, key: jax.Array) -> jax.Array:
        """A goal [3] (m): a training goal, or as the reference draws it where the robot knows no goal space."""
        return GoalsOf(self.task)(key) if self.goals is None else self.goals.draw(key)

    def sample_object(self, key: jax.Array) -> jax.Array:
        """Draw the object's start, [2] in m: uniform in a square around the grip, but not near it.

        The reference draws until a place is far enough. Of 128 draws one is, but for one episode in 10^13 of
        fetch_slide; the last stands then.
        """
        reach = self.task.object_range
        places = jax.random.uniform(key, (128, 2), jnp.float32, minval=-reach, maxval=reach)
        far = jnp.sqrt((places**2).sum(-1)) >= NEAREST_START
        return (
            jnp.array(self.task.start_grip[:2], jnp.float32)
            + places[jnp.where(far.any(), jnp.argmax(far), len(places) - 1)]
        )

    def begin_anew(self, key: jax.Array, goal: jax.Array) -> FetchState:
        """A new episode for this goal [3] (m), without a check of the goal."""
        motion = self.physics.start()
        if self.task.object_height is not None:
            motion = self.physics.place_object(motion, self.sample_object(key))
        return self._first(motion, self.physics.start_pose(motion), goal)

    def begin(self, motion: Motion, goal: jax.Array) -> FetchState:
        """An episode that starts from this motion."""
        return self._first(motion, self.physics.pose(motion, 0.0), goal)

    def _first(self, motion: Motion, pose: Pose, goal: jax.Array) -> FetchState:
        false = jnp.zeros((), bool)
        return FetchState(
            motion=motion,
            observation=self._observation(motion, pose),
            gripper=pose.gripper,
            gripper_quaternion=pose.gripper_quaternion,
            desired_goal=goal,
            time=jnp.zeros((), jnp.int32),
            terminated=false,
            truncated=false,
            diverged=false,
        )

    def step(self, state: FetchState, action: jax.Array) -> FetchState:
        """40 ms under an action [4] in [-1, 1]: displacement of the gripper in units of 5 cm, and opening of the
        fingers.

        A step that diverges is undone: the state stays finite, and the episode is truncated and marked as diverged.
        """
        motion = self.physics.control_step(
            state.motion, state.gripper, state.gripper_quaternion, jnp.clip(action, -1.0, 1.0)
        )
        pose = self.physics.pose(motion, 0.0 if self.task.blocks_fingers else LATE)
        observation = self._observation(motion, pose)
        finite = jnp.isfinite(
            jnp.concatenate([motion.position, motion.velocity, motion.acceleration, observation])
        ).all()
        diverged = ~(finite & (jnp.abs(motion.position) < WORLD).all() & (jnp.abs(motion.velocity) < FASTEST).all())
        moved = motion, observation, pose.gripper, pose.gripper_quaternion
        kept = state.motion, state.observation, state.gripper, state.gripper_quaternion
        motion, observation, gripper, quaternion = jax.tree.map(partial(jax.lax.select, diverged), kept, moved)
        state = state.replace(motion=motion, observation=observation, gripper=gripper, gripper_quaternion=quaternion)
        time = state.time + 1
        terminated = self.ends_at_goal & ~diverged & self.reached(self.achieved(state), state.desired_goal)
        return state.replace(
            time=time,
            terminated=terminated,
            truncated=((time >= self.episode_length) | diverged) & ~terminated,
            diverged=diverged,
        )

    def observe(self, state: FetchState) -> jax.Array:
        """The stored observation: all of it, float32 [10 or 25]."""
        return state.observation

    def render(self, observation: jax.Array) -> jax.Array:
        """The input of the network: the observation, centred and scaled so that each number is of the order of 1."""
        centre, scale = (with_rank(jnp.asarray(unit, jnp.float32), observation.ndim) for unit in self.units)
        return (observation - centre) / scale

    @property
    def units(self) -> tuple[np.ndarray, np.ndarray]:
        """Centre and scale of each number of an observation, [10 or 25]: positions relative to the start of the grip,
        velocities unchanged."""
        grip = np.array(self.task.start_grip)
        if self.task.object_height is None:
            blocks = [(grip, POSITION_SCALE), (np.zeros(2), FINGER_SCALE), (np.zeros(5), VELOCITY_SCALE)]
        else:
            thing = np.array([*grip[:2], self.task.object_height])
            blocks = [
                (grip, POSITION_SCALE),
                (thing, POSITION_SCALE),
                (np.zeros(3), POSITION_SCALE),
                (np.zeros(2), FINGER_SCALE),
                (np.zeros(3), 1.0),
                (np.zeros(11), VELOCITY_SCALE),
            ]
        return np.concatenate([centre for centre, _ in blocks]), np.concatenate(
            [np.full(len(centre), scale) for centre, scale in blocks]
        )

    def achieved(self, state: FetchState) -> jax.Array:
        """The record of what was achieved: position [3] of the object, or of the grip without one (m)."""
        return state.observation[..., :3] if self.task.object_height is None else state.observation[..., 3:6]

    def reached(self, record: jax.Array, goal: jax.Array) -> jax.Array:
        """Whether the position is at the goal, bool [...], for records and goals [..., 3]."""
        return distances(record, goal) < DISTANCE_THRESHOLD

    def reward(self, record: jax.Array, goal: jax.Array) -> jax.Array:
        """The reference's sparse reward: 0 at the goal and -1 elsewhere, float32 [...]."""
        return -(distances(record, goal) > DISTANCE_THRESHOLD).astype(jnp.float32)

    def _observation(self, motion: Motion, pose: Pose) -> jax.Array:
        """The reference's vector: grip, object, object - grip, fingers, object's Euler angles, its velocities
        (relative) and turning, the grip's velocity and the fingers', velocities times 40 ms."""
        step = model.CONTROL_STEP
        fingers, finger_velocity = self.physics.finger_state(motion)
        grip_velocity = step * pose.grip_velocity
        if self.task.object_height is None:
            return jnp.concatenate([pose.grip, fingers, grip_velocity, step * finger_velocity])
        return jnp.concatenate(
            [
                pose.grip,
                pose.thing,
                pose.thing - pose.grip,
                fingers,
                euler_angles(pose.thing_rotation),
                step * pose.thing_velocity - grip_velocity,
                step * pose.thing_turning,
                grip_velocity,
                step * finger_velocity,
            ]
        )


def euler_angles(rotation: jax.Array) -> jax.Array:
    """Angles [3] about x, y and z (rad) of a rotation matrix [3, 3], in the reference's convention (mat2euler)."""
    across = jnp.sqrt(rotation[2, 2] ** 2 + rotation[1, 2] ** 2)
    # Else the object stands on end, and x and z turn it about the same axis. The reference's bound is for float64.
    regular = across > 4e-6
    about_x = jnp.where(regular, -jnp.arctan2(rotation[1, 2], rotation[2, 2]), 0.0)
    about_y = -jnp.arctan2(-rotation[0, 2], across)
    about_z = jnp.where(
        regular, -jnp.arctan2(rotation[0, 1], rotation[0, 0]), -jnp.arctan2(-rotation[1, 0], rotation[1, 1])
    )
    return jnp.stack([about_x, about_y, about_z])


def make(name: str, config: FetchConfig) -> Fetch:
    """The environment of a Fetch task. Raises `UserError` for an unknown name."""
    config.check(None)
    task = find(name)
    setting = model.FAITHFUL if config.faithful else model.FAST
    return Fetch(
        task=task,
        physics=physics.load(task, setting),
        episode_length=config.episode_length,
        ends_at_goal=config.ends_at_goal,
    )


def with_positions(robot: Fetch, held_out: str) -> Fetch:
    """The robot with positions as goals, drawn as in the reference. held_out: as in `FetchConfig`."""
    sampler, use_of = GoalsOf(robot.task), None
    if held_out == "octant":
        with jax.ensure_compile_time_eval():
            drawn = np.asarray(jax.jit(jax.vmap(sampler))(jax.random.split(from_seed(0), 512)))
        low, high = drawn.min(0), drawn.max(0)
        use_of = InOctant(tuple(np.where(high > low, (low + high) / 2, -np.inf).tolist()))
    goals = GoalBox.of(*robot.workspace, sampler=sampler, use_of=use_of, seen=Seen(robot.task))
    return robot.replace(goals=goals)
