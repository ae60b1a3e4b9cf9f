"""How many seeds run side by side in a device's memory, before anything is compiled; and what a compiled program says
that it needs.

The estimate counts what training carries and what an update and an evaluation look at. What it misses shows in the
compiled program (`check_compiled`); sizes that no device has, in the arrays of the traced one (`check_traced`).
"""

import dataclasses
import math
import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr

from infogoal_jax import presets
from infogoal_jax.config import TrainConfig
from infogoal_jax.envs.environment import one_observation
from infogoal_jax.errors import UserError, require
from infogoal_jax.keys import is_key
from infogoal_jax.runner.compilation import inner_programs
from infogoal_jax.train.program import Train

MEMORY_FRACTION = 0.8
"""Of the device's memory that a sweep may fill before it is sliced."""
EVALUATION_POLICIES = 4
"""Code sampled or mean, goals clean or corrupted."""
WORKING_COPIES = 2
"""Copies of a seed's state that a running chunk holds beside the one that is carried: updated, and gradients."""
MATERIALISED = {"dot_general", "conv_general_dilated", "scan", "while", "sort", "scatter", "scatter-add", "cumsum"}
"""Operations whose results lie in memory; compilers fuse most others with what uses them."""
GIB = 2**30


def bytes_of(tree: Any) -> int:
    """Bytes that the arrays of a pytree (or of its shapes) take."""
    return sum(array_bytes(leaf) for leaf in jax.tree.leaves(tree))


def array_bytes(array: Any) -> int:
    """Bytes of an array or its shape. A key is two uint32."""
    return math.prod(array.shape) * (8 if is_key(array) else array.dtype.itemsize)


def device_memory(device) -> int:
    """Bytes of memory that the device has."""
    statistics = device.memory_stats()
    if statistics and "bytes_limit" in statistics:
        return statistics["bytes_limit"]
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def mesh_memory(mesh: jax.sharding.Mesh) -> int:
    """Bytes of memory that every device of a mesh has."""
    return min(device_memory(device) for device in mesh.devices.flat)


def state_bytes(train: Train) -> int:
    """Bytes that training carries for one seed."""
    return bytes_of(train.state_shapes)


def working_bytes(train: Train) -> int:
    """Bytes that a seed takes beside copies of its state, roughly: what is seen of each transition three times over and
    cut into patches, the goals that it achieved, and the episodes of an evaluation."""
    config, env = train.config, train.env
    observation = one_observation(env)
    seen = jax.eval_shape(env.render, observation)
    goal = jax.eval_shape(lambda: env.goals.inputs_of(env.goals.examples[0]))
    num_goals = config.batch_size * train.parts.agent.num_steps
    if env.goals.finite and env.goals.num_goals <= config.batch_size:
        num_goals = env.goals.num_goals
    encoded = (6 * config.batch_size * seen.size + 4 * num_goals * goal.size) * np.dtype("float32").itemsize
    return encoded + (episode_bytes(train, config.evaluation_starts) if env.simulated else 0)


def episode_bytes(train: Train, starts: int) -> int:
    """Bytes of what is observed in the episodes of an evaluation of one seed, with so many starts a goal."""
    env = train.env
    observation = one_observation(env)
    episodes = len(env.goals.evaluated) * starts
    return episodes * (env.episode_length + 1) * bytes_of(observation) * EVALUATION_POLICIES


