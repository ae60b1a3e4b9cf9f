"""Training a low level, as pure functions of a key: gradient updates of any agent for target states.

epoch = run every environment for one episode, remember it, scan over updates

And the file of a trained low level: what `infogoal pretrain` writes and HRAC loads. Those of four tasks are shipped
(docs/reference/low_level.md). The header names the task and the widths of the layers, and how it was trained; the
arrays are those of the policy, without critics.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import optax

from infogoal_jax import hyperparameters, networks
from infogoal_jax.agents import td3
from infogoal_jax.agents.hrac import JointLevel, LowLevel, LowLevelConfig, joint_input
from infogoal_jax.envs.fetch.environment import Fetch
from infogoal_jax.envs.fetch.targets import TargetSpace
from infogoal_jax.envs.fetch.tasks import find
from infogoal_jax.errors import UserError, require
from infogoal_jax.field_types import LARGEST_WHOLE
from infogoal_jax.runs import checkpoint
from infogoal_jax.runs.disk import Place, decode

DATA = Path(__file__).parent.parent / "data" / "files"
SHIPPED, SHIPPED_JOINT_LEVEL = DATA / "fetch" / "low_level", DATA / "cube" / "low_level"
KIND = "low level"
INITIAL, COLLECT, UPDATE, EVALUATE = range(4)
"""Purposes for which keys are folded from the seed's key."""


@dataclasses.dataclass(frozen=True)
class PretrainConfig:
    """What decides the compiled program of a low level's training, whatever it drives."""

    task: str
    """Name of the task."""
    num_envs: int = 1024
    """Episodes in an epoch, side by side."""
    num_epochs: int = 60
    """Epochs: each runs one episode in every environment, then updates."""
    updates_per_epoch: int = 1000
    """Gradient updates in an epoch."""
    batch_size: int = 2048
    """Transitions in an update [RL-Zoo]."""
    network: LowLevelConfig = dataclasses.field(default_factory=LowLevelConfig)
    """Sizes of the networks."""
    hyper: Any = None
    """Default values of the compiled program's arguments."""

    def __post_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, int) and not isinstance(value, bool):
                require(value > 0, field.name, value, "give a whole number greater than 0")
        require(
            self.num_epochs * self.updates_per_epoch <= LARGEST_WHOLE,
            "num_epochs * updates_per_epoch",
            self.num_epochs * self.updates_per_epoch,
            f"updates are numbered; give at most {LARGEST_WHOLE} together",
        )
        require(
            len(self.network.hidden) > 0 and all(width > 0 for width in self.network.hidden),
            "network.hidden",
            self.network.hidden,
            "give widths greater than 0, for example 256 256 256",
        )
        object.__setattr__(self, "hyper", hyperparameters.checked(self.hyper))


class TargetAgent(NamedTuple):
    """An agent that learns to drive to target states: what differs between one robot and another.

    initial(key, hyper) -> (params, experience): parameters are trained by gradient, experience is what they are trained
    on.
    policy(params, experience) -> low level, a pytree with `act(observation, target) -> action`.
    run(low_level, key, explores, hyper) -> (rows, metrics): an episode in every environment, with noise to learn from,
    or (explores False) without. remember(experience, rows, number) -> experience: with the rows of this epoch.
    draw(experience, key, number, hyper) -> (batches, keys): of all updates of this epoch, leaves [U, ...], and the key
    [U] of each. loss(params, target_params, experience, batch, key, hyper) -> (loss, metrics).
    learning_rate(hyper, update) -> float32: Adam's step at this update, counted from 0 over all epochs.
    key(key, purpose, number) -> the seed's key for `INITIAL`, `COLLECT`, `UPDATE` or `EVALUATE` and a number, such as
    that of the epoch.
    curve: metrics of an epoch that are written down; measured: those of `run` at the end; compared: by which of these,
    in this order, a low level is better than another.
    describe(report) -> what a low level reached, in words; header: what its file says beside.
    num_measured: episodes of a run without exploration that count.
    """

    config: PretrainConfig
    initial: Callable[..., tuple[dict, Any]]
    policy: Callable[[dict, Any], Any]
    run: Callable[..., tuple[Any, dict[str, jax.Array]]]
    remember: Callable[..., Any]
    draw: Callable[..., tuple[Any, jax.Array]]
    loss: Callable[..., tuple[jax.Array, dict[str, jax.Array]]]
    learning_rate: Callable[..., jax.Array]
    key: Callable[..., jax.Array]
    curve: tuple[str, ...]
    measured: tuple[str, ...]
    compared: tuple[str, ...]
    describe: Callable[[dict], str]
    header: dict[str, Any]
    num_measured: int


