"""What training needs of a device's memory, before anything is compiled or allocated: how many seeds run side by side,
and which field is to blame where not even one does.

Two estimates count. A formula of the state and of what is seen says how many seeds fit; the traced program says what it
holds at once at least, whatever the sizes are that ask for it.
"""

import dataclasses
import math
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var

from infogoal_jax import presets
from infogoal_jax.errors import UserError, require
from infogoal_jax.keys import is_key
from infogoal_jax.runner.compilation import Chunk, inner_programs
from infogoal_jax.train.program import Train, make_train

MEMORY_SHARE = 0.8
"""Of the device's memory that a sweep may fill before it is sliced."""
EVALUATION_POLICIES = 4
"""Code sampled or mean, goals clean or corrupted."""
WORKING_COPIES = 2
"""Copies of a seed's state that a running chunk holds beside the one that is carried: updated, and gradients."""
WRITTEN_OUT = {"dot_general", "conv_general_dilated", "scan", "while", "sort", "scatter", "scatter-add", "cumsum"}
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
    return bytes_of(jax.eval_shape(train.initial, jax.random.key(0), train.config.hyper, train.env))


def working_bytes(train: Train) -> int:
    """Bytes that a seed takes beside copies of its state, roughly: what is seen of each transition three times over and
    cut into patches, the goals that it achieved, and the episodes of an evaluation."""
    config, env = train.config, train.env
    observation = jax.eval_shape(lambda key: env.observe(env.reset(key)), jax.random.key(0))
    seen, goal = jax.eval_shape(env.render, observation), env.goals.inputs[0]
    num_goals = (
        env.goals.num_goals
        if env.goals.num_goals <= config.batch_size
        else config.batch_size * train.parts.agent.num_steps
    )
    encoded = (6 * config.batch_size * seen.size + 4 * num_goals * goal.size) * np.dtype("float32").itemsize
    return encoded + episode_bytes(train, config.evaluation_starts)


def episode_bytes(train: Train, starts: int) -> int:
    """Bytes of what is observed in the episodes of an evaluation of one seed, with so many starts a goal."""
    env = train.env
    observation = jax.eval_shape(lambda key: env.observe(env.reset(key)), jax.random.key(0))
    episodes = len(env.goals.evaluated) * starts
    return episodes * (env.episode_length + 1) * bytes_of(observation) * EVALUATION_POLICIES


