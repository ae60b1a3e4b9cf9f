"""The low level of an arm that is moved by single joint steps: double Q-learning over the recorded moves, towards
target states of the joints.

All moves of the dataset are known, so there is nothing to collect: each update draws moves uniformly, and for each of
them a target state. An epoch's episodes only measure.
"""

import dataclasses
from typing import Annotated

import flax.struct
import jax
import jax.numpy as jnp
import optax

from infogoal_jax import networks
from infogoal_jax.agents import dqn
from infogoal_jax.agents.hrac import JointLevel, LowLevelConfig, joint_input, joint_values
from infogoal_jax.angles import wrapped
from infogoal_jax.envs.object_manipulation import ObjectManipulation, ObjectManipulationConfig
from infogoal_jax.errors import require
from infogoal_jax.hyperparameters import Number
from infogoal_jax.keys import fold
from infogoal_jax.low_level.trainer import COLLECT, EVALUATE, INITIAL, UPDATE, PretrainConfig, TargetAgent

NEAR, FARTHEST = jnp.pi / 4, jnp.pi / 2
"""Target states lie up to this far from each joint when measured, as HRAC's subgoals do, and when trained (radians)."""
MOST_MOVES = 12
"""Moves in an episode."""


@flax.struct.dataclass
class JointHyperparameters:
    """Floats of the low level's training: an argument of the compiled program."""

    learning_rate: Annotated[float, Number("(0, 1]")] = 1e-3
    """Step of Adam at the start; it falls to 0."""
    discount: Annotated[float, Number("[0, 1)")] = 0.9
    """Discount of a step."""
    target_rate: Annotated[float, Number("(0, 1]")] = 0.02
    """Share by which the target network follows at each update."""


@dataclasses.dataclass(frozen=True)
class JointPretrainConfig(PretrainConfig):
    """Train the low level of object manipulation (docs/reference/object_manipulation.md)."""

    task: str = "object_manipulation"
    """Name of the task."""
    num_envs: int = 1000
    """Episodes that measure each epoch, side by side."""
    num_epochs: int = 30
    """Epochs: each measures one episode in every environment, then updates."""
    updates_per_epoch: int = 500
    """Gradient updates in an epoch."""
    batch_size: int = 512
    """Moves in an update."""
    network: LowLevelConfig = dataclasses.field(default_factory=lambda: LowLevelConfig((128, 128)))
    """Sizes of the network."""
    hyper: JointHyperparameters = dataclasses.field(default_factory=JointHyperparameters)
    """Default values of the compiled program's arguments."""
    env: ObjectManipulationConfig = dataclasses.field(default_factory=ObjectManipulationConfig)
    """The dataset whose moves it learns."""

    def __post_init__(self):
        super().__post_init__()
        require(
            self.task == "object_manipulation",
            "task",
            self.task,
            "is driven by no joint steps; give object_manipulation",
        )
        self.env.check(self)


def half_step(env: ObjectManipulation) -> jax.Array:
    """How near joints have to be to a target state, each: half of the smallest step that a move makes, radians."""
    change = jnp.abs(wrapped(env.joints[env.next_node] - env.joints[:, None]))
    return 0.5 * jnp.where(change > 1e-4, change, jnp.inf).min()


def at_target(joints: jax.Array, target: jax.Array, precision: jax.Array) -> jax.Array:
    """Whether all joints [..., J] are at their target [..., J], bool [...]."""
    return (jnp.abs(wrapped(target - joints)) < precision).all(-1)


def draw_targets(key: jax.Array, joints: jax.Array) -> jax.Array:
    """Target states [B, J] for these joints [B, J]: up to `FARTHEST` away, and often much nearer, so that values spread
    outwards."""
    reach_key, turn_key = jax.random.split(key)
    reach = FARTHEST * jax.random.uniform(reach_key, (len(joints), 1), jnp.float32)
    return wrapped(joints + reach * jax.random.uniform(turn_key, joints.shape, minval=-1.0, dtype=jnp.float32))


def key_of(key: jax.Array, purpose: int, number: jax.Array) -> jax.Array:
    """A seed's key for a purpose and a number. Updates are numbered over all epochs, and parameters not at all."""
    folded = fold(key, (INITIAL, UPDATE, COLLECT, EVALUATE).index(purpose))
    return folded if purpose == INITIAL else fold(folded, number)


