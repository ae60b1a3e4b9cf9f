"""The tasks as Gymnasium goal environments. The Fetch tasks stand here, with the spaces, rewards and infos of
Gymnasium-Robotics' FetchReach-v4 and its like; the others in gymnasium_tasks.py.

`make` gives one environment on the CPU, `FetchVector` and `TaskVector` a batch on whatever device jax uses. Importing
this module registers them: `gymnasium.make("infogoal_jax.bridges.gymnasium:infogoal/FetchReach-v0")`. Needs the extra
`gymnasium`.
"""

import copy
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import checks, envs
from infogoal_jax.envs.fetch import environment
from infogoal_jax.envs.fetch.environment import DISTANCE_THRESHOLD, Fetch, FetchState
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.errors import UserError, require
from infogoal_jax.field_types import checked

try:
    import gymnasium
except ImportError as error:
    raise UserError("gymnasium: is not installed; pip install 'infogoal-jax[gymnasium]'") from error

from infogoal_jax.bridges.gymnasium_base import Batch, One, copied, key_of, on_cpu, options_of, with_limit
from infogoal_jax.bridges.gymnasium_tasks import TaskGymnasium, TaskVector

REWARD_TYPES = ("sparse", "dense")
"""The reference's rewards: 0 at the goal and -1 elsewhere, or minus the distance in m."""


def id_of(task: str) -> str:
    """The Gymnasium id of a task: fetch_reach is infogoal/FetchReach-v0."""
    return "infogoal/" + "".join(word.capitalize() for word in task.split("_")) + "-v0"


IDS = {name: id_of(name) for name in envs.registry}
"""The Gymnasium ids of the package's tasks."""
FARTHEST, LARGEST = 10.0, 50.0
"""No goal (m) and no number of an observation gets beyond these unless the simulation has diverged, and then the step
is taken back."""


def load(task: str, config: FetchConfig | None) -> Fetch:
    """The task; by default its episodes are never terminated, as in the reference. Raises `UserError` for a name that
    is no Fetch task, and for a configuration of another kind."""
    checks.not_forked()
    fits = config is None or isinstance(config, FetchConfig)
    require(fits, "config", config, "give a FetchConfig, or leave it out for the reference's episodes")
    checks.text(task, "task", f"give one of {', '.join(TASKS)}")
    return environment.make(task, FetchConfig(ends_at_goal=False) if config is None else checked(config, "config."))


def check_reward_type(reward_type: Any) -> None:
    """Raise `UserError` for a reward that the reference does not have."""
    known = isinstance(reward_type, str) and reward_type in REWARD_TYPES
    require(known, "reward_type", reward_type, f"give one of {', '.join(REWARD_TYPES)}")


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
    for goals, field in ((achieved, "achieved_goal"), (desired, "desired_goal")):
        checks.as_float32(goals, field)  # Beyond, no distance is a number.
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


def spaces_of(env: Fetch) -> tuple[gymnasium.spaces.Dict, gymnasium.spaces.Box]:
    """The observation and action space of one environment."""
    goal = gymnasium.spaces.Box(-FARTHEST, FARTHEST, (3,), np.float32)
    observation = gymnasium.spaces.Box(-LARGEST, LARGEST, (env.observation_size,), np.float32)
    return (
        gymnasium.spaces.Dict({"observation": observation, "achieved_goal": goal, "desired_goal": goal}),
        gymnasium.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32),
    )


def action_of(action: Any, field: str, shape: tuple[int, ...]) -> np.ndarray:
    """The action, float32 of this shape. Raises `UserError` for what is none; the simulation clips what is beyond
    [-1, 1], as the reference does, and diverges with what is not finite."""
    remedy = f"give {' x '.join(map(str, shape))} numbers in [-1, 1]"
    given = checks.array(action, field, "numbers", shape, remedy, finite=False)
    return np.asarray(given, np.float32)


jitted_reset = jax.jit(reset)
# The environment has no leaves: one program for each task and setting, however many environments there are.
jitted_step = jax.jit(Fetch.step)


