"""How large the training program of each task is, and how long it takes to build: traced, lowered and compiled, for one
seed or several.

    python benchmarks/speed/program_size.py [--tasks object_search fetch_reach ...] [--method infogoal] [--seeds 1 16]

Operations are equations of the jaxpr, those of inner functions counted wherever they are called. Nothing comes from a
compilation cache.
"""

import argparse
import time

import jax
import jax.numpy as jnp

from infogoal_jax import jit, make_train, presets
from infogoal_jax.presets import TASKS
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.train.compilation import operations, without_garbage_collection


def measure(task: str, method: str, num_seeds: int) -> tuple[int, float, float, float]:
    """Operations of the chunk of one seed, and seconds to trace, lower and compile that of `num_seeds`."""
    config = presets.load(task, method)
    train = make_train(config)
    keys = jax.random.split(jax.random.key(0), num_seeds)
    states = jax.eval_shape(jax.vmap(lambda key: train.initial(key, config.hyper, train.env)), keys)
    arguments = (states, jnp.arange(config.epochs_per_evaluation), config.hyper, train.env)
    started = time.perf_counter()
    with without_garbage_collection():
        traced = jit(jax.vmap(train.chunk, in_axes=(0, None, None, None)), donate_argnums=0).trace(*arguments)
        after_trace = time.perf_counter()
        lowered = traced.lower()
        after_lower = time.perf_counter()
        lowered.compile()
    seconds = (after_trace - started, after_lower - after_trace, time.perf_counter() - after_lower)
    return operations(traced.jaxpr), *seconds


def main():
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--method", default="infogoal")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 16])
    arguments = parser.parse_args()
    print(f"{arguments.method}, the chunk of the preset; {describe_machine()}\n")
    print("| task | seeds | operations | trace s | lower s | compile s | all s |\n|---|---|---|---|---|---|---|")
    for task in arguments.tasks:
        for num_seeds in arguments.seeds:
            count, *seconds = measure(task, arguments.method, num_seeds)
            each = " | ".join(f"{value:.1f}" for value in (*seconds, sum(seconds)))
            print(f"| {task} | {num_seeds} | {count:,} | {each} |", flush=True)


if __name__ == "__main__":
    main()
