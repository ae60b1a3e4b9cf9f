"""Whatever a public function is given in place of one of its arguments: it is right, or one `UserError` says what is
wrong. Nothing is coerced, no error of Python or JAX comes through, and nothing is written."""

import dataclasses
import importlib
import inspect
import os
import re
from collections.abc import Callable
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import flax.struct
import hand_made
import hand_made_robots
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from places import ROOT, forgotten

import infogoal_jax
from infogoal_jax import (
    UserError,
    agents,
    compiled,
    envs,
    evaluate,
    jit,
    learners,
    load_run,
    make_train,
    presets,
    rollout,
    sweep,
    use_compilation_cache,
)
from infogoal_jax.bridges import brax, gymnasium, minari
from infogoal_jax.data.episodes import Episodes, of_arrays
from infogoal_jax.envs.plane import PlaneConfig
from infogoal_jax.envs.recordings import with_recordings
from infogoal_jax.goals import GoalBox, GoalSet
from infogoal_jax.hyperparameters import NoHyperparameters
from infogoal_jax.registry import Entry, Registry
from infogoal_jax.report.comparison_figures import draw_comparison
from infogoal_jax.report.figures import draw_figures
from infogoal_jax.report.statistics import mean_interval, paired_difference
from infogoal_jax.report.video import write_video
from infogoal_jax.runner import jobs, training
from infogoal_jax.runner.listeners import print_success
from infogoal_jax.runner.training import run

SHORT, LONG = 75, 5000


def zero(*arguments):
    """0, whatever it is given."""
    return 0


ENV, KEY = hand_made.environment(), jax.random.key(0)
CONFIG = hand_made.config()
GOALS = np.array([0, 2, 5])
SCALARS = [None, True, False, np.True_, 0, 1, -1, 2**31, 2**32 + 1, 2**70, 10**400, 0.5, 1.0, -0.0, 1e39, 1e308]
SCALARS += [
    float("nan"),
    float("inf"),
    1j,
    "",
    "x",
    "0",
    "\0",
    "\ud800",
    b"x",
    np.float32(0.5),
    np.int64(1),
    np.str_("x"),
]
SCALARS += [np.datetime64(0, "s"), object(), int, len, lambda: 0, zero, Path("x"), Path(), range(2), Ellipsis]
ARRAYS = [
    [],
    [0],
    [0, 2, 5],
    (),
    (0,),
    {},
    {"goal": 0},
    {1: 2},
    {0},
    [[0], [1, 2]],
    [None],
    ["a"],
    [True],
    [0.5],
    [[0, 2]],
]
ARRAYS += [
    np.array(0),
    np.array([0]),
    np.array([np.nan]),
    np.array([True]),
    np.array(["a"]),
    np.zeros((3, 4)),
    np.zeros(0),
]
ARRAYS += [
    np.array([0, 2], object),
    np.ma.masked_array([0, 1], [True, False]),
    np.zeros((2, 2), np.uint8),
    jnp.zeros(3),
]
ARRAYS += [jnp.arange(3), KEY, jax.random.split(KEY), jax.ShapeDtypeStruct((3,), np.int32), np.zeros(2, np.complex64)]
ODD = [*SCALARS, *ARRAYS, CONFIG, ENV, ENV.goals]


class Call(NamedTuple):
    """A public function, arguments with which it works, and for each argument that is replaced, which values are right
    too."""

    function: Callable
    arguments: dict[str, Any]
    right: dict[str, Callable[[Any], bool]]


def stay(observation, goal, key):
    """The first action, for every episode."""
    return jnp.zeros(observation.shape[:1], jnp.int32)


def whole(value, low=None, high=None) -> bool:
    """A whole number from low to high."""
    is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return is_whole and (low is None or value >= low) and (high is None or value <= high)


def are_actions(value) -> bool:
    """Three actions of the recordings: vectors, or the numbers of moves."""
    if isinstance(value, np.ndarray | jax.Array):
        moves = value.shape == (3,) and value.dtype.kind == "i" and bool((value >= 0).all())
        return moves or (isinstance(value, np.ndarray) and value.shape == (3, 4))
    return isinstance(value, list | tuple) and len(value) == 3 and all(whole(move, 0) for move in value)


