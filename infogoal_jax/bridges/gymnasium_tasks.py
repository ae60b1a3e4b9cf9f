"""Tasks whose goals are a finite set and whose actions are moves, as Gymnasium goal environments: object search, object
manipulation, embodied question answering, and tasks of a user's own.

A goal is an entry of a vector of bits: `desired_goal` has one that is set, `achieved_goal` those of the goals that are
achieved now: the desired one where it is reached, and of the others those that may be known while training (no
validation or test question of embodied question answering). Hindsight relabelling may therefore put one in place of the
other. Rewards are those of the Fetch tasks, 0 at the goal and -1 elsewhere. `TaskGymnasium` is one environment on the
CPU, `TaskVector` a batch on whatever device jax uses; importing `infogoal_jax.bridges.gymnasium` registers both.
"""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import checks, envs
from infogoal_jax.bridges.gymnasium_base import Batch, One, copied, key_of, on_cpu, options_of, with_limit
from infogoal_jax.envs.environment import Environment
from infogoal_jax.errors import require

METADATA = {"render_modes": ["rgb_array"], "render_fps": 4}


def load(task: str | Environment, config: Any) -> Environment:
    """The task of this name, or the environment itself. Raises `UserError` for one whose goals do not form a finite
    set, or whose actions are vectors."""
    checks.not_forked()
    if isinstance(task, Environment):
        require(config is None, "config", config, "leave it out: the environment has one of its own")
    env = task if isinstance(task, Environment) else envs.load(task, config)
    fits = env.goals.finite and env.discrete
    require(
        fits,
        "task",
        task,
        "its goals do not form a finite set, or its actions are vectors; give object_search, for example",
    )
    return env


def seen(env: Environment, state: Any) -> dict[str, jax.Array]:
    """The observation as a network sees it, and the goals as bits int8 [N]."""
    record = env.achieved(state)
    goals, bits = env.goals_of(record), jnp.zeros(env.goals.num_goals, jnp.int8)
    achieved = bits.at[jnp.where(goals < 0, env.goals.num_goals, goals)].set(1, mode="drop")
    return {
        "observation": env.render(env.observe(state)),
        # `goals_of` may leave out the desired goal where it is reached: a test question, a pose within 10 degrees.
        "achieved_goal": achieved.at[state.goal].set(env.reached(record, state.goal).astype(jnp.int8)),
        "desired_goal": bits.at[state.goal].set(1),
    }