@flax.struct.dataclass
class PretrainState:
    """What training carries from epoch to epoch, for one seed."""

    params: dict
    target_params: dict
    optimizer_state: Any
    experience: Any
    key: jax.Array


class Trainer(NamedTuple):
    """The functions that a low level's training is made of, all pure: vmap them over seeds or hyperparameters.

    initial(key, hyper) -> state; policy(state) -> low level.
    learn(state, rows, number, hyper) -> (state, metrics): an epoch's updates, with the rows of `TargetAgent.run`.
    """

    agent: TargetAgent
    initial: Callable[[jax.Array, Any], PretrainState]
    policy: Callable[[PretrainState], Any]
    learn: Callable[..., tuple[PretrainState, dict[str, jax.Array]]]


def make_trainer(agent: TargetAgent) -> Trainer:
    """The training program of an agent for target states."""
    optimizer, num_updates = optax.scale_by_adam(), agent.config.updates_per_epoch

    def initial(key, hyper) -> PretrainState:
        params, experience = agent.initial(key, hyper)
        return PretrainState(params, params, optimizer.init(params), experience, key)

    def policy(state: PretrainState):
        return agent.policy(state.params, state.experience)

    def learn(state: PretrainState, rows, number, hyper):
        experience = agent.remember(state.experience, rows, number)
        batches, keys = agent.draw(experience, state.key, number, hyper)

        def update(carry, drawn):
            params, target_params, optimizer_state = carry
            batch, key, count = drawn
            gradient, metrics = jax.grad(agent.loss, has_aux=True)(params, target_params, experience, batch, key, hyper)
            direction, optimizer_state = optimizer.update(gradient, optimizer_state)
            rate = agent.learning_rate(hyper, count)
            params = jax.tree.map(lambda leaf, by: leaf - rate * by, params, direction)
            return (
                params,
                optax.incremental_update(params, target_params, hyper.target_rate),
                optimizer_state,
            ), metrics

        drawn = batches, keys, number * num_updates + jnp.arange(num_updates, dtype=jnp.int32)
        carry, metrics = jax.lax.scan(update, (state.params, state.target_params, state.optimizer_state), drawn)
        params, target_params, optimizer_state = carry
        return PretrainState(params, target_params, optimizer_state, experience, state.key), jax.tree.map(
            jnp.mean, metrics
        )

    return Trainer(agent, initial, policy, learn)


@dataclasses.dataclass(frozen=True)
class LowLevelHeader:
    """What is read of the header. kind: of checkpoint; hidden: widths of the layers; joints, moves: of an arm."""

    kind: str = ""
    task: str = ""
    hidden: tuple[int, ...] = ()
    joints: int = 0
    moves: int = 0

    def __post_init__(self):
        sizes = all(0 < width <= 2**14 for width in self.hidden) and len(self.hidden) <= 16
        require(sizes, "hidden", self.hidden, "should be widths of layers, from 1 to 16,384, of 16 layers at most")
        require(0 <= self.joints <= 1000, "joints", self.joints, "should be from 0 to 1,000")
        require(0 <= self.moves <= 1000, "moves", self.moves, "should be from 0 to 1,000")


def shipped(task: str) -> Path:
    """The file of the low level that the project ships for a task. Raises `UserError` for an unknown task, or one that
    has none."""
    path = SHIPPED / find(task).name
    if not path.exists():
        known = ", ".join(sorted(file.name for file in SHIPPED.glob("fetch_*")))
        raise UserError(f"low_level = '': no low level is shipped for {task}; give the file of one. Shipped: {known}")
    return path