def number(value) -> bool:
    """A number of Python or NumPy."""
    return isinstance(value, int | float | np.floating | np.integer) and not isinstance(value, bool)


def flag(value) -> bool:
    """True or False."""
    return isinstance(value, bool | np.bool_)


def goals(value) -> bool:
    """Goals of the hand-made task."""
    array = value if isinstance(value, np.ndarray | jax.Array) else None
    if isinstance(value, list | tuple | range) and all(whole(goal) for goal in value):
        array = np.array([*value], int)
    plain = array is not None and array.ndim == 1 and array.size and not isinstance(array, np.ma.MaskedArray)
    is_key = plain and jax.dtypes.issubdtype(array.dtype, jax.dtypes.prng_key)
    return bool(
        plain and not is_key and np.issubdtype(array.dtype, np.integer) and (array >= 0).all() and (array < 8).all()
    )


def one_goal(value) -> bool:
    """A goal of the hand-made task."""
    return whole(value, 0, 7) or (isinstance(value, np.ndarray) and value.ndim == 0 and goals(value[None]))


def never(value) -> bool:
    """None of the values."""
    return False


def is_method(value) -> bool:
    """Names of methods, some of which are short enough to be drawn."""
    return isinstance(value, str) and value in presets.METHODS


def none(value) -> bool:
    """Only what is left out."""
    return value is None


def shapes_of(function):
    """The function, traced only."""
    return lambda **arguments: jax.eval_shape(lambda: function(**arguments))


def seeds(value) -> bool:
    """Numbers with an axis of seeds."""
    try:
        array = value if isinstance(value, np.ndarray | jax.Array) else np.asarray(value)
    except ValueError:
        return False
    if isinstance(array, np.ma.MaskedArray) or jax.dtypes.issubdtype(array.dtype, jax.dtypes.prng_key):
        return False
    return array.ndim >= 1 and array.dtype.kind in "iuf"


def an_option(value) -> bool:
    """Options of a reset."""
    return value is None or (isinstance(value, dict) and value in ({}, {"goal": 0}))


def a_name(value) -> bool:
    """A learner or an agent by its name."""
    return isinstance(value, str) and (value in learners.registry or value in agents.registry)


def still(observation, goal, key):
    """No movement, for every episode."""
    return jnp.zeros((*observation.shape[:1], 2), jnp.float32)


def registered(register):
    """What a task's registration returns; afterwards nobody knows the task."""
    with forgotten():
        return register()


def a_word(value) -> bool:
    """Text, or a path, which counts as its name."""
    return isinstance(value, str | Path)


def texts(value) -> bool:
    """A dict by names."""
    return isinstance(value, dict) and all(isinstance(name, str) for name in value)


class WorkBegins(BaseException):
    """What was given is taken: the function would begin its work now."""


def until_work(function, module, name):
    """The function, which returns where it would call this one."""

    def begin(*arguments, **named):
        raise WorkBegins

    def call(**arguments):
        with mock.patch.object(module, name, begin):
            try:
                function(**arguments)
            except WorkBegins:
                return

    return call


def several_seeds(value) -> bool:
    """Different seeds."""
    array = value if isinstance(value, np.ndarray | jax.Array) else None
    if isinstance(value, list | tuple | range) and all(whole(seed) for seed in value):
        array = np.array([*value], int)
    if array is None or isinstance(array, np.ma.MaskedArray) or array.ndim != 1 or not array.size:
        return False
    is_whole = not jax.dtypes.issubdtype(array.dtype, jax.dtypes.prng_key) and array.dtype.kind in "iu"
    return is_whole and len({*array.tolist()}) == array.size and bool((array >= 0).all())


