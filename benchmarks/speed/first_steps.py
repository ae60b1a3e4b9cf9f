"""A newcomer's first quarter of an hour: the first commands of the README, one after the other in an empty home, and
how long each of them takes.

    python benchmarks/speed/first_steps.py [--tasks object_search fetch_reach] [--seeds 16]

Installation is not part of it. Nothing comes from a cache but what an earlier command of the list left there. What the
commands print goes to stderr. Exit status 1 if one of them failed.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time

from infogoal_jax import presets
from infogoal_jax.report.statistics import describe_machine


def commands_of(tasks: list[str], seeds: int) -> list[str]:
    """What is typed after `infogoal`, in this order."""
    found = ["--help", "methods"]
    for task in tasks:
        train = f"train {task} --seeds {seeds}"
        found += [
            f"evaluate shipped/{task}",
            f"{train} --out {task}",
            f"{train} --out {task}_again",
            f"{train} --method her --out {task}_her",
            f"compare {task} {task}_her --out {task}.pdf",
            f"export {task} --out {task}.npz",
        ]
        if task in presets.FETCH_TASKS:
            found.append(f"video {task} --out {task}.mp4")
    return found


def main():
    """Play the commands and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=presets.TASKS, default=["object_search", "fetch_reach"])
    parser.add_argument("--seeds", type=int, default=16)
    arguments = parser.parse_args()
    print("| command | seconds |\n|---|---|", flush=True)
    started, failed = time.perf_counter(), False
    with tempfile.TemporaryDirectory() as home:
        environment = {name: value for name, value in os.environ.items() if name != "XDG_CACHE_HOME"} | {"HOME": home}
        for command in commands_of(arguments.tasks, arguments.seeds):
            words, before = [sys.executable, "-m", "infogoal_jax", *command.split()], time.perf_counter()
            done = subprocess.run(words, cwd=home, env=environment, stdout=sys.stderr)
            failed |= done.returncode != 0
            note = f" (failed, exit status {done.returncode})" if done.returncode else ""
            print(f"| `infogoal {command}` | {time.perf_counter() - before:.1f}{note} |", flush=True)
    minutes = (time.perf_counter() - started) / 60
    print(f"\nall of it {minutes:.1f} minutes; {describe_machine()}")  # Only now: it takes the memory of a GPU.
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
