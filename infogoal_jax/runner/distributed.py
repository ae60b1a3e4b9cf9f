"""How seeds share devices and hosts: slices of a sweep that does not fit into memory, a part of the seeds on each
device of a process, and one run on several hosts, where each process trains its share of the seeds on its own devices
and the first one writes.

Seeds do not touch each other, so that processes meet only between chunks of epochs: to gather what is written, and to
agree on whether to stop. With one process the functions for several do nothing.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.errors import UserError, require
from infogoal_jax.keys import is_key
from infogoal_jax.stopping import StopRequest


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


def shardings_of(mesh: jax.sharding.Mesh) -> tuple[jax.sharding.NamedSharding, jax.sharding.NamedSharding]:
    """Where arrays lie whose first axis is that of the seeds, and where those lie that all seeds share."""
    spread, whole = jax.sharding.PartitionSpec("seeds"), jax.sharding.PartitionSpec()
    return jax.sharding.NamedSharding(mesh, spread), jax.sharding.NamedSharding(mesh, whole)


AUTO = "auto"
LONGEST = 4096
"""Bytes of what `agreed` tells."""
SECONDS = 60
"""That a process waits for the others at the beginning."""


def join(coordinator: str, count: int, number: int) -> None:
    """Let this process be one of several; called before jax looks for devices.

    coordinator: HOST:PORT of the first process, or `auto`, where Slurm, Open MPI, Kubernetes or a TPU says who the
    processes are; count, number: of processes, and of this one, where nobody says it. Raises `UserError` where they do
    not find each other.
    """
    given: dict[str, Any] = {}
    if coordinator != AUTO:
        require(":" in coordinator, "distributed", coordinator, "give auto, or HOST:PORT of the first process")
        require(count > 1, "num_processes", count, "give how many there are, 2 or more")
        require(0 <= number < count, "process", number, f"give 0 to {count - 1}, each process another number")
        given = {"coordinator_address": coordinator, "num_processes": count, "process_id": number}
        if number == 0:
            given["coordinator_bind_address"] = coordinator  # Jax would listen on every address of this machine.
    jax.config.update("jax_enable_preemption_service", False)  # It would keep TERM from `stop_on_signal`.
    try:
        jax.distributed.initialize(**given, initialization_timeout=SECONDS)
    except (RuntimeError, ValueError) as error:
        raise UserError(
            f"distributed = {coordinator!r}: {error}; start all processes within {SECONDS} s, or give HOST:PORT of the "
            "first, --num-processes and --process"
        ) from error
    try:
        any_process(False)  # They meet once, before anything is compiled.
    except jax.errors.JaxRuntimeError as error:
        raise UserError(
            f"distributed = {coordinator!r}: the processes do not reach each other: {error}; the name of each host has "
            "to stand for an address that the others reach (see hostname -i; 127.0.1.1 is none)"
        ) from error


def part() -> None:
    """Let the processes of a trained run go, so that none waits for the first one, which may go on for long. From then
    on each is alone, and nothing here must be called. Every process has to call this at the same place."""
    jax.distributed.shutdown()


def is_one_of_several() -> bool:
    """Whether there are other processes. Looks for no device where there are none."""
    return jax.distributed.is_initialized() and jax.process_count() > 1


def is_writer() -> bool:
    """Whether this process writes the run. Looks for no device where it is the only one."""
    return not jax.distributed.is_initialized() or jax.process_index() == 0


def own_seeds(seeds: Sequence[int]) -> Sequence[int]:
    """The seeds of this process. Raises `UserError` where not all processes get as many."""
    count = jax.process_count()
    require(len(seeds) % count == 0, "seeds", len(seeds), f"give a multiple of {count}, the number of processes")
    return seeds[own_slice(len(seeds))]


def own_slice(count: int) -> slice:
    """Where the seeds of this process stand among so many seeds."""
    size = count // jax.process_count()
    return slice(jax.process_index() * size, (jax.process_index() + 1) * size)


def gathered(tree: Any) -> Any:
    """A pytree of arrays [seeds of this process, ...] as one of arrays [all seeds, ...]. Every process has to call this
    at the same place."""
    if jax.process_count() == 1:
        return tree
    from jax.experimental.multihost_utils import process_allgather

    def whole(leaf):
        if is_key(leaf):
            return jax.random.wrap_key_data(whole(jax.random.key_data(leaf)), impl=jax.random.key_impl(leaf))
        return process_allgather(np.asarray(leaf), tiled=True)

    return jax.tree.map(whole, tree)


def gathered_by_writer(tree: Any) -> Any:
    """The arrays of all seeds, as `gathered` has them, in the memory of the host of the process that writes; None for
    the others. Of the states of all seeds no device has room: one seed of one array at a time is brought together.
    Every process has to call this at the same place."""
    if jax.process_count() == 1:
        return tree
    from jax.experimental.multihost_utils import process_allgather

    count, writes = jax.process_count(), is_writer()

    def whole(leaf):
        if is_key(leaf):
            numbers = whole(jax.random.key_data(leaf))
            return jax.random.wrap_key_data(numbers, impl=jax.random.key_impl(leaf)) if writes else None
        mine = np.asarray(leaf)
        found = np.empty((count, *mine.shape), mine.dtype) if writes else None
        for seed, own in enumerate(mine):
            slices = process_allgather(own)
            if writes:
                found[:, seed] = slices
        return found.reshape(count * len(mine), *mine.shape[1:]) if writes else None

    trees = jax.tree.map(whole, tree)
    return trees if writes else None


def agreed(words: str) -> str:
    """What the first process says, in all of them. Every process has to call this at the same place."""
    if not is_one_of_several():
        return words
    from jax.experimental.multihost_utils import broadcast_one_to_all

    said = np.frombuffer(words.encode().ljust(LONGEST, b"\0"), np.uint8)
    return np.asarray(broadcast_one_to_all(said)).astype(np.uint8).tobytes().rstrip(b"\0").decode()


def any_process(said: bool) -> bool:
    """Whether any process says so. Every process has to call this at the same place."""
    return bool(np.any(gathered(np.asarray([said]))))


@contextlib.contextmanager
def noted(stop: StopRequest) -> Iterator[None]:
    """Inside, where there are other processes, a signal is noted until `check` tells them: one that ended at once would
    leave them waiting."""
    if is_one_of_several():
        stop.finishing = "the preparations, together with the other processes"
    try:
        yield
    finally:
        stop.finishing = ""


def check(stop: StopRequest) -> None:
    """Raise `Stopped` in all processes if one of them was asked to stop. Every process has to call this at the same
    place."""
    stop.requested = any_process(stop.requested)
    stop.check()


def of_all(shapes: Any) -> Any:
    """The shapes of all seeds' arrays, for those of this process."""
    count = jax.process_count()
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((leaf.shape[0] * count, *leaf.shape[1:]), leaf.dtype), shapes)
