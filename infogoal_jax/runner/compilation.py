"""How programs are compiled: options that save time on each kind of device, a chunk of training as two programs that
compile at the same time, and a folder in which compiled programs outlive their process."""

import contextlib
import functools
import gc
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr

from infogoal_jax import checks
from infogoal_jax.errors import require

OPTIONS: dict[str, dict[str, int | bool | str]] = {
    "cpu": {"xla_backend_optimization_level": 1},
    "gpu": {
        "xla_gpu_triton_gemm_any": False,
        "xla_gpu_command_buffer_scheduling_mode": "CONCURRENT",
        "xla_gpu_dot_merger_threshold_mb": 2,
    },
}
"""Measured on object search and Fetch. With LLVM's first level a CPU compiles in two thirds of the time and runs as
fast as with the third; the level below runs two to four times as long. On a GPU cuBLAS multiplies what a kernel of
Triton's would hardly do faster: fewer kernels are tried out, a program compiles in two thirds to three quarters of the
time and runs as fast. Kernels of an update that do not wait for each other run at the same time: one seed of object
search makes 1.7 times the updates (H200, jax 0.11.2, 2026-11-28). Products of one matrix with several are joined where
they are small: one seed of object search makes 1.07 times the updates. Joined at XLA's own 32 MB, sixteen seeds make
0.92 times, of the cube 0.97 times, since the results are then cut apart (2026-11-29)."""
QUICKLY: dict[str, dict[str, int | bool]] = {"cpu": {"xla_cpu_use_fusion_emitters": False}}
"""Options beside `OPTIONS` for programs that run for seconds only. On two cores FetchReach and object search at toy
size compile in two thirds of the time; object search at full size runs a twentieth slower (jax 0.10.2, 2026-11-27)."""
QUICKEST: dict[str, int | bool] = {
    "xla_backend_optimization_level": 0,
    "xla_cpu_parallel_codegen_split_count": 1,
} | QUICKLY["cpu"]
"""For programs that a CPU runs for less than a second, as most of those that the tests run. They are compiled four
times as fast; half of that is the option of `QUICKLY`, which jax 0.10 has and jax 0.11 has not. A program in one piece
takes a sixth less work than in pieces for several cores."""
short_runs: ContextVar[bool] = ContextVar("short_runs", default=False)


@contextlib.contextmanager
def compiling_quickly(quickly: bool = True) -> Iterator[None]:
    """Within this block, and in this thread, `jit` takes the options of `QUICKLY` too, if quickly: functions that it is
    given here compile faster and may run slower, wherever they are called."""
    token = short_runs.set(quickly)
    try:
        yield
    finally:
        short_runs.reset(token)


def compiler_options() -> dict[str, int | bool | str]:
    """Options for `jax.jit(..., compiler_options=...)` on the devices in use, and for short runs within
    `compiling_quickly`; without those that the user's XLA_FLAGS name."""
    flags, device = os.environ.get("XLA_FLAGS", ""), jax.default_backend()
    options = OPTIONS.get(device, {}) | (QUICKLY.get(device, {}) if short_runs.get() else {})
    return known({name: value for name, value in options.items() if name not in flags})


def known(options: dict[str, int | bool | str]) -> dict[str, int | bool | str]:
    """Those of these options that the compiler of the devices in use has."""
    return {name: value for name, value in options.items() if is_known(name, value)}


def flags(options: dict[str, int | bool]) -> str:
    """Those of these options that the compiler has, as XLA_FLAGS, which stop a process where one is unknown."""
    return " ".join(f"--{name}={str(value).lower()}" for name, value in known(options).items())


@functools.cache
def is_known(option: str, value: int | bool | str) -> bool:
    """Whether the compiler of the devices in use has this option: versions of jax come and go with them."""
    try:
        jax.jit(lambda: 0, compiler_options={option: value}).lower().compile()
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return False
    return True


def jit(function: Callable, **options: Any) -> Callable:
    """`jax.jit` with the `compiler_options` of the devices in use; other options are those of `jax.jit`. Raises
    `UserError` for what is no function."""
    require(callable(function), "function", function, "give a function of arrays")
    return jax.jit(function, compiler_options=compiler_options(), **options)


def compiled(function: Callable, *arguments: Any, **options: Any) -> Callable:
    """The function, compiled by `jit` for arguments of these shapes: `jax.stages.Compiled`."""
    with without_garbage_collection():
        return jit(function, **options).lower(*arguments).compile()


@contextlib.contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Tracing makes millions of objects that stay: looking through them for garbage would take a quarter of its
    time."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


class Chunk(NamedTuple):
    """epochs: (states, numbers [E], *shared) -> (states, metrics), which gives the memory of the states back;
    evaluation: (states, *shared) -> metrics. Both are jitted."""

    epochs: Callable
    evaluation: Callable

    def trace(self, states: Any, numbers: Any, *shared: Any) -> tuple[jax.stages.Traced, jax.stages.Traced]:
        """Both programs for arguments of these shapes. Lowering them does not trace them again."""
        with without_garbage_collection():
            return self.epochs.trace(states, numbers, *shared), self.evaluation.trace(states, *shared)

    def compiling(
        self, states: Any, numbers: Any, *shared: Any, check: Callable[..., None] = lambda epochs, evaluation: None
    ) -> Callable[[], Callable]:
        """Begin to compile both programs for arguments of these shapes (and shardings). What is returned waits for them
        and returns (states, numbers) -> (states, metrics of the epochs, metrics of the evaluation), which has the
        shared arguments.

        A compiler does much of its work on one core: each program has one, and the caller another.

        check: called with both compiled programs (`jax.stages.Compiled`) before they are run.
        """
        pool = ThreadPoolExecutor(2)
        with without_garbage_collection():
            first = pool.submit(self.epochs.lower(states, numbers, *shared).compile)
            second = pool.submit(self.evaluation.lower(states, *shared).compile)
        pool.shutdown(wait=False)

        def compiled() -> Callable:
            epochs, evaluation = first.result(), second.result()
            check(epochs, evaluation)

            def chunk(states, numbers):
                states, metrics = epochs(states, numbers, *shared)
                return states, metrics, evaluation(states, *shared)

            return chunk

        return compiled


def chunk_of(epochs: Callable, evaluation: Callable) -> Chunk:
    """The chunk of two functions, compiled by `jit`."""
    return Chunk(jit(epochs, donate_argnums=0), jit(evaluation))


def use_compilation_cache(folder: str | Path | None = None) -> Path | None:
    """Keep compiled programs on disk, for every process that calls this and for CPUs and GPUs alike; a second start of
    the same program then takes seconds.

    folder: None for $XDG_CACHE_HOME/infogoal/jax, or ~/.cache/infogoal/jax. The command line calls this; an import
    never does. Returns the folder, or None where it cannot be written to, which costs the cache and nothing else.
    """
    if folder is None:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "infogoal" / "jax"
    folder = Path(checks.path(folder, "folder", "give a folder, or None for the user's own cache"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # Small programs are many.
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return folder


def inner_programs(parameter) -> Iterator[Jaxpr | ClosedJaxpr]:
    """The jaxprs among an equation's parameters."""
    if isinstance(parameter, Jaxpr | ClosedJaxpr):
        yield parameter
    elif isinstance(parameter, tuple | list):
        for part in parameter:
            yield from inner_programs(part)
