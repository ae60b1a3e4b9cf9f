"""Training the low level of object manipulation: double Q-learning over the recorded moves, towards target states of the joints.

All moves of the dataset are known, so there is nothing to collect: each update draws moves uniformly, and for each of them a target state. Half a
minute on a CPU.
"""

import dataclasses
import datetime
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import optax

from infogoal_jax import networks
from infogoal_jax.agents import dqn
from infogoal_jax.agents.joint_level import JointLevel, network_input, values_of
from infogoal_jax.angles import wrapped
from infogoal_jax.envs.object_manipulation import ObjectManipulation, ObjectManipulationConfig, make
from infogoal_jax.errors import UserError, require
from infogoal_jax.train import files, low_level_file
from infogoal_jax.train.compilation import compiler_options

NEAR, FARTHEST = jnp.pi / 4, jnp.pi / 2
"""Target states lie up to this far from each joint when measured, as HRAC's subgoals do, and when trained (radians)."""
TASK = "object_manipulation"


@dataclasses.dataclass(frozen=True)
class JointPretrainConfig:
    """Train the low level of object manipulation (docs/object_manipulation.md)."""

    env: ObjectManipulationConfig = dataclasses.field(default_factory=ObjectManipulationConfig)
    """The dataset whose moves it learns."""
    hidden: tuple[int, ...] = (128, 128)
    """Widths of the network's layers."""
    num_updates: int = 15000
    """Gradient updates."""
    batch_size: int = 512
    """Moves in an update."""
    learning_rate: float = 1e-3
    """Step of Adam at the start; it falls to 0."""
    discount: float = 0.9
    """Discount of a step."""
    target_rate: float = 0.02
    """Share by which the target network follows at each update."""
    seed: int = 0
    """Seed of networks and draws."""
    out: str = ""
    """Folder to write to; empty: a new one under runs/."""

    def check(self) -> None:
        """Raise `UserError` for values out of range."""
        for name in ("num_updates", "batch_size"):
            require(getattr(self, name) > 0, name, getattr(self, name), "give a whole number greater than 0")
        for name in ("learning_rate", "target_rate"):
            require(0 < getattr(self, name) <= 1, name, getattr(self, name), "give a number above 0, at most 1")
        require(0 <= self.discount < 1, "discount", self.discount, "give a number from 0 to below 1, for example 0.9")
        require(bool(self.hidden) and min(self.hidden) > 0, "hidden", self.hidden, "give widths greater than 0, for example 128 128")
        require(0 <= self.seed < 2**32, "seed", self.seed, "give a seed from 0 to below 2^32")


def half_step(env: ObjectManipulation) -> jax.Array:
    """How near joints have to be to a target state, each: half of the smallest step that a move makes, radians."""
    change = jnp.abs(wrapped(env.joints[env.next_node] - env.joints[:, None]))
    return 0.5 * jnp.where(change > 1e-4, change, jnp.inf).min()


def at_target(joints: jax.Array, target: jax.Array, precision: jax.Array) -> jax.Array:
    """Whether all joints [..., J] are at their target [..., J], bool [...]."""
    return (jnp.abs(wrapped(target - joints)) < precision).all(-1)


def draw_targets(key: jax.Array, env: ObjectManipulation, frame: jax.Array) -> jax.Array:
    """Target states [B, J] for joints that stand as in these images: up to `FARTHEST` away, and often much nearer, so that values spread outwards."""
    reach_key, turn_key = jax.random.split(key)
    reach = FARTHEST * jax.random.uniform(reach_key, (*frame.shape, 1))
    return wrapped(env.joints[frame] + reach * jax.random.uniform(turn_key, (*frame.shape, env.joints.shape[1]), minval=-1.0))


