"""Seconds until Fetch tasks with positions as goals are solved, compiling included: each seed beside the others in one
program, evaluated after every chunk of epochs.

    python -m benchmarks.speed.positions --task fetch_push_positions --seeds 5 --out FOLDER
"""

import argparse
import json
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import make_train, presets


def main() -> None:
    """Train and print a line of json after every evaluation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="fetch_push_positions")
    parser.add_argument("--method", default="none")
    parser.add_argument("--agent", default="td3")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=300.0, help="stop after so many")
    parser.add_argument("--out", type=Path, default=Path("."))
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE", help="fields of TrainConfig, and floats")
    arguments = parser.parse_args()
    began = time.perf_counter()
    changed = dict(word.split("=") for word in arguments.set)
    floats = {name: float(value) for name, value in changed.items() if "." in value}
    whole = {name: int(value) for name, value in changed.items() if "." not in value}
    config = presets.load(arguments.task, arguments.method, agent=arguments.agent, **whole)
    train, hyper = make_train(config), config.hyper.replace(**floats)

    def chunk(states, numbers, hyper, env):
        return jax.vmap(lambda state: train.chunk(state, numbers, hyper, env)[::2])(states)

    def initial(keys, hyper, env):
        return jax.vmap(lambda key: train.initial(key, hyper, env))(keys)

    keys = jax.random.split(jax.random.key(0), arguments.seeds)
    states = jax.jit(initial)(keys, hyper, train.env)
    program = jax.jit(chunk, donate_argnums=0)
    size, name = (
        config.epochs_per_evaluation,
        "-".join([arguments.task, arguments.agent, arguments.method, *arguments.set]),
    )
    with open(arguments.out / f"{name}.jsonl", "w", encoding="utf-8") as file:
        for first in range(0, config.num_epochs, size):
            states, metrics = program(states, jnp.arange(first, first + size, dtype=jnp.int32), hyper, train.env)
            metrics = jax.device_get(metrics)
            line = {"run": name, "seconds": round(time.perf_counter() - began, 1), "epochs": first + size}
            line |= {
                key: np.round(value, 3).tolist()
                for key, value in metrics.items()
                if key.endswith("goal/success_rate") or key == "env_steps"
            }
            for stream in (file, sys.stdout):
                print(json.dumps(line), file=stream, flush=True)
            if line["seconds"] > arguments.seconds:
                break


if __name__ == "__main__":
    main()
