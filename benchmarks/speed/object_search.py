"""Speed of object search: environment steps alone, and fused training, for 1, 16 and 128 seeds side by side, compile
time apart.

    python benchmarks/speed/object_search.py [--seeds 1 16 128] [--epochs 3]

Prints a Markdown table. `one seed's time` says how much longer the sweep takes than one seed alone.
"""

import argparse
import time

import jax
import jax.numpy as jnp

from infogoal_jax import compiled, make_train, presets
from infogoal_jax.report.statistics import describe_machine
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


def main():
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 16, 128])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--method", default="infogoal")
    arguments = parser.parse_args()
    config = presets.load("object_search", arguments.method, epochs_per_evaluation=1, evaluation_starts=1)
    train = make_train(config)
    print(f"object_search, {arguments.method}; {train.env.source}\n{describe_machine()}\n")
    print(
        "| seeds | environment alone, steps/s | compile s | fused training, env steps/s | updates/s | compile s | one "
        "seed's time | state, MiB |"
    )
    print("|---|---|---|---|---|---|---|---|")
    alone = None
    for num_seeds in arguments.seeds:
        steps_rate, env_compile = env_rate(config, train.env, num_seeds, arguments.repeats)
        seconds, train_compile, size = training_rate(config, train, num_seeds, arguments.repeats)
        alone = seconds if alone is None else alone
        steps, updates = (
            num_seeds * count / seconds for count in (config.num_envs * config.rollout_steps, config.updates_per_epoch)
        )
        print(
            f"| {num_seeds} | {steps_rate:,.0f} | {env_compile:.1f} | {steps:,.0f} | {updates:,.0f} | "
            f"{train_compile:.1f} "
            f"| x {seconds / alone:.2f} | {size / 2**20:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
