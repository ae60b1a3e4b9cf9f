"""Live goal environments of Gymnasium as tasks: `from_gymnasium`, for Gymnasium-Robotics and for a robot of one's own
on C MuJoCo. docs/guides/bridges.md trains on one.

A task is pure, and a simulator is not. Its whole state therefore travels in the state of the task, byte for byte, and
is put back before each step: a few simulators, a thread each, play every row of a batch inside one host callback. So
the same key gives the same numbers, and seeds, resuming and evaluation work as for every task.

A state has 37 kB for FetchReach and 24 kB for AntMaze, nearly all of it MuJoCo's arrays. To read it and to put it back
takes 0.15 ms of a core beside 1.5 ms for a step of FetchReach, 0.06 beside 1.0 ms for AntMaze, and 0.08 beside 0.14 ms
for PointMaze. The simulators run on the CPU. With a GPU each step waits for them, and the state goes to the host and
back.
"""

import ctypes
import dataclasses
import os
import queue
import types
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from numbers import Real
from typing import Any, NamedTuple

import flax.struct
import jax
import numpy as np

from infogoal_jax import checks
from infogoal_jax.data.episodes import Episodes
from infogoal_jax.envs import adapters
from infogoal_jax.envs.adapters import AdaptedTask
from infogoal_jax.envs.goal_task import Episode, between
from infogoal_jax.errors import UserError, nearest, reason, require
from infogoal_jax.field_types import LARGEST_WHOLE

PARTS = ("observation", "achieved_goal", "desired_goal")
MOST_NUMBERS = 1024
"""Of an attribute of an environment that is carried along; longer ones are taken for tables that stay as they are."""
MOST_SIMULATORS = 8
GOALS_DRAWN = 256
"""Goals that are drawn to find how far they spread: a reset of such an environment takes about a millisecond."""
PLAYED = 50
"""Steps for which an environment is compared with itself, put back into each state."""


class Row(NamedTuple):
    """What the task carries of one environment.

    bytes: uint32 [W], the simulator's state.
    obs: dictionary of float32.
    done: float32, the episode has failed.
    cut: bool, the environment has truncated it, or the task has ended it.
    """

    bytes: jax.Array
    obs: dict[str, jax.Array]
    done: jax.Array
    cut: jax.Array

    @property
    def over(self) -> bool:
        """Of one environment: whether its episode is over."""
        return bool(self.done or self.cut)