def seeds_at_once(
    state_bytes: int,
    extra_bytes: int,
    env_bytes: int,
    num_seeds: int,
    memory: int,
    devices: int = 1,
    name: str = "seeds",
) -> int:
    """How many of a device's seeds run beside each other in `MEMORY_SHARE` of its memory: all of them, or a part that
    divides their number.

    Raises `UserError` if not even their states fit and one of them. state_bytes: carried for each of the `num_seeds` of
    the device, and once more for those that run in a slice; extra_bytes: `working_bytes` of each that runs; env_bytes:
    held once; devices: how many there are, for the message; name: of their number, for it too.
    """
    room, running = MEMORY_SHARE * memory - env_bytes, WORKING_COPIES * state_bytes + extra_bytes
    if num_seeds * (state_bytes + running) <= room:
        return num_seeds
    fitting = int((room - num_seeds * state_bytes) // (state_bytes + running))
    alone = int(state_bytes + running <= room)
    most = devices * max(alone, int((room - state_bytes - running) // state_bytes))
    require(
        fitting > 0,
        name,
        num_seeds * devices,
        f"each takes {state_bytes / 2**20:,.0f} MiB, {running / 2**20:,.0f} MiB more while it runs, a device has "
        f"{memory / GIB:.1f} GiB: give at most {most}",
    )
    return max(count for count in divisors(num_seeds) if count <= fitting)


def divisors(number: int) -> Iterator[int]:
    """Every divisor of a number."""
    for small in range(1, math.isqrt(number) + 1):
        if number % small == 0:
            yield small
            yield number // small


def peak_bytes(program: Jaxpr | ClosedJaxpr) -> int:
    """Bytes that a traced program holds at once at least, beside its arguments: results of `WRITTEN_OUT` operations and
    what scans read step by step, from where they are made to where they are used last."""
    jaxpr = program.jaxpr if isinstance(program, ClosedJaxpr) else program
    last_use = {
        variable: number
        for number, equation in enumerate(jaxpr.eqns)
        for variable in equation.invars
        if not isinstance(variable, Literal)
    }
    last_use |= {variable: len(jaxpr.eqns) for variable in jaxpr.outvars if not isinstance(variable, Literal)}
    scanned = {variable for equation in jaxpr.eqns for variable in scanned_by(equation)}
    held, most, ends = 0, 0, {}
    for number, equation in enumerate(jaxpr.eqns):
        inside = [peak_bytes(inner) for value in equation.params.values() for inner in inner_programs(value)]
        made = 0
        for variable in equation.outvars:
            if equation.primitive.name in WRITTEN_OUT or variable in scanned:
                size = array_bytes(variable.aval)
                made += size
                end = last_use.get(variable, number)
                ends[end] = ends.get(end, 0) + size
        most = max(most, held + max(made, *inside, 0))
        held += made - ends.pop(number, 0)
    return most


def scanned_by(equation: JaxprEqn) -> list[Var]:
    """The variables that a scan reads an element of at each step; none of another operation."""
    if equation.primitive.name != "scan":
        return []
    body = equation.params["jaxpr"]
    inside = getattr(body, "jaxpr", body).invars
    # What is read step by step has an axis of steps outside; constants and what is carried look alike on both sides.
    # (How parameters of a scan are named changes between versions of JAX.)
    return [
        variable
        for variable, element in zip(equation.invars, inside, strict=True)
        if not isinstance(variable, Literal) and variable.aval.ndim > element.aval.ndim
    ]


def needed_bytes(train: Train, num_seeds: int) -> float:
    """Bytes that these seeds need at least, one of them running at a time."""
    config = train.config
    state = jax.eval_shape(train.initial, jax.random.key(0), config.hyper, train.env)
    carried = bytes_of(state)
    numbers = jax.ShapeDtypeStruct((config.epochs_per_evaluation,), np.int32)
    traced = jax.jit(train.chunk).trace(state, numbers, config.hyper, train.env)
    running = max(WORKING_COPIES * carried + working_bytes(train), peak_bytes(traced.jaxpr))
    return num_seeds * carried + running + bytes_of(train.env)


def check_program(
    chunk: Chunk, states: Any, shared: tuple, train: Train, num_seeds: int, mesh: jax.sharding.Mesh, name: str = "seeds"
) -> None:
    """Raise `UserError`, naming the field that is to blame, if the traced epochs and evaluation of all seeds cannot
    run. Lowering them does not trace them again: the types are the same.

    states, shared: what `chunk` is called with beside the numbers of epochs, or their shapes, on all devices of the
    mesh together; name: of the number of seeds.
    """
    numbers = jax.ShapeDtypeStruct((train.config.epochs_per_evaluation,), np.int32)
    epochs, evaluation = (peak_bytes(program.jaxpr) for program in chunk.trace(states, numbers, *shared))
    # What the epochs return stands where the states stood, and is part of their peak; the evaluation reads the states.
    running = max(epochs, bytes_of(states) + evaluation)
    needed, memory = (bytes_of(train.env) + running) / mesh.size, mesh_memory(mesh)
    if needed > memory:
        raise to_blame(train, num_seeds, memory, f"training needs {needed / GIB:,.1f} GiB at least", name)


def to_blame(train: Train, num_seeds: int, memory: int, needs: str, name: str) -> UserError:
    """The refusal of training that names the field which takes most. name: of the number of seeds."""
    preset = presets.load(train.config.task, **presets.names_of(train.config))
    fields = [
        Larger(field, value, usual, lambda field=field, usual=usual: with_usual(train, field, usual, num_seeds))
        for field, value, usual in larger_fields(train.config, preset)
    ]
    if num_seeds > 1:
        alone = needed_bytes(train, 1)
        if alone <= MEMORY_SHARE * memory:  # Otherwise no number of seeds would do.
            fields.insert(0, Larger(name, num_seeds, 1, lambda: alone))
    return refusal(fields, train.config.task, memory, needs)


class Larger(NamedTuple):
    """A field that has a larger value than usual. needed: () -> bytes that would be needed with the usual one."""

    name: str
    value: Any
    usual: Any
    needed: Callable[[], float]


def refusal(fields: list[Larger], task: str, memory: int, needs: str) -> UserError:
    """The refusal that names the field whose usual value would leave the least to be needed. needs: what takes more
    than `memory` bytes, in words."""
    room = f"a device has {memory / GIB:.1f} GiB"
    if not fields:
        return UserError(f"task = {task!r}: {needs}, {room}: give smaller sizes, or take a larger device")
    blamed = min(fields, key=lambda field: field.needed()) if len(fields) > 1 else fields[0]
    remedy = f"give a smaller value, such as {blamed.usual!r}"
    return UserError(f"{blamed.name} = {blamed.value!r}: {needs}, {room}: {remedy}")


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


def with_usual(train: Train, name: str, usual: Any, num_seeds: int) -> float:
    """Bytes that would be needed with another value of a field; none could be more where that makes no program."""
    try:
        other = make_train(with_field(train.config, name, usual), None if name.startswith("env.") else train.env)
    except UserError:
        return math.inf
    return needed_bytes(other, num_seeds)


def with_field(config: Any, name: str, value: Any) -> Any:
    """A configuration with another value of the field of this dotted name."""
    part, _, field = name.rpartition(".")
    changed = dataclasses.replace(getattr(config, part), **{field: value}) if part else value
    return dataclasses.replace(config, **{part or name: changed})


def at_once(train: Train, count: int, mesh: jax.sharding.Mesh, name: str = "seeds") -> int:
    """How many of a device's seeds (or lanes) run beside each other. Raises `UserError`, naming the field that is to
    blame, if not even one does. name: of their number."""
    memory = mesh_memory(mesh)
    sizes = state_bytes(train), working_bytes(train), bytes_of(train.env)
    try:
        return seeds_at_once(*sizes, count // mesh.size, memory, mesh.size, name)
    except UserError as error:
        state, extra, held = sizes
        needed = (count // mesh.size + 1 + WORKING_COPIES) * state + extra + held
        needs = f"training needs {needed / GIB:,.1f} GiB and may take {MEMORY_SHARE * memory / GIB:,.1f} GiB"
        blamed = to_blame(train, count, memory, needs, name)
        raise (error if str(blamed).startswith(name) else blamed) from error
