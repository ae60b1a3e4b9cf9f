"""The cost of each method: seconds of an epoch's updates relative to the bare agent's, all in one run.

    python benchmarks/speed/method_cost.py [--task object_search] [--methods vae her ...] [--seeds 1] [--repeats 5]
        [--out FILE.json]
    python benchmarks/speed/method_cost.py --goals 24 324 6384 [--rows her leo head ...] [--updates 20] [--repeats 3]

What is timed is what an epoch does after collecting: preparing what is drawn from (tables of a relabelling, bonuses of
an explorer), drawing, and the preset's updates; the fastest of some repeats after one that is not counted, compile time
apart. Prints a Markdown table.

With `--goals` it is the cost of an update under all goals, beside HER's: object search with its goals repeated to so
many. `every goal` gives each transition every goal in turn, one pass of the universal value function for each: what
learning from all goals would cost without a head for it. `subset` draws 256 goals for each update. Goals are texts
here; goals that are images cost more to encode.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import compiled, make_train, presets
from infogoal_jax.goals import NO_USE, GoalSet
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.train.update import updates

SIZES = {"num_epochs": 1, "epochs_per_evaluation": 1}
ROWS = {
    "her": ("her", {}),
    "leo": ("leo", {}),
    "head": ("all_goals", {}),
    "leo, subset": ("leo", {"relabelling.num_goals": 256}),
    "head, subset": ("all_goals", {"relabelling.num_goals": 256}),
    "every goal": ("all_goals", {"agent.head": "concatenated"}),
}


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


def repeated(env, num_goals: int):
    """Object search whose goals are repeated until there are so many. The repetitions can be achieved only."""
    own, goals = env.goals.num_goals, env.goals
    which = np.arange(num_goals) % own
    uses = np.where(goals.train_mask, 0, np.where(goals.validation_mask, 1, 2))[which]
    uses[own:] = NO_USE
    names = tuple(goals.names[goal] for goal in which)
    many = GoalSet.of(goals.inputs[which], goals.regions[which], uses, names, goals.region_names)
    place = jnp.asarray(np.pad(np.asarray(env.place), (0, max(0, num_goals - own))))
    return env.replace(goals=many, in_view=env.in_view[:, which], place=place)


def of_methods(arguments) -> dict:
    """Print the table of methods, and return its numbers."""
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
    return {"task": arguments.task, "found": found}


def of_all_goals(arguments) -> dict:
    """Print the table of learning under all goals, and return its numbers."""
    sizes = SIZES | {"updates_per_epoch": arguments.updates}
    env = make_train(presets.load("object_search", "none", **sizes)).env
    print(f"{describe_machine()}; {arguments.seeds} seeds; {env.source}\n\n| goals | | ms an update | compile s |")
    print("|---|---|---|---|")
    found = []
    for num_goals in arguments.goals:
        many = repeated(env, num_goals)
        for row in arguments.rows:
            method, changes = ROWS[row]
            config = with_values(presets.load("object_search", method, **sizes), changes)
            numbers = measure(make_train(config, many), arguments.seeds, arguments.repeats)
            milliseconds = 1000 * numbers["seconds"] / arguments.updates
            print(f"| {num_goals:,} | {row} | {milliseconds:.2f} | {numbers['compile_seconds']:.1f} |", flush=True)
            found.append({"goals": num_goals, "row": row, "milliseconds": milliseconds})
    return {"rows": found}


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
    parser.add_argument("--goals", type=int, nargs="+", help="measure learning under this many goals instead")
    parser.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS), help="for --goals")
    parser.add_argument("--updates", type=int, default=20, help="updates of an epoch, for --goals")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, help="file to write the numbers to (json)")
    arguments = parser.parse_args()
    found = (of_all_goals if arguments.goals else of_methods)(arguments)
    if arguments.out:
        about = {"machine": describe_machine(), "seeds": arguments.seeds}
        arguments.out.write_text(json.dumps(about | found) + "\n")


if __name__ == "__main__":
    main()