@flax.struct.dataclass
class LiveTask(AdaptedTask):
    """A Gymnasium environment as a task: its world is a `Row`."""

    def step(self, state: Episode, action: jax.Array) -> Episode:
        """One step. What the environment truncates is truncated. Where the episode is over, also at its goal, the
        environment is not stepped: it may refuse."""
        over = state.terminated | state.truncated
        state = super().step(state.replace(world=state.world._replace(cut=state.world.cut | over)), action)
        return state.replace(truncated=state.truncated | (state.world.cut & ~state.terminated))

    def recorded_observation(self, episodes: Episodes) -> np.ndarray:
        """What the agent sees of a recording: `achieved_goal` and `observation`, which a recording may have apart."""
        seen, achieved = episodes.observations, episodes.achieved_goals
        apart = achieved is not None and seen.ndim == 2 and seen.shape[1] + achieved.shape[1] == len(self.shown)
        return np.concatenate([achieved, seen], 1) if apart else super().recorded_observation(episodes)

    def mujoco_model(self) -> Any:
        """MuJoCo's model of the robot; None where the environment has none."""
        return self.env.mujoco_model

    def joint_positions(self, world: Row) -> np.ndarray:
        """The positions of that model [nq]; not in a compiled program."""
        return self.env.joint_positions(np.asarray(world.bytes))

    @property
    def action_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Those of the environment."""
        return self.env.bounds


def from_gymnasium(
    make: str | Callable[[], Any],
    *,
    radius: float | None = None,
    episode_length: int | None = None,
    ends_at_goal: bool = True,
    read: Callable[[Any], Any] | None = None,
    write: Callable[[Any, Any], None] | None = None,
    simulators: int = 0,
    source: str = "",
    **arguments: Any,
) -> LiveTask:
    """A goal environment of Gymnasium as a task: its id, or a function that makes a new one. Observations are `Dict`
    with `observation`, `achieved_goal` and `desired_goal`, vectors each; the agent sees the first two, in the order
    `achieved_goal`, `observation`.

    radius: distance below which a goal is reached; None: the environment's `distance_threshold`.
    episode_length: steps of an episode, at most the environment's own time limit, which None is. ends_at_goal: whether
        reaching the goal ends it. Where the environment terminates elsewhere than at its goal, the episode has failed.
        Where it terminates at its own goal it is stepped on, since episodes for other goals go on there.
    read, write: (environment) -> its state as an array of numbers, and (environment, that array) -> None; None: what
        MuJoCo's `MjData` holds, with every number and short array among the environment's attributes.
    simulators: environments that are made, a thread each; 0: one for each core, at most 8.
    arguments: of `from_brax`: `low`, `high`, `held_out`, `num_evaluated`, `starts`.

    Raises `UserError`, naming the argument, for what is no such environment, and for one that goes elsewhere within 50
    steps once it is put back into a state: where a step draws random numbers, or depends on what is not carried. Each
    process of a sweep makes its own: by an id, or by a file that `--import` names.
    """
    require((read is None) == (write is None), "write", write, "give both read and write, or neither")
    for name, function, count in (("read", read, 1), ("write", write, 2)):
        if function is not None:
            checks.function(function, name, count, "give a function of the environment")
    if radius is not None:
        checks.number(radius, "radius", 0.0, adapters.WIDEST)
    if episode_length is not None:
        checks.whole(episode_length, "episode_length", 1, LARGEST_WHOLE)
    checks.whole(simulators, "simulators", 0, MOST_SIMULATORS)
    checks.text(source, "source", "say what is simulated, in words")
    adapters.check_arguments(arguments, {"goal", "achieved", "hidden", "goals_drawn"})
    made = maker(make)
    first = said("make", Simulator, made, read, write)
    threshold, limit = first.threshold() if radius is None else radius, first.limit()
    require(threshold is not None, "radius", None, "the environment has no distance_threshold; give a distance")
    require(episode_length or limit, "episode_length", None, "the environment has no time limit; give one")
    own = getattr(first.env.unwrapped, "distance_threshold", None)
    own_threshold = float(own) if isinstance(own, Real) else 0.0
    if own is None:
        first.check_reward(threshold, "radius", "give the environment's own, or more")
    first.radius = max(float(threshold), own_threshold)  # What ends the environment's episodes for its own goal.
    said(first.name, first.check_put_back)
    batch = Batch(first, made, read, write, simulators or min(os.cpu_count() or 1, MOST_SIMULATORS))
    task = adapters.from_brax(
        batch,
        goal="desired_goal",
        achieved="achieved_goal",
        radius=float(threshold),
        episode_length=min(filter(None, (episode_length, limit))),
        ends_at_goal=ends_at_goal,
        source=source or f"{first.name} of Gymnasium, simulated",
        goals_drawn=GOALS_DRAWN,
        **arguments,
    )
    return LiveTask(**{field.name: getattr(task, field.name) for field in dataclasses.fields(task)})


def maker(make: Any) -> Callable[[], Any]:
    """What makes one environment. Raises `UserError` where Gymnasium is not installed, and for an unknown id."""
    gymnasium = adapters.imported("gymnasium", "pip install 'infogoal-jax[gymnasium]'")
    if isinstance(make, str):
        others = make not in gymnasium.registry and ":" not in make
        if others and adapters.is_there("gymnasium_robotics"):
            gymnasium.register_envs(adapters.imported("gymnasium_robotics", "pip install gymnasium-robotics"))
        known = [*gymnasium.registry]
        there = make in known or ":" in make  # `MODULE:ID` is imported by Gymnasium.
        robotics = "that of Gymnasium-Robotics: pip install gymnasium-robotics"
        remedy = f"Gymnasium has no such environment; {robotics}; one of your own: --import FILE that registers it"
        require(there, "make", make, f"{remedy}.{nearest(make, sorted(known, reverse=True))}")  # The newest version.
    else:
        checks.function(make, "make", 0, "give the id of an environment, or a function that makes a new one")
    mend_robotics()
    function = partial(gymnasium.make, make, disable_env_checker=True) if isinstance(make, str) else make

    def made() -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return said("make", function)

    return made


def mend_robotics() -> None:
    """Gymnasium-Robotics 1.4.2 asks whether a number is in a tuple of enumerators, which MuJoCo 3.17 denies: a Fetch or
    a Hand could not be made. In its module of these functions they become the numbers that they are."""
    robotics = adapters.is_there("gymnasium_robotics.utils")
    utils = adapters.imported("gymnasium_robotics.utils.mujoco_utils", "pip install mujoco") if robotics else None
    if utils is None or isinstance(utils.mujoco, types.SimpleNamespace):
        return
    joints = {name: int(value) for name, value in utils.mujoco.mjtJoint.__members__.items()}
    utils.mujoco = types.SimpleNamespace(**(vars(utils.mujoco) | {"mjtJoint": types.SimpleNamespace(**joints)}))


class Place(NamedTuple):
    """Where a carried number or array is: an attribute of one of the environment's layers."""

    layer: int
    name: str
    shape: tuple[int, ...]
    dtype: np.dtype