def save(path: Path, header: dict[str, Any], low_level: LowLevel | JointLevel) -> None:
    """Write a low level. header: JSON values, `task` among them, and `joints` and `moves` of an arm that is moved by
    joint steps."""
    checkpoint.save(path, {"kind": KIND, **header, "hidden": list(low_level.hidden)}, low_level)


def load(path: str, task: str) -> LowLevel:
    """The low level of a Fetch task from its file, or from the folder that it was trained in; empty: the shipped one.

    Raises `UserError` for a file that is missing, damaged, something else, of another task, or of other shapes.
    """
    return load_with_header(path, task)[1]


def load_with_header(path: str, task: str) -> tuple[dict[str, Any], LowLevel]:
    """The header and the low level, as `load` reads them."""
    return read(Path(path) if path else shipped(task), task, lambda header: empty(task, header.hidden))


def load_joint_level(
    path: str, num_joints: int, num_moves: int, task: str = "object_manipulation"
) -> tuple[dict[str, Any], JointLevel]:
    """The header and the low level of an arm with so many joints and moves, from a file as `load` takes it."""
    file = Path(path) if path else SHIPPED_JOINT_LEVEL

    def empty_joint_level(header):
        if (header.joints, header.moves) != (num_joints, num_moves):
            raise UserError(
                f"low_level = {str(file)!r}: is of an arm with {header.joints} joints and {header.moves} moves, "
                f"the dataset's has {num_joints} and {num_moves}; train one with `infogoal pretrain {task} "
                "--env.dataset FILE`, give it with --agent.low-level"
            )
        hidden, joints = header.hidden, jnp.zeros(num_joints, jnp.float32)
        params = jax.eval_shape(networks.MLP(hidden, num_moves).init, jax.random.key(0), joint_input(joints, joints))
        return JointLevel(params, hidden, num_moves)

    return read(file, task, empty_joint_level)


def read(file: Path, task: str, empty: Callable[[LowLevelHeader], Any]) -> tuple[dict[str, Any], Any]:
    """The header, with the checksum of the file in it, and the low level of a task, whose shapes are those of
    `empty(header)`."""
    file = file / "low_level" if file.is_dir() else file
    if not file.exists():
        raise UserError(
            f"low_level = {str(file)!r}: there is no such file; give one that `infogoal pretrain {task}` wrote, or "
            "none at all for the shipped one"
        )
    header, payload = checkpoint.read_header(file)
    about = decode(LowLevelHeader, header, Place(file, remedy=checkpoint.REMEDY))
    if about.kind != KIND:
        raise UserError(
            f"low_level = {str(file)!r}: is a checkpoint of something else; give a file that `infogoal pretrain "
            f"{task}` wrote"
        )
    if about.task != task:
        raise UserError(
            f"low_level = {str(file)!r}: is of the task {about.task!r}, not {task!r}; give one of `infogoal "
            f"pretrain {task}`"
        )
    template = empty(about)
    try:
        content = checkpoint.checksum({"format": checkpoint.FORMAT, **header}, payload)
        return header | {"sha256": content}, jax.device_put(checkpoint.arrays(file, payload, template))
    except UserError as error:
        raise UserError(
            f"low_level = {str(file)!r}: its arrays have other shapes than {task} needs; train again with `infogoal "
            f"pretrain {task}`"
        ) from error


def empty(task: str, hidden: tuple[int, ...]) -> LowLevel:
    """Shapes of the low level of a task, with layers of these widths."""
    robot = Fetch(task=find(task), physics=None, episode_length=0, ends_at_goal=False)  # Asked for its sizes only.
    observation, inputs = (
        jax.ShapeDtypeStruct((size,), jnp.float32)
        for size in (robot.observation_size, robot.observation_size + TargetSpace(robot.task).size)
    )
    actor = jax.eval_shape(lambda x: td3.Actor(hidden, robot.action_size).init(jax.random.key(0), x), inputs)
    return LowLevel(actor, observation, observation, hidden, robot.action_size)