def some_places(value) -> bool:
    """Places of an observation of four numbers that leave one of the first two."""
    if isinstance(value, np.ndarray) and not isinstance(value, np.ma.MaskedArray):
        is_places = value.size == 0 or (value.ndim < 2 and value.dtype.kind in "iu")
        value = [int(place) for place in np.ravel(value)] if is_places else None
    if whole(value, -4, 3):
        value = [value]
    is_several = isinstance(value, list | tuple | set | dict) and all(whole(place, -4, 3) for place in value)
    return is_several and not {0, 1} <= {place % 4 for place in value}


@flax.struct.dataclass
class Seen:
    """A state as brax has them."""

    obs: jax.Array
    done: jax.Array


class Line:
    """An environment as brax has them: two numbers are moved, two are their goal."""

    action_size = 2

    def reset(self, rng):
        return Seen(jax.random.uniform(jax.random.wrap_key_data(rng), (4,), jnp.float32), jnp.zeros((), jnp.float32))

    def step(self, state, action):
        return state.replace(obs=state.obs.at[:2].add(action))


def stepped(actions):
    """What a step of a batch of three rooms returns."""
    batch = gymnasium.TaskVector(ENV, 3)
    batch.reset(seed=0)
    return batch.step(actions)


LINE = Line()
MASS = partial(TimeLimit, hand_made_robots.Mass(), 9)
"""Makes a robot of Gymnasium with a time limit."""
RECORDED = {"observations": np.zeros((3, 4)), "actions": np.zeros((3, 2)), "terminals": [0, 0, 1]}
MAZE = envs.load("point_maze", PlaneConfig(held_out=False))
SQUARES = np.zeros((2, 2), np.uint8)
"""Two goals of the maze, as one of `ARRAYS` has them."""
ROOMS = gymnasium.TaskGymnasium(ENV)
WALK = {"actions": np.zeros((3, 2)), "last": np.arange(3) == 2, "achieved_goals": np.zeros((3, 2))}
WALK |= {"observations": np.zeros((3, *jax.eval_shape(lambda: MAZE.observe(MAZE.reset(KEY))).shape))}
REWARDED = ("achieved_goal", "desired_goal")
FIELDS = {"inputs": np.zeros((3, 4), np.float32), "regions": [0, 0, 0], "uses": [0, 0, 2], "names": ("a", "b", "c")}


def is_path(value) -> bool:
    """A path that is not empty."""
    return isinstance(value, str | Path) and str(value) != "" and "\0" not in str(value)


