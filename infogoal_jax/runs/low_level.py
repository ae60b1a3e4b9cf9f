"""The low level of HRAC: an exported policy (policy_file.py) of a run of target states. `infogoal pretrain` leaves its
file in the folder of the run; those of four tasks are shipped (docs/reference/low_level.md)."""

import json
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import policy_file
from infogoal_jax.data import archives
from infogoal_jax.envs.environment import Environment, one_observation
from infogoal_jax.errors import UserError, require
from infogoal_jax.files import expanded

NAME = "low_level.npz"
SHIPPED = Path(__file__).parent.parent / "data" / "files" / "low_levels"
IN_JAX = policy_file.operations(jnp)


@flax.struct.dataclass
class LowLevel:
    """A frozen policy that reaches target states: an exported one (policy_file.py), run by JAX. A pytree."""

    constants: list[jax.Array]
    """Parameters of the policy."""
    program: str = flax.struct.field(pytree_node=False)
    """Its operations, JSON."""
    discrete: bool = flax.struct.field(pytree_node=False)
    """Whether an action is a move, of which the program gives the values."""

    @classmethod
    def of(cls, policy: policy_file.ExportedPolicy) -> "LowLevel":
        """The low level that this policy is."""
        return cls(jax.device_put(policy.constants), json.dumps(policy.program), policy.about.get("discrete", True))

    def act(self, observation: Any, target: jax.Array) -> jax.Array:
        """The action float32 [A] in [-1, 1], or move int32, from a stored observation towards the target state [S]."""
        found = self.outputs(observation, target)
        return found.argmax().astype(jnp.int32) if self.discrete else found

    def outputs(self, observation: Any, target: jax.Array) -> jax.Array:
        """The action, or the values of all moves, float32 [A]."""
        program = json.loads(self.program)
        leaves = jax.tree.leaves(observation)
        (body,) = (leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating))
        others = [np.zeros(shape, dtype) for shape, dtype in program["inputs"][1][2:]]  # Noise: none.
        return policy_file.run_program(program, self.constants, (body, target, *others), IN_JAX)[0]


def shipped(task: str) -> Path:
    """The file of the low level that the project ships for a task. Raises `UserError` for a task that has none."""
    path = SHIPPED / f"{task}.npz"
    known = ", ".join(sorted(file.stem for file in SHIPPED.glob("*.npz")))
    require(path.exists(), "low_level", "", f"none is shipped for {task}; give the file of one. Shipped: {known}")
    return path


def read(path: str, env: Environment) -> tuple[dict[str, Any], LowLevel]:
    """What is said of the low level in this file or run, and the low level, for the target states of this environment.
    path: empty for the shipped one.

    Raises `UserError` for a file that is missing, damaged, something else, of another task, or of other shapes.
    """
    task = env.space.name
    file = expanded(path) if path else shipped(task)
    file = file / NAME if file.is_dir() else file
    remedy = f"give one of `infogoal pretrain {task}`, or none at all for the shipped one"
    try:
        policy = policy_file.ExportedPolicy(file)
    except FileNotFoundError:
        raise UserError(f"low_level = {str(file)!r}: there is no such file; {remedy}") from None
    except (OSError, ValueError) as error:
        raise UserError(f"low_level = {str(file)!r}: {error}; {remedy}") from error
    about = policy.about
    require(
        about.get("task") in (task, f"{task}_targets"),
        "low_level",
        str(file),
        f"is of the task {about.get('task')!r}, not {task!r}; {remedy}",
    )
    observation = one_observation(env)
    target, wanted = (jax.ShapeDtypeStruct((size,), "float32") for size in (env.space.size, env.action_size))
    try:
        low_level = LowLevel.of(policy)
        found = jax.eval_shape(low_level.outputs, observation, target)
    except Exception:  # Whatever goes wrong in a program for other arrays.
        found = None
    require(
        found == wanted and low_level.discrete == env.discrete,
        "low_level",
        str(file),
        f"does not fit the {env.space.size} numbers of a target state and the {env.action_size} "
        f"{'moves' if env.discrete else 'numbers of an action'} of {task} as it is configured; train one with "
        f"`infogoal pretrain {task}` and the same --env flags, or choose another --agent",
    )
    words = archives.checksum(np.frombuffer(low_level.program.encode(), np.uint8), *policy.constants)
    return about | {"content": about.get("content", words)}, low_level
