"""Tasks as Gymnasium goal environments: all of the package but the Fetch tasks in their reference's form, and tasks of
a user's own.

A goal that is a vector is itself. One of a finite set is an entry of a vector of bits: `desired_goal` has one that is
set, `achieved_goal` those of the goals that are achieved now: the desired one where it is reached, and of the others
those that may be known while training (no validation or test question of embodied question answering). Hindsight
relabelling may therefore put one in place of the other. Rewards are those of the Fetch tasks, 0 at the goal and -1
elsewhere. `TaskGymnasium` is one environment on the CPU, `TaskVector` a batch on whatever device jax uses; importing
`infogoal_jax.bridges.gymnasium` registers both.
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
from infogoal_jax.goals import is_goal, no_goals_like, select

METADATA = {"render_modes": ["rgb_array"], "render_fps": 4}


def load(task: str | Environment, config: Any) -> Environment:
    """The task of this name, or the environment itself. Raises `UserError` for one whose goals form a finite set and
    whose actions are vectors."""
    checks.not_forked()
    if isinstance(task, Environment):
        require(config is None, "config", config, "leave it out: the environment has one of its own")
    env = task if isinstance(task, Environment) else envs.load(task, config)
    remedy = "its goals form a finite set, and its actions are vectors; give object_search or point_maze, for example"
    require(env.discrete or not env.goals.finite, "task", task, remedy)
    return env


def shown_observation(env: Environment, state: Any) -> jax.Array:
    """The observation: a vector as the task has it, anything else as a network sees it."""
    stored = env.observe(state)
    is_vector = isinstance(stored, jax.Array) and stored.dtype == jnp.float32
    return stored if is_vector else env.render(stored)


def seen(env: Environment, state: Any) -> dict[str, jax.Array]:
    """The observation, and the goals as bits int8 [N], or as the vectors that they are, float32 [D]."""
    record, observation = env.achieved(state), shown_observation(env, state)
    if not env.goals.finite:
        return {"observation": observation, "achieved_goal": env.goals_of(record)[0], "desired_goal": state.goal}
    goals, bits = env.goals_of(record), jnp.zeros(env.goals.num_goals, jnp.int8)
    achieved = bits.at[jnp.where(goals < 0, env.goals.num_goals, goals)].set(1, mode="drop")
    return {
        "observation": observation,
        # `goals_of` may leave out the desired goal where it is reached: a test question, a pose within 10 degrees.
        "achieved_goal": achieved.at[state.goal].set(env.reached(record, state.goal).astype(jnp.int8)),
        "desired_goal": bits.at[state.goal].set(1),
    }


@jax.jit
def start(env: Environment, key: jax.Array, goal: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
    """The state of a new episode and what is seen of it. goal: "no goal" for one drawn among the training goals."""
    drawn_key, start_key = jax.random.split(key)
    space = env.goals
    drawn = jax.random.choice(drawn_key, space.training_goals) if space.finite else space.draw(drawn_key)
    state = env.reset_to(start_key, select(is_goal(goal), goal, drawn))
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
        fresh, _ = start(env, key, no_goals_like(state.goal))
        state = jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, env.step(state, action))
        return state, seen(env, state), env.action_mask(env.observe(state)), ended

    return jax.vmap(one)(states, actions, keys)


def spaces_of(env: Environment) -> tuple[gymnasium.spaces.Dict, gymnasium.Space]:
    """The observation and action space of one environment. What is achieved may lie beyond the corners of desired
    goals."""
    shown = jax.eval_shape(lambda key: shown_observation(env, env.reset(key)), jax.random.key(0))
    low, high = (0, 255) if shown.dtype == jnp.uint8 else (-np.inf, np.inf)
    if env.goals.finite:
        achieved = desired = gymnasium.spaces.MultiBinary(env.goals.num_goals)
    else:
        achieved = gymnasium.spaces.Box(-np.inf, np.inf, env.goals.shape, np.float32)
        desired = gymnasium.spaces.Box(np.asarray(env.goals.low), np.asarray(env.goals.high), dtype=np.float32)
    spaces = {
        "observation": gymnasium.spaces.Box(low, high, shown.shape, shown.dtype),
        "achieved_goal": achieved,
        "desired_goal": desired,
    }
    one = (env.action_size,)
    actions = gymnasium.spaces.Discrete(one[0]) if env.discrete else gymnasium.spaces.Box(-1.0, 1.0, one, np.float32)
    return gymnasium.spaces.Dict(spaces), actions


def at_goal(env: Environment, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
    """Whether desired goals [..., D] are achieved, bool [...]: vectors, or bits of a finite set. Raises `UserError` for
    other shapes, and for numbers that are not finite."""
    if env.goals.finite:
        return among(achieved, desired, env.goals.num_goals)
    (size,) = env.goals.shape
    given = {"achieved_goal": achieved, "desired_goal": desired}
    achieved, desired = (
        checks.as_float32(checks.array(goals, field, "numbers", (..., size)), field) for field, goals in given.items()
    )
    require(
        achieved.shape == desired.shape,
        "achieved_goal",
        f"of shape {achieved.shape}, desired_goal of {desired.shape}",
        f"give goals [..., {size}] of one shape",
    )
    rows = achieved.size // size
    # Hindsight relabelling asks for batches of many sizes: each power of two is compiled once.
    padding = [(0, (1 << max(rows - 1, 0).bit_length()) - rows), (0, 0)]
    pairs = (np.pad(goals.reshape(rows, size), padding) for goals in (achieved, desired))
    with on_cpu():
        return np.asarray(reached_in_rows(env, *pairs))[:rows].reshape(achieved.shape[:-1])


@jax.jit
def reached_in_rows(env: Environment, achieved: jax.Array, desired: jax.Array) -> jax.Array:
    """Whether each of M achieved goals [M, D] reaches the desired one beside it, bool [M]."""
    return env.reached(achieved, desired)


def among(achieved: np.ndarray, desired: np.ndarray, num_goals: int) -> np.ndarray:
    """Whether a desired goal is among those that are achieved, bool [...], for bits [..., N]. Raises `UserError` for
    other shapes, and for another number of goals N."""
    bits = {}
    for field, given in {"achieved_goal": achieved, "desired_goal": desired}.items():
        flags = isinstance(given, np.ndarray) and given.dtype == bool
        bits[field] = np.asarray(checks.array(given, field, "flags" if flags else "numbers", (..., num_goals)))
        require(np.isin(bits[field], (0, 1)).all(), field, given, f"give bits [..., {num_goals}], each 0 or 1")
    achieved, desired = bits["achieved_goal"], bits["desired_goal"]
    require(
        achieved.shape == desired.shape,
        "achieved_goal",
        f"of shape {achieved.shape}, desired_goal of {desired.shape}",
        f"give bits [..., {num_goals}] of one shape",
    )
    return ((achieved > 0) & (desired > 0)).any(-1)


def rewards(env: Environment, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
    """0 at the goal and -1 elsewhere, float32 [...]."""
    return at_goal(env, achieved, desired).astype(np.float32) - np.float32(1)


def goal_of(env: Environment, options: dict[str, Any] | None) -> np.ndarray:
    """The goal that `options` asks for, a vector or the number or name of one of a finite set; "no goal" for none.
    Raises `UserError` for one that cannot be evaluated."""
    space = env.goals
    if not options_of(options):
        return np.asarray(no_goals_like(np.zeros(space.shape, space.dtype)))
    goal, field = options["goal"], 'options["goal"]'
    if not space.finite:
        return np.asarray(space.checked(goal, field, axes=0))
    remedy = "give the number or the name of an evaluated goal (env.goals)"
    if isinstance(goal, str):
        require(goal in env.goals.names, field, goal, remedy)
        number = env.goals.names.index(goal)
    else:
        number = checks.whole(goal, field, remedy=remedy)
    require(number in np.asarray(env.goals.evaluated), field, goal, remedy)
    return np.int32(number)


def action_of(env: Environment, action: Any, field: str, axes: tuple[int, ...] = ()) -> jax.Array:
    """Actions with these axes, int32, or vectors float32 that the task clips. Raises `UserError` for others."""
    if env.discrete:
        most = env.action_size - 1
        if not axes:
            return jnp.asarray(checks.whole(action, field, 0, most, f"give 0 to {most}"), jnp.int32)
        remedy = f"give {axes[0]} whole numbers from 0 to {most}"
        given = np.asarray(checks.array(action, field, "whole numbers", axes, remedy))
        require(bool(((given >= 0) & (given <= most)).all()), field, action, remedy)
        return jnp.asarray(given, jnp.int32)
    shape = (*axes, env.action_size)
    remedy = f"give {' x '.join(map(str, shape))} numbers in [-1, 1]"
    return jnp.asarray(checks.array(action, field, "numbers", shape, remedy), jnp.float32)


def told(env: Environment, shown: dict[str, np.ndarray], state: Any, mask: jax.Array) -> dict[str, np.ndarray]:
    """What `info` tells after a step of one environment, or of each of a batch."""
    info = {"is_success": at_goal(env, shown["achieved_goal"], shown["desired_goal"]).astype(float)}
    if env.discrete:
        info["action_mask"] = np.array(mask, np.int8)
    if not env.goals.finite:
        info["diverged"] = np.array(state.diverged)
    return info


def default_length(task: str | Environment) -> int:
    """The task's own number of steps, which a configuration may change."""
    return task.episode_length if isinstance(task, Environment) else envs.registry.entry(task).config().episode_length