def learn(config: JointPretrainConfig, env: ObjectManipulation, key: jax.Array) -> tuple[JointLevel, dict[str, jax.Array]]:
    """The trained low level and the curve of its error [num_updates]. A pure function of the key."""
    num_moves, precision = env.action_size, half_step(env)
    init_key, key = jax.random.split(key)
    optimizer = optax.adam(optax.linear_schedule(config.learning_rate, 0.0, config.num_updates))
    params = networks.MLP(config.hidden, num_moves).init(init_key, network_input(env.joints[0], env.joints[0]))

    def update(carry, key):
        params, target_params, optimizer_state = carry
        frame_key, move_key, target_key = jax.random.split(key, 3)
        frame = jax.random.randint(frame_key, (config.batch_size,), 0, env.joints.shape[0])
        move = jax.random.randint(move_key, frame.shape, 0, num_moves)
        target = draw_targets(target_key, env, frame)
        here, there = env.joints[frame], env.joints[env.next_node[frame, move]]
        done = at_target(there, target, precision)
        best = values_of(params, config.hidden, num_moves, there, target).argmax(-1)
        following = dqn.of_actions(values_of(target_params, config.hidden, num_moves, there, target), best)
        value = jax.lax.stop_gradient(jnp.where(done, 1.0, config.discount * following))

        def loss(params):
            return optax.l2_loss(dqn.of_actions(values_of(params, config.hidden, num_moves, here, target), move), value).mean()

        error, gradient = jax.value_and_grad(loss)(params)
        step, optimizer_state = optimizer.update(gradient, optimizer_state)
        params = optax.apply_updates(params, step)
        return (params, optax.incremental_update(params, target_params, config.target_rate), optimizer_state), error

    (params, _, _), errors = jax.lax.scan(update, (params, params, optimizer.init(params)), jax.random.split(key, config.num_updates))
    return JointLevel(params, config.hidden, num_moves), {"loss": errors}


def measure(low_level: JointLevel, env: ObjectManipulation, key: jax.Array, episodes: int = 4000, num_steps: int = 12) -> dict[str, jax.Array]:
    """How often the joints reach a target state up to `NEAR` away within `num_steps` moves, and in how many moves (those that do)."""
    frame_key, target_key = jax.random.split(key)
    frame = jax.random.randint(frame_key, (episodes,), 0, env.joints.shape[0])
    turn = jax.random.uniform(target_key, (episodes, env.joints.shape[1]), minval=-NEAR, maxval=NEAR)
    target, precision = wrapped(env.joints[frame] + turn), half_step(env)
    there = (jnp.abs(wrapped(env.joints - target[:, None])) < precision).all(-1).any(-1)  # The joint limits leave some target states out.

    def step(carry, number):
        frame, first = carry
        move = low_level.act(env.observe_frame(frame), target)
        frame = jnp.where(first <= number, frame, env.next_node[frame, move])
        first = jnp.where(at_target(env.joints[frame], target, precision), jnp.minimum(first, number + 1), first)
        return (frame, first), None

    first = jnp.where(at_target(env.joints[frame], target, precision), 0, num_steps + 1)
    (_, first), _ = jax.lax.scan(step, (frame, first), jnp.arange(num_steps))
    reached = (first <= num_steps) & there
    return {"success_rate": reached.sum() / there.sum(), "moves": jnp.where(reached, first, 0).sum() / jnp.maximum(reached.sum(), 1)}


def pretrain(config: JointPretrainConfig, command: str = "") -> dict[str, Any]:
    """Train, measure, and leave FOLDER/low_level. Returns its header. Raises `UserError` before any compilation for what cannot be used."""
    config.check()
    folder = Path(config.out or f"runs/{TASK}-low-level-{time.strftime('%Y%m%d-%H%M%S')}")
    if (folder / "low_level").exists():
        raise UserError(f"out = {str(folder)!r}: holds a low level already; give another folder")
    env = make(config.env)
    require(env.joints.shape[1] > 0, "env.dataset", config.env.dataset, "tells no joint angles: import it with columns joint_NAME")
    files.make_folder(folder)
    key, started = jax.random.key(config.seed), time.perf_counter()
    low_level, curve = jax.block_until_ready(jax.jit(lambda env, key: learn(config, env, key), compiler_options=compiler_options())(env, key))
    seconds = time.perf_counter() - started
    found = jax.device_get(jax.jit(lambda low_level, env: measure(low_level, env, jax.random.fold_in(key, 1)))(low_level, env))
    header = {
        "task": TASK, "command": command, "config": dataclasses.asdict(config), "joints": env.joints.shape[1], "moves": env.action_size,
        "success_rate": round(float(found["success_rate"]), 4), "mean_moves": round(float(found["moves"]), 3), "data": env.source,
        "final_loss": float(curve["loss"][-100:].mean()), "seconds_with_compiling": round(seconds, 1), "device": jax.devices()[0].device_kind,
        "date": datetime.date.today().isoformat(),
    }
    low_level_file.save_joint_level(folder / "low_level", header, jax.device_get(low_level))
    return header | {"folder": str(folder)}


def print_result(header: dict[str, Any]) -> None:
    """What the low level reached, and where it is."""
    print(f"target states up to 45 degrees away in every joint: {header['success_rate']:.4f} reached, in {header['mean_moves']:.2f} moves on average")
    print(f"compiling and running {header['seconds_with_compiling']:.1f} s")
    print(f"low level   {Path(header['folder']) / 'low_level'}")
