"""What training costs, in six tables.

    python benchmarks/speed/training.py rates [--tasks object_search ...] [--method infogoal] [--seeds 1 16 128]
    python benchmarks/speed/training.py size [--tasks object_search fetch_reach ...] [--method infogoal] [--seeds 1 16]
    python benchmarks/speed/training.py methods [--tasks object_search] [--methods vae her ...] [--out FILE.json]
    python benchmarks/speed/training.py goals [--goals 24 324 6384] [--rows her leo head ...] [--out FILE.json]
    python benchmarks/speed/training.py devices [--tasks object_search] [--method infogoal] [--seeds 16]
    python benchmarks/speed/training.py evaluating [--tasks fetch_pick_and_place] [--method infogoal] [--seeds 16]

rates: environment steps alone, and fused training, for several seeds side by side, compile time apart; `one seed's
time` says how much longer the sweep takes than one seed alone.

size: how large the training program of each task is, and how long it takes to build as `infogoal train` builds it:
traced, lowered and compiled, its two halves at the same time. Operations are equations of the jaxpr, those of inner
functions counted wherever they are called, and nothing comes from a compilation cache. Options of the compiler are
those of infogoal_jax.jit, but for what XLA_FLAGS names, here and in `rates`.

methods: seconds of an epoch's updates relative to the bare agent's, all in one run. What is timed is what an epoch does
after collecting: preparing what is drawn from (tables of a relabelling, bonuses of an explorer), drawing, and the
preset's updates; the fastest of some repeats after one that is not counted, compile time apart.

devices: an epoch of so many seeds on one device, and of as many on each of all devices, as `infogoal train` spreads
them. Efficiency is the first time over the second.

evaluating: what an evaluation costs beside collecting and learning of an epoch, from the preset's number of start
states and from one; and how much of it is needed: after the preset's training, how far success on test goals strays
when it is measured from fewer of `STARTS` start states of each goal, beside how far seeds differ.

goals: the cost of an update under all goals, beside HER's: object search with its goals repeated to so many. `every
goal` gives each transition every goal in turn, one pass of the universal value function for each: what learning from
all goals would cost without a head for it. `subset` draws 256 goals for each update. Goals are texts here; goals that
are images cost more to encode.
"""

import argparse
import functools
import json
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn

from infogoal_jax import compiled, jit, make_train, presets
from infogoal_jax.goals import NO_USE, GoalSet
from infogoal_jax.hyperparameters import with_values
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.runner.compilation import inner_programs
from infogoal_jax.runner.distributed import epochs_over_seeds, over_seeds, shardings_of
from infogoal_jax.runner.memory import bytes_of
from infogoal_jax.runner.sweep import side_by_side
from infogoal_jax.train.evaluation import random_policy
from infogoal_jax.train.experience import collect_epoch, make_experience
from infogoal_jax.train.rollout import collect
from infogoal_jax.train.update import updates

STARTS = 40
"""Start states of each goal from which the trained policies are evaluated."""
SIZES = {"num_epochs": 1, "epochs_per_evaluation": 1}
ROWS = {
    "her": ("her", {}),
    "leo": ("leo", {}),
    "head": ("all_goals", {}),
    "leo, subset": ("leo", {"agent.num_goals": 256}),
    "head, subset": ("all_goals", {"agent.num_goals": 256}),
    "every goal": ("all_goals", {"agent.head": "concatenated"}),
}


def timed(function, *arguments):
    """Result and seconds of a call, until the device has finished."""
    started = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, time.perf_counter() - started


def timed_compilation(function, *arguments):
    """The function, compiled for these arguments, and the seconds that compiling took."""
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
    return min(seconds), compile_seconds, bytes_of(states)


