"""Whatever a public function is given in place of one of its arguments: it is right, or one `UserError` says what is
wrong. Nothing is coerced, no error of Python or JAX comes through, and nothing is written."""

import dataclasses
import os
import re
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any, NamedTuple

import hand_made
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from infogoal_jax import (
    UserError,
    compiled,
    envs,
    evaluate,
    jit,
    learners,
    load_run,
    make_train,
    presets,
    rollout,
    use_compilation_cache,
)
from infogoal_jax.bridges import brax, gymnasium
from infogoal_jax.envs.plane import PlaneConfig
from infogoal_jax.goals import GoalBox, GoalSet
from infogoal_jax.hyperparameters import NoHyperparameters
from infogoal_jax.registry import Entry, Registry
from infogoal_jax.report.comparison_figures import draw_comparison
from infogoal_jax.report.figures import draw_figures
from infogoal_jax.report.statistics import mean_interval, paired_difference
from infogoal_jax.report.video import write_video
from infogoal_jax.runner.training import run

SHORT, LONG = 150, 5000


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
    """A part by its name."""
    return isinstance(value, str) and value in learners.registry


def still(observation, goal, key):
    """No movement, for every episode."""
    return jnp.zeros((*observation.shape[:1], 2), jnp.float32)


def registered(name, register):
    """What a task's registration returns; afterwards nobody knows the task."""
    try:
        return register()
    finally:
        for registry in (envs.registry, presets.registry):
            if isinstance(name, str) and name not in KNOWN:
                registry.pop(name, None)


def a_word(value) -> bool:
    """Text, or a path, which counts as its name."""
    return isinstance(value, str | Path)


def texts(value) -> bool:
    """A dict by names."""
    return isinstance(value, dict) and all(isinstance(name, str) for name in value)


MAZE = envs.load("point_maze", PlaneConfig(held_out=False))
KNOWN = {*envs.registry}
SQUARES = np.zeros((2, 2), np.uint8)
"""Two goals of the maze, as one of `ARRAYS` has them."""
ROOMS = gymnasium.TaskGymnasium(ENV)
FIELDS = {"inputs": np.zeros((3, 4), np.float32), "regions": [0, 0, 0], "uses": [0, 0, 2], "names": ("a", "b", "c")}
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
            "method": never,
            "learner": lambda value: none(value) or a_name(value),
            "agent": none,
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
        run,
        {"config": None, "seeds": [0], "folder": "out", "resume": False, "listeners": (), "env": ENV, "phase": stay},
        {name: never for name in ("config", "seeds", "folder", "resume", "listeners", "env", "phase")},
    ),
    "reset": Call(
        ROOMS.reset,
        {"seed": 0, "options": None},
        {"seed": lambda value: none(value) or whole(value, 0), "options": an_option},
    ),
    "TaskGymnasium": Call(
        gymnasium.TaskGymnasium,
        {"task": ENV, "config": None, "render_mode": None, "timed": True},
        {"task": lambda value: value is ENV, "config": none, "render_mode": none, "timed": flag},
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
    "FetchGymnasium": Call(
        gymnasium.FetchGymnasium,
        {"task": "fetch_reach", "config": None, "render_mode": None, "reward_type": "sparse"},
        {"task": never, "config": none, "render_mode": none, "reward_type": never},
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
        lambda name, env, preset: registered(name, lambda: presets.register(name, env, preset)),
        {"name": "mine", "env": MAZE, "preset": None},
        {
            "name": lambda value: isinstance(value, str) and bool(re.fullmatch(r"\w[\w.-]*", value)),
            "env": lambda value: value is MAZE,
            "preset": none,
        },
    ),
    "Preset": Call(
        lambda **fields: registered("mine", lambda: presets.registry.update(mine=presets.Preset(**fields))),
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
SURE += ["GoalBox.checked", "rollout of vectors", "evaluate vectors", "presets.register", "Preset"]
"""Functions that work as they are called here."""


def is_path(value) -> bool:
    """A path that is not empty."""
    return isinstance(value, str | Path) and str(value) != "" and "\0" not in str(value)


@st.composite
def calls(draw) -> tuple[str, str, Any]:
    """A function, one of its arguments, and an odd value for it."""
    name = draw(st.sampled_from(list(CALLS)))
    argument = draw(st.sampled_from(list(CALLS[name].right)))
    return name, argument, draw(st.sampled_from(ODD) | st.integers() | st.floats() | st.text(max_size=4))


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
        name, argument, value = call
        function, arguments, right = CALLS[name]
        if right[argument](value):
            return
        with pytest.raises(UserError):
            function(**arguments | {argument: value})
        assert not os.listdir(tmp_path)

    check()


@pytest.mark.parametrize("name", SURE)
def test_right_arguments_are_taken(name):
    """Else everything would be refused."""
    function, arguments, _ = CALLS[name]
    function(**arguments)


def test_arrays_are_no_hyperparameters_of_a_run(tmp_path):
    """They were found out when the run was written, and left an empty folder."""
    config = dataclasses.replace(CONFIG, hyper=CONFIG.hyper.replace(discount=np.array([0.9, 0.95])))
    with pytest.raises(UserError, match="hyper.discount = array.*give one number"):
        run(config, [0], tmp_path / "run", env=ENV)
    assert not os.listdir(tmp_path)
