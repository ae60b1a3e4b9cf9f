"""What a change costs: programs of an earlier commit and of this checkout, in turns, on this machine.

    python benchmarks/speed/before_and_after.py 8ac0064 [--programs rooms/infogoal/1/3000 ...] [--rounds 3] [--turns 3]

Instead of a commit, a folder that holds one serves, where there is no git. A program is task/method/seeds/updates: an
epoch of so many updates of so many seeds side by side, with its collecting; the task `rooms` is the hand-made one of
the tests. Each round has a process for each checkout, which knows nothing of caches: it imports, traces and compiles
all programs at once; then the processes take turns, while the other one waits. The first turn does not count.

Printed are medians, lowest to highest of the ratios in brackets, and whether the parameters are the same bits. CPU
seconds, over all threads, hardly change with other work on the machine; updates a second do.
"""

import argparse
import contextlib
import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
Times = dict[str, float]
"""What was measured, by its name in the table."""


def lowered(name: str) -> tuple:
    """A program of this process's checkout, not compiled yet; the function of its states; and their arguments."""
    import jax
    import jax.numpy as jnp

    import infogoal_jax

    task, method, seeds, count = name.split("/")
    sizes = {"num_epochs": 1, "epochs_per_evaluation": 1, "updates_per_epoch": int(count)}
    if task == "rooms":
        import hand_made

        config = hand_made.config(method, **sizes)
        train = infogoal_jax.make_train(config, hand_made.environment())
    else:
        config = infogoal_jax.presets.load(task, method, **sizes)
        train = infogoal_jax.make_train(config)
    jit = getattr(infogoal_jax, "jit", jax.jit)
    initial = jit(jax.vmap(train.initial, in_axes=(0, None, None)))
    arguments = jax.random.split(jax.random.key(0), int(seeds)), config.hyper, train.env
    epoch = jit(jax.vmap(train.epochs, in_axes=(0, None, None, None)))
    shared = jnp.zeros(1, jnp.int32), *arguments[1:]
    return epoch.lower(jax.eval_shape(initial, *arguments), *shared), lambda: initial(*arguments), shared


def work(names: list[str]) -> None:
    """The process of a checkout: says what it took to get ready, then, for each line of standard input, the name of a
    program, the rates of its updates and the bits of its parameters."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # What else is printed is no answer.
    clock = [time.process_time()]
    import jax
    import numpy as np

    import infogoal_jax  # noqa: F401

    clock.append(time.process_time())
    programs = {name: lowered(name) for name in names}
    clock.append(time.process_time())
    with ThreadPoolExecutor(len(names)) as pool:
        compiled = dict(zip(names, pool.map(lambda name: programs[name][0].compile(), names), strict=True))
    clock.append(time.process_time())
    spans = zip(("import", "trace", "compile"), clock, clock[1:], strict=False)
    print(json.dumps({f"{what}, CPU s": after - before for what, before, after in spans}), file=answers, flush=True)
    states = {name: start() for name, (_, start, _) in programs.items()}
    for name in map(str.strip, sys.stdin):
        wall, used = time.perf_counter(), time.process_time()
        state, _ = jax.block_until_ready(compiled[name](states[name], *programs[name][2]))
        wall, used = time.perf_counter() - wall, time.process_time() - used
        seeds, count = map(int, name.split("/")[2:])
        rates = {f"{name}, updates/s": seeds * count / wall, f"{name}, updates a CPU s": seeds * count / used}
        bits = hashlib.sha256(b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(state.params)))
        print(json.dumps([rates, bits.hexdigest()]), file=answers, flush=True)


def started(checkout: Path, names: list[str]) -> subprocess.Popen:
    """The process of a checkout."""
    path = [str(checkout), str(checkout / "tests"), *filter(None, [os.environ.get("PYTHONPATH")])]
    command = [sys.executable, str(Path(__file__).resolve()), "--work", "--programs", *names]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return subprocess.Popen(command, text=True, env=os.environ | {"PYTHONPATH": os.pathsep.join(path)}, **pipes)


def round_of(checkouts: list[Path], names: list[str], turns: int) -> tuple[list[Times], bool]:
    """What a process of each checkout measured, medians over its turns, and whether their bits are the same."""
    with contextlib.ExitStack() as ending:
        processes = [ending.enter_context(started(checkout, names)) for checkout in checkouts]
        for process in processes:
            ending.callback(process.kill)
        found = [json.loads(process.stdout.readline()) for process in processes]
        rates: list[list[Times]] = [[] for _ in checkouts]
        bits = set()
        for turn in range(turns + 1):
            for place in (0, 1) if turn % 2 else (1, 0):
                rates[place].append({})
                for name in names:
                    print(name, file=processes[place].stdin, flush=True)
                    own, digest = json.loads(processes[place].stdout.readline())
                    rates[place][turn] |= own
                    bits.add((name, digest))
    for own, (_, *counted) in zip(found, rates, strict=True):
        own |= {name: statistics.median(turn[name] for turn in counted) for name in counted[0]}
    return found, len(bits) == len(names)


def main() -> None:
    """Measure in turns and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", nargs="?", help="the earlier commit, or a folder")
    parser.add_argument("--programs", nargs="+", default=["rooms/infogoal/1/3000"])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--turns", type=int, default=3, help="of each process; the median counts")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.work:
        work(arguments.programs)
        return
    if arguments.before is None:
        parser.error("give the earlier commit, or its folder")
    with tempfile.TemporaryDirectory() as folder:
        before = Path(arguments.before).absolute()
        if not before.is_dir():
            before = Path(folder)
            content = subprocess.run(["git", "archive", arguments.before], cwd=ROOT, check=True, stdout=subprocess.PIPE)
            subprocess.run(["tar", "xf", "-"], cwd=before, input=content.stdout, check=True)
        rounds = [round_of([before, ROOT], arguments.programs, arguments.turns) for _ in range(arguments.rounds)]
    print(f"| {arguments.rounds} rounds | {arguments.before} | now | ratio (lowest to highest) |\n|---|---|---|---|")
    for name in rounds[0][0][0]:
        earlier, now = ([found[place][name] for found, _ in rounds] for place in (0, 1))
        ratios = [last / first for first, last in zip(earlier, now, strict=True)]
        middle = [statistics.median(values) for values in (earlier, now, ratios)]
        cells = [f"{middle[0]:,.4g}", f"{middle[1]:,.4g}", f"{middle[2]:.3f} ({min(ratios):.3f} to {max(ratios):.3f})"]
        print(f"| {' | '.join([name, *cells])} |")
    print(f"the same bits: {'yes' if all(same for _, same in rounds) else 'no'}")


if __name__ == "__main__":
    main()
