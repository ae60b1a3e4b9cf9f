"""The file of a trained low level: what `infogoal pretrain` writes and HRAC loads. Those of four tasks are shipped
(docs/low_level.md).

The header names the task and the widths of the layers, and how it was trained; the arrays are those of the policy,
without critics.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from infogoal_jax import networks
from infogoal_jax.agents import td3
from infogoal_jax.agents.hrac import JointLevel, LowLevel, joint_input
from infogoal_jax.envs.fetch.environment import Fetch
from infogoal_jax.envs.fetch.targets import TargetSpace
from infogoal_jax.envs.fetch.tasks import find
from infogoal_jax.errors import UserError
from infogoal_jax.runs import checkpoint
from infogoal_jax.runs.disk import Place, decode

DATA = Path(__file__).parent.parent.parent / "data" / "files"
SHIPPED, SHIPPED_JOINT_LEVEL = DATA / "fetch" / "low_level", DATA / "cube" / "low_level"
KIND = "low level"


@dataclasses.dataclass(frozen=True)
class LowLevelHeader:
    """What is read of the header. kind: of checkpoint; hidden: widths of the layers; joints, moves: of an arm."""

    kind: str = ""
    task: str = ""
    hidden: tuple[int, ...] = ()
    joints: int = 0
    moves: int = 0


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
                "the dataset's has "
                f"{num_joints} and {num_moves}; train one with `infogoal pretrain {task} --env.dataset FILE`, give it "
                "with "
                "--agent.low-level"
            )
        hidden, joints = header.hidden, jnp.zeros(num_joints)
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
            "none at all for the "
            "shipped one"
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
        return header | {"sha256": content}, jax.tree.map(jnp.asarray, checkpoint.arrays(file, payload, template))
    except UserError as error:
        raise UserError(
            f"low_level = {str(file)!r}: its arrays have other shapes than {task} needs; train again with `infogoal "
            f"pretrain {task}`"
        ) from error


def empty(task: str, hidden: tuple[int, ...]) -> LowLevel:
    """Shapes of the low level of a task, with layers of these widths."""
    robot = Fetch(task=find(task), physics=None, episode_length=0, ends_at_goal=False)  # Asked for its sizes only.
    observation = jnp.zeros(robot.observation_size)
    inputs = jnp.zeros(robot.observation_size + TargetSpace(robot.task).size)
    actor = jax.eval_shape(td3.Actor(hidden, robot.action_size).init, jax.random.key(0), inputs)
    return LowLevel(actor, observation, observation, hidden, robot.action_size)
