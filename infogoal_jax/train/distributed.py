"""One run on several hosts: each process trains its share of the seeds on its own devices, and the first one writes.

Seeds do not touch each other, so that processes meet only between chunks of epochs: to gather what is written, and to
agree on whether to stop. With one process everything here does nothing.
"""

import contextlib
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from infogoal_jax.errors import UserError, require
from infogoal_jax.runs.checkpoint import is_key
from infogoal_jax.stopping import StopRequest

AUTO = "auto"
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


def share(seeds: Sequence[int]) -> Sequence[int]:
    """The seeds of this process. Raises `UserError` where not all processes get as many."""
    count = jax.process_count()
    require(len(seeds) % count == 0, "seeds", len(seeds), f"give a multiple of {count}, the number of processes")
    return seeds[share_of(len(seeds))]


def share_of(count: int) -> slice:
    """Where the share of this process stands among so many seeds."""
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
        return found.reshape(-1, *mine.shape[1:]) if writes else None

    trees = jax.tree.map(whole, tree)
    return trees if writes else None


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
