"""The tasks as Gymnasium goal environments, those of the package and a user's own. `make` gives one environment on the
CPU, `TaskVector` a batch on whatever device jax uses. Importing this module registers the package's tasks:
`gymnasium.make("infogoal_jax.bridges.gymnasium:infogoal/FetchReach-v0")`. Needs the extra `gymnasium`.

A goal that is a vector is itself. One of a finite set is an entry of a vector of bits: `desired_goal` has one that is
set, `achieved_goal` those of the goals that are achieved now: the desired one where it is reached, and of the others
those that may be known while training (no validation or test question of embodied question answering). Hindsight
relabelling may therefore put one in place of the other. The Fetch tasks have the rewards and episodes of
Gymnasium-Robotics' FetchReach-v4 and its like.
"""

import contextlib
import copy
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import checks, envs
from infogoal_jax.envs.contract import check_contract
from infogoal_jax.envs.environment import Environment, draws_itself, failed_in
from infogoal_jax.envs.fetch.environment import Fetch
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.errors import UserError, require
from infogoal_jax.field_types import LARGEST_WHOLE
from infogoal_jax.goals import is_goal, no_goals_like, select
from infogoal_jax.train.contracts import check_simulated

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise UserError("gymnasium: is not installed; pip install 'infogoal-jax[gymnasium]'") from error

REWARD_TYPES = ("sparse", "dense")
"""0 at the goal and -1 elsewhere, or minus the distance."""
FARTHEST, LARGEST = 10.0, 50.0
"""No position (m) and no number of an observation of Fetch gets beyond these unless the simulation has diverged, and
then the step is taken back."""
METADATA = {"render_modes": ["rgb_array"], "render_fps": 4}


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


def load(task: str | Environment, config: Any) -> Environment:
    """The task of this name, or the environment itself; episodes of a Fetch task by default go on at the goal. Raises
    `UserError` for one whose goals form a finite set and whose actions are vectors."""
    checks.not_forked()
    if isinstance(task, Environment):
        require(config is None, "config", config, "leave it out: the environment has one of its own")
        check_contract(task)
        env = task
    else:
        of_reference = config is None and isinstance(task, str) and task in TASKS
        env = envs.load(task, FetchConfig(ends_at_goal=False) if of_reference else config)
    remedy = "its goals form a finite set, and its actions are vectors; give object_search or point_maze, for example"
    require(env.discrete or not env.goals.finite, "task", task, remedy)
    check_simulated(env, "task", task if isinstance(task, str) else type(env).__name__)
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
        achieved = env.goals_of(record)[0]
        return {"observation": observation, "achieved_goal": achieved, "desired_goal": state.desired_goal}
    goals, bits = env.goals_of(record), jnp.zeros(env.goals.num_goals, jnp.int8)
    achieved = bits.at[jnp.where(goals < 0, env.goals.num_goals, goals)].set(1, mode="drop")
    return {
        "observation": observation,
        # `goals_of` may leave out the desired goal where it is reached: a test question, a pose within 10 degrees.
        "achieved_goal": achieved.at[state.desired_goal].set(env.reached(record, state.desired_goal).astype(jnp.int8)),
        "desired_goal": bits.at[state.desired_goal].set(1),
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
def move(env: Environment, state: Any, action: jax.Array) -> tuple[Any, dict[str, jax.Array], jax.Array, jax.Array]:
    """The next state, what is seen of it, which actions can be taken in it, bool [A], and whether the episode has
    failed."""
    state = env.step(state, action)
    return state, seen(env, state), env.action_mask(env.observe(state)), failed_in(env, state)


@jax.jit
def drawn(env: Environment, state: Any) -> jax.Array:
    """The picture that a task draws of a state."""
    return env.draw(state)


start_all = jax.jit(jax.vmap(start, in_axes=(None, 0, 0)))
"""`start` for a batch."""


@jax.jit
def move_all(env: Environment, states: Any, actions: jax.Array, keys: jax.Array):
    """`move` for a batch, in which episodes that had ended start anew; and which these are."""

    def one(state, action, key):
        ended = state.terminated | state.truncated
        fresh, _ = start(env, key, no_goals_like(state.desired_goal))
        state = jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, env.step(state, action))
        return state, seen(env, state), env.action_mask(env.observe(state)), failed_in(env, state), ended

    return jax.vmap(one)(states, actions, keys)


