"""Where do the seconds of a first run go? `infogoal train object_search` in an empty cache, phase by phase; and
those of its updates, by what the compiled program computes.

    python benchmarks/speed/first_run.py run [--seeds 2] [--small] [--num-epochs 20]
    python benchmarks/speed/first_run.py update [--seeds 2] [--small]

run: seconds and CPU seconds of all threads. CPU seconds hardly change when the machine is busy. Training is said for
the epochs that were asked for, without those of its evaluations. update: one epoch under XLA's profiler, each kernel
counted where its HLO comes from. Kernels run side by side: shares are of the sum.
"""

import argparse
import collections
import itertools
import os
import re
import resource
import sys
import tempfile
import time
from pathlib import Path

PARTS = {
    "state encoder": r"PatchEncoder",
    "value network": r"\(MLP\)",
    "goal encoder": r"GaussianEncoder|GoalLayers|infogoal",
}
"""What a kernel belongs to, by the names of modules in its metadata; all else is the rest, Adam among it."""


def clock() -> tuple[float, float]:
    """Seconds, and CPU seconds of this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return time.perf_counter(), used.ru_utime + used.ru_stime


def run(arguments: argparse.Namespace) -> None:
    """Train as the command line does and print what each phase took."""
    marks = [("importing", *clock())]
    with tempfile.TemporaryDirectory() as home:
        os.environ["XDG_CACHE_HOME"] = home
        from infogoal_jax.cli.main import main as infogoal
        from infogoal_jax.runner import training

        train = training.run

        def told(*given, phase, **named):
            def begins(name: str, epoch: int) -> None:
                marks.append((name, *clock()))
                phase(name, epoch)

            result = train(*given, phase=begins, **named)
            marks.append(("figures", *clock()))
            return result

        training.run = told
        words = f"train object_search --seeds {arguments.seeds} --out {home}/run"
        epochs = f" --num-epochs {arguments.num_epochs}" if arguments.num_epochs else ""
        try:
            infogoal([*(words + epochs).split(), *(["--small"] if arguments.small else [])])
        except SystemExit as end:
            if end.code:
                raise
        finally:
            training.run = train
        marks.append(("all", *clock()))
    print("\n| phase | seconds | CPU seconds |\n|---|---|---|")
    for (name, *since), (_, *until) in itertools.pairwise(marks):
        print(f"| {name} | {until[0] - since[0]:.1f} | {until[1] - since[1]:.1f} |")
    print(f"| all | {marks[-1][1] - marks[0][1]:.1f} | {marks[-1][2] - marks[0][2]:.1f} |")


def update(arguments: argparse.Namespace) -> None:
    """Profile an epoch and print what its kernels took."""
    import jax
    import jax.numpy as jnp
    from jax.profiler import ProfileData

    from infogoal_jax import compiled, make_train, presets

    config = presets.load("object_search", **({"small": True} if arguments.small else {}))
    train = make_train(config)
    keys = jax.random.split(jax.random.key(0), arguments.seeds)
    states = jax.jit(jax.vmap(train.initial, in_axes=(0, None, None)))(keys, config.hyper, train.env)
    over = jax.vmap(lambda *given: train.epochs(*given)[0], in_axes=(0, None, None, None))
    program = compiled(over, states, jnp.arange(1), config.hyper, train.env)
    states = jax.block_until_ready(program(states, jnp.arange(1), config.hyper, train.env))
    before = clock()
    states = jax.block_until_ready(program(states, jnp.arange(1) + 1, config.hyper, train.env))
    each = [(now - then) / config.updates_per_epoch * 1e3 for then, now in zip(before, clock(), strict=True)]
    print(f"an update of {arguments.seeds} seeds, collecting included: {each[0]:.1f} ms, {each[1]:.1f} CPU ms\n")
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(program(states, jnp.arange(1) + 2, config.hyper, train.env))
        profile = ProfileData.from_file(str(next(Path(folder).rglob("*.xplane.pb"))))
        events = [event for plane in profile.planes for line in plane.lines for event in line.events]
    lines = re.finditer(r"^\s*(?:ROOT )?%([\w.-]+) = .*", program.as_text(), re.MULTILINE)
    origin = {line[1]: line[0] for line in lines}
    took: collections.Counter = collections.Counter()
    for event in events:
        if event.name in origin and "while/body/closed_call/while/body" in origin[event.name]:
            words = origin[event.name]
            part = next((name for name, pattern in PARTS.items() if re.search(pattern, words)), "the rest")
            kind = "products" if "dot_general" in words or " dot(" in words else "all else"
            took[part, kind] += event.duration_ns
    total = sum(took.values())
    print("| part of an update | products | all else |\n|---|---|---|")
    for part in [*PARTS, "the rest"]:
        shares = " | ".join(f"{took[part, kind] / max(total, 1):.0%}" for kind in ("products", "all else"))
        print(f"| {part} | {shares} |")


def main() -> None:
    """Print the table that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=("run", "update"))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--small", action="store_true", help="the preset for first trials")
    parser.add_argument("--num-epochs", type=int, default=0, help="in place of the preset's")
    arguments = parser.parse_args()
    {"run": run, "update": update}[arguments.table](arguments)
    from infogoal_jax.report.statistics import describe_machine

    print(f"\n{describe_machine()}, load {os.getloadavg()[0]:.1f}", file=sys.stdout)


if __name__ == "__main__":
    main()
