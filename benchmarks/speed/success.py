"""Is success the same after a change? Whole runs of presets, by an earlier checkout and by this one.

    python benchmarks/speed/success.py run before object_search infogoal --seeds 5 --checkout FOLDER --out RUNS
    python benchmarks/speed/success.py run after object_search infogoal --seeds 5 --out RUNS
    python benchmarks/speed/success.py compare RUNS [--save]

run: trains the seeds 0, 1, ... of a preset side by side, and keeps success of each at every evaluation, in a file of
RUNS; --checkout: with the package in this folder; --bfloat16: with that field. compare: success on test goals at the
last evaluation of both, and the difference with its 95 % interval, seeds paired, for every task that RUNS has twice;
--save: keeps them as those of --bfloat16, of which `python -m infogoal_paper.pages bfloat16` makes the page's table.
"""

import argparse
import json
import lzma
import sys
import time
from pathlib import Path


def run(arguments: argparse.Namespace) -> None:
    """Train, and keep what came of it. What it imports is of the checkout that was asked for."""
    if arguments.checkout is not None:
        sys.path.insert(0, str(arguments.checkout.resolve()))
    import jax
    import numpy as np

    from infogoal_jax import make_train, presets
    from infogoal_jax.report.statistics import describe_machine
    from infogoal_jax.runner.compilation import compiler_options

    changes = {"bfloat16": True} if arguments.bfloat16 else {}  # Earlier checkouts have no such field.
    config = presets.load(arguments.task, arguments.method, **changes)
    train = make_train(config)
    keys = jax.vmap(jax.random.key)(np.arange(arguments.seeds))
    over = jax.vmap(lambda key, hyper, env: train(key, hyper, env).metrics, in_axes=(0, None, None))
    program = jax.jit(over, compiler_options=compiler_options()).lower(keys, config.hyper, train.env).compile()
    started = time.perf_counter()
    metrics = jax.block_until_ready(program(keys, config.hyper, train.env))
    values = {name: np.asarray(value, float) for name, value in metrics.items() if name.endswith("success_rate")}
    found = {
        **{name: getattr(arguments, name) for name in ("label", "task", "method", "seeds")},
        "updates": config.num_epochs * config.updates_per_epoch,
        "seconds": time.perf_counter() - started,
        "machine": describe_machine(),
        "success": {name: value.reshape(arguments.seeds, -1).round(4).tolist() for name, value in values.items()},
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / f"success_{arguments.label}_{arguments.task}.json").write_text(json.dumps(found) + "\n")
    print(f"{arguments.label}, {arguments.task}: {found['seconds']:.0f} s")


def compare(arguments: argparse.Namespace) -> None:
    """Print the table."""
    from infogoal_paper import pages

    runs = [json.loads(path.read_text()) for path in sorted(arguments.runs.glob("success_*.json"))]
    print(pages.success_table(runs))
    if arguments.save:
        pages.BFLOAT16.write_bytes(lzma.compress("".join(f"{json.dumps(each)}\n" for each in runs).encode()))


def main() -> None:
    """Run one side, or print the table of both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("run")
    one.add_argument("label", choices=("before", "after"))
    one.add_argument("task")
    one.add_argument("method")
    one.add_argument("--seeds", type=int, default=5)
    one.add_argument("--checkout", type=Path)
    one.add_argument("--bfloat16", action="store_true")
    one.add_argument("--out", type=Path, required=True)
    two = commands.add_parser("compare")
    two.add_argument("runs", type=Path)
    two.add_argument("--save", action="store_true")
    arguments = parser.parse_args()
    {"run": run, "compare": compare}[arguments.command](arguments)


if __name__ == "__main__":
    main()
