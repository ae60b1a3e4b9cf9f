"""What the Gymnasium environments of all tasks share: one environment on the CPU, and a batch as one compiled
program."""

import contextlib
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from infogoal_jax import checks
from infogoal_jax.errors import UserError, require
from infogoal_jax.field_types import LARGEST_WHOLE


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


def key_of(generator: np.random.Generator) -> jax.Array:
    """A PRNG key drawn from Gymnasium's generator."""
    return jax.random.key(int(generator.integers(2**31)))


def options_of(options: Any) -> dict[str, Any]:
    """The options of a reset. Raises `UserError` for others than the goal."""
    require(options is None or isinstance(options, dict), "options", options, 'give {"goal": ...}, or leave them out')
    unknown = sorted(map(str, set(options or {}) - {"goal"}))
    require(not unknown, "options", unknown, 'only "goal" is known')
    return options or {}


def on_cpu() -> contextlib.AbstractContextManager:
    """Run the block on the CPU: a single robot is faster there than on an accelerator."""
    if jax.default_backend() == "cpu":
        return contextlib.nullcontext()
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:  # jax was told to use the accelerator only.
        return contextlib.nullcontext()


def copied(parts: dict[str, Any]) -> dict[str, np.ndarray]:
    """Copies of what is seen, which users may keep."""
    return {name: np.array(part) for name, part in parts.items()}


class Refusing(gymnasium.spaces.Dict):
    """A space that raises `checks.not_forked` when it is compared. Workers compare spaces first, and hand that error to
    their parent; what is raised while an environment is made they lose."""

    __hash__ = None

    def __eq__(self, other: Any) -> bool:
        checks.not_forked()
        return super().__eq__(other)


class Begun:
    """What one environment and a batch of them share: a state, which is None before the first reset, and pictures."""

    env: Any
    """The task."""
    state: Any
    """The state of the episode, or of those of the batch."""

    def begin(self, env: Any, render_mode: Any) -> None:
        """Hold the task, whose first episode is yet to come. Raises `UserError` for a mode that does not exist."""
        known = render_mode is None or (isinstance(render_mode, str) and render_mode in self.metadata["render_modes"])
        require(known, "render_mode", render_mode, 'give "rgb_array" or None')
        self.env, self.render_mode, self.state = env, render_mode, None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Seed Gymnasium's generator. Raises `UserError` for what is no seed."""
        return super().reset(seed=None if seed is None else checks.whole(seed, "seed", 0))

    def check_begun(self, call: str) -> None:
        """Raise `UserError` before the first reset."""
        require(self.state is not None, "state", None, f"call reset() before {call}()")

    def render(self) -> Any:
        """A picture, of a batch one of each environment, in mode "rgb_array"."""
        if self.render_mode is None:
            return None
        self.check_begun("render")
        return self.pictures()


class One(Begun, gymnasium.Env):
    """One environment, which says what is wrong once it is used in a process that was forked from one in which JAX had
    started, such as a worker of Gymnasium's `AsyncVectorEnv`: nothing could be computed there."""

    def __getattr__(self, name: str) -> Any:
        checks.not_forked()
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def is_refused(self) -> bool:
        """Whether nothing can be computed in this process; then only spaces are made."""
        if checks.Fork.jax_had_started:
            self.observation_space = self.action_space = Refusing()
        return checks.Fork.jax_had_started

    def compute_truncated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> bool:
        """Never: the time limit does not depend on the goal."""
        return False


class Batch(Begun, VectorEnv):
    """Many environments of one task as one compiled program, on jax's default device.

    Autoreset is Gymnasium's `NEXT_STEP`: the step after the last of an episode starts the next one, with reward 0 and
    its action unused.
    """

    autoreset = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 - Gymnasium's own form.

    def make_spaces(self, num_envs: int, observation: gymnasium.Space, action: gymnasium.Space) -> None:
        """The spaces of so many environments, of those of one."""
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = observation, action
        self.observation_space, self.action_space = (batch_space(space, num_envs) for space in (observation, action))

    def new_keys(self) -> jax.Array:
        """A key for each environment."""
        return jax.random.split(key_of(self.np_random), self.num_envs)
