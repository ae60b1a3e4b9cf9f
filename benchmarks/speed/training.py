"""What training costs, in three tables.

    python benchmarks/speed/training.py rates [--tasks object_search ...] [--method infogoal] [--seeds 1 16 128]
        [--bfloat16]
    python benchmarks/speed/training.py size [--tasks object_search fetch_reach ...] [--method infogoal] [--seeds 1 16]
    python benchmarks/speed/training.py evaluating [--tasks fetch_pick_and_place] [--method infogoal] [--seeds 16]

rates: environment steps alone, and fused training, for several seeds side by side, compile time apart; `one seed's
time` says how much longer the sweep takes than one seed alone.

size: how large the training program of each task is, and how long it takes to build as `infogoal train` builds it:
traced, lowered and compiled, its two halves at the same time. Operations are equations of the jaxpr, those of inner
functions counted wherever they are called, and nothing comes from a compilation cache. Options of the compiler are
those of infogoal_jax.jit, but for what XLA_FLAGS names, here and in `rates`.

evaluating: what an evaluation costs beside collecting and learning of an epoch, from the preset's number of start
states and from one; and how much of it is needed: after the preset's training, how far success on test goals strays
when it is measured from fewer of `STARTS` start states of each goal, beside how far seeds differ.
"""

import argparse
import functools
import time
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn

from infogoal_jax import compiled, make_train, presets
from infogoal_jax.report.statistics import describe_machine
from infogoal_jax.runner.compilation import inner_programs
from infogoal_jax.runner.memory import bytes_of
from infogoal_jax.runner.sweep import side_by_side
from infogoal_jax.train.evaluation import random_policy
from infogoal_jax.train.experience import collect_epoch, make_experience
from infogoal_jax.train.rollout import collect
from infogoal_jax.train.update import updates

STARTS = 40
"""Start states of each goal from which the trained policies are evaluated."""


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


def print_rates(arguments) -> None:
    """The table of speeds."""
    print(
        "| task | seeds | environment alone, steps/s | compile s | fused training, env steps/s | updates/s | compile s "
        "| one seed's time | state, MiB |\n|---|---|---|---|---|---|---|---|---|"
    )
    for task in arguments.tasks:
        changes = {"epochs_per_evaluation": 1, "evaluation_starts": 1, "bfloat16": arguments.bfloat16}
        config, alone = presets.load(task, arguments.method, **changes), None
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


def print_sizes(arguments) -> None:
    """The table of programs."""
    print("| task | seeds | operations | trace s | lower s | compile s | all s |\n|---|---|---|---|---|---|---|")
    for task in arguments.tasks:
        for num_seeds in arguments.seeds:
            count, *seconds = build(task, arguments.method, num_seeds)
            each = " | ".join(f"{value:.1f}" for value in (*seconds, sum(seconds)))
            print(f"| {task} | {num_seeds} | {count:,} | {each} |", flush=True)


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


TABLES = {"rates": print_rates, "size": print_sizes, "evaluating": print_evaluating}


def main():
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=TABLES)
    parser.add_argument("--tasks", nargs="+", choices=presets.TASKS, default=["object_search"])
    parser.add_argument("--method", default="infogoal")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1], help="side by side")
    parser.add_argument("--repeats", type=int, default=3, help="of rates")
    parser.add_argument("--bfloat16", action="store_true", help="in layers, for rates")
    arguments = parser.parse_args()
    print(f"{arguments.table}; {describe_machine()}\n")
    TABLES[arguments.table](arguments)


if __name__ == "__main__":
    main()