def make(config: JointPretrainConfig, env: ObjectManipulation) -> TargetAgent:
    """The agent that learns the target states of the arm in this environment. Raises `UserError` for a dataset without
    joints."""
    require(
        env.joints.shape[1] > 0,
        "env.dataset",
        config.env.dataset,
        "tells no joint angles: import it with columns joint_NAME",
    )
    joints, next_node, num_moves, precision = env.joints, env.next_node, env.action_size, half_step(env)
    hidden, num_updates = config.network.hidden, config.updates_per_epoch

    def initial(key, hyper):
        return networks.MLP(hidden, num_moves).init(key_of(key, INITIAL, 0), joint_input(joints[0], joints[0])), ()

    def policy(params, experience) -> JointLevel:
        return JointLevel(params, hidden, num_moves)

    def run(low_level: JointLevel, key, explores, hyper):
        """Nothing is explored. `success_rate`: share of the joints that reach a target state up to `NEAR` away, of
        those that some setting of the joints is at; `mean_moves`: in how many moves these do.
        """
        frame_key, target_key = jax.random.split(key)
        frame = jax.random.randint(frame_key, (config.num_envs,), 0, len(joints), jnp.int32)
        turn = jax.random.uniform(
            target_key, (config.num_envs, joints.shape[1]), minval=-NEAR, maxval=NEAR, dtype=jnp.float32
        )
        target = wrapped(joints[frame] + turn)
        # The joint limits leave some target states out.
        possible = at_target(joints, target[:, None], precision).any(-1)

        def step(carry, number):
            frame, first = carry
            move = low_level.act(env.observe_frame(frame), target)
            frame = jnp.where(first <= number, frame, next_node[frame, move])
            first = jnp.where(at_target(joints[frame], target, precision), jnp.minimum(first, number + 1), first)
            return (frame, first), None

        first = jnp.where(at_target(joints[frame], target, precision), 0, MOST_MOVES + 1)
        (_, first), _ = jax.lax.scan(step, (frame, first), jnp.arange(MOST_MOVES, dtype=jnp.int32))
        reached = (first <= MOST_MOVES) & possible
        moves = jnp.where(reached, first, 0).sum(dtype=jnp.int32).astype(jnp.float32)
        num_reached, num_possible = (found.sum(dtype=jnp.int32).astype(jnp.float32) for found in (reached, possible))
        mean_moves = moves / jnp.maximum(num_reached, 1.0)
        return None, {"success_rate": num_reached / num_possible, "mean_moves": mean_moves}

    def draw(experience, key, number, hyper):
        """Images, moves and target states: [U, B], [U, B] and [U, B, J]."""
        keys = jax.vmap(key_of, in_axes=(None, None, 0))(
            key, UPDATE, number * num_updates + jnp.arange(num_updates, dtype=jnp.int32)
        )

        def one(key):
            frame_key, move_key, target_key = jax.random.split(key, 3)
            frame = jax.random.randint(frame_key, (config.batch_size,), 0, len(joints), jnp.int32)
            move = jax.random.randint(move_key, frame.shape, 0, num_moves, jnp.int32)
            return frame, move, draw_targets(target_key, joints[frame])

        return jax.vmap(one)(keys), keys

    def loss(params, target_params, experience, drawn, key, hyper):
        """Temporal-difference error of double Q-learning: 1 at the target, where an episode ends, and nothing
        elsewhere."""
        frame, move, target = drawn
        here, there = joints[frame], joints[next_node[frame, move]]
        done = at_target(there, target, precision)
        next_values, target_values = (
            joint_values(each, hidden, num_moves, there, target) for each in (params, target_params)
        )
        value = dqn.double_q_target(
            done.astype(jnp.float32),
            hyper.discount * ~done,
            next_values,
            target_values,
            jnp.ones(next_values.shape, bool),
        )
        return dqn.td_loss(joint_values(params, hidden, num_moves, here, target), move, value, huber=False)

    def learning_rate(hyper, update):
        return optax.linear_schedule(hyper.learning_rate, 0.0, config.num_epochs * num_updates)(update)

    return TargetAgent(
        config,
        initial,
        policy,
        run,
        remember=lambda experience, rows, number: (),
        draw=draw,
        loss=loss,
        learning_rate=learning_rate,
        key=key_of,
        curve=("success_rate", "mean_moves", "value", "td_error"),
        measured=("success_rate", "mean_moves"),
        compared=("success_rate",),
        describe=lambda report: (
            "target states up to 45 degrees away in every joint: "
            f"{report['success_rate']:.4f} reached, in {report['mean_moves']:.2f} moves on average"
        ),
        header={"joints": joints.shape[1], "moves": num_moves, "data": env.source},
        num_measured=config.num_envs,
    )