def spaces_of(env: Environment) -> tuple[gymnasium.spaces.Dict, gymnasium.Space]:
    """The observation and action space of one environment. What is achieved may lie beyond the corners of desired
    goals."""
    shown = jax.eval_shape(lambda key: shown_observation(env, env.reset(key)), jax.random.key(0))
    farthest, largest = (FARTHEST, LARGEST) if isinstance(env, Fetch) else (np.inf, np.inf)
    low, high = (0, 255) if shown.dtype == jnp.uint8 else (-largest, largest)
    if env.goals.finite:
        achieved = desired = gymnasium.spaces.MultiBinary(env.goals.num_goals)
    else:
        achieved = gymnasium.spaces.Box(-farthest, farthest, env.goals.shape, np.float32)
        desired = gymnasium.spaces.Box(np.asarray(env.goals.low), np.asarray(env.goals.high), dtype=np.float32)
    spaces = {
        "observation": gymnasium.spaces.Box(low, high, shown.shape, shown.dtype),
        "achieved_goal": achieved,
        "desired_goal": desired,
    }
    one = (env.action_size,)
    actions = gymnasium.spaces.Discrete(one[0]) if env.discrete else gymnasium.spaces.Box(-1.0, 1.0, one, np.float32)
    return gymnasium.spaces.Dict(spaces), actions


