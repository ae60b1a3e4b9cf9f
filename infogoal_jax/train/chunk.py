"""A chunk of training, epochs and the evaluation after them, as two programs that compile at the same time."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax

from infogoal_jax.train.compilation import jit, without_garbage_collection


class Chunk(NamedTuple):
    """epochs: (states, numbers [E], *shared) -> (states, metrics), which gives the memory of the states back;
    evaluation: (states, *shared) -> metrics. Both are jitted."""

    epochs: Callable
    evaluation: Callable

    def trace(self, states: Any, numbers: Any, *shared: Any) -> tuple[jax.stages.Traced, jax.stages.Traced]:
        """Both programs for arguments of these shapes. Lowering them does not trace them again."""
        with without_garbage_collection():
            return self.epochs.trace(states, numbers, *shared), self.evaluation.trace(states, *shared)

    def compiling(self, states: Any, numbers: Any, *shared: Any) -> Callable[[], Callable]:
        """Begin to compile both programs for arguments of these shapes (and shardings). What is returned waits for them
        and returns (states, numbers, *shared) -> (states, metrics of the epochs, metrics of the evaluation).

        A compiler does much of its work on one core: each program has one, and the caller another.
        """
        pool = ThreadPoolExecutor(2)
        with without_garbage_collection():
            first = pool.submit(self.epochs.lower(states, numbers, *shared).compile)
            second = pool.submit(self.evaluation.lower(states, *shared).compile)
        pool.shutdown(wait=False)

        def compiled() -> Callable:
            epochs, evaluation = first.result(), second.result()

            def chunk(states, numbers, *shared):
                states, metrics = epochs(states, numbers, *shared)
                return states, metrics, evaluation(states, *shared)

            return chunk

        return compiled


def chunk_of(epochs: Callable, evaluation: Callable) -> Chunk:
    """The chunk of two functions."""
    return Chunk(jit(epochs, donate_argnums=0), jit(evaluation))
