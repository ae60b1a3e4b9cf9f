"""What the goal images cost: the encoder's work, the gradient through it and the gather of images as shares of the
fused step's time.

    python benchmarks/speed/fetch_shares.py [--task fetch_reach] [--seeds 5] [--updates 100] [--out FILE.json]

One epoch of the preset is a rollout and `--updates` updates. Each part is compiled alone, run on the same arrays as in
training, and timed over three runs after one that is not counted; parts of an update run as often as in an epoch,
inside a scan as there.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp

from infogoal_jax import compiled, make_train, presets, replay
from infogoal_jax.learners.learner import encode_all
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.train.experience import Experience
from infogoal_jax.train.rollout import collect
from infogoal_jax.train.update import updates as updates_of

REPEATS = 3


def seconds(function: Callable, *arguments) -> tuple[float, float]:
    """Seconds that one call takes, mean of `REPEATS`, and seconds of compiling."""
    started = time.perf_counter()
    program = compiled(function, *arguments)
    compiling = time.perf_counter() - started
    jax.block_until_ready(program(*arguments))
    started = time.perf_counter()
    for _ in range(REPEATS):
        jax.block_until_ready(program(*arguments))
    return (time.perf_counter() - started) / REPEATS, compiling


def measure(task: str, seeds: int, updates: int) -> dict[str, float]:
    """Seconds of each part of an epoch, for this many seeds side by side."""
    config = presets.load(task, "infogoal")
    train = make_train(config)
    env, learner, hyper = train.env, train.parts.learner, config.hyper
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds, dtype=jnp.uint32))
    states = jax.jit(jax.vmap(train.initial, in_axes=(0, None, None)))(keys, hyper, env)
    draws = jax.random.split(jax.random.key(1), updates)
    images = 3 * config.learner.num_pairs  # Anchors, positives and negatives of an update.

    def rollout(state, env):
        policy = train.policy(state.params, hyper, env)
        return collect(env, state.env_states, policy, state.key, config.rollout_steps)[1]

    def updating(state, rows, env):
        buffer = replay.add(state.buffer, rows, jnp.int32(0))
        filled = jax.tree.map(lambda leaf: jnp.resize(leaf[: config.num_envs], leaf.shape), buffer)
        achieved = (env.goals_of(filled.record) >= 0).any(-1)
        every = jnp.ones(env.goals.num_goals, bool)
        experience = Experience(
            buffer=filled,
            decision_count=replay.running_count(filled.valid & filled.decided),
            achieved=achieved,
            achieved_count=replay.running_count(achieved),
            known=every,
            usable=every,
            dissimilarity=state.dissimilarity,
            codes=encode_all(learner, state.params["goal"], env.goals),
        )
        return updates_of(train.parts, env, hyper, experience, state, jax.random.key(2), updates)[0].params

    def chosen(key, env):
        return env.goals.inputs[jax.random.randint(key, (images,), 0, env.goals.num_goals)]

    def gather(state, env):
        return jax.lax.scan(
            lambda total, key: (total + chosen(key, env).sum(dtype=jnp.int32), None), jnp.int32(0), draws
        )[0]

    def encode(state, env, gradient: bool):
        def loss(params, key):
            code = learner.encode(params, chosen(key, env))
            return sum(leaf.mean() for leaf in jax.tree.leaves(code))

        def step(params, key):
            value, slope = jax.value_and_grad(loss)(params, key) if gradient else (loss(params, key), params)
            return jax.tree.map(lambda leaf, by: leaf - 1e-6 * value * by, params, slope), None

        return jax.lax.scan(step, state.params["goal"], draws)[0]

    over_seeds = {
        name: jax.vmap(function, in_axes=(0, None))
        for name, function in {
            "rollout": rollout,
            "images gathered": gather,
            "encoded": lambda state, env: encode(state, env, False),
            "encoded, with gradient": lambda state, env: encode(state, env, True),
            "all goals encoded, once": lambda state, env: encode_all(learner, state.params["goal"], env.goals),
        }.items()
    }
    rows = jax.jit(over_seeds["rollout"])(states, env)
    found = {name: seconds(function, states, env)[0] for name, function in over_seeds.items()}
    found["updates"] = seconds(jax.vmap(updating, in_axes=(0, 0, None)), states, rows, env)[0]
    return found


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="fetch_reach", choices=presets.FETCH_TASKS)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--updates", type=int, default=100)
    parser.add_argument("--out", type=Path, help="file to write the numbers to (json)")
    arguments = parser.parse_args()
    found = measure(arguments.task, arguments.seeds, arguments.updates)
    whole = found["rollout"] + found["updates"]  # The updates include everything else.
    shares = {
        "gather": found["images gathered"],
        "encoder": found["encoded"] - found["images gathered"],
        "gradient": found["encoded, with gradient"] - found["encoded"],
        "all goals, once an epoch": found["all goals encoded, once"],
    }
    for name, value in found.items():
        print(f"{name:24s} {value * 1e3:9.1f} ms")
    for name, value in shares.items():
        print(f"share of an epoch, {name:24s} {value / whole:6.1%}")
    print(f"{arguments.task}, {arguments.seeds} seeds, {arguments.updates} updates; {describe_machine()}")
    if arguments.out:
        arguments.out.write_text(
            json.dumps(
                {
                    "seconds": found,
                    "shares": {name: value / whole for name, value in shares.items()},
                    "machine": describe_machine(),
                    "task": arguments.task,
                    "seeds": arguments.seeds,
                }
            )
            + "\n"
        )


if __name__ == "__main__":
    main()