def spread_rate(config, train, seeds_of_each: int, num_devices: int, repeats: int) -> tuple[list[float], float]:
    """Seconds of epochs of so many seeds on each of the first devices, and compile seconds."""
    mesh = jax.sharding.Mesh(np.asarray(jax.local_devices()[:num_devices]), ("seeds",))
    by_seed, everywhere = shardings_of(mesh)
    count = seeds_of_each * num_devices
    shared = jax.device_put((config.hyper, train.env), everywhere)
    keys = jax.device_put(jax.random.split(jax.random.key(0), count), by_seed)
    states = jit(over_seeds(train.initial, count, seeds_of_each, mesh), out_shardings=by_seed)(keys, *shared)
    epochs = jit(epochs_over_seeds(train.epochs, count, seeds_of_each, mesh), donate_argnums=0)
    numbers = jax.device_put(jnp.arange(repeats + 1)[:, None], everywhere)
    started = time.perf_counter()
    program = epochs.lower(states, numbers[0], *shared).compile()
    compile_seconds, seconds = time.perf_counter() - started, []
    for number in numbers:
        (states, *_), elapsed = timed(program, states, number, *shared)
        seconds.append(elapsed)
    return seconds[1:], compile_seconds


def operations(program: Jaxpr | ClosedJaxpr, platform: str | None = None) -> int:
    """Equations of a jaxpr, with those of inner functions and loop bodies counted wherever they stand; of what is
    written for several kinds of devices, the form for this one alone, since the others are not compiled.

    platform: "cpu" or "cuda"; None for the devices in use.
    """
    platform = platform or {"gpu": "cuda"}.get(jax.default_backend(), jax.default_backend())
    jaxpr = program.jaxpr if isinstance(program, ClosedJaxpr) else program
    return sum(
        1 + sum(operations(inner, platform) for inner in compiled_programs(equation, platform))
        for equation in jaxpr.eqns
    )


def compiled_programs(equation: JaxprEqn, platform: str) -> Iterator[Jaxpr | ClosedJaxpr]:
    """The inner jaxprs of an equation, without those that are for other devices."""
    platforms = equation.params.get("branches_platforms")
    if platforms is None:
        for value in equation.params.values():
            yield from inner_programs(value)
    else:
        branches = zip(equation.params["branches"], platforms, strict=True)
        yield next(branch for branch, names in branches if names is None or platform in names)


def build(task: str, method: str, num_seeds: int) -> tuple[int, float, float, float]:
    """Operations of the chunk of one seed, and seconds to trace, lower and compile that of `num_seeds`."""
    train = make_train(config := presets.load(task, method))
    programs, numbers = side_by_side(train, range(num_seeds)), jnp.arange(config.epochs_per_evaluation)
    started = time.perf_counter()
    programs.check()
    after_trace = time.perf_counter()
    finish = programs.compiling()  # Traced already: it lowers, and compiles on other threads.
    after_lower = time.perf_counter()
    finish()
    seconds = (after_trace - started, after_lower - after_trace, time.perf_counter() - after_lower)
    return operations(jax.make_jaxpr(train.chunk)(train.state_shapes, numbers, config.hyper, train.env)), *seconds


def update_cost(train, num_seeds: int, repeats: int) -> dict[str, float]:
    """Seconds to compile, and of an epoch's updates of this many seeds side by side."""
    config, env = train.config, train.env
    keys = jax.random.split(jax.random.key(0), num_seeds)

    def start(key, hyper, env):
        return train.chunk(train.initial(key, hyper, env), jnp.arange(1), hyper, env)[0]

    # One epoch, so that there is something to draw from.
    states = jax.jit(jax.vmap(start, in_axes=(0, None, None)))(keys, config.hyper, env)

    def epoch(state, key, hyper, env):
        setup = train.setup(hyper, env)
        experience, state = make_experience(setup, state, 0)
        return updates(setup, experience, state, key, config.updates_per_epoch)[0].params

    arguments = (states, keys, config.hyper, env)
    program, compile_seconds = timed_compilation(jax.vmap(epoch, in_axes=(0, 0, None, None)), *arguments)
    timed(program, *arguments)
    seconds = min(timed(program, *arguments)[1] for _ in range(repeats))
    return {"compile_seconds": compile_seconds, "seconds": seconds}


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


