"""Absurd actions: constant extremes, alternating extremes and random ones, by the million. Nothing that is not a number
may leave its environment.

    python benchmarks/fidelity/fetch_absurd.py [--tasks ...] [--steps 10000000] [--batch 16384] [--faithful]

Prints for each task and pattern the environment steps taken, the diverged episodes (ended, counted and started anew),
and whether any observation, record or reward was not finite. Exit status 1 if one was.
"""

import argparse
import sys

import jax
import jax.numpy as jnp

from infogoal_jax import envs
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.train.rollout import chosen

CORNERS = jnp.array([[float(2 * (number >> bit & 1) - 1) for bit in range(4)] for number in range(16)])
CHUNK = 200
"""Steps under one call."""


def constant(step, batch, key):
    """Every robot pushes into one of the 16 corners of the action space for ever."""
    return CORNERS[jnp.arange(batch) % 16]


def alternating(step, batch, key):
    """Every robot jumps between two opposite corners with every step."""
    return CORNERS[jnp.arange(batch) % 16] * (1 - 2 * (step % 2))


def random(step, batch, key):
    """Uniform actions, ten times too large: the environment clips them."""
    return jax.random.uniform(key, (batch, 4), minval=-10.0, maxval=10.0)


PATTERNS = (constant, alternating, random)


def make_chunk(env, batch: int):
    """`chunk(states, key, first, pattern)`: `CHUNK` steps under the pattern of this number; the states after, diverged
    episodes, whether all stayed finite."""

    @jax.jit
    def chunk(states, key, first, pattern):
        def one(states, inputs):
            key, number = inputs
            action_key, reset_key = jax.random.split(key)
            actions = jnp.stack([make(number, batch, action_key) for make in PATTERNS])[pattern]
            stepped = jax.vmap(env.step)(states, actions)
            record = jax.vmap(env.achieved)(stepped)
            seen = (stepped.observation, record, env.reward(record, stepped.desired_goal), stepped.motion)
            finite = jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(seen)]).all()
            fresh = jax.vmap(env.reset)(jax.random.split(reset_key, batch))
            finished = stepped.terminated | stepped.truncated
            return chosen(finished, fresh, stepped), (stepped.diverged.sum(), finite)

        states, (diverged, finite) = jax.lax.scan(
            one, states, (jax.random.split(key, CHUNK), first + jnp.arange(CHUNK))
        )
        return states, diverged.sum(), finite.all()

    return chunk


def run(env, chunk, pattern: int, batch: int, steps: int) -> tuple[int, int, bool]:
    """Steps taken, diverged episodes, and whether everything stayed finite."""
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), batch))
    diverged, finite, taken = 0, True, 0
    while taken < steps:
        states, ended, good = chunk(states, jax.random.fold_in(jax.random.key(2), taken), taken // batch, pattern)
        diverged, finite, taken = diverged + int(ended), finite and bool(good), taken + CHUNK * batch
    return taken, diverged, finite


def main():
    """Run every pattern and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--steps", type=int, default=10_000_000, help="over all patterns, for each task")
    parser.add_argument("--batch", type=int, default=16384)
    parser.add_argument("--faithful", action="store_true")
    arguments = parser.parse_args()
    print(f"{'faithful' if arguments.faithful else 'default'} setting; {describe_machine()}\n")
    print("| task | actions | env steps | diverged episodes | all finite |\n|---|---|---|---|---|")
    all_finite = True
    for task in arguments.tasks:
        env = envs.load(task, FetchConfig(faithful=arguments.faithful, ends_at_goal=False))
        chunk = make_chunk(env, arguments.batch)
        for number, pattern in enumerate(PATTERNS):
            taken, diverged, finite = run(env, chunk, number, arguments.batch, arguments.steps // len(PATTERNS))
            print(f"| {task} | {pattern.__name__} | {taken:,} | {diverged} | {'yes' if finite else 'NO'} |", flush=True)
            all_finite &= finite
    sys.exit(0 if all_finite else 1)


if __name__ == "__main__":
    main()
