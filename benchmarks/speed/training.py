"""Speed of training, and how long its program takes to build.

    python benchmarks/speed/training.py [--tasks object_search ...] [--method infogoal] [--seeds 1 16 128] [--repeats 3]
    python benchmarks/speed/training.py --size [--tasks object_search fetch_reach ...] [--seeds 1 16]

Environment steps alone, and fused training, for several seeds side by side, compile time apart; `one seed's time` says
how much longer the sweep takes than one seed alone. With `--size`: how large the training program of each task is, and
how long it takes to build: traced, lowered and compiled. Operations are equations of the jaxpr, those of inner
functions counted wherever they are called, and nothing comes from a compilation cache. Prints a Markdown table.
"""

import argparse
import time

import jax
import jax.numpy as jnp

from infogoal_jax import compiled, jit, make_train, presets
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.train.compilation import operations, without_garbage_collection
from infogoal_jax.train.evaluation import random_policy
from infogoal_jax.train.rollout import collect


def timed(function, *arguments):
    """Result and seconds of a call, until the device has finished."""
    started = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, time.perf_counter() - started


def timed_compilation(function, *arguments):
    """The compiled function for these arguments, and the seconds that compiling took."""
    started = time.perf_counter()
    return compiled(function, *arguments), time.perf_counter() - started


def env_rate(config, env, num_seeds: int, repeats: int) -> tuple[float, float]:
    """Environment steps a second of a random policy in `num_envs` environments a seed, and compile seconds."""

    def rollout(keys, env):
        def one(key):
            states = jax.vmap(env.reset)(jax.random.split(key, config.num_envs))
            states, rows = collect(env, states, random_policy(env), key, config.rollout_steps)
            return states, rows.valid.sum()

        return jax.vmap(one)(keys)

    keys = jax.random.split(jax.random.key(0), num_seeds)
    program, compile_seconds = timed_compilation(rollout, keys, env)
    timed(program, keys, env)
    seconds = min(timed(program, keys, env)[1] for _ in range(repeats))
    return num_seeds * config.num_envs * config.rollout_steps / seconds, compile_seconds


def training_rate(config, train, num_seeds: int, repeats: int) -> tuple[float, float, float]:
    """Seconds of an epoch of all seeds (collecting and updating, no evaluation), compile seconds, and bytes of all
    seeds' states."""
    keys = jax.random.split(jax.random.key(0), num_seeds)
    states = jax.jit(jax.vmap(train.initial, in_axes=(0, None, None)))(keys, config.hyper, train.env)

    def epochs(states, numbers, hyper, env):
        return jax.vmap(train.chunk, in_axes=(0, None, None, None))(states, numbers, hyper, env)[0]

    program, compile_seconds = timed_compilation(epochs, states, jnp.arange(1), config.hyper, train.env)
    states, _ = timed(program, states, jnp.arange(1), config.hyper, train.env)
    seconds = []
    for repeat in range(repeats):
        states, elapsed = timed(program, states, jnp.arange(1) + repeat + 1, config.hyper, train.env)
        seconds.append(elapsed)
    size = sum(
        leaf.nbytes for leaf in jax.tree.leaves(states) if not jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    )
    return min(seconds), compile_seconds, size


def build(task: str, method: str, num_seeds: int) -> tuple[int, float, float, float]:
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


def print_rates(tasks, method: str, seeds: list[int], repeats: int) -> None:
    """Print the table of speeds."""
    print(
        "| task | seeds | environment alone, steps/s | compile s | fused training, env steps/s | updates/s | compile s "
        "| one seed's time | state, MiB |\n|---|---|---|---|---|---|---|---|---|"
    )
    for task in tasks:
        config, alone = presets.load(task, method, epochs_per_evaluation=1, evaluation_starts=1), None
        train = make_train(config)
        for num_seeds in seeds:
            steps_rate, env_compile = env_rate(config, train.env, num_seeds, repeats)
            seconds, train_compile, size = training_rate(config, train, num_seeds, repeats)
            alone = seconds if alone is None else alone
            steps, updates = (
                num_seeds * count / seconds
                for count in (config.num_envs * config.rollout_steps, config.updates_per_epoch)
            )
            print(
                f"| {task} | {num_seeds} | {steps_rate:,.0f} | {env_compile:.1f} | {steps:,.0f} | {updates:,.0f} | "
                f"{train_compile:.1f} | x {seconds / alone:.2f} | {size / 2**20:.0f} |",
                flush=True,
            )


def print_sizes(tasks, method: str, seeds: list[int]) -> None:
    """Print the table of programs."""
    print("| task | seeds | operations | trace s | lower s | compile s | all s |\n|---|---|---|---|---|---|---|")
    for task in tasks:
        for num_seeds in seeds:
            count, *seconds = build(task, method, num_seeds)
            each = " | ".join(f"{value:.1f}" for value in (*seconds, sum(seconds)))
            print(f"| {task} | {num_seeds} | {count:,} | {each} |", flush=True)


def main():
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--size", action="store_true", help="how large the programs are and how long they take to build"
    )
    parser.add_argument("--tasks", nargs="+", choices=presets.TASKS, default=["object_search"])
    parser.add_argument("--method", default="infogoal")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 16, 128])
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    print(f"{arguments.method}; {describe_machine()}\n")
    if arguments.size:
        print_sizes(arguments.tasks, arguments.method, arguments.seeds)
    else:
        print_rates(arguments.tasks, arguments.method, arguments.seeds, arguments.repeats)


if __name__ == "__main__":
    main()