def at_once(train: Train, count: int, mesh: jax.sharding.Mesh, name: str = "seeds") -> int:
    """How many of a device's seeds (or members of another name) run beside each other. Raises `UserError`, naming the
    field that is to blame, if not even one does."""
    memory = mesh_memory(mesh)
    state, extra, held = state_bytes(train), working_bytes(train), bytes_of(train.env)
    alone = (1 + WORKING_COPIES) * state + extra + held
    if alone > MEMORY_FRACTION * memory:
        raise too_large(train.config, preset_of(train.config), alone, memory)
    return seeds_at_once(state, extra, held, count // mesh.size, memory, mesh.size, name)


def fit_at_once(state_bytes: int, extra_bytes: int, env_bytes: int, num_seeds: int, memory: int) -> bool:
    """Whether so many seeds run beside each other, as `seeds_at_once` takes them."""
    running = WORKING_COPIES * state_bytes + extra_bytes
    return num_seeds * (state_bytes + running) + env_bytes <= MEMORY_FRACTION * memory


def seeds_at_once(
    state_bytes: int,
    extra_bytes: int,
    env_bytes: int,
    num_seeds: int,
    memory: int,
    devices: int = 1,
    name: str = "seeds",
) -> int:
    """How many of a device's seeds run beside each other in `MEMORY_FRACTION` of its memory: all of them, or a part
    that divides their number.

    state_bytes: carried for each of the `num_seeds` of the device, and once more for those that run in a slice.
    extra_bytes: `working_bytes` of each that runs.
    env_bytes: held once.
    devices and name: how many there are, and of the number of seeds, for the message.
    Raises `UserError` if not even their states fit and one of them.
    """
    if fit_at_once(state_bytes, extra_bytes, env_bytes, num_seeds, memory):
        return num_seeds
    room, running = MEMORY_FRACTION * memory - env_bytes, WORKING_COPIES * state_bytes + extra_bytes
    fitting = int((room - num_seeds * state_bytes) // (state_bytes + running))
    alone = int(state_bytes + running <= room)
    most = devices * max(alone, int((room - state_bytes - running) // state_bytes))
    require(
        fitting > 0,
        name,
        num_seeds * devices,
        f"each takes {state_bytes / 2**20:,.0f} MiB, {running / 2**20:,.0f} MiB more while it runs, "
        f"{room_in_words(memory)}: give at most {most}",
    )
    return max(count for count in divisors(num_seeds) if count <= fitting)


def divisors(number: int) -> Iterator[int]:
    """Every divisor of a number."""
    for small in range(1, math.isqrt(number) + 1):
        if number % small == 0:
            yield small
            yield number // small


def room_in_words(memory: int) -> str:
    """How much memory a device has, of a GPU what jax takes of it."""
    words = f"a device has {memory / GIB:.1f} GiB"
    if jax.default_backend() != "gpu":
        return words
    fraction = os.environ.get("XLA_PYTHON_CLIENT_MEM_FRACTION") or "0.75"
    return f"{words}: {fraction} of its memory, the fraction that XLA_PYTHON_CLIENT_MEM_FRACTION lets jax take"


def check_traced(programs: Iterable[Jaxpr | ClosedJaxpr], config: Any, usual: Callable[[], Any], memory: int) -> None:
    """Raise `UserError`, naming the field that is to blame, if one array of these traced programs is larger than the
    memory of their devices together. Lowering a program does not trace it again: the types are the same."""
    largest = max(largest_array(program) for program in programs)
    if largest > memory:
        raise too_large(config, usual(), largest, memory)


def largest_array(program: Jaxpr | ClosedJaxpr) -> int:
    """Bytes of the largest array that an operation of `MATERIALISED` makes or a scan reads, inside of loops too."""
    jaxpr = program.jaxpr if isinstance(program, ClosedJaxpr) else program
    largest = 0
    for equation in jaxpr.eqns:
        name = equation.primitive.name
        inside = [largest_array(inner) for value in equation.params.values() for inner in inner_programs(value)]
        lying = [*(equation.outvars if name in MATERIALISED else ()), *(equation.invars if name == "scan" else ())]
        largest = max(largest, *inside, *(array_bytes(each.aval) for each in lying), 0)
    return largest


def check_compiled(programs: Iterable[jax.stages.Compiled], config: Any, usual: Callable[[], Any], memory: int) -> None:
    """Raise `UserError`, naming the field that is to blame, if one of these compiled programs needs more than the
    memory of a device. A compiler that does not say what a program needs is believed."""
    for program in programs:
        found = program.memory_analysis()
        if found is None:
            continue
        held = found.argument_size_in_bytes + found.output_size_in_bytes - found.alias_size_in_bytes
        if held + found.temp_size_in_bytes > memory:
            raise too_large(config, usual(), held + found.temp_size_in_bytes, memory)


def too_large(config: Any, usual: Any, needed: int, memory: int) -> UserError:
    """The refusal of a training that needs so many bytes. It names the field that is the most times larger than in the
    usual configuration; where none is the recordings that are learned from, or the task."""
    needs = f"training needs {needed / GIB:,.1f} GiB, {room_in_words(memory)}"
    fields = list(larger_fields(config, usual))
    recordings = getattr(config.env, "dataset", "")
    if not fields and recordings:
        remedy = "leave out some of its episodes, or take a larger device"
        return UserError(f"env.dataset = {recordings!r}: {needs}: {remedy}")
    if not fields:
        return UserError(f"task = {config.task!r}: {needs}: give smaller sizes, or take a larger device")
    name, value, preset = max(fields, key=lambda field: size(field[1]) / max(1, size(field[2])))
    return UserError(f"{name} = {value!r}: {needs}: give a smaller value, such as {preset!r}")


def preset_of(config: TrainConfig) -> TrainConfig:
    """The preset of a configuration's task and parts."""
    return presets.load(config.task, **presets.names_of(config))


def larger_fields(config: Any, preset: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """(dotted name, value, the preset's) of every whole number, and every list of them, that is larger than the
    preset's."""
    for field in dataclasses.fields(config):
        value, usual = getattr(config, field.name), getattr(preset, field.name)
        if dataclasses.is_dataclass(value):
            if field.name != "hyper" and type(value) is type(usual):
                yield from larger_fields(value, usual, f"{prefix}{field.name}.")
        elif size(value) is not None and size(value) > size(usual):
            yield f"{prefix}{field.name}", value, usual


def size(value: Any) -> float | None:
    """How large a whole number, or a list of them, is; None of anything else."""
    if isinstance(value, tuple) and value and all(isinstance(item, int) for item in value):
        return math.prod(value)
    return value if isinstance(value, int) and not isinstance(value, bool) else None
