"""The cost of each method: seconds of an epoch's updates relative to the bare agent's, all in one run.

    python benchmarks/speed/method_cost.py [--task object_search] [--methods vae her ...] [--seeds 1] [--repeats 5]
    [--out FILE.json]

What is timed is what an epoch does after collecting: preparing what is drawn from (tables of a relabelling, bonuses of
an explorer), drawing, and the preset's updates; the fastest of some repeats after one that is not counted, compile time
apart. Prints a Markdown table.
"""

import argparse
import json
import time
from pathlib import Path

import jax

from infogoal_jax import compiled, make_train, presets
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.train.update import updates

SIZES = {"num_epochs": 1, "epochs_per_evaluation": 1}


def measure(train, num_seeds: int, repeats: int) -> dict[str, float]:
    """Seconds to compile, and of an epoch's updates of this many seeds side by side."""
    config, env = train.config, train.env
    keys = jax.random.split(jax.random.key(0), num_seeds)
    start = jax.jit(
        jax.vmap(
            lambda key, hyper, env: train.chunk(train.initial(key, hyper, env), jax.numpy.arange(1), hyper, env)[0],
            in_axes=(0, None, None),
        )
    )
    states = start(keys, config.hyper, env)  # One epoch, so that there is something to draw from.

    def epoch(state, key, hyper, env):
        experience, state = train.experience_of(state, 0, hyper, env)
        return updates(train.parts, env, hyper, experience, state, key, config.updates_per_epoch)[0].params

    started = time.perf_counter()
    program = compiled(jax.vmap(epoch, in_axes=(0, 0, None, None)), states, keys, config.hyper, env)
    compile_seconds, seconds = time.perf_counter() - started, []
    for _ in range(repeats + 1):
        started = time.perf_counter()
        jax.block_until_ready(program(states, keys, config.hyper, env))
        seconds.append(time.perf_counter() - started)
    return {"compile_seconds": compile_seconds, "seconds": min(seconds[1:])}


def main():
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="object_search", choices=presets.TASKS)
    parser.add_argument(
        "--methods",
        nargs="*",
        default=[name for name in presets.METHODS if name != "none"],
        choices=list(presets.METHODS),
    )
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, help="file to write the numbers to (json)")
    arguments = parser.parse_args()
    base = presets.load(arguments.task, "none", **SIZES)
    env, found = make_train(base).env, {}
    print(
        f"{arguments.task}, {arguments.seeds} seeds, {base.updates_per_epoch} updates of batch {base.batch_size}; "
        f"{env.source}"
    )
    print(f"{describe_machine()}\n\n| method | ms an update | times the bare agent's | compile s |\n|---|---|---|---|")
    for method in ["none", *arguments.methods]:
        config = presets.load(arguments.task, method, **SIZES)
        found[method] = measure(make_train(config, env), arguments.seeds, arguments.repeats)
        ratio = found[method]["seconds"] / found["none"]["seconds"]
        milliseconds = 1000 * found[method]["seconds"] / config.updates_per_epoch
        print(f"| {method} | {milliseconds:.2f} | {ratio:.2f} | {found[method]['compile_seconds']:.1f} |", flush=True)
    if arguments.out:
        arguments.out.write_text(
            json.dumps(
                {"machine": describe_machine(), "task": arguments.task, "seeds": arguments.seeds, "found": found}
            )
            + "\n"
        )


if __name__ == "__main__":
    main()