CALLS = {
    "rollout": Call(
        shapes_of(rollout),
        {"env": ENV, "policy": stay, "goal": 0, "key": KEY},
        {"env": lambda value: value is ENV, "policy": never, "goal": one_goal, "key": lambda value: value is KEY},
    ),
    "evaluate": Call(
        shapes_of(evaluate),
        {"policy": stay, "env": ENV, "goals": GOALS, "starts": 1, "seed": 0},
        {
            "policy": never,
            "env": lambda value: value is ENV,
            "goals": goals,
            "starts": lambda value: whole(value, 1, 2**20),
            "seed": lambda value: whole(value, 0, 2**32 - 1),
        },
    ),
    "GoalSet.of": Call(
        GoalSet.of,
        FIELDS | {"region_names": ("a",), "rows": None},
        {
            "inputs": lambda value: isinstance(value, np.ndarray) and value.shape == (3, 4),
            "regions": never,
            "uses": lambda value: isinstance(value, jax.Array) and value.dtype == np.int32,
            "names": never,
            "region_names": lambda value: isinstance(value, list | np.ndarray) and str(value) in ("['a']",),
            "rows": lambda value: none(value) or (isinstance(value, jax.Array) and value.dtype == np.int32),
        },
    ),
    "presets.load": Call(
        presets.load,
        {"task": "fetch_reach", "method": "her", "learner": None, "agent": None, "num_envs": 4},
        {
            "task": never,
            "method": is_method,
            "learner": lambda value: none(value) or a_name(value),
            "agent": lambda value: none(value) or a_name(value),
            "num_envs": lambda value: whole(value, 1, 4000),
        },
    ),
    "envs.load": Call(envs.load, {"task": "fetch_reach", "config": None}, {"task": never, "config": none}),
    "make_train": Call(
        make_train,
        {"config": CONFIG, "env": ENV, "callback": None},
        {
            "config": lambda value: value is CONFIG,
            "env": lambda value: none(value) or value is ENV,
            "callback": lambda value: none(value) or callable(value),
        },
    ),
    "print_success": Call(
        print_success,
        {"num_epochs": 2, "num_seeds": 3},
        {"num_epochs": lambda value: whole(value, 1), "num_seeds": lambda value: whole(value, 1)},
    ),
    "mean_interval": Call(mean_interval, {"values": [1.0]}, {"values": seeds}),
    "paired_difference": Call(
        paired_difference, {"first": np.zeros((7, 5)), "second": np.zeros((7, 5))}, {"first": never, "second": never}
    ),
    "jit": Call(jit, {"function": stay}, {"function": callable}),
    "compiled": Call(compiled, {"function": len}, {"function": callable}),
    "use_compilation_cache": Call(
        use_compilation_cache, {"folder": ""}, {"folder": lambda value: none(value) or is_path(value)}
    ),
    "load_run": Call(load_run, {"folder": ""}, {"folder": never}),
    "draw_figures": Call(
        draw_figures,
        {"folder": "", "format": "png", "captions": False},
        {"folder": never, "format": never, "captions": never},
    ),
    "draw_comparison": Call(
        draw_comparison,
        {"folders": ["no_run"], "path": "out.png", "metrics": (), "captions": False},
        {"folders": never, "path": never, "metrics": never, "captions": never},
    ),
    "write_video": Call(
        write_video, {"path": "out.mp4", "frames": [], "fps": 25}, {"path": never, "frames": never, "fps": never}
    ),
    "run": Call(
        until_work(run, training, "make_train"),
        {
            "config": CONFIG,
            "seeds": [0],
            "folder": "out",
            "resume": False,
            "listeners": (),
            "env": ENV,
            "phase": zero,
            "left": zero,
        },
        {
            "config": lambda value: value is CONFIG,
            "seeds": several_seeds,
            "folder": lambda value: is_path(value) and "\ud800" not in str(value),
            "resume": flag,
            "listeners": lambda value: isinstance(value, list | tuple) and not value,
            "env": lambda value: none(value) or value is ENV,
            "phase": lambda value: value in (zero, int) if callable(value) else False,
            "left": lambda value: callable(value) and value not in (len, stay, object),
        },
    ),
    "sweep": Call(
        until_work(sweep, jobs, "check_new"),
        {
            "config": CONFIG,
            "seeds": [0],
            "folder": "out",
            "resume": False,
            "seeds_at_once": 0,
            "execute": zero,
            "learning_rate": [1e-4],
        },
        {
            "config": lambda value: value is CONFIG,
            "seeds": several_seeds,
            "folder": lambda value: is_path(value) and "\ud800" not in str(value),
            "resume": lambda value: flag(value) and not value,
            "seeds_at_once": lambda value: whole(value, 0),
            "execute": lambda value: value in (zero, int) if callable(value) else False,
            "learning_rate": lambda value: isinstance(value, list) and value == [0.5],
        },
    ),
    "envs.from_brax": Call(
        envs.from_brax,
        {
            "env": LINE,
            "goal": [2, 3],
            "achieved": [0, 1],
            "radius": 0.1,
            "hidden": (),
            "episode_length": 9,
            "ends_at_goal": True,
            "low": None,
            "high": None,
            "held_out": None,
            "num_evaluated": 2,
            "starts": 1,
            "source": "",
            "goals_drawn": 2,
        },
        {
            "env": lambda value: value is LINE,
            "goal": lambda value: isinstance(value, range),
            "achieved": lambda value: isinstance(value, range),
            "radius": lambda value: number(value) and 0 < value <= 1e37,
            "hidden": some_places,
            "episode_length": lambda value: whole(value, 1, 2**31 - 1),
            "ends_at_goal": flag,
            "low": none,
            "high": none,
            "held_out": lambda value: none(value) or value is zero,
            "num_evaluated": lambda value: whole(value, 1, 4096),
            "starts": lambda value: whole(value, 1, 4096),
            "goals_drawn": lambda value: whole(value, 2, 2**16),
            "source": lambda value: isinstance(value, str),
        },
    ),
    "envs.from_gymnasium": Call(
        envs.from_gymnasium,
        {
            "make": MASS,
            "radius": 0.1,
            "episode_length": 9,
            "ends_at_goal": False,
            "read": None,
            "write": None,
            "simulators": 1,
            "source": "",
        },
        {
            "make": lambda value: value is MASS,
            "radius": lambda value: none(value) or (number(value) and 0 < value <= 1e37),
            "episode_length": lambda value: none(value) or whole(value, 1, 2**31 - 1),
            "ends_at_goal": flag,
            "read": none,
            "write": none,
            "simulators": lambda value: whole(value, 0, 8),
            "source": lambda value: isinstance(value, str),
        },
    ),
    "envs.from_playground": Call(
        lambda **arguments: envs.from_playground(**arguments, goal=[2, 3], achieved=[0, 1], radius=0.1),
        {"env": LINE, "config_overrides": None},
        {"env": lambda value: value is LINE, "config_overrides": none},
    ),
    "envs.from_recordings": Call(
        envs.from_recordings,
        {"episodes": Episodes(**WALK), "held_out": None, "seen": None},
        {"episodes": never, "held_out": lambda value: none(value) or value is zero, "seen": none},
    ),
    "envs.from_jaxgcrl": Call(envs.from_jaxgcrl, {"name": ""}, {"name": never}),
    "of_arrays": Call(
        lambda **arrays: of_arrays(arrays),
        RECORDED,
        {
            "observations": lambda value: np.shape(value) == (3, 4) if isinstance(value, np.ndarray) else False,
            "actions": are_actions,
            "terminals": never,
        },
    ),
    "of_arrays of transitions": Call(
        lambda **arrays: of_arrays(arrays),
        RECORDED | {"next_observations": np.ones((3, 4)), "terminals": [1, 1, 1]},  # Each is an episode.
        {
            "observations": lambda value: np.shape(value) == (3, 4) if isinstance(value, np.ndarray) else False,
            "actions": are_actions,
            "terminals": never,
            "next_observations": lambda value: np.shape(value) == (3, 4) if isinstance(value, np.ndarray) else False,
        },
    ),
    "of_arrays of nothing": Call(of_arrays, {"arrays": RECORDED}, {"arrays": never}),
    "with_recordings": Call(
        with_recordings,
        {"task": MAZE, "episodes": Episodes(**WALK)},
        {"task": lambda value: value is MAZE, "episodes": never},
    ),
    "episodes_of": Call(minari.episodes_of, {"dataset": ""}, {"dataset": never}),
    "to_minari": Call(
        minari.to_minari, {"episodes": Episodes(**WALK), "out": "walks"}, {"episodes": never, "out": is_path}
    ),
    "presets.method_named": Call(presets.method_named, {"name": "her"}, {"name": is_method}),
    "presets.name_of": Call(presets.name_of, {"config": CONFIG}, {"config": lambda value: value is CONFIG}),
    "presets.default_hyperparameters": Call(
        presets.default_hyperparameters,
        {"learner": CONFIG.learner, "agent": CONFIG.agent},
        {"learner": never, "agent": never},
    ),
    "step of a batch": Call(
        stepped,
        {"actions": np.zeros(3, int)},
        {"actions": lambda value: str(value) in ("[0 1 2]", "[0, 2, 5]") and not isinstance(value, str)},
    ),
    "compute_reward of bits": Call(
        ROOMS.compute_reward,
        {"achieved_goal": np.eye(8)[:1], "desired_goal": np.eye(8)[1:2], "info": {}},
        {"achieved_goal": never, "desired_goal": never},
    ),
    "compute_reward of vectors": Call(
        gymnasium.TaskGymnasium(MAZE).compute_reward,
        {"achieved_goal": [[0.5, 0.5]], "desired_goal": [[0.5, 0.2]], "info": {}},
        {name: lambda value: str(value) == "[[0, 2]]" and not isinstance(value, str) for name in REWARDED},
    ),
    "compute_reward of Fetch": Call(
        gymnasium.TaskGymnasium("fetch_reach").compute_reward,
        {"achieved_goal": np.zeros((1, 3)), "desired_goal": np.ones((1, 3)), "info": {}},
        {name: never for name in REWARDED},
    ),
    "reset": Call(
        ROOMS.reset,
        {"seed": 0, "options": None},
        {"seed": lambda value: none(value) or whole(value, 0), "options": an_option},
    ),
    "TaskGymnasium": Call(
        gymnasium.TaskGymnasium,
        {"task": ENV, "config": None, "render_mode": None, "reward_type": "sparse", "timed": True},
        {"task": lambda value: value is ENV, "config": none, "render_mode": none, "reward_type": never, "timed": flag},
    ),
    "TaskVector": Call(
        gymnasium.TaskVector,
        {"task": ENV, "num_envs": 2, "max_episode_steps": None},
        {
            "task": lambda value: value is ENV,
            "num_envs": lambda value: whole(value, 1, 2**20),
            "max_episode_steps": lambda value: none(value) or (whole(value, -1, 2**31 - 1) and value != 0),
        },
    ),
    "FetchBrax": Call(
        brax.FetchBrax,
        {"task": "fetch_reach", "reward": "sparse", "config": None},
        {"task": never, "reward": never, "config": none},
    ),
    "GoalBox.of": Call(
        GoalBox.of,
        {"low": [0, 0], "high": [1, 1], "sampler": None, "use_of": None, "seen": None, "num_evaluated": 2, "seed": 0},
        {
            "low": never,
            "high": never,
            "sampler": none,
            "use_of": lambda value: none(value) or value is zero,
            "seen": none,
            "num_evaluated": lambda value: whole(value, 1, 4096),
            "seed": lambda value: whole(value, 0, 2**32 - 1),
        },
    ),
    "GoalBox.checked": Call(
        MAZE.goals.checked,
        {"goals": [[0.5, 0.5]], "field": "goals", "axes": 1},
        {"goals": lambda value: str(value) in ("[[0, 2]]", str(SQUARES)) and not isinstance(value, str)},
    ),
    "rollout of vectors": Call(
        shapes_of(rollout),
        {"env": MAZE, "policy": still, "goal": [0.5, 0.5], "key": KEY},
        {
            "env": lambda value: value is MAZE,
            "policy": never,
            "goal": lambda value: value == range(2) if isinstance(value, range) else False,
            "key": lambda value: value is KEY,
        },
    ),
    "evaluate vectors": Call(
        shapes_of(evaluate),
        {"policy": still, "env": MAZE, "goals": [[0.5, 0.5]], "starts": 1, "seed": 0},
        {
            "policy": never,
            "env": lambda value: value is MAZE,
            "goals": lambda value: str(value) in ("[[0, 2]]", str(SQUARES)) and not isinstance(value, str),
            "starts": lambda value: whole(value, 1, 2**20),
            "seed": lambda value: whole(value, 0, 2**32 - 1),
        },
    ),
    "presets.register": Call(
        lambda name, env, preset: registered(lambda: presets.register(name, env, preset)),
        {"name": "mine", "env": MAZE, "preset": None},
        {
            "name": lambda value: isinstance(value, str) and bool(re.fullmatch(r"[^\W_][\w.-]*", value)),
            "env": lambda value: value is MAZE,
            "preset": none,
        },
    ),
    "Preset": Call(
        lambda **fields: registered(lambda: presets.registry.update(mine=presets.Preset(**fields))),
        {"agent": "td3", "training": {}, "hyper": {}, "methods": {}, "env": {}, "agents": {}, "description": ""},
        {
            "agent": a_word,
            "training": texts,
            "hyper": texts,
            "methods": lambda value: isinstance(value, dict) and not value,
            "env": texts,
            "agents": lambda value: isinstance(value, dict) and not value,
            "description": a_word,
        },
    ),
    "Entry": Call(
        lambda **fields: Registry("learner", {}).__setitem__("own", Entry(**fields)),
        {"config": type(CONFIG.learner), "make": stay, "hyper": NoHyperparameters, "traits": None},
        {"config": never, "make": callable, "hyper": never, "traits": lambda value: none(value) or callable(value)},
    ),
}


