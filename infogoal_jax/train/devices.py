"""How seeds share devices: slices of a sweep that does not fit into memory, and a part of the seeds on each device."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def over_seeds(function: Callable, num_seeds: int, at_once: int, mesh: jax.sharding.Mesh) -> Callable:
    """The function of one seed's first argument as a function of all seeds', vmapped; in slices on each device where
    memory asks for it."""
    if at_once * mesh.size >= num_seeds:
        return lambda batched, *shared: jax.vmap(lambda one: function(one, *shared))(batched)
    return on_each_device(
        lambda batched, *shared: jax.lax.map(lambda one: function(one, *shared), batched, batch_size=at_once), mesh
    )


def epochs_over_seeds(epochs: Callable, num_seeds: int, at_once: int, mesh: jax.sharding.Mesh) -> Callable:
    """`over_seeds` for epochs of training, (state, ...) -> (state, metrics): slices are written back to where
    they came from, so all states are held once."""
    if at_once * mesh.size >= num_seeds:
        return over_seeds(epochs, num_seeds, at_once, mesh)

    def in_slices(states, *shared):
        def run(part):
            return jax.vmap(lambda one: epochs(one, *shared))(part)

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


def placed(shapes: Any, sharding: jax.sharding.Sharding) -> Any:
    """Shapes of arrays, with where the arrays lie: what a program is compiled for before they are there."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), shapes)


def seed_mesh(num_seeds: int) -> jax.sharding.Mesh:
    """As many devices of this process as divide its number of seeds."""
    devices = jax.local_devices()
    used = max(count for count in range(1, len(devices) + 1) if num_seeds % count == 0)
    return jax.sharding.Mesh(np.asarray(devices[:used]), ("seeds",))