def picture(env: Environment, image: np.ndarray) -> np.ndarray:
    """What the agent sees as RGB, uint8 [H, W, 3]. Raises `UserError` where it sees no image."""
    require(image.dtype == np.uint8, "render_mode", "rgb_array", "the agent sees no images in this task; leave it out")
    return np.array(np.broadcast_to(image, (*image.shape[:2], 3)))


class TaskGymnasium(One):
    """One environment. An episode is terminated at the goal and truncated after the task's number of steps.

    `info`: `is_success` 0.0 or 1.0; `action_mask` int8 [A], where actions are moves, those that can be taken next;
    `diverged`, where goals are vectors: the step led to numbers that are not finite, and was taken back.
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
        """A new episode. options: {"goal": number, name or vector}; without them a training goal is drawn."""
        super().reset(seed=seed)
        goal = goal_of(self.env, options)
        with on_cpu():
            self.state, shown = start(self.env, key_of(self.np_random), goal)
            mask = self.env.action_mask(self.env.observe(self.state))
        self.shown = copied(shown)
        return dict(self.shown), {"action_mask": np.array(mask, np.int8)} if self.env.discrete else {}

    def step(self, action: Any):
        """One step. Raises `UserError` before the first reset, and for an action that does not exist."""
        self.check_begun("step")
        action = action_of(self.env, action, "action")
        with on_cpu():
            self.state, shown, mask = move(self.env, self.state, action)
        self.shown = copied(shown)
        info = told(self.env, self.shown, self.state, mask)
        info["is_success"] = float(info["is_success"])
        if "diverged" in info:
            info["diverged"] = bool(info["diverged"])
        reward = info["is_success"] - 1.0
        return dict(self.shown), reward, bool(self.state.terminated), bool(self.state.truncated), info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """0 at the goal and -1 elsewhere, float32 [...], for goals [..., N]; what hindsight relabelling calls."""
        return rewards(self.env, achieved_goal, desired_goal)

    def compute_terminated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """Whether these goals would have ended the episode, bool [...]."""
        return at_goal(self.env, achieved_goal, desired_goal) & self.env.ends_at_goal

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
        """Reset every environment. options: {"goal": number, name or vector}, for this episode only."""
        super().reset(seed=seed)
        goal = goal_of(self.env, options)
        goals = jnp.broadcast_to(goal, (self.num_envs, *np.shape(goal)))
        self.state, shown = start_all(self.env, self.new_keys(), goals)
        self.shown = copied(shown)
        if not self.env.discrete:
            return dict(self.shown), {}
        mask = np.array(self.env.action_mask(self.env.observe(self.state)), np.int8)
        return dict(self.shown), {"action_mask": mask, "_action_mask": np.ones(self.num_envs, bool)}

    def step(self, actions: np.ndarray):
        """One step everywhere, actions int [num_envs] or vectors [num_envs, A]."""
        self.check_begun("step")
        actions = action_of(self.env, actions, "actions", (self.num_envs,))
        self.state, shown, mask, fresh = move_all(self.env, self.state, actions, self.new_keys())
        self.shown, moved = copied(shown), ~np.array(fresh)
        terminated, truncated = np.array(self.state.terminated), np.array(self.state.truncated)
        info = told(self.env, self.shown, self.state, mask)
        reward = np.where(moved, info["is_success"] - 1.0, 0.0).astype(np.float32)
        info["is_success"] *= moved
        # Gymnasium's marks of the environments that these infos are of.
        info |= {f"_{name}": np.ones(self.num_envs, bool) if name == "action_mask" else moved for name in info}
        return dict(self.shown), reward, terminated, truncated, info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """As `TaskGymnasium.compute_reward`."""
        return rewards(self.env, achieved_goal, desired_goal)

    def pictures(self) -> tuple[np.ndarray, ...]:
        """What each agent sees, uint8 [H, W, 3]."""
        return tuple(picture(self.env, image) for image in self.shown["observation"])