SURE = ["rollout", "evaluate", "GoalSet.of", "presets.load", "envs.load", "mean_interval", "Entry", "GoalBox.of"]
SURE += ["GoalBox.checked", "rollout of vectors", "evaluate vectors", "presets.register", "Preset", "run", "sweep"]
SURE += ["envs.from_brax", "envs.from_gymnasium", "envs.from_playground", "of_arrays", "of_arrays of transitions"]
SURE += ["with_recordings", "envs.from_recordings", "presets.method_named", "presets.name_of"]
SURE += ["presets.default_hyperparameters", "step of a batch"]
SURE += ["compute_reward of bits", "compute_reward of vectors", "compute_reward of Fetch"]
"""Functions that work as they are called here."""


@st.composite
def calls(draw) -> tuple[str, str, Any]:
    """A function, one of its arguments, and an odd value for it."""
    name = draw(st.sampled_from(list(CALLS)))
    argument = draw(st.sampled_from(list(CALLS[name].right)))
    return name, argument, draw(st.sampled_from(ODD) | st.integers() | st.floats() | st.text(max_size=4))


def is_right_or_refused(name: str, argument: str, value: Any) -> None:
    """Call a function with an odd value in place of one argument, in an empty folder."""
    function, arguments, right = CALLS[name]
    if right[argument](value):
        return
    with pytest.raises(UserError):
        function(**arguments | {argument: value})
    assert not os.listdir()