class Simulator:
    """One environment, whose state can be read and put back."""

    def __init__(self, make: Callable[[], Any], read: Any, write: Any):
        self.env, self.own = make(), (read, write)
        self.check_spaces()
        self.name = getattr(getattr(self.env, "spec", None), "id", None) or type(self.env.unwrapped).__name__
        self.radius = 0.0
        self.shapes = {name: self.env.observation_space[name].shape for name in PARTS}
        self.layers = [self.env]
        while hasattr(self.layers[-1], "env"):
            self.layers.append(self.layers[-1].env)
        self.begun(self.env.reset(seed=0)[0])
        self.datas, self.buffers, self.places = [], [], []
        self.find_state()
        self.ended = False
        """Whether the last step ended the episode, be it at the goal."""
        self.start = None
        self.start = self.read()

    def check_spaces(self) -> None:
        """Raise `UserError` for spaces other than vectors for observation, goals and bounded actions."""
        for name in ("observation_space", "action_space", "reset", "step", "unwrapped"):
            require(hasattr(self.env, name), "make", type(self.env).__name__, f"has no {name}: give a Gymnasium one")
        spaces = getattr(self.env.observation_space, "spaces", {})
        for name in PARTS:
            space = spaces.get(name) if isinstance(spaces, dict) else None
            field = f"observation_space[{name!r}]"
            require(space is not None, field, str(self.env.observation_space)[:60], "give a Dict with such an entry")
            remedy = "give a Box of numbers with one axis; pixels and nested spaces are not taken"
            is_vector = len(getattr(space, "shape", None) or ()) == 1 and space.dtype.kind == "f"
            require(is_vector, field, str(space)[:60], remedy)
        goals = [spaces[name].shape[0] for name in PARTS[1:]]
        require(goals[0] == goals[1], "desired_goal", goals[1], f"achieved_goal has {goals[0]} numbers; give as many")
        actions = self.env.action_space
        low, high = getattr(actions, "low", None), getattr(actions, "high", None)
        is_vector = low is not None and len(actions.shape) == 1 and actions.dtype.kind == "f"
        require(
            is_vector, "action_space", str(actions)[:60], "actions are vectors; give a Box of numbers with one axis"
        )
        bounded = np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()
        require(bounded, "action_space", str(actions)[:60], "give finite bounds, between which actions lie")

    def limit(self) -> int | None:
        """The time limit of Gymnasium's wrapper, the shortest of several."""
        own = [getattr(layer, "_max_episode_steps", None) for layer in self.layers]
        return min(filter(None, own), default=None)

    def threshold(self) -> float | None:
        """The environment's distance below which a goal is reached, if it has one. Raises `UserError` where
        `compute_reward` takes goals well beyond it for reached."""
        radius = getattr(self.env.unwrapped, "distance_threshold", None)
        if radius is not None:
            checks.number(radius, "distance_threshold", 0.0, adapters.WIDEST)
            self.check_reward(radius, "distance_threshold", "give radius")
        return radius

    def check_reward(self, radius: float, field: str, remedy: str) -> None:
        """Raise `UserError`, naming the field, where `compute_reward` takes goals beyond this distance for reached."""
        reward = getattr(self.env.unwrapped, "compute_reward", None)
        if reward is None:
            return
        goal = np.asarray(self.env.reset(seed=0)[0]["desired_goal"], np.float64)
        ways = np.concatenate([np.eye(len(goal)), -np.eye(len(goal))])
        goals = np.broadcast_to(goal, ways.shape)
        there, beyond = (
            np.asarray(said("compute_reward", reward, goals + far * radius * ways, goals, {})) for far in (0, 1.1)
        )
        farther = f"compute_reward takes goals that are farther away for reached; {remedy}"
        require((there != beyond).all(), field, radius, farther)

    def find_state(self) -> None:
        """Find what is carried: the buffers of MuJoCo, and the numbers among the attributes of each layer; of wrappers
        alone, where the user reads and writes the environment."""
        layers = self.layers
        if self.own[0] is None:
            mujoco = adapters.imported("mujoco", "pip install mujoco")
            found = [getattr(self.env.unwrapped, "data", None)]
            found += [value for layer in layers for value in vars(layer).values()]
            self.datas = [*{id(value): value for value in found if isinstance(value, mujoco.MjData)}.values()]
            self.buffers = [buffer for data in self.datas for buffer in buffers_of(data)]
        else:
            layers = layers[:-1]
        for number, layer in enumerate(layers):
            for name, value in vars(layer).items():
                array = carried(value)
                if array is None or name.startswith("_np_random"):
                    continue
                if not any(np.may_share_memory(array, buffer) for buffer in self.buffers):
                    self.places.append(Place(number, name, array.shape, array.dtype))

    def read(self) -> np.ndarray:
        """The state, uint32 [W]."""
        parts = [np.array([data.time for data in self.datas]).tobytes(), *(each.tobytes() for each in self.buffers)]
        for place in self.places:
            found = vars(self.layers[place.layer])[place.name]
            value = np.asarray(found)
            if value.shape != place.shape or not np.can_cast(value.dtype, place.dtype, "same_kind"):
                was = checks.written(place.shape, str(place.dtype))
                raise UserError(f"{place.name} of {self.name}: is {checks.described(value)}; it began as {was}")
            # Numbers of Python and NumPy calculate differently, and a step may put one in the place of the other.
            is_python = np.uint32(not isinstance(found, np.ndarray | np.generic))
            parts += [value.astype(place.dtype, copy=False).tobytes(), is_python.tobytes()]
        if self.own[0] is not None:
            state = said("read", self.own[0], self.env)
            parts.append(np.asarray(checks.array(state, "the state of read", "numbers"), np.float64).tobytes())
        content = b"".join(parts)
        words = np.frombuffer(content + bytes(-len(content) % 4), np.uint32)
        same = self.start is None or words.shape == self.start.shape
        require(same, "the state of read", len(words), "has another length than before")
        return words

    def write(self, words: np.ndarray) -> None:
        """Put the environment into a state [W]."""
        content, start = np.ascontiguousarray(words).view(np.uint8), 0
        for data in self.datas:
            data.time = float(content[start : start + 8].view(np.float64)[0])
            start += 8
        for buffer in self.buffers:
            buffer[:] = content[start : start + buffer.size]
            start += buffer.size
        for layer, name, shape, dtype in self.places:
            value = np.ndarray(shape, dtype, content, start)
            start += value.nbytes
            is_python = content[start : start + 4].view(np.uint32)[0]
            start += 4
            vars(self.layers[layer])[name] = value.item() if is_python else value.copy()[()]
        if self.own[1] is not None:
            numbers = content[start : start + (content.size - start) // 8 * 8].copy().view(np.float64)
            said("write", self.own[1], self.env, numbers)

    def observed(self, seen: Any) -> dict[str, np.ndarray]:
        """What is seen, as float32. Raises `UserError` for another thing than the space says."""
        seen = seen if isinstance(seen, dict) else {}
        parts = {name: np.asarray(seen.get(name)) for name in PARTS}
        for name, found in parts.items():
            if found.shape != self.shapes[name] or found.dtype.kind != "f":
                wanted = checks.written(self.shapes[name], "float")
                raise UserError(f"{name} of {self.name}: is {checks.described(found)}; its space is {wanted}")
        return {name: found.astype(np.float32) for name, found in parts.items()}

    def begun(self, seen: Any) -> dict[str, np.ndarray]:
        """What is seen after a reset. Raises `UserError` for numbers that are not finite: a network sees them, and a
        step that leads to them is taken back, which a reset cannot be."""
        found = self.observed(seen)
        for name, numbers in found.items():
            finite = np.isfinite(numbers).all()
            require(finite, f"{name} of {self.name}", numbers.tolist(), "is not finite after a reset; mend it there")
        return found

    def reset(self, seed: int) -> Row:
        """A new episode, from the same state of the simulator always."""
        self.write(self.start)
        seen, _ = self.env.reset(seed=seed)
        self.ended = False
        return Row(self.read(), self.begun(seen), np.float32(0), np.bool_(False))

    def step(self, action: np.ndarray) -> Row:
        """One step from the state that the environment is in; the action lies in [-1, 1]. It is clipped to the bounds
        of the environment's own, which a rounded sum may miss."""
        space = self.env.action_space
        action = np.clip(between((space.low, space.high), action), space.low, space.high).astype(space.dtype)
        seen, _, terminated, truncated, _ = self.env.step(action)
        self.ended = bool(terminated or truncated)
        failed = bool(terminated) and not self.at_goal(seen)
        return Row(self.read(), self.observed(seen), np.float32(failed), np.bool_(truncated))

    def at_goal(self, seen: dict[str, np.ndarray]) -> bool:
        """Whether the environment's own goal is achieved where this is seen."""
        return bool(np.linalg.norm(np.subtract(seen["achieved_goal"], seen["desired_goal"])) < self.radius)

    def following(self, row: Row, action: np.ndarray) -> Row:
        """The step after a row, to which the environment is put back; one that is over stays: its next state is not
        used, and an environment may refuse to step."""
        self.write(row.bytes)
        if row.over:
            return row
        try:
            return self.step(action)
        except Exception as error:
            if isinstance(error, UserError) or not self.at_goal(row.obs):
                raise
            remedy = "it was at its own goal, where episodes for other goals go on: let it be stepped there"
            raise UserError(f"{self.name}: raised {reason(error)}; {remedy}") from error

    def check_put_back(self) -> None:
        """Raise `UserError` unless an episode with the environment put back into each state, and others begun in
        between, is the one that it plays alone."""
        size = self.env.action_space.shape[0]
        actions = np.random.default_rng(0).uniform(-1, 1, (PLAYED, size)).astype(np.float32)
        alone = [self.reset(1)]
        for action in actions:
            alone += [] if self.ended else [self.step(action)]
        row = self.reset(1)
        for number in range(len(alone)):
            same = all(np.array_equal(row.obs[name], alone[number].obs[name], equal_nan=True) for name in PARTS)
            where = f"after {number} steps" if number else "after a reset with the same seed"
            remedy = (
                "give read and write, which hold all that a step uses and a reset may draw; a step may draw no random "
                "numbers"
            )
            same = same and row[2:] == alone[number][2:]
            require(same, "make", self.name, f"goes elsewhere {where} when put back; {remedy}")
            if number + 1 < len(alone):
                self.following(self.reset(2), -actions[number])
                row = self.following(row, actions[number])


def said(field: str, function: Callable, *arguments: Any) -> Any:
    """What a function of the environment's author returns. Raises `UserError`, naming it, where it raises."""
    try:
        return function(*arguments)
    except UserError:
        raise
    except Exception as error:
        raise UserError(f"{field}: raised {reason(error)}{checks.line_of(error)}") from error


def buffers_of(data: Any) -> list[np.ndarray]:
    """The memory in which MuJoCo keeps the arrays of `MjData` that last from step to step, as bytes: the arena of what
    each step makes anew is elsewhere. Derived numbers are among them, such as places of bodies, which are those of the
    last substep: an environment reads them before it steps. Left out is what is for drawing alone."""
    first = data.qpos.ctypes.data  # The first of them.
    inside = data.qpos.size > 0 and first < data.xpos.ctypes.data < first + data.nbuffer
    require(inside, "make", "MjData without joints", "give a model with a joint, or read and write")
    whole = np.ctypeslib.as_array((ctypes.c_uint8 * data.nbuffer).from_address(first))
    drawn = data.bvh_active
    if not drawn.size:
        return [whole]
    start = drawn.ctypes.data - first
    return [whole[:start], whole[start + drawn.nbytes :]]


def within(actions: Any) -> tuple[np.ndarray, np.ndarray]:
    """The bounds of a space of actions, float32 [A], rounded inwards."""
    low, high = (np.asarray(bound, np.float32) for bound in (actions.low, actions.high))
    rounded = np.where(low < actions.low, np.nextafter(low, np.inf), low)
    return rounded, np.where(high > actions.high, np.nextafter(high, -np.inf), high)


def carried(value: Any) -> np.ndarray | None:
    """The array of what is a number or a short array of numbers."""
    if not isinstance(value, bool | int | float | np.generic | np.ndarray):
        return None
    array = np.asarray(value)
    return array if array.dtype.kind in "biuf" and array.size <= MOST_NUMBERS else None


class Batch:
    """Any number of environments with the interface of brax, played by a few simulators."""

    def __init__(self, first: Simulator, make: Callable, read: Any, write: Any, count: int):
        self.action_size = first.env.action_space.shape[0]
        self.bounds = within(first.env.action_space)
        self.free: queue.SimpleQueue = queue.SimpleQueue()
        self.threads = ThreadPoolExecutor(count)
        self.count = count
        self.mujoco_model = first.datas[0].model if first.datas else None
        self.shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), first.reset(0))
        for number in range(count):
            simulator = Simulator(make, read, write) if number else first
            simulator.start, simulator.radius = first.start, first.radius
            self.free.put(simulator)

    def joint_positions(self, words: np.ndarray) -> np.ndarray:
        """The joints' positions of MuJoCo [nq] in a state [W]."""
        simulator = self.free.get()
        simulator.write(words)
        found = simulator.datas[0].qpos.copy()
        self.free.put(simulator)
        return found

    def reset(self, key: jax.Array) -> Row:
        """A new episode, seeded by the last word of a key."""
        return jax.pure_callback(self.reset_rows, self.shapes, key[..., -1], vmap_method="broadcast_all")

    def step(self, row: Row, action: jax.Array) -> Row:
        """The environment after an action."""
        return jax.pure_callback(self.step_rows, self.shapes, row, action, vmap_method="broadcast_all")

    def reset_rows(self, seeds: Any) -> Row:
        """Resets for seeds [...]."""
        seeds = np.asarray(seeds)
        flat = seeds.reshape(-1)
        return self.played(seeds.shape, lambda simulator, row: simulator.reset(int(flat[row])))

    def step_rows(self, rows: Row, actions: Any) -> Row:
        """Steps of rows [...] under actions [..., A]."""
        rows, pushes = jax.tree.map(np.asarray, (rows, actions))
        axes = rows.done.shape
        rows, pushes = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[len(axes) :]), (rows, pushes))

        def play(simulator: Simulator, number: int) -> Row:
            return simulator.following(jax.tree.map(lambda leaf: leaf[number], rows), pushes[number])

        return self.played(axes, play)

    def played(self, axes: tuple[int, ...], play: Callable[[Simulator, int], Row]) -> Row:
        """The rows [axes] that simulators play, each a part of them."""
        size = int(np.prod(axes))
        rows = jax.tree.map(lambda leaf: np.empty((size, *leaf.shape), leaf.dtype), self.shapes)
        leaves = jax.tree.leaves(rows)

        def some(part: np.ndarray) -> None:
            simulator = self.free.get()
            try:
                for row in part:
                    played = said(simulator.name, play, simulator, row)
                    for leaf, value in zip(leaves, jax.tree.leaves(played), strict=True):
                        leaf[row] = value
            finally:
                self.free.put(simulator)

        list(self.threads.map(some, np.array_split(np.arange(size), min(self.count, max(size, 1)))))
        return jax.tree.map(lambda leaf: leaf.reshape((*axes, *leaf.shape[1:])), rows)
