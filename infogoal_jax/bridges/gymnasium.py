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
from infogoal_jax.bridges.gymnasium_goals import (
    check_mode,
    check_reward_type,
    distance,
    goal_of,
    key_of,
    load,
    on_cpu,
    reset,
    rewards,
    seeded,
    view,
    with_limit,
)
from infogoal_jax.envs.fetch.environment import DISTANCE_THRESHOLD, Fetch, FetchState
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.errors import UserError, require

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise UserError("gymnasium: is not installed; pip install 'infogoal-jax[gymnasium]'") from error

from infogoal_jax.bridges.forks import RefusesForks
from infogoal_jax.bridges.gymnasium_tasks import TaskGymnasium, TaskVector


def id_of(task: str) -> str:
    """The Gymnasium id of a task: fetch_reach is infogoal/FetchReach-v0."""
    return "infogoal/" + "".join(word.capitalize() for word in task.split("_")) + "-v0"


IDS = {name: id_of(name) for name in envs.registry}
"""The Gymnasium ids of the package's tasks."""
FARTHEST, LARGEST = 10.0, 50.0
"""No goal (m) and no number of an observation gets beyond these unless the simulation has diverged, and then the step
is taken back."""


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


class FetchGymnasium(RefusesForks, gymnasium.Env):
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
        check_mode(render_mode, self.metadata["render_modes"])
        check_reward_type(reward_type)
        self.env = with_limit(load(task, config), None, timed, FetchConfig().episode_length)
        self.render_mode, self.reward_type = render_mode, reward_type
        self.observation_space, self.action_space = spaces_of(self.env)
        self.state: FetchState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """A new episode. options: {"goal": [x, y, z]} in m. Raises `UserError` for a goal outside of the workspace."""
        super().reset(seed=seeded(seed))
        goal, given = goal_of(self.env, options, (3,))
        with on_cpu():
            self.state = jitted_reset(self.env, key_of(self.np_random), goal, given)
        return self._view(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """40 ms of simulation. Raises `UserError` before the first reset, and for an action of another shape."""
        require(self.state is not None, "state", None, "call reset() before step()")
        action = action_of(action, "action", self.action_space.shape)
        with on_cpu():
            self.state = jitted_step(self.env, self.state, action)
        seen = self._view()
        near = distance(seen["achieved_goal"], seen["desired_goal"]) < DISTANCE_THRESHOLD
        info = {"is_success": float(near), "diverged": bool(self.state.diverged)}
        reward = float(self.compute_reward(seen["achieved_goal"], seen["desired_goal"], info))
        return seen, reward, bool(self.state.terminated), bool(self.state.truncated), info

    def _view(self) -> dict[str, np.ndarray]:
        """Copies of the state's parts, which users may keep."""
        return {name: np.array(part) for name, part in view(self.env, jax.device_get(self.state)).items()}

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """0 at the goal and -1 elsewhere, or minus the distance, float32 [...], for goals [..., 3]; what hindsight
        relabelling calls."""
        return rewards(achieved_goal, desired_goal, self.reward_type)

    def compute_terminated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """Whether reaching the goal would have ended the episode, bool [...]."""
        return (distance(achieved_goal, desired_goal) < DISTANCE_THRESHOLD) & self.env.ends_at_goal

    def compute_truncated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> bool:
        """Never: the time limit does not depend on the goal."""
        return False

    def render(self) -> np.ndarray | None:
        """A picture uint8 [480, 640, 3] in mode "rgb_array"."""
        if self.render_mode is None:
            return None
        from infogoal_jax.envs.fetch.scene import draw_fetch

        require(self.state is not None, "state", None, "call reset() before render()")
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


class FetchVector(VectorEnv):
    """Many environments of one task as one compiled program, on jax's default device.

    Autoreset is Gymnasium's `NEXT_STEP`: the step after the last of an episode starts the next one, with reward 0 and
    its action unused.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25, "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 - Gymnasium's own form.

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
        check_mode(render_mode, self.metadata["render_modes"])
        check_reward_type(reward_type)
        self.env = with_limit(load(task, config), max_episode_steps, timed, FetchConfig().episode_length)
        self.num_envs, self.render_mode, self.reward_type = num_envs, render_mode, reward_type
        self.single_observation_space, self.single_action_space = spaces_of(self.env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.state: FetchState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Reset every environment. options: {"goal": [3] or [num_envs, 3]} in m, for this episode only."""
        super().reset(seed=seeded(seed))
        goals, given = goal_of(self.env, options, (self.num_envs, 3))
        keys = jax.random.split(key_of(self.np_random), self.num_envs)
        self.state, seen = jitted_vector_reset(self.env, keys, goals, given)
        return {name: np.array(part) for name, part in seen.items()}, {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """40 ms everywhere, actions [num_envs, 4]."""
        require(self.state is not None, "state", None, "call reset() before step()")
        actions = action_of(actions, "actions", self.action_space.shape)
        keys = jax.random.split(key_of(self.np_random), self.num_envs)
        self.state, seen, fresh = jitted_vector_step(self.env, self.state, actions, keys)
        seen, moved = {name: np.array(part) for name, part in seen.items()}, ~np.array(fresh)
        near = distance(seen["achieved_goal"], seen["desired_goal"]) < DISTANCE_THRESHOLD
        reward = np.where(moved, self.compute_reward(seen["achieved_goal"], seen["desired_goal"], {}), np.float32(0))
        info = {"is_success": (near & moved).astype(float), "diverged": np.array(self.state.diverged)}
        # Gymnasium's marks of the environments that these infos are of.
        info |= {f"_{name}": moved.copy() for name in info}
        return seen, reward, np.array(self.state.terminated), np.array(self.state.truncated), info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """As `FetchGymnasium.compute_reward`."""
        return rewards(achieved_goal, desired_goal, self.reward_type)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture uint8 [480, 640, 3] of each environment in mode "rgb_array"."""
        if self.render_mode is None:
            return None
        from infogoal_jax.envs.fetch.scene import draw_fetch

        require(self.state is not None, "state", None, "call reset() before render()")
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