@pytest.mark.long
@pytest.mark.parametrize("name", CALLS)
def test_every_odd_value_is_right_or_is_refused(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for argument in CALLS[name].right:
        for value in ODD:
            is_right_or_refused(name, argument, value)


@pytest.mark.parametrize("count", [SHORT, pytest.param(LONG, marks=pytest.mark.long)])
def test_an_argument_is_right_or_is_refused(count, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    @settings(
        max_examples=count,
        deadline=timedelta(seconds=30),
        derandomize=count == SHORT,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(calls())
    def check(call):
        is_right_or_refused(*call)

    check()


@pytest.mark.parametrize("name", SURE)
def test_right_arguments_are_taken(name):
    """Else everything would be refused."""
    function, arguments, _ = CALLS[name]
    function(**arguments)


def public_functions() -> set[str]:
    """The functions that the package exports or docs/reference/api.md describes, and that take something."""
    found = {name: getattr(infogoal_jax, name) for name in infogoal_jax.__all__}
    found |= {f"presets.{name}": getattr(presets, name) for name in presets.__all__}
    found |= {f"envs.{name}": getattr(envs, name) for name in vars(envs) if name == "load" or name.startswith("from_")}
    for path in re.findall(r"^::: ([\w.]+)$", (ROOT / "docs" / "reference" / "api.md").read_text(), re.M):
        module, _, name = path.rpartition(".")
        if module not in ("infogoal_jax.presets", "infogoal_jax.envs"):
            found[name] = getattr(importlib.import_module(module), name)
    return {name for name, value in found.items() if inspect.isfunction(value) and inspect.signature(value).parameters}


def test_every_public_function_is_called_here():
    """One that is added is tried with odd arguments too."""
    assert not public_functions() - {*CALLS}
    assert {"sweep", "run", "envs.from_brax", "presets.register"} <= public_functions()


def test_arrays_are_no_hyperparameters_of_a_run(tmp_path):
    """They were found out when the run was written, and left an empty folder."""
    config = dataclasses.replace(CONFIG, hyper=CONFIG.hyper.replace(discount=np.array([0.9, 0.95])))
    with pytest.raises(UserError, match="hyper.discount = array.*give one number"):
        run(config, [0], tmp_path / "run", env=ENV)
    assert not os.listdir(tmp_path)