def print_rates(arguments) -> None:
    """The table of speeds."""
    print(
        "| task | seeds | environment alone, steps/s | compile s | fused training, env steps/s | updates/s | compile s "
        "| one seed's time | state, MiB |\n|---|---|---|---|---|---|---|---|---|"
    )
    for task in arguments.tasks:
        config, alone = presets.load(task, arguments.method, epochs_per_evaluation=1, evaluation_starts=1), None
        train = make_train(config)
        for num_seeds in arguments.seeds:
            steps_rate, env_compile = env_rate(config, train.env, num_seeds, arguments.repeats)
            seconds, train_compile, size = training_rate(config, train, num_seeds, arguments.repeats)
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


def print_devices(arguments) -> None:
    """The table of seeds over devices."""
    print("| task | devices | seeds | ms an epoch, from and to | efficiency | compile s |\n|---|---|---|---|---|---|")
    for task in arguments.tasks:
        config, alone = presets.load(task, arguments.method, epochs_per_evaluation=1, evaluation_starts=1), None
        train, seeds = make_train(config), arguments.seeds[0]
        for devices in sorted({1, len(jax.local_devices())}):
            seconds, compile_seconds = spread_rate(config, train, seeds, devices, arguments.repeats)
            alone = min(seconds) if alone is None else alone
            print(
                f"| {task} | {devices} | {seeds * devices} | {1000 * min(seconds):.0f} to {1000 * max(seconds):.0f} | "
                f"{alone / min(seconds):.3f} | {compile_seconds:.1f} |",
                flush=True,
            )


def print_sizes(arguments) -> None:
    """The table of programs."""
    print("| task | seeds | operations | trace s | lower s | compile s | all s |\n|---|---|---|---|---|---|---|")
    for task in arguments.tasks:
        for num_seeds in arguments.seeds:
            count, *seconds = build(task, arguments.method, num_seeds)
            each = " | ".join(f"{value:.1f}" for value in (*seconds, sum(seconds)))
            print(f"| {task} | {num_seeds} | {count:,} | {each} |", flush=True)


def print_methods(arguments) -> dict:
    """The table of methods; returns its numbers."""
    found = {}
    for task in arguments.tasks:
        base = presets.load(task, "none", **SIZES)
        env, seeds = make_train(base).env, arguments.seeds[0]
        print(f"{task}, {seeds} seeds, {base.updates_per_epoch} updates of batch {base.batch_size}; {env.source}\n")
        print("| method | ms an update | times the bare agent's | compile s |\n|---|---|---|---|")
        for method in ["none", *arguments.methods]:
            config = presets.load(task, method, **SIZES)
            cost = update_cost(make_train(config, env), seeds, arguments.repeats)
            ratio = cost["seconds"] / found.setdefault(f"{task}/none", cost)["seconds"]
            milliseconds = 1000 * cost["seconds"] / config.updates_per_epoch
            print(f"| {method} | {milliseconds:.2f} | {ratio:.2f} | {cost['compile_seconds']:.1f} |", flush=True)
            found[f"{task}/{method}"] = cost
    return found