@jax.jit
def start(env: Environment, key: jax.Array, goal: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
    """The state of a new episode and what is seen of it. goal: -1 for one drawn among the training goals."""
    drawn_key, start_key = jax.random.split(key)
    drawn = jax.random.choice(drawn_key, env.goals.training_goals)
    state = env.reset_to(start_key, jnp.where(goal < 0, drawn, goal))
    return state, seen(env, state)


@jax.jit
def move(env: Environment, state: Any, action: jax.Array) -> tuple[Any, dict[str, jax.Array], jax.Array]:
    """The next state, what is seen of it, and which actions can be taken in it, bool [A]."""
    state = env.step(state, action)
    return state, seen(env, state), env.action_mask(env.observe(state))


@jax.jit
def start_all(env: Environment, keys: jax.Array, goals: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
    """`start` for a batch."""
    return jax.vmap(start, in_axes=(None, 0, 0))(env, keys, goals)


@jax.jit
def move_all(env: Environment, states: Any, actions: jax.Array, keys: jax.Array):
    """`move` for a batch, in which episodes that had ended start anew; and which these are."""

    def one(state, action, key):
        ended = state.terminated | state.truncated
        fresh, _ = start(env, key, jnp.asarray(-1))
        state = jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, env.step(state, action))
        return state, seen(env, state), env.action_mask(env.observe(state)), ended

    return jax.vmap(one)(states, actions, keys)


def spaces_of(env: Environment) -> tuple[gymnasium.spaces.Dict, gymnasium.spaces.Discrete]:
    """The observation and action space of one environment."""
    shown = jax.eval_shape(lambda key: env.render(env.observe(env.reset(key))), jax.random.key(0))
    image = shown.dtype == jnp.uint8
    low, high = (0, 255) if image else (-np.inf, np.inf)
    goal = gymnasium.spaces.MultiBinary(env.goals.num_goals)
    spaces = {
        "observation": gymnasium.spaces.Box(low, high, shown.shape, shown.dtype),
        "achieved_goal": goal,
        "desired_goal": goal,
    }
    return gymnasium.spaces.Dict(spaces), gymnasium.spaces.Discrete(env.action_size)


def at_goal(achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
    """Whether a desired goal is among those that are achieved, bool [...], for bits [..., N]. Raises `UserError` for
    other shapes."""
    bits = {}
    for field, given in {"achieved_goal": achieved, "desired_goal": desired}.items():
        flags = isinstance(given, np.ndarray) and given.dtype == bool
        bits[field] = np.asarray(checks.array(given, field, "flags" if flags else "numbers", (..., "N")))
        require(np.isin(bits[field], (0, 1)).all(), field, given, "give bits [..., N], each 0 or 1")
    achieved, desired = bits["achieved_goal"], bits["desired_goal"]
    require(
        achieved.shape == desired.shape,
        "achieved_goal",
        f"of shape {achieved.shape}, desired_goal of {desired.shape}",
        "give bits [..., N] of one shape",
    )
    return ((achieved > 0) & (desired > 0)).any(-1)


def rewards(achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
    """0 at the goal and -1 elsewhere, float32 [...]."""
    return at_goal(achieved, desired).astype(np.float32) - np.float32(1)


def goal_number(env: Environment, options: dict[str, Any] | None) -> int:
    """The goal that `options` asks for by its number or its name; -1 for none. Raises `UserError` for one that cannot
    be evaluated."""
    if not options_of(options):
        return -1
    goal, field = options["goal"], 'options["goal"]'
    remedy = "give the number or the name of an evaluated goal (env.goals)"
    if isinstance(goal, str):
        require(goal in env.goals.names, field, goal, remedy)
        number = env.goals.names.index(goal)
    else:
        number = checks.whole(goal, field, remedy=remedy)
    require(number in np.asarray(env.goals.evaluated), field, goal, remedy)
    return number


def default_length(task: str | Environment) -> int:
    """The task's own number of steps, which a configuration may change."""
    return task.episode_length if isinstance(task, Environment) else envs.registry.entry(task).config().episode_length


def picture(env: Environment, image: np.ndarray) -> np.ndarray:
    """What the agent sees as RGB, uint8 [H, W, 3]. Raises `UserError` where it sees no image."""
    require(image.dtype == np.uint8, "render_mode", "rgb_array", "the agent sees no images in this task; leave it out")
    return np.array(np.broadcast_to(image, (*image.shape[:2], 3)))


class TaskGymnasium(One):
    """One environment. An episode is terminated at the goal and truncated after the task's number of steps.

    `info`: `is_success` 0.0 or 1.0; `action_mask` int8 [A], the actions that can be taken next.
    """

    metadata = METADATA

    def __init__(self, task: str | Environment, config: Any = None, render_mode: str | None = None, timed: bool = True):
        """timed: False where Gymnasium keeps the time."""
        if self.is_refused():
            return
        with on_cpu():
            self.begin(with_limit(load(task, config), None, timed, default_length(task)), render_mode)
        self.observation_space, self.action_space = spaces_of(self.env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """A new episode. options: {"goal": number or name}; without them a training goal is drawn."""
        super().reset(seed=seed)
        goal = goal_number(self.env, options)
        with on_cpu():
            self.state, shown = start(self.env, key_of(self.np_random), goal)
            mask = self.env.action_mask(self.env.observe(self.state))
        self.shown = copied(shown)
        return dict(self.shown), {"action_mask": np.array(mask, np.int8)}

    def step(self, action: int):
        """One move. Raises `UserError` before the first reset, and for an action that does not exist."""
        self.check_begun("step")
        most = self.env.action_size - 1
        action = checks.whole(action, "action", 0, most, f"give 0 to {most}")
        with on_cpu():
            self.state, shown, mask = move(self.env, self.state, jnp.asarray(action, jnp.int32))
        self.shown = copied(shown)
        reward = float(rewards(self.shown["achieved_goal"], self.shown["desired_goal"]))
        info = {"is_success": float(self.state.terminated), "action_mask": np.array(mask, np.int8)}
        return dict(self.shown), reward, bool(self.state.terminated), bool(self.state.truncated), info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """0 at the goal and -1 elsewhere, float32 [...], for goals [..., N]; what hindsight relabelling calls."""
        return rewards(achieved_goal, desired_goal)

    def compute_terminated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """Whether these goals would have ended the episode, bool [...]."""
        return at_goal(achieved_goal, desired_goal)

    def pictures(self) -> np.ndarray:
        """What the agent sees, uint8 [H, W, 3]."""
        return picture(self.env, self.shown["observation"])


class TaskVector(Batch):
    """Many environments of one task, as `Batch` has them."""

    metadata = METADATA | Batch.autoreset

    def __init__(
        self,
        task: str | Environment,
        num_envs: int,
        config: Any = None,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        timed: bool = True,
    ):
        """max_episode_steps: None for those of the configuration; -1 for no limit."""
        num_envs = checks.whole(num_envs, "num_envs", 1, checks.MOST_ENVS)
        self.begin(with_limit(load(task, config), max_episode_steps, timed, default_length(task)), render_mode)
        self.make_spaces(num_envs, *spaces_of(self.env))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Reset every environment. options: {"goal": number or name}, for this episode only."""
        super().reset(seed=seed)
        goals = jnp.full(self.num_envs, goal_number(self.env, options), jnp.int32)
        self.state, shown = start_all(self.env, self.new_keys(), goals)
        mask = np.array(self.env.action_mask(self.env.observe(self.state)), np.int8)
        self.shown = copied(shown)
        return dict(self.shown), {"action_mask": mask, "_action_mask": np.ones(self.num_envs, bool)}

    def step(self, actions: np.ndarray):
        """One move everywhere, actions int [num_envs]."""
        self.check_begun("step")
        whole = np.issubdtype(np.asarray(actions).dtype, np.integer)
        fits = whole and self.action_space.contains(np.asarray(actions, self.action_space.dtype))
        require(fits, "actions", actions, f"give {self.num_envs} whole numbers from 0 to {self.env.action_size - 1}")
        actions = jnp.asarray(actions, jnp.int32)
        self.state, shown, mask, fresh = move_all(self.env, self.state, actions, self.new_keys())
        self.shown, moved = copied(shown), ~np.array(fresh)
        terminated, truncated = np.array(self.state.terminated), np.array(self.state.truncated)
        reward = np.where(moved, rewards(self.shown["achieved_goal"], self.shown["desired_goal"]), np.float32(0))
        info = {"is_success": (terminated & moved).astype(float), "action_mask": np.array(mask, np.int8)}
        info |= {"_is_success": moved, "_action_mask": np.ones(self.num_envs, bool)}
        return dict(self.shown), reward, terminated, truncated, info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """As `TaskGymnasium.compute_reward`."""
        return rewards(achieved_goal, desired_goal)

    def pictures(self) -> tuple[np.ndarray, ...]:
        """What each agent sees, uint8 [H, W, 3]."""
        return tuple(picture(self.env, image) for image in self.shown["observation"])
