"""The cost of an update under all goals, beside HER's: object search with its goals repeated to 24, 324 and 6,384.

    python benchmarks/speed/all_goals.py [--goals 24 324 6384] [--rows her leo head ...] [--seeds 1] [--repeats 3]
    [--out FILE.json]

`every goal` gives each transition every goal in turn, one pass of the universal value function for each: what learning
from all goals would cost without a head for it. `subset` draws 256 goals for each update. Goals are texts here; goals
that are images cost more to encode. What is timed is what benchmarks/speed/method_cost.py times.
"""

import argparse
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from method_cost import SIZES, measure

from infogoal_jax import make_train, presets
from infogoal_jax.goals import NO_USE, GoalSet
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.report.statistics import describe_machine

ROWS = {
    "her": ("her", {}),
    "leo": ("leo", {}),
    "head": ("all_goals", {}),
    "leo, subset": ("leo", {"relabelling.num_goals": 256}),
    "head, subset": ("all_goals", {"relabelling.num_goals": 256}),
    "every goal": ("all_goals", {"agent.head": "concatenated"}),
}


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


def main():
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--goals", type=int, nargs="*", default=[24, 324, 6384])
    parser.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS))
    parser.add_argument("--updates", type=int, default=20, help="updates of an epoch")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--out", type=Path, help="file to write the numbers to (json)")
    arguments = parser.parse_args()
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
    if arguments.out:
        arguments.out.write_text(json.dumps({"machine": describe_machine(), "seeds": arguments.seeds, "rows": found}))


if __name__ == "__main__":
    main()
