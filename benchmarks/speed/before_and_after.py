"""What a change costs: one small program of an earlier commit and of this checkout, in turns, on this machine.

    python benchmarks/speed/before_and_after.py 8ac0064 [--method infogoal] [--rounds 5] [--epochs 60]

Instead of a commit, a folder that holds one serves, where there is no git.

Each turn is a process of its own, which knows nothing of caches: it imports, traces, compiles and trains the hand-made
rooms of the tests of its checkout. Time is that of the processor, over all threads, which other work on the machine
changes little. Printed are the medians of both, and the ratio of the later to the earlier one over the rounds. The
parameters are compared too: the same bits, or not.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CHILD = """
import hashlib, json, sys, time
begun = time.process_time()
import jax, numpy as np
import hand_made
from infogoal_jax import make_train
method, epochs, repeats = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
imported = time.process_time()
config = hand_made.config(method, num_epochs=epochs, epochs_per_evaluation=epochs // 2, updates_per_epoch=50)
train = make_train(config, hand_made.environment())
lowered = jax.jit(train).lower(jax.random.key(0))
traced = time.process_time()
program = lowered.compile()
compiled = time.process_time()
times = []
for seed in range(repeats):
    start = time.process_time()
    result = jax.block_until_ready(program(jax.random.key(seed)))
    times.append(time.process_time() - start)
leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(result.params)]
steps = epochs * config.num_envs * config.rollout_steps
print(json.dumps({
    "import_s": imported - begun, "trace_s": traced - imported, "compile_s": compiled - traced,
    "steps_per_s": steps / min(times), "bits": hashlib.sha256(b"".join(leaves)).hexdigest()[:12],
}))
"""
MEASURED = {
    "import_s": "import, CPU s",
    "trace_s": "trace, CPU s",
    "compile_s": "compile, CPU s",
    "steps_per_s": "steps a CPU s",
}


def measured(checkout: Path, arguments: argparse.Namespace) -> dict:
    """What one process of this checkout takes."""
    words = [arguments.method, str(arguments.epochs), str(arguments.repeats)]
    environment = os.environ | {"PYTHONPATH": f"{checkout}:{checkout / 'tests'}"}
    ran = subprocess.run(
        [sys.executable, "-c", CHILD, *words], env=environment, cwd=checkout, check=True, stdout=subprocess.PIPE
    )
    return json.loads(ran.stdout.splitlines()[-1])


def main() -> None:
    """Measure in turns and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", help="or a folder")
    parser.add_argument("--method", default="infogoal")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--epochs", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=3, help="runs of the program in a process; the fastest counts")
    arguments = parser.parse_args()
    rounds = []
    with tempfile.TemporaryDirectory() as folder:
        before = Path(arguments.commit).absolute()
        if not before.is_dir():
            before = Path(folder) / "before"
            before.mkdir()
            content = subprocess.run(["git", "archive", arguments.commit], cwd=ROOT, check=True, stdout=subprocess.PIPE)
            subprocess.run(["tar", "xf", "-"], cwd=before, input=content.stdout, check=True)
        for number in range(arguments.rounds):
            order = [before, ROOT] if number % 2 == 0 else [ROOT, before]
            found = {checkout: measured(checkout, arguments) for checkout in order}
            rounds.append((found[before], found[ROOT]))
            print(number, json.dumps(rounds[-1]), file=sys.stderr, flush=True)
    what = f"{arguments.method}, {arguments.rounds} rounds"
    print(f"| {what} | {arguments.commit} | now | ratio, median (lowest to highest) |")
    print("|---|---|---|---|")
    for name, words in MEASURED.items():
        first, second = ([pair[place][name] for pair in rounds] for place in (0, 1))
        ratios = sorted(after / earlier for earlier, after in zip(first, second, strict=True))
        middle = [statistics.median(values) for values in (first, second, ratios)]
        print(
            f"| {words} | {middle[0]:.4g} | {middle[1]:.4g} | {middle[2]:.3f} ({ratios[0]:.3f} to {ratios[-1]:.3f}) |"
        )
    same = {earlier["bits"] == now["bits"] for earlier, now in rounds}
    print(f"the same bits: {'yes' if same == {True} else 'no'}")


if __name__ == "__main__":
    main()