def print_evaluating(arguments) -> None:
    """The tables of what evaluation costs and of what it is needed for."""
    for task in arguments.tasks:
        config, seeds = presets.load(task, arguments.method), arguments.seeds[0]
        train = make_train(config)
        hyper, env = config.hyper, train.env
        keys = jax.random.split(jax.random.key(0), seeds)

        def collecting(state, hyper, env, train=train):
            return state if env.recorded is not None else collect_epoch(train.setup(hyper, env), state, 0)[0]

        def learning(state, hyper, env, train=train):
            setup = train.setup(hyper, env)
            experience, state = make_experience(setup, state, 0)
            return updates(setup, experience, state, state.key, train.config.updates_per_epoch)[0]

        def training(key, hyper, env, train=train):
            numbers = jnp.arange(train.config.num_epochs, dtype=jnp.int32)
            return train.epochs(train.initial(key, hyper, env), numbers, hyper, env)[0]

        def evaluating(state, hyper, env, starts, train=train):
            return train.evaluate(state.params, hyper, env, starts)

        def over(function, **fixed):
            return jax.vmap(functools.partial(function, **fixed), in_axes=(0, None, None))

        program, _ = timed_compilation(over(training), keys, hyper, env)
        states, whole = timed(program, keys, hyper, env)
        parts = {"collecting": over(collecting), "learning": over(learning)}
        starts = dict.fromkeys((1, config.evaluation_starts, STARTS))
        parts |= {f"evaluating, {count} starts": over(evaluating, starts=count) for count in starts}
        found, milliseconds = {}, {}
        for name, part in parts.items():
            program, _ = timed_compilation(part, states, hyper, env)
            found[name], _ = timed(program, states, hyper, env)
            milliseconds[name] = 1000 * min(timed(program, states, hyper, env)[1] for _ in range(arguments.repeats))
        print(f"{task}, {seeds} seeds, {config.num_epochs} epochs without evaluations: {whole:.1f} s\n")
        print("| an epoch's | ms |\n|---|---|")
        print("\n".join(f"| {name} | {value:.1f} |" for name, value in milliseconds.items()), flush=True)
        first = np.asarray(found[f"evaluating, {STARTS} starts"]["first_reached"])
        mask = np.asarray(env.goals.test_mask)[np.asarray(env.goals.evaluated)]
        reached = (first <= env.episode_length)[:, mask].mean(1)  # [seeds, STARTS]
        print(f"\nTest goals reached: {reached.mean():.3f}\n\n| starts | strays by | seeds differ by |\n|---|---|---|")
        for count in (1, 2, 5, 10, 20):
            of_starts = reached.reshape(seeds, STARTS // count, count).mean(-1)
            strays, differ = (float(of_starts.std(axis, ddof=1).mean()) for axis in (1, 0))
            print(f"| {count} | {strays:.3f} | {differ:.3f} |", flush=True)
        print(flush=True)


def print_goals(arguments) -> list[dict]:
    """The table of learning under all goals; returns its numbers."""
    sizes = SIZES | {"updates_per_epoch": arguments.updates}
    env = make_train(presets.load("object_search", "none", **sizes)).env
    print(f"{arguments.seeds[0]} seeds; {env.source}\n\n| goals | | ms an update | compile s |\n|---|---|---|---|")
    found = []
    for num_goals in arguments.goals:
        many = repeated(env, num_goals)
        for row in arguments.rows:
            method, changes = ROWS[row]
            config = with_values(presets.load("object_search", method, **sizes), changes)
            cost = update_cost(make_train(config, many), arguments.seeds[0], arguments.repeats)
            milliseconds = 1000 * cost["seconds"] / arguments.updates
            print(f"| {num_goals:,} | {row} | {milliseconds:.2f} | {cost['compile_seconds']:.1f} |", flush=True)
            found.append({"goals": num_goals, "row": row, "milliseconds": milliseconds})
    return found


TABLES = {
    "rates": print_rates,
    "size": print_sizes,
    "methods": print_methods,
    "goals": print_goals,
    "devices": print_devices,
    "evaluating": print_evaluating,
}


def main():
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=TABLES)
    parser.add_argument("--tasks", nargs="+", choices=presets.TASKS, default=["object_search"])
    parser.add_argument("--method", default="infogoal", help="of all tables but methods and goals")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1], help="side by side; rates and size take several")
    parser.add_argument("--repeats", type=int, default=3)
    methods = [name for name in presets.METHODS if name != "none"]
    parser.add_argument("--methods", nargs="*", default=methods, choices=methods)
    parser.add_argument("--goals", type=int, nargs="+", default=[24, 324, 6384])
    parser.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS), help="of goals")
    parser.add_argument("--updates", type=int, default=20, help="of an epoch, for goals")
    parser.add_argument("--out", type=Path, help="file to write the numbers of methods or goals to (json)")
    arguments = parser.parse_args()
    if arguments.out and arguments.table not in ("methods", "goals"):
        parser.error("--out is for methods and goals")
    print(f"{arguments.table}; {describe_machine()}\n")
    found = TABLES[arguments.table](arguments)
    if arguments.out:
        about = {"machine": describe_machine(), "table": arguments.table, "seeds": arguments.seeds}
        arguments.out.write_text(json.dumps(about | {"found": found}) + "\n")


if __name__ == "__main__":
    main()
