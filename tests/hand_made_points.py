"""fetch_reach without physics: a point in the place of the grip, which a hand-written low level drives straight to its
target state.

Everything but the robot, its low level and the pictures is the real thing: goals, records, units, target states, HRAC
over them. The pictures are of a dot where the goal is, the brighter the higher it lies.
"""

from types import SimpleNamespace

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import learners, presets
from infogoal_jax.agents.hrac import HRACConfig
from infogoal_jax.config import StateEncoderConfig, TrainConfig
from infogoal_jax.data.goal_images import grid_positions
from infogoal_jax.envs.fetch.environment import DISTANCE_THRESHOLD, Fetch
from infogoal_jax.envs.fetch.image_goals import ImageGoals, from_data
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.envs.target_states import SubgoalEnv
from infogoal_jax.train.program import Train

SPEED = 0.05
"""Farthest that the point moves in a step along each axis, in m."""
GRID, SPACING = 5, 0.075
IMAGE_SIDE = 16
INTERVAL, EPISODE_LENGTH = 3, 12
LONG_INTERVAL = 5
"""Steps between decisions with which an episode ends within an interval, at the goal or when time is up."""


@flax.struct.dataclass
class PointState:
    """One episode of a point: observation [10], of which the first three numbers are its position."""

    observation: jax.Array
    desired_goal: jax.Array
    time: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    diverged: jax.Array


@flax.struct.dataclass
class Point:
    """A point that goes where it is told, in the place of `Fetch`."""

    task = TASKS["fetch_reach"]
    units, render = Fetch.units, Fetch.render
    action_size = 4
    episode_length = EPISODE_LENGTH

    def begin_anew(self, key: jax.Array, goal: jax.Array) -> PointState:
        """A new episode, from near the start of the grip."""
        position = jnp.array(self.task.start_grip, jnp.float32) + jax.random.uniform(
            key, (3,), jnp.float32, -0.05, 0.05
        )
        false = jnp.zeros((), bool)
        return PointState(jnp.pad(position, (0, 7)), goal, jnp.zeros((), jnp.int32), false, false, false)

    def step(self, state: PointState, action: jax.Array) -> PointState:
        """The first three numbers of the action are the displacement in units of `SPEED`."""
        observation = state.observation.at[:3].add(SPEED * jnp.clip(action[:3], -1.0, 1.0))
        time, terminated = state.time + 1, self.reached(observation[:3], state.desired_goal)
        truncated = (time >= self.episode_length) & ~terminated
        return state.replace(observation=observation, time=time, terminated=terminated, truncated=truncated)

    def achieved(self, state: PointState) -> jax.Array:
        """The position."""
        return state.observation[..., :3]

    def reached(self, record: jax.Array, goal: jax.Array) -> jax.Array:
        """Within 5 cm."""
        return jnp.sqrt(((record - jax.lax.broadcast_to_rank(goal, record.ndim)) ** 2).sum(-1)) < DISTANCE_THRESHOLD


@flax.struct.dataclass
class Straight:
    """The low level: straight to the target state. `gain` stands for its parameters."""

    gain: jax.Array

    def act(self, observation: jax.Array, target: jax.Array) -> jax.Array:
        """Action [..., 4]."""
        return jnp.pad(self.gain * (target - observation[..., :3]) / SPEED, [(0, 0)] * (target.ndim - 1) + [(0, 1)])


def pictures(positions: np.ndarray, low: np.ndarray) -> np.ndarray:
    """uint8 [N, 16, 16, 3] of a dot at each position [N, 3] of a space of 0.3 m from `low` on."""
    place = (positions - low) / 0.3
    pixels = (np.arange(IMAGE_SIDE) + 0.5) / IMAGE_SIDE
    dot = np.exp(
        -(
            (pixels[None, :, None] - place[:, 0, None, None]) ** 2
            + (pixels[None, None, :] - place[:, 1, None, None]) ** 2
        )
        / 0.02
    )
    shaded = dot[..., None] * np.stack([np.ones(len(place)), place[:, 2], 1 - place[:, 2]], axis=-1)[:, None, None]
    return np.round(255 * np.clip(shaded, 0, 1)).astype(np.uint8)


def points(train_backgrounds: np.ndarray | None = None, test_backgrounds: np.ndarray | None = None) -> ImageGoals:
    """The task over a grid of 125 positions, with 4 goals for training and 4 for tests. Backgrounds: uint8 [M, 16, 16,
    3], or noise."""
    low = np.array(TASKS["fetch_reach"].start_grip) - 0.15
    generator = np.random.default_rng(0)
    drawn = (
        low
        + 0.075
        + 0.15 * np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    )
    drawn += generator.uniform(-0.02, 0.02, drawn.shape)
    positions = np.concatenate([grid_positions(low, SPACING, (GRID,) * 3), drawn]).astype(np.float32)
    uses = np.repeat([-1, 0, 2], [GRID**3, 4, 4])
    bank = SimpleNamespace(
        images=pictures(positions, low),
        positions=positions,
        grid_low=low,
        spacing=SPACING,
        grid_shape=(GRID,) * 3,
        describe=lambda: "dots",
    )
    noise = generator.integers(0, 256, (2, 20, IMAGE_SIDE, IMAGE_SIDE, 3)).astype(np.uint8)
    train, test = (
        chosen if chosen is not None else drawn
        for chosen, drawn in zip((train_backgrounds, test_backgrounds), noise, strict=True)
    )
    return from_data(Point(), bank, SimpleNamespace(train=train, test=test, source="noise"), uses)


def steered(env: ImageGoals | None = None, interval: int = INTERVAL) -> SubgoalEnv:
    """The task as HRAC acts in it."""
    env = points() if env is None else env
    return SubgoalEnv(env, Straight(jnp.ones((), jnp.float32)), env.space, interval, HRACConfig.subgoal_scale)


def config(method: str = "infogoal", **changes) -> TrainConfig:
    """A configuration that trains on the points in seconds. Its batches are smaller than the set of goals, as those of
    Fetch are."""
    learner = {"hidden": (64,)} | ({"window": 3, "num_pairs": 64} if method == "infogoal" else {})
    parts = {
        "agent": HRACConfig(interval=INTERVAL, hidden=(64, 64)),
        "learner": learners.registry.entry(method).config(**learner),
    }
    small = parts | {
        "env": FetchConfig(goals="images", episode_length=EPISODE_LENGTH),
        "state_encoder": StateEncoderConfig(features=32),
        "hyper": presets.default_hyperparameters(**parts),
        "num_epochs": 4,
        "epochs_per_evaluation": 2,
        "num_envs": 8,
        "rollout_steps": 26,
        "updates_per_epoch": 5,
        "batch_size": 64,
        "buffer_steps": 2000,
        "evaluation_starts": 2,
    }
    return presets.load("fetch_reach", method, **(small | changes))


def random_params(train: Train) -> dict:
    """Parameters of the sizes that this program's have, drawn at random: compiling the real initialisation takes ten
    seconds."""
    shapes = train.state_shapes.params
    generator = np.random.default_rng(0)
    return jax.tree.map(
        lambda leaf: jnp.asarray(generator.normal(0, 1 / np.sqrt((*leaf.shape[-2:], 1)[0]), leaf.shape), leaf.dtype),
        shapes,
    )
