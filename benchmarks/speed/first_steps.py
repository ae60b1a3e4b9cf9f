"""A newcomer's hour: what the README, `docs/start/first_run.md` and the guides tell a newcomer to type, one after the
other in an empty home, with the seconds until each thing that a newcomer wants to see.

    python benchmarks/speed/first_steps.py [--seeds 2] [--checkout FOLDER] [--only own] [--save now]

Milestones are a result and a picture, a run, a task of one's own, a comparison and a policy that runs elsewhere; a step
without one belongs to the next. Installation is not part of it. Nothing comes from a cache but what an earlier step
left there. CPU seconds are those of all processes of a step, and hardly change when the machine is busy. --checkout
plays the hour with the code and the pages of another checkout; a step that its commands cannot do yet is left out.
What the commands print goes to stderr. --save puts the sums into docs/results/first_hour.json, under `before` or
`now`; then run `python -m infogoal_paper.pages first_hour`. Exit status 1 if a step failed.
"""

import argparse
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from infogoal_jax.report.statistics import describe_machine

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "docs" / "results" / "first_hour.json"
GUIDES = ("docs/guides/own_task.md", "docs/own_task.md")
"""The page with a task of one's own, here and in older checkouts."""
IMPORTS = "infogoal_jax/imports.py"
"""Where this is, the command trains such a task."""
ELSEWHERE = """
import sys
import numpy as np
from policy_file import ExportedPolicy
policy = ExportedPolicy("policy.npz")
mask = np.ones(policy.about["action_size"], bool)
print(policy.about["actions"][policy.act(np.zeros((32, 32, 1), np.uint8), policy.goals[0], action_mask=mask)])
assert "jax" not in sys.modules and "infogoal_jax" not in sys.modules
"""
"""Acts by an exported policy of object search beside a copy of policy_file.py, with NumPy alone."""


class Step(NamedTuple):
    """What is typed. milestone: what the newcomer then has, or nothing; shown: the line; words: the command; needs: a
    file of the checkout without which the command cannot do it yet; instead: a file of the checkout with which nobody
    needs to type it; folder: where, below the newcomer's home."""

    milestone: str
    shown: str
    words: list[str]
    needs: str = ""
    instead: str = ""
    folder: str = "."


def infogoal(line: str, milestone: str = "", needs: str = "") -> Step:
    """A step of the command line."""
    return Step(milestone, f"infogoal {line}", [sys.executable, "-m", "infogoal_jax", *line.split()], needs)


def python(script: str, shown: str, milestone: str = "", **where: str) -> Step:
    """A step that runs a script."""
    return Step(milestone, shown, [sys.executable, script], **where)


def steps_of(seeds: int, own_task: str) -> list[Step]:
    """What is typed, in this order. own_task: its name in the registry."""
    train = f"train object_search --small --seeds {seeds}"
    return [
        Step("", 'python -c "import infogoal_jax"', [sys.executable, "-c", "import infogoal_jax"]),
        infogoal("--help"),
        infogoal("report shipped/object_search", "a result and a picture"),
        infogoal(f"{train} --out infogoal", "a run of object search"),
        python("my_task.py", "python my_task.py  # the script of the guide", "a task of one's own", instead=IMPORTS),
        infogoal(
            f"train {own_task} --import my_task.py --method none --num-epochs 20 --seeds {seeds} --out mine",
            "a task of one's own",
            IMPORTS,
        ),
        infogoal(f"{train} --method her --out her", "HER"),
        infogoal("compare infogoal her --out success.pdf", "a comparison"),
        infogoal("export infogoal --out elsewhere/policy.npz"),
        python("run.py", "python run.py  # NumPy alone", "a policy elsewhere", folder="elsewhere"),
        infogoal(f"{train} --out again", "the same run, from the cache"),
    ]


def write_files(home: Path, checkout: Path) -> str:
    """Write what the newcomer copies from the pages; the name of the task of one's own."""
    page = next(path for path in (checkout / name for name in GUIDES) if path.exists())
    (script, *_) = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
    (home / "my_task.py").write_text(script)
    (home / "elsewhere").mkdir()
    (home / "elsewhere" / "run.py").write_text(ELSEWHERE)
    shutil.copy(checkout / "infogoal_jax" / "policy_file.py", home / "elsewhere")
    return re.search(r"""(?:registry\[|register\()"(\w+)\"""", script)[1]


def cpu_seconds() -> float:
    """Of all processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def play(steps: list[Step], home: Path, checkout: Path) -> Iterator[tuple[Step, float, float, int]]:
    """Each step with its seconds, its CPU seconds and its exit status."""
    environment = {name: value for name, value in os.environ.items() if name not in ("XDG_CACHE_HOME", "XLA_FLAGS")}
    paths = filter(None, [str(checkout), os.environ.get("PYTHONPATH")])
    environment |= {"HOME": str(home), "PYTHONPATH": os.pathsep.join(paths)}
    for step in steps:
        if not (checkout / step.needs).exists() or (step.instead and (checkout / step.instead).exists()):
            continue
        before, used = time.perf_counter(), cpu_seconds()
        done = subprocess.run(step.words, cwd=home / step.folder, env=environment, stdout=sys.stderr)
        yield step, time.perf_counter() - before, cpu_seconds() - used, done.returncode


def main():
    """Play the hour and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--checkout", type=Path, default=ROOT, metavar="FOLDER", help="whose code and pages are played")
    parser.add_argument("--only", default="", metavar="WORD", help="the steps alone whose line holds this, for a try")
    parser.add_argument(
        "--save", default="", choices=("", "before", "now"), help="the column of docs/research/speed.md"
    )
    arguments = parser.parse_args()
    checkout = arguments.checkout.resolve()
    print("| typed | seconds | CPU seconds | since the beginning | |\n|---|---|---|---|---|", flush=True)
    elapsed, failed, sums, since = 0.0, False, {}, [0.0, 0.0]
    with tempfile.TemporaryDirectory() as folder:
        steps = steps_of(arguments.seeds, write_files(Path(folder), checkout))
        chosen = [step for step in steps if arguments.only in step.shown]
        for step, seconds, used, status in play(chosen, Path(folder), checkout):
            elapsed, failed = elapsed + seconds, failed or status != 0
            note = f"failed, exit status {status}" if status else step.milestone
            since = [since[0] + seconds, since[1] + used]
            if step.milestone:
                sums[step.milestone], since = [round(each, 1) for each in since], [0.0, 0.0]
            print(f"| `{step.shown}` | {seconds:.1f} | {used:.1f} | {elapsed:.0f} | {note} |", flush=True)
    load = os.getloadavg()[2]
    machine = f"{describe_machine()}, load {load:.1f}"  # Only now: it takes the memory of a GPU.
    print(f"\n{machine}")
    if arguments.save and not failed and not arguments.only:
        saved = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        saved[arguments.save] = {"machine": machine, "seconds": sums}
        RESULTS.write_text(json.dumps(saved, indent=1) + "\n")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
