"""Target states of an arm that is moved by single joint steps: the task that the low level of HRAC is trained on for
object manipulation. The world is the dataset of that task, of which only the joints are looked at."""

import dataclasses

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.angles import on_circles, wrapped
from infogoal_jax.envs.environment import Traits
from infogoal_jax.envs.goal_task import STARTS, Episode, GoalTask
from infogoal_jax.envs.graph import frame_edges
from infogoal_jax.envs.object_manipulation import load_frames
from infogoal_jax.errors import require
from infogoal_jax.field_types import Count, Size
from infogoal_jax.goals import GoalBox
from infogoal_jax.shapes import aligned, with_rank

NEAR, FARTHEST = np.pi / 4, np.pi / 2
"""Target states lie up to this far from each joint in evaluations, as HRAC's subgoals do, and in training (radians)."""


@dataclasses.dataclass(frozen=True)
class JointTargetsConfig:
    """The dataset whose moves are learned, and the length of an episode."""

    dataset: str = ""
    """File of an image dataset with joints (docs/reference/datasets.md); empty: the generated arm with a cube."""
    generator_seed: Count = 0
    """Seed of the generated dataset."""
    physical_limits: bool = False
    """Generate only what the joints of the real arm can reach."""
    episode_length: Size = 20
    """Steps after which an episode is truncated."""


@flax.struct.dataclass
class JointTargets(GoalTask):
    """An arm of J joints turns one of them a step at a time until all are at their targets. Its world is the image,
    int32, of which there are K."""

    joints: jax.Array = flax.struct.field(kw_only=True)
    """float32 [K, J] angles of each image, in radians."""
    next_node: jax.Array = flax.struct.field(kw_only=True)
    """int32 [K, A], the image that each move leads to."""
    source: str = flax.struct.field(pytree_node=False, kw_only=True)
    """The data in words."""

    discrete = True

    @property
    def action_size(self) -> int:
        """Number of moves."""
        return self.next_node.shape[1]

    def begin(self, key: jax.Array) -> jax.Array:
        return jax.random.randint(key, (), 0, len(self.joints), jnp.int32)

    def reset(self, key: jax.Array) -> Episode:
        """A new episode: targets up to `FARTHEST` away, and often much nearer, so that values spread outwards."""
        begin_key, reach_key, turn_key = jax.random.split(key, 3)
        image = self.begin(begin_key)
        reach = FARTHEST * jax.random.uniform(reach_key, (STARTS, 1), jnp.float32)
        turn = jax.random.uniform(turn_key, (STARTS, self.joints.shape[1]), jnp.float32, minval=-1.0)
        goals = wrapped(self.joints[image] + reach * turn)
        away = ~self.reached(self.joints[image], goals)
        return self.episode(image, goals[away.argmax()])

    def reset_to(self, key: jax.Array, goal: jax.Array) -> Episode:
        """A new episode for this target [J], from an image at most `NEAR` away in every joint, or a step if that is
        farther, and not there."""
        turn = jnp.abs(wrapped(with_rank(jnp.asarray(goal, jnp.float32), 2) - self.joints)).max(-1)
        may_start = (turn < max(NEAR, 3 * self.radius)) & (turn >= self.radius)
        drawn = jnp.where(may_start, jax.random.uniform(key, may_start.shape, jnp.float32), -1.0)
        return self.episode(drawn.argmax().astype(jnp.int32), goal)

    def move(self, world: jax.Array, action: jax.Array) -> jax.Array:
        return self.next_node[world, action]

    def observation(self, world: jax.Array) -> jax.Array:
        """The joints [J], in radians."""
        return self.joints[world]

    def render(self, observation: jax.Array) -> jax.Array:
        """The input of the network: cosines and sines of the joints, [..., 2 J]."""
        return on_circles(observation)

    def achieved_goal(self, world: jax.Array) -> jax.Array:
        """The joints [J]."""
        return self.joints[world]

    def reached(self, record: jax.Array, goal: jax.Array) -> jax.Array:
        """Whether each joint [..., J] is nearer to its target [..., J] than half of the smallest step, bool [...]."""
        record, goal = aligned(record, goal)
        return (jnp.abs(wrapped(goal - record)) < self.radius).all(-1)


def traits(config: JointTargetsConfig) -> Traits:
    return Traits(finite_goals=False)


def make(config: JointTargetsConfig) -> JointTargets:
    """Make the task of this configuration. Raises `UserError` for a file that cannot be used, or tells no joints."""
    data = load_frames(config.dataset, config.generator_seed, config.physical_limits)
    require(
        data.joints is not None,
        "env.dataset",
        config.dataset,
        "tells no joint angles: import it with columns joint_NAME",
    )
    next_node, _ = frame_edges(data)
    return from_data(data.joints, next_node, data.describe(data.joints, next_node), config.episode_length)


def from_data(joints: np.ndarray, next_node: np.ndarray, source: str, episode_length: int) -> JointTargets:
    """Make the task of joints [K, J] and the images int32 [K, A] that moves lead to."""
    steps = np.abs(wrapped(joints[next_node] - joints[:, None]))
    turns = steps[steps > 1e-4]
    require(len(turns) > 0, "env.dataset", source, "no move turns a joint: give images of an arm that moves")
    precision = float(0.5 * turns.min())

    def draw(key: jax.Array) -> jax.Array:
        """A target state [J] that some setting of the joints is at."""
        image_key, turn_key = jax.random.split(key)
        image = jax.random.randint(image_key, (), 0, len(joints), jnp.int32)
        most = 0.99 * precision
        turn = jax.random.uniform(turn_key, joints.shape[1:], jnp.float32, minval=-most, maxval=most)
        return wrapped(jnp.asarray(joints, jnp.float32)[image] + turn)

    limits = np.full(joints.shape[1], np.pi)
    return JointTargets(
        goals=GoalBox.of(-limits, limits, sampler=draw, seen=on_circles),
        radius=precision,
        episode_length=episode_length,
        joints=jax.device_put(np.asarray(joints, np.float32)),
        next_node=jax.device_put(np.asarray(next_node, np.int32)),
        source=source,
    )
