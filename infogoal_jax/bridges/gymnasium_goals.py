"""Observations, rewards and goals of the Fetch tasks as Gymnasium-Robotics defines them, for one environment and for a
batch."""

import contextlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import checks
from infogoal_jax.envs.fetch import environment
from infogoal_jax.envs.fetch.environment import DISTANCE_THRESHOLD, Fetch, FetchState
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.errors import UserError, require
from infogoal_jax.field_types import LARGEST_WHOLE, checked

REWARD_TYPES = ("sparse", "dense")
"""The reference's rewards: 0 at the goal and -1 elsewhere, or minus the distance in m."""


def load(task: str, config: FetchConfig | None) -> Fetch:
    """The task; by default its episodes are never terminated, as in the reference. Raises `UserError` for a name that
    is no Fetch task, and for a configuration of another kind."""
    checks.not_forked()
    fits = config is None or isinstance(config, FetchConfig)
    require(fits, "config", config, "give a FetchConfig, or leave it out for the reference's episodes")
    checks.text(task, "task", f"give one of {', '.join(TASKS)}")
    return environment.make(task, FetchConfig(ends_at_goal=False) if config is None else checked(config, "config."))


def with_limit(env: Any, max_episode_steps: int | None, timed: bool, default: int) -> Any:
    """The environment with the time limit that counts, of which Gymnasium is the owner where it made the environment.

    timed: False where `gymnasium.make` puts its own `TimeLimit` around, whose number is then the only one; the
    environment has none. max_episode_steps: of a batch, which Gymnasium does not wrap; -1, as in Gymnasium, for none.
    default: the task's own length. Raises `UserError` for a configuration that asks for another one than Gymnasium.
    """
    timed, length = checks.flag(timed, "timed"), env.episode_length
    if max_episode_steps is not None:
        steps = checks.whole(max_episode_steps, "max_episode_steps", -1, LARGEST_WHOLE)
        require(steps != 0, "max_episode_steps", steps, "give a whole number from 1 on, or -1 for no limit")
    if timed and max_episode_steps is None:
        return env
    if length not in (default, max_episode_steps):
        given = "" if max_episode_steps is None else f", max_episode_steps = {max_episode_steps}"
        raise UserError(
            f"config.episode_length = {length}{given}: two limits; give max_episode_steps={length} to Gymnasium and "
            f"leave the configuration's at {default}, or call infogoal_jax.bridges.gymnasium.make"
        )
    return env.replace(episode_length=LARGEST_WHOLE if max_episode_steps in (None, -1) else steps)


def check_mode(render_mode: Any, modes: list[str]) -> None:
    """Raise `UserError` for a mode that does not exist."""
    known = render_mode is None or (isinstance(render_mode, str) and render_mode in modes)
    require(known, "render_mode", render_mode, 'give "rgb_array" or None')


def check_reward_type(reward_type: Any) -> None:
    """Raise `UserError` for a reward that the reference does not have."""
    known = isinstance(reward_type, str) and reward_type in REWARD_TYPES
    require(known, "reward_type", reward_type, f"give one of {', '.join(REWARD_TYPES)}")


def seeded(seed: Any) -> int | None:
    """A seed of Gymnasium's generator; None for one that is drawn."""
    return None if seed is None else checks.whole(seed, "seed", 0)


def reset(env: Fetch, key: jax.Array, goal: jax.Array, given: jax.Array) -> FetchState:
    """A new episode, for `goal` [3] where one is given; otherwise as `env.reset` draws it."""
    goal_key, object_key = jax.random.split(key)
    return env.reset_to(object_key, jnp.where(given, goal, env.sample_goal(goal_key)))


def view(env: Fetch, state: FetchState) -> dict[str, jax.Array]:
    """The observation in the form of Gymnasium's goal environments."""
    return {"observation": state.observation, "achieved_goal": env.achieved(state), "desired_goal": state.goal}


def distance(achieved, desired) -> np.ndarray:
    """Metres between positions [..., 3]. Raises `UserError` for other shapes, and for numbers that are not finite:
    these are neither near nor far."""
    remedy = "give positions [..., 3]"
    achieved = np.asarray(checks.array(achieved, "achieved_goal", "numbers", remedy=remedy))
    desired = np.asarray(checks.array(desired, "desired_goal", "numbers", remedy=remedy))
    fit = achieved.shape[-1:] == (3,) and achieved.shape == desired.shape
    require(
        fit,
        "achieved_goal",
        f"of shape {achieved.shape}, desired_goal of {desired.shape}",
        "give positions [..., 3] of one shape",
    )
    return np.linalg.norm(achieved - desired, axis=-1)


def rewards(achieved, desired, reward_type: str = "sparse") -> np.ndarray:
    """0 at the goal and -1 farther than 5 cm, or minus the distance in m, float32 [...]."""
    apart = distance(achieved, desired)
    return -(apart.astype(np.float32) if reward_type == "dense" else (apart > DISTANCE_THRESHOLD).astype(np.float32))


def key_of(generator: np.random.Generator) -> jax.Array:
    """A PRNG key drawn from Gymnasium's generator."""
    return jax.random.key(int(generator.integers(2**31)))


def options_of(options: Any) -> dict[str, Any]:
    """The options of a reset. Raises `UserError` for others than the goal."""
    require(options is None or isinstance(options, dict), "options", options, 'give {"goal": ...}, or leave them out')
    unknown = sorted(map(str, set(options or {}) - {"goal"}))
    require(not unknown, "options", unknown, 'only "goal" is known')
    return options or {}


def goal_of(env: Fetch, options: dict[str, Any] | None, shape: tuple[int, ...]) -> tuple[np.ndarray, bool]:
    """The goal that `options` asks for, broadcast to `shape`, and whether it asks for one. Raises `UserError` for what
    cannot be one."""
    if not options_of(options):
        return np.zeros(shape, np.float32), False
    remedy = "give a position of 3 numbers, in m"
    goal = np.asarray(checks.array(options["goal"], 'options["goal"]', "numbers", remedy=remedy), np.float32)
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
