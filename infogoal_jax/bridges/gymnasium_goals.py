"""Observations, rewards and goals of the Fetch tasks as Gymnasium-Robotics defines them, for one environment and for a
batch."""

import contextlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.envs.fetch import environment
from infogoal_jax.envs.fetch.environment import DISTANCE_THRESHOLD, Fetch, FetchState
from infogoal_jax.envs.fetch.tasks import FetchConfig
from infogoal_jax.errors import UserError, require


def load(task: str, config: FetchConfig | None) -> Fetch:
    """The task; by default its episodes are never terminated, as in the reference. Raises `UserError` for a name that
    is no Fetch task, and for a configuration of another kind."""
    fits = config is None or isinstance(config, FetchConfig)
    require(fits, "config", config, "give a FetchConfig, or leave it out for the reference's episodes")
    return environment.make(task, FetchConfig(ends_at_goal=False) if config is None else config)


def reset(env: Fetch, key: jax.Array, goal: jax.Array, given: jax.Array) -> FetchState:
    """A new episode, for `goal` [3] where one is given; otherwise as `env.reset` draws it."""
    goal_key, object_key = jax.random.split(key)
    return env.reset_to(object_key, jnp.where(given, goal, env.sample_goal(goal_key)))


def view(env: Fetch, state: FetchState) -> dict[str, jax.Array]:
    """The observation in the form of Gymnasium's goal environments."""
    return {"observation": state.observation, "achieved_goal": env.achieved(state), "desired_goal": state.goal}


def distance(achieved, desired) -> np.ndarray:
    """Metres between positions [..., 3]. Raises `UserError` for other shapes."""
    achieved, desired = np.asarray(achieved), np.asarray(desired)
    fit = achieved.shape[-1:] == (3,) and achieved.shape == desired.shape
    require(
        fit,
        "achieved_goal",
        f"of shape {achieved.shape}, desired_goal of {desired.shape}",
        "give positions [..., 3] of one shape",
    )
    return np.linalg.norm(achieved - desired, axis=-1)


def rewards(achieved, desired) -> np.ndarray:
    """0 at the goal and -1 farther than 5 cm, float32 [...]."""
    return -(distance(achieved, desired) > DISTANCE_THRESHOLD).astype(np.float32)


def key_of(generator: np.random.Generator) -> jax.Array:
    """A PRNG key drawn from Gymnasium's generator."""
    return jax.random.key(int(generator.integers(2**31)))


def goal_of(env: Fetch, options: dict[str, Any] | None, shape: tuple[int, ...]) -> tuple[np.ndarray, bool]:
    """The goal that `options` asks for, broadcast to `shape`, and whether it asks for one. Raises `UserError` for what
    cannot be one."""
    unknown = set(options or {}) - {"goal"}
    require(not unknown, "options", sorted(unknown), 'only "goal" is known')
    if not options:
        return np.zeros(shape, np.float32), False
    try:
        goal = np.asarray(options["goal"], np.float32)
    except (TypeError, ValueError) as error:
        raise UserError(f'options["goal"] = {options["goal"]!r}: give a position of 3 numbers, in m') from error
    env.check_goals(goal)
    require(
        goal.ndim <= len(shape) and all(a in (1, b) for a, b in zip(goal.shape[::-1], shape[::-1], strict=False)),
        'options["goal"]',
        f"of shape {goal.shape}",
        f"give {list(shape)} or [3]",
    )
    return np.broadcast_to(goal, shape), True


def on_cpu() -> contextlib.AbstractContextManager:
    """Run the block on the CPU: a single robot is faster there than on an accelerator."""
    if jax.default_backend() == "cpu":
        return contextlib.nullcontext()
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:  # jax was told to use the accelerator only.
        return contextlib.nullcontext()
