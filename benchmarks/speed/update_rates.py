"""Updates a second of an earlier checkout and of this one, in turns, on a device that nothing else uses.

    python benchmarks/speed/update_rates.py FOLDER [--programs object_search/infogoal/16/1000 ...] [--turns 7]

A program is task/method/seeds/updates: the loop over so many updates of so many seeds side by side, after an epoch's
collecting. Each checkout is a process, which compiles all programs at once; then the processes take turns, program by
program, while the other one waits. The first turn does not count. Printed are the medians, lowest to highest in
brackets, and whether the losses are the same.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = (
    "object_search/infogoal/1/1500",
    "object_search/infogoal/16/1000",
    "fetch_pick_and_place/infogoal/16/200",
    "object_manipulation/infogoal+her/15/200",
)


def lowered(name: str) -> tuple:
    """A program of this process's checkout, not compiled yet; the one that makes its states; and their arguments."""
    import jax
    import jax.numpy as jnp

    from infogoal_jax import make_train, presets
    from infogoal_jax.runner.compilation import compiler_options
    from infogoal_jax.train.experience import collect_epoch, experience_of
    from infogoal_jax.train.update import updates

    task, method, seeds, count = name.split("/")
    learner, _, relabelling = method.partition("+")
    config = presets.load(task, learner, relabelling=relabelling or None)
    train = make_train(config)
    arguments = jax.random.split(jax.random.key(0), int(seeds)), config.hyper, train.env

    def start(key, hyper, env):
        return collect_epoch(train.setup(hyper, env), train.initial(key, hyper, env), jnp.zeros((), jnp.int32))[0]

    def loop(state, key, hyper, env):
        setup = train.setup(hyper, env)
        experience, state = experience_of(setup, state, jnp.zeros((), jnp.int32))
        return updates(setup, experience, state, key, int(count))

    def over(function, keys):
        return jax.jit(jax.vmap(function, in_axes=(*keys, None, None)), compiler_options=compiler_options())

    first = over(start, (0,))
    program = over(loop, (0, 0)).lower(jax.eval_shape(first, *arguments), *arguments)
    return program, first.lower(*arguments), arguments


def work(names: list[str]) -> None:
    """The process of a checkout: for each line of standard input, the name of a program, the seconds that it takes."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # What else is printed is no answer.
    import jax

    def compiled(program, first, arguments):
        return program.compile(), first.compile()(*arguments), arguments

    with ThreadPoolExecutor(len(names)) as pool:
        begun = {name: pool.submit(compiled, *lowered(name)) for name in names}
        ready = {name: each.result() for name, each in begun.items()}
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        program, states, arguments = ready[line.strip()]
        started = time.perf_counter()
        _, metrics = jax.block_until_ready(program(states, *arguments))
        seconds = time.perf_counter() - started
        print(json.dumps([seconds, float(metrics["agent/loss"].mean())]), file=answers, flush=True)


def started(checkout: Path, names: list[str]) -> subprocess.Popen:
    """The process of a checkout."""
    path = os.pathsep.join([str(checkout), *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, str(Path(__file__).resolve()), "--work", "--programs", *names]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    return subprocess.Popen(command, text=True, env=os.environ | {"PYTHONPATH": path}, **pipes)


def main() -> None:
    """Measure in turns and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, nargs="?", help="folder of the earlier checkout")
    parser.add_argument("--programs", nargs="+", default=list(PROGRAMS))
    parser.add_argument("--turns", type=int, default=7)
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    names = arguments.programs
    if arguments.work:
        work(names)
        return
    if arguments.before is None:
        parser.error("give the folder of the earlier checkout")
    processes = [started(checkout, names) for checkout in (arguments.before.resolve(), ROOT)]
    try:
        waiting = [threading.Thread(target=process.stdout.readline) for process in processes]
        for thread in waiting:
            thread.start()
        for thread in waiting:
            thread.join()
        found: dict[tuple[str, int], list[list[float]]] = {}
        for turn in range(arguments.turns):
            for name in names:
                for place in (0, 1) if turn % 2 else (1, 0):
                    print(name, file=processes[place].stdin, flush=True)
                    answer = json.loads(processes[place].stdout.readline())
                    found.setdefault((name, place), []).append(answer)
    finally:
        for process in processes:
            process.kill()
    print("| program | before, updates/s | now, updates/s | ratio | the same loss |\n|---|---|---|---|---|")
    for name in names:
        seeds, count = map(int, name.split("/")[2:])
        rates = [[seeds * count / seconds for seconds, _ in found[name, place][1:]] for place in (0, 1)]
        middle = [statistics.median(each) for each in rates]
        cells = [f"{middle[place]:,.0f} ({min(each):,.0f} to {max(each):,.0f})" for place, each in enumerate(rates)]
        losses = {found[name, place][0][1] for place in (0, 1)}
        same = "yes" if len(losses) == 1 else "no"
        print(f"| {name} | {cells[0]} | {cells[1]} | {middle[1] / middle[0]:.2f} | {same} |")


if __name__ == "__main__":
    main()