class FetchGymnasium(One):
    """One Fetch task. As in the reference an episode is truncated after its 50 steps and never terminated, unless
    `config` has it end at the goal.

    `info` of a step: `is_success` 0.0 or 1.0; `diverged`: the simulation failed, the step was taken back and the
    episode is truncated.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012 - Gymnasium's own form.

    def __init__(
        self,
        task: str,
        config: FetchConfig | None = None,
        render_mode: str | None = None,
        reward_type: str = "sparse",
        timed: bool = True,
    ):
        """reward_type: "sparse", or "dense" for minus the distance in m. timed: False where Gymnasium keeps time."""
        if self.is_refused():
            return
        check_reward_type(reward_type)
        self.begin(with_limit(load(task, config), None, timed, FetchConfig().episode_length), render_mode)
        self.reward_type = reward_type
        self.observation_space, self.action_space = spaces_of(self.env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """A new episode. options: {"goal": [x, y, z]} in m. Raises `UserError` for a goal outside of the workspace."""
        super().reset(seed=seed)
        goal, given = goal_of(self.env, options, (3,))
        with on_cpu():
            self.state = jitted_reset(self.env, key_of(self.np_random), goal, given)
        return self._view(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """40 ms of simulation. Raises `UserError` before the first reset, and for an action of another shape."""
        self.check_begun("step")
        action = action_of(action, "action", self.action_space.shape)
        with on_cpu():
            self.state = jitted_step(self.env, self.state, action)
        seen = self._view()
        near = distance(seen["achieved_goal"], seen["desired_goal"]) < DISTANCE_THRESHOLD
        info = {"is_success": float(near), "diverged": bool(self.state.diverged)}
        reward = float(self.compute_reward(seen["achieved_goal"], seen["desired_goal"], info))
        return seen, reward, bool(self.state.terminated), bool(self.state.truncated), info

    def _view(self) -> dict[str, np.ndarray]:
        return copied(view(self.env, jax.device_get(self.state)))

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """0 at the goal and -1 elsewhere, or minus the distance, float32 [...], for goals [..., 3]; what hindsight
        relabelling calls."""
        return rewards(achieved_goal, desired_goal, self.reward_type)

    def compute_terminated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """Whether reaching the goal would have ended the episode, bool [...]."""
        return (distance(achieved_goal, desired_goal) < DISTANCE_THRESHOLD) & self.env.ends_at_goal

    def pictures(self) -> np.ndarray:
        """A picture uint8 [480, 640, 3]."""
        from infogoal_jax.envs.fetch.scene import draw_fetch

        return draw_fetch(self.env, self.state)


@jax.jit
def jitted_vector_reset(env: Fetch, keys: jax.Array, goals: jax.Array, given: jax.Array):
    """States and views of a batch."""
    states = jax.vmap(reset, in_axes=(None, 0, 0, None))(env, keys, goals, given)
    return states, jax.vmap(view, in_axes=(None, 0))(env, states)


@jax.jit
def jitted_vector_step(env: Fetch, states: FetchState, actions: jax.Array, keys: jax.Array):
    """The next states of a batch with their views, and which episodes are new: an episode that had ended is reset."""

    def step(state, action, key):
        ended = state.terminated | state.truncated
        state = jax.tree.map(
            lambda fresh, moved: jnp.where(ended, fresh, moved), env.reset(key), env.step(state, action)
        )
        return state, view(env, state), ended

    return jax.vmap(step)(states, actions, keys)


class FetchVector(Batch):
    """Many environments of one Fetch task, as `Batch` has them."""

    metadata = FetchGymnasium.metadata | Batch.autoreset

    def __init__(
        self,
        task: str,
        num_envs: int,
        config: FetchConfig | None = None,
        render_mode: str | None = None,
        reward_type: str = "sparse",
        max_episode_steps: int | None = None,
        timed: bool = True,
    ):
        """reward_type: see `FetchGymnasium`. max_episode_steps: None for the configuration's; -1 for no limit."""
        num_envs = checks.whole(num_envs, "num_envs", 1, checks.MOST_ENVS)
        check_reward_type(reward_type)
        env = with_limit(load(task, config), max_episode_steps, timed, FetchConfig().episode_length)
        self.begin(env, render_mode)
        self.reward_type = reward_type
        self.make_spaces(num_envs, *spaces_of(env))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Reset every environment. options: {"goal": [3] or [num_envs, 3]} in m, for this episode only."""
        super().reset(seed=seed)
        goals, given = goal_of(self.env, options, (self.num_envs, 3))
        self.state, seen = jitted_vector_reset(self.env, self.new_keys(), goals, given)
        return copied(seen), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """40 ms everywhere, actions [num_envs, 4]."""
        self.check_begun("step")
        actions = action_of(actions, "actions", self.action_space.shape)
        self.state, seen, fresh = jitted_vector_step(self.env, self.state, actions, self.new_keys())
        seen, moved = copied(seen), ~np.array(fresh)
        near = distance(seen["achieved_goal"], seen["desired_goal"]) < DISTANCE_THRESHOLD
        reward = np.where(moved, self.compute_reward(seen["achieved_goal"], seen["desired_goal"], {}), np.float32(0))
        info = {"is_success": (near & moved).astype(float), "diverged": np.array(self.state.diverged)}
        # Gymnasium's marks of the environments that these infos are of.
        info |= {f"_{name}": moved.copy() for name in info}
        return seen, reward, np.array(self.state.terminated), np.array(self.state.truncated), info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """As `FetchGymnasium.compute_reward`."""
        return rewards(achieved_goal, desired_goal, self.reward_type)

    def pictures(self) -> tuple[np.ndarray, ...]:
        """A picture uint8 [480, 640, 3] of each environment."""
        from infogoal_jax.envs.fetch.scene import draw_fetch

        return tuple(
            draw_fetch(self.env, jax.tree.map(lambda leaf, row=row: leaf[row], self.state))
            for row in range(self.num_envs)
        )


def register(task: str, reward_type: str = "sparse") -> str:
    """Make a task known to Gymnasium, unless it is. Returns its id, in which dense rewards are named."""
    name = id_of(task)
    gymnasium_id = name.replace("-v0", "Dense-v0") if reward_type == "dense" else name
    if gymnasium_id not in gymnasium.registry:
        one, batch = (FetchGymnasium, FetchVector) if task in TASKS else (TaskGymnasium, TaskVector)
        # Of the time Gymnasium is the only owner: `make` wraps one environment, a batch is told.
        kwargs = {"task": task, "timed": False} | ({"reward_type": reward_type} if reward_type == "dense" else {})
        gymnasium.register(
            gymnasium_id,
            entry_point=f"{one.__module__}:{one.__name__}",
            vector_entry_point=f"{batch.__module__}:{batch.__name__}",
            kwargs=kwargs,
            max_episode_steps=envs.registry.entry(task).config().episode_length,
            order_enforce=False,
            disable_env_checker=True,
        )
    return gymnasium_id


for name in IDS:
    register(name)
for name in TASKS:
    register(name, "dense")


def make(task: str, config: Any = None, render_mode: str | None = None) -> gymnasium.Env:
    """The environment of a task by its name, `FetchGymnasium` or `TaskGymnasium`, without a wrapper.

    config: of the task; None for its defaults, of a Fetch task for the reference's episodes of 50 steps. Its
    `episode_length` is the limit, which `env.spec` knows. render_mode: None or "rgb_array". Raises `UserError` for
    unknown names.
    """
    default = envs.registry.entry(task).config().episode_length
    env = (FetchGymnasium if task in TASKS else TaskGymnasium)(task, config, render_mode)
    env.spec = copy.deepcopy(gymnasium.spec(register(task)))
    env.spec.max_episode_steps = env.env.episode_length
    env.spec.kwargs |= {
        "config": None if config is None else dataclasses.replace(config, episode_length=default),
        "render_mode": render_mode,
    }
    return env