def vectors(env: Environment, achieved: np.ndarray, desired: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Goals [..., D] as float32; NaN, which is no goal, is neither near nor far. Raises `UserError` for other shapes,
    and for infinite numbers."""
    (size,), found = env.goals.shape, []
    for field, goals in {"achieved_goal": achieved, "desired_goal": desired}.items():
        goals = np.asarray(checks.array(goals, field, "numbers", (..., size), finite=False))
        none = np.isnan(goals)
        found.append(np.where(none, np.float32(np.nan), checks.as_float32(np.where(none, 0, goals), field)))
    require_alike(*found, f"give goals [..., {size}] of one shape")
    return found[0], found[1]


def require_alike(achieved: np.ndarray, desired: np.ndarray, remedy: str) -> None:
    """Raise `UserError` for goals of two shapes."""
    found = f"of shape {achieved.shape}, desired_goal of {desired.shape}"
    require(achieved.shape == desired.shape, "achieved_goal", found, remedy)


def at_goal(env: Environment, achieved: np.ndarray, desired: np.ndarray) -> np.ndarray:
    """Whether desired goals [..., D] are achieved, bool [...]: vectors, or bits of a finite set. Raises `UserError` for
    other shapes, and for infinite numbers."""
    if env.goals.finite:
        return among(achieved, desired, env.goals.num_goals)
    achieved, desired = vectors(env, achieved, desired)
    size = achieved.shape[-1]
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
    require_alike(achieved, desired, f"give bits [..., {num_goals}] of one shape")
    return ((achieved > 0) & (desired > 0)).any(-1)


def goal_of(env: Environment, options: Any, num_envs: int = 0) -> np.ndarray:
    """The goal that `options` asks for, a vector or the number or name of one of a finite set; "no goal" for none. Of a
    batch goals [num_envs, *shape], which may be given one by one. Raises `UserError` for other options, and for a goal
    that cannot be evaluated."""
    require(options is None or isinstance(options, dict), "options", options, 'give {"goal": ...}, or leave them out')
    unknown = sorted(map(str, set(options or {}) - {"goal"}))
    require(not unknown, "options", unknown, 'only "goal" is known')
    space, axes, field = env.goals, (num_envs,) if num_envs else (), 'options["goal"]'
    if not options:
        return np.broadcast_to(no_goals_like(np.zeros(space.shape, space.dtype)), (*axes, *space.shape))
    given = options["goal"]
    given = np.asarray(given) if isinstance(given, jax.Array) else given
    listed = isinstance(given, list | tuple) or np.ndim(given) > 0
    several = bool(axes) and listed and len(given) > 0 and (space.finite or np.ndim(given[0]) > 0)
    goal = np.asarray(space.checked(given, field, axes=int(several)))
    require(not several or len(goal) == num_envs, field, f"of shape {np.shape(goal)}", f"give one, or {num_envs}")
    if space.finite:
        remedy = "give the number or the name of an evaluated goal (env.goals)"
        require(bool(np.isin(goal, np.asarray(space.evaluated)).all()), field, given, remedy)
    return np.broadcast_to(goal, (*axes, *space.shape))


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


def told(
    env: Environment, reached: np.ndarray, state: Any, mask: jax.Array, failed: jax.Array
) -> dict[str, np.ndarray]:
    """What `info` tells after a step of one environment, or of each of a batch. reached: whether it is at its goal,
    which is no success where the episode failed there."""
    info = {"is_success": (reached & ~np.array(failed)).astype(float)}
    if env.discrete:
        info["action_mask"] = np.array(mask, np.int8)
    if not env.goals.finite:
        info["diverged"] = np.array(state.diverged)
    return info


def default_length(task: str | Environment) -> int:
    """The task's own number of steps, which a configuration may change."""
    return task.episode_length if isinstance(task, Environment) else envs.registry.entry(task).config().episode_length


def picture(env: Environment, state: Any, image: np.ndarray) -> np.ndarray:
    """The scene of a Fetch task, what a task draws itself, or what the agent sees as RGB, uint8 [H, W, 3]. Raises
    `UserError` where it sees no image."""
    if isinstance(env, Fetch):
        from infogoal_jax.envs.fetch.scene import draw_fetch

        return draw_fetch(env, state)
    if draws_itself(env):
        return np.array(drawn(env, state))
    remedy = "the agent sees no images in this task; write draw(state), or leave it out"
    require(image.dtype == np.uint8, "render_mode", "rgb_array", remedy)
    return np.array(np.broadcast_to(image, (*image.shape[:2], 3)))


class Refusing(gymnasium.spaces.Dict):
    """A space that raises `checks.not_forked` when it is compared. Workers compare spaces first, and hand that error to
    their parent; what is raised while an environment is made they lose."""

    __hash__ = None

    def __eq__(self, other: Any) -> bool:
        checks.not_forked()
        return super().__eq__(other)


class OfTask:
    """What one environment and a batch of them share."""

    metadata = METADATA
    env: Environment
    """The task."""
    state: Any
    """The state of the episode, or of those of the batch; None before the first reset."""
    shown: dict[str, np.ndarray]
    """What was seen last."""

    def begin(self, env: Environment, render_mode: Any, reward_type: Any) -> None:
        """Hold the task, whose first episode is yet to come. Raises `UserError` for a mode or a reward that does not
        exist."""
        known = render_mode is None or (isinstance(render_mode, str) and render_mode in METADATA["render_modes"])
        require(known, "render_mode", render_mode, 'give "rgb_array" or None')
        fits = isinstance(reward_type, str) and reward_type in REWARD_TYPES
        require(fits, "reward_type", reward_type, f"give one of {', '.join(REWARD_TYPES)}")
        dense = reward_type == "dense"
        require(not (dense and env.goals.finite), "reward_type", reward_type, "goals have no distance; give sparse")
        self.env, self.render_mode, self.reward_type, self.state = env, render_mode, reward_type, None
        if isinstance(env, Fetch):
            self.metadata = self.metadata | {"render_fps": 25}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Seed Gymnasium's generator. Raises `UserError` for what is no seed."""
        return super().reset(seed=None if seed is None else checks.whole(seed, "seed", 0))

    def check_begun(self, call: str) -> None:
        """Raise `UserError` before the first reset."""
        require(self.state is not None, "state", None, f"call reset() before {call}()")

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """0 at the goal and -1 elsewhere, or minus the distance, float32 [...], for goals [..., N]; what hindsight
        relabelling calls."""
        if self.reward_type == "sparse":
            return at_goal(self.env, achieved_goal, desired_goal).astype(np.float32) - np.float32(1)
        achieved, desired = vectors(self.env, achieved_goal, desired_goal)
        remedy = 'is no goal, which has no distance; give reward_type="sparse"'
        for field, goals in (("achieved_goal", achieved), ("desired_goal", desired)):
            require(not np.isnan(goals).any(), field, goals.tolist(), remedy)
        return -np.linalg.norm(achieved - desired, axis=-1)

    def compute_terminated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """Whether these goals would have ended the episode, bool [...]."""
        return at_goal(self.env, achieved_goal, desired_goal) & self.env.ends_at_goal

    def reached(self) -> np.ndarray:
        """Whether what was seen last is at its goal."""
        return at_goal(self.env, self.shown["achieved_goal"], self.shown["desired_goal"])

    def rewards(self, reached: np.ndarray) -> np.ndarray:
        """The rewards of what was seen last, where this is whether it is at its goal."""
        if self.reward_type == "sparse":
            return reached.astype(float) - 1.0
        return self.compute_reward(self.shown["achieved_goal"], self.shown["desired_goal"], {})


class TaskGymnasium(OfTask, gymnasium.Env):
    """One environment. An episode is terminated at the goal, where the task ends there, and truncated after the task's
    number of steps.

    `info`: `is_success` 0.0 or 1.0, and 0.0 where the episode fails; `action_mask` int8 [A], where actions are moves,
    those that can be taken next; `diverged`, where goals are vectors: the step led to numbers that are not finite, and
    was taken back.

    It says what is wrong once it is used in a process that was forked from one in which JAX had started, such as a
    worker of Gymnasium's `AsyncVectorEnv`: nothing could be computed there.
    """

    def __init__(
        self,
        task: str | Environment,
        config: Any = None,
        render_mode: str | None = None,
        reward_type: str = "sparse",
        timed: bool = True,
    ):
        """reward_type: "sparse", or "dense" for minus the distance. timed: False where Gymnasium keeps the time."""
        if checks.Fork.jax_had_started:
            self.observation_space = self.action_space = Refusing()
            return
        with on_cpu():
            self.begin(with_limit(load(task, config), None, timed, default_length(task)), render_mode, reward_type)
        self.observation_space, self.action_space = spaces_of(self.env)

    def __getattr__(self, name: str) -> Any:
        checks.not_forked()
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

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
            self.state, shown, mask, failed = move(self.env, self.state, action)
        self.shown = copied(shown)
        reached = self.reached()
        info = told(self.env, reached, self.state, mask, failed)
        info["is_success"] = float(info["is_success"])
        if "diverged" in info:
            info["diverged"] = bool(info["diverged"])
        reward = float(self.rewards(reached))
        return dict(self.shown), reward, bool(self.state.terminated), bool(self.state.truncated), info

    def compute_truncated(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> bool:
        """Never: the time limit does not depend on the goal."""
        return False

    def render(self) -> np.ndarray | None:
        """A picture uint8 [H, W, 3], in mode "rgb_array"."""
        if self.render_mode is None:
            return None
        self.check_begun("render")
        return picture(self.env, self.state, self.shown["observation"])


class TaskVector(OfTask, VectorEnv):
    """Many environments of one task as one compiled program, on jax's default device.

    Autoreset is Gymnasium's `NEXT_STEP`: the step after the last of an episode starts the next one, with reward 0 and
    its action unused.
    """

    metadata = METADATA | {"autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        task: str | Environment,
        num_envs: int,
        config: Any = None,
        render_mode: str | None = None,
        reward_type: str = "sparse",
        max_episode_steps: int | None = None,
        timed: bool = True,
    ):
        """reward_type: see `TaskGymnasium`. max_episode_steps: None for those of the configuration; -1 for no limit."""
        self.num_envs = checks.whole(num_envs, "num_envs", 1, checks.MOST_ENVS)
        env = with_limit(load(task, config), max_episode_steps, timed, default_length(task))
        self.begin(env, render_mode, reward_type)
        self.single_observation_space, self.single_action_space = spaces_of(self.env)
        single = self.single_observation_space, self.single_action_space
        self.observation_space, self.action_space = (batch_space(space, self.num_envs) for space in single)

    def new_keys(self) -> jax.Array:
        """A key for each environment."""
        return jax.random.split(key_of(self.np_random), self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Reset every environment. options: {"goal": number, name or vector, or one for each}, for this episode
        only."""
        super().reset(seed=seed)
        self.state, shown = start_all(self.env, self.new_keys(), goal_of(self.env, options, self.num_envs))
        self.shown = copied(shown)
        if not self.env.discrete:
            return dict(self.shown), {}
        mask = np.array(self.env.action_mask(self.env.observe(self.state)), np.int8)
        return dict(self.shown), {"action_mask": mask, "_action_mask": np.ones(self.num_envs, bool)}

    def step(self, actions: np.ndarray):
        """One step everywhere, actions int [num_envs] or vectors [num_envs, A]."""
        self.check_begun("step")
        actions = action_of(self.env, actions, "actions", (self.num_envs,))
        self.state, shown, mask, failed, fresh = move_all(self.env, self.state, actions, self.new_keys())
        self.shown, moved = copied(shown), ~np.array(fresh)
        terminated, truncated = np.array(self.state.terminated), np.array(self.state.truncated)
        reached = self.reached()
        info = told(self.env, reached, self.state, mask, failed)
        reward = np.where(moved, self.rewards(reached), 0.0).astype(np.float32)
        info["is_success"] *= moved
        # Gymnasium's marks of the environments that these infos are of.
        info |= {f"_{name}": np.ones(self.num_envs, bool) if name == "action_mask" else moved for name in info}
        return dict(self.shown), reward, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of each environment, in mode "rgb_array"."""
        if self.render_mode is None:
            return None
        self.check_begun("render")
        states = [jax.tree.map(lambda leaf, row=row: leaf[row], self.state) for row in range(self.num_envs)]
        return tuple(map(picture, [self.env] * self.num_envs, states, self.shown["observation"]))


def id_of(task: str) -> str:
    """The Gymnasium id of a task: fetch_reach is infogoal/FetchReach-v0."""
    return "infogoal/" + "".join(word.capitalize() for word in task.split("_")) + "-v0"


def register(task: str, reward_type: str = "sparse") -> str:
    """Make a task known to Gymnasium, unless it is. Returns its id, in which dense rewards are named."""
    name = id_of(task)
    gymnasium_id = name.replace("-v0", "Dense-v0") if reward_type == "dense" else name
    if gymnasium_id not in gymnasium.registry:
        # Of the time Gymnasium is the only owner: `make` wraps one environment, a batch is told.
        kwargs = {"task": task, "timed": False} | ({"reward_type": reward_type} if reward_type == "dense" else {})
        gymnasium.register(
            gymnasium_id,
            entry_point=f"{__name__}:TaskGymnasium",
            vector_entry_point=f"{__name__}:TaskVector",
            kwargs=kwargs,
            max_episode_steps=default_length(task),
            order_enforce=False,
            disable_env_checker=True,
        )
    return gymnasium_id


for name in envs.registry:
    register(name)
for name in TASKS:
    register(name, "dense")


def make(task: str, config: Any = None, render_mode: str | None = None) -> gymnasium.Env:
    """The environment of a task by its name, without a wrapper.

    config: of the task; None for its defaults, of a Fetch task for the reference's episodes of 50 steps. Its
    `episode_length` is the limit, which `env.spec` knows. render_mode: None or "rgb_array". Raises `UserError` for
    unknown names.
    """
    env = TaskGymnasium(task, config, render_mode)
    env.spec = copy.deepcopy(gymnasium.spec(register(task)))
    env.spec.max_episode_steps = env.env.episode_length
    env.spec.kwargs |= {
        "config": None if config is None else dataclasses.replace(config, episode_length=default_length(task)),
        "render_mode": render_mode,
    }
    return env
