"""How seeds share devices: what fits into memory, slices of a sweep that does not, and a part of the seeds on each
device."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.errors import require
from infogoal_jax.train import checkpoint
from infogoal_jax.train.program import Train

MEMORY_SHARE = 0.8  # Of the device's memory that a sweep may fill before it is sliced.
EVALUATION_POLICIES = 4  # Code sampled or mean, goals clean or corrupted.
WORKING_COPIES = (
    2  # Copies of a seed's state that a running chunk holds beside the one that is carried: updated, and gradients.
)


def bytes_of(tree: Any) -> int:
    """Bytes that the arrays of a pytree (or of its shapes) take."""
    leaves = jax.tree.leaves(tree)
    # A key is two uint32.
    return sum(leaf.size * (8 if checkpoint.is_key(leaf) else leaf.dtype.itemsize) for leaf in leaves)


def device_memory(device) -> int:
    """Bytes of memory that the device has."""
    statistics = device.memory_stats()
    if statistics and "bytes_limit" in statistics:
        return statistics["bytes_limit"]
    import os

    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


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
    episodes = (
        len(env.goals.evaluated)
        * config.evaluation_starts
        * (env.episode_length + 1)
        * bytes_of(observation)
        * EVALUATION_POLICIES
    )
    return encoded + episodes


def seeds_at_once(
    state_bytes: int, extra_bytes: int, env_bytes: int, num_seeds: int, memory: int, devices: int = 1
) -> int:
    """How many of a device's seeds run beside each other in `MEMORY_SHARE` of its memory: all of them, or a part that
    divides their number.

    Raises `UserError` if not even their states fit and one of them. state_bytes: carried for each of the `num_seeds` of
    the device, and once more for those that run in a slice; extra_bytes: `working_bytes` of each that runs; env_bytes:
    held once; devices: how many there are, for the message.
    """
    room, running = MEMORY_SHARE * memory - env_bytes, WORKING_COPIES * state_bytes + extra_bytes
    if num_seeds * (state_bytes + running) <= room:
        return num_seeds
    fitting = int((room - num_seeds * state_bytes) // (state_bytes + running))
    most = devices * max(0, int((room - state_bytes - running) // state_bytes))
    require(
        fitting > 0,
        "seeds",
        num_seeds * devices,
        f"each takes {state_bytes / 2**20:,.0f} MiB, {running / 2**20:,.0f} MiB more while it runs, a device has "
        f"{memory / 2**30:.1f} GiB: "
        f"give at most {most}, or a smaller buffer_steps, batch_size or evaluation_starts",
    )
    return max(count for count in range(1, fitting + 1) if num_seeds % count == 0)


def over_seeds(function: Callable, num_seeds: int, at_once: int, mesh: jax.sharding.Mesh) -> Callable:
    """The function of one seed's first argument as a function of all seeds', vmapped; in slices on each device where
    memory asks for it."""
    if at_once * mesh.size >= num_seeds:
        return lambda batched, *shared: jax.vmap(lambda one: function(one, *shared))(batched)
    return on_each_device(
        lambda batched, *shared: jax.lax.map(lambda one: function(one, *shared), batched, batch_size=at_once), mesh
    )


def chunk_over_seeds(chunk: Callable, num_seeds: int, at_once: int, mesh: jax.sharding.Mesh) -> Callable:
    """`over_seeds` for a chunk of training, (state, ...) -> (state, metrics, ...): slices are written back to where
    they came from, so all states are held once."""
    if at_once * mesh.size >= num_seeds:
        return over_seeds(chunk, num_seeds, at_once, mesh)

    def in_slices(states, *shared):
        def run(part):
            return jax.vmap(lambda one: chunk(one, *shared))(part)

        def slice_of(tree, number):
            return jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, number * at_once, at_once), tree)

        def put(whole, part, number):
            return jax.tree.map(
                lambda old, new: jax.lax.dynamic_update_slice_in_dim(old, new, number * at_once, axis=0), whole, part
            )

        def step(number, carry):
            states, found = carry
            after, *metrics = run(slice_of(states, number))
            return put(states, after, number), put(found, metrics, number)

        count = num_seeds // mesh.size // at_once
        _, *shapes = jax.eval_shape(run, slice_of(states, 0))
        found = jax.tree.map(lambda leaf: jnp.zeros((count * at_once, *leaf.shape[1:]), leaf.dtype), shapes)
        states, found = jax.lax.fori_loop(0, count, step, (states, found))
        return states, *found

    return on_each_device(in_slices, mesh)


def on_each_device(function: Callable, mesh: jax.sharding.Mesh) -> Callable:
    """The function of batched and shared arguments, run on each device of the mesh for its own part of the batch."""
    spread, whole = jax.sharding.PartitionSpec("seeds"), jax.sharding.PartitionSpec()

    def everywhere(batched, *shared):
        specs = (spread, *[whole] * len(shared))
        return jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=spread, check_vma=False)(batched, *shared)

    return everywhere


def seed_mesh(num_seeds: int) -> jax.sharding.Mesh:
    """As many devices as divide the number of seeds."""
    devices = jax.devices()
    used = max(count for count in range(1, len(devices) + 1) if num_seeds % count == 0)
    return jax.sharding.Mesh(np.asarray(devices[:used]), ("seeds",))
