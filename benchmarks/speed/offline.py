"""Speed of offline learning: updates a second of conservative Q-learning on the recorded flights of embodied question
answering, compile time apart.

    python benchmarks/speed/offline.py [--batch 256 1024] [--seeds 1 16] [--updates 1000] [--epochs 3] [--out FILE.json]
        [--peer [PYTHON]]    the same in PyTorch on the CPU (peers/offline_peer.py), in this run, by an interpreter that
        has torch; else by this one

What is timed is training's own program, drawing and relabelling of the batches included and evaluation left out: the
fastest of some epochs of `--updates` updates, after one that is not counted; of the peer the fastest of as many runs.
Prints Markdown tables. Torch is no dependency of the project: `pip install torch` into any other environment will do.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax import compiled, make_train, presets
from infogoal_jax.report.statistics import describe_machine

MILLION = 1_000_000


def configuration(batch: int, updates: int):
    """Embodied question answering without goal representation learning: bare CQL."""
    sizes = {
        "batch_size": batch,
        "updates_per_epoch": updates,
        "num_epochs": 1,
        "epochs_per_evaluation": 1,
        "evaluation_starts": 1,
    }
    return presets.load("embodied_qa", "none", **sizes)


def measure(train, num_seeds: int, epochs: int) -> dict:
    """Compile seconds, and seconds of each of `epochs` epochs of this many seeds side by side, after a first one."""
    hyper, env = train.config.hyper, train.env
    keys = jax.random.split(jax.random.key(0), num_seeds)
    states = jax.jit(jax.vmap(train.initial, in_axes=(0, None, None)))(keys, hyper, env)

    def epoch(states, numbers, hyper, env):
        # Nobody asks for the evaluation: it is not run.
        return jax.vmap(train.chunk, in_axes=(0, None, None, None))(states, numbers, hyper, env)[0]

    started = time.perf_counter()
    program = compiled(epoch, states, jnp.arange(1), hyper, env, donate_argnums=0)
    compile_seconds, seconds = time.perf_counter() - started, []
    for number in range(epochs + 1):
        started = time.perf_counter()
        states = jax.block_until_ready(program(states, jnp.arange(1) + number, hyper, env))
        seconds.append(time.perf_counter() - started)
    return {"compile_seconds": compile_seconds, "epoch_seconds": seconds[1:]}


def peer_arrays(train) -> dict[str, np.ndarray]:
    """What peers/offline_peer.py reads: the recorded moves, what is known of each image, and the sizes and
    hyperparameters as json."""
    config, env = train.config, train.env
    rows, goals = env.recorded, env.goals
    seen = jax.jit(train.initial)(jax.random.key(0), config.hyper, env).seen
    usable = np.asarray(env.goals.usable_mask(config.known_goals))
    known = usable & (np.asarray(seen) | (config.known_goals == "all"))
    images = jnp.arange(env.num_observations)
    achieved = np.asarray(env.goals_of(images))
    hyper = ("learning_rate", "discount", "target_rate", "max_gradient_norm")
    settings = {
        **{name: getattr(config.hyper, name) for name in hyper},
        "conservative_weight": config.hyper.agent.conservative_weight,
        "patch": config.state_encoder.patch,
        "channels": config.state_encoder.channels,
        "features": config.state_encoder.features,
        "hidden": config.agent.hidden,
        "goal_hidden": config.learner.hidden,
        "latent_size": config.learner.latent_size,
        "future_share": config.relabelling.future_share,
        "random_share": config.relabelling.random_share,
    }
    return {
        "images": env.images,
        "in_view": env.in_view,
        "known_goals": np.where((achieved >= 0) & usable[achieved], achieved, -1),
        "known": np.flatnonzero(known),
        "action_mask": env.action_mask(images),
        "goal_inputs": goals.inputs_of(jnp.arange(goals.num_goals)),
        "image": rows.observation,
        "action": rows.action,
        "goal": rows.desired_goal[:, 0],
        "length": rows.valid.sum(1),
        "settings": json.dumps(settings),
    }


def run_peer(python: str, train, batches: list[int], updates: int, repeats: int) -> dict | None:
    """Updates a second in PyTorch, of each batch size and way to feed it, or None where the interpreter has no
    torch."""
    if subprocess.run([python, "-c", "import torch"], capture_output=True).returncode:
        print(
            f"no peer: {python} has no torch; give --peer the interpreter of an environment into which it is installed",
            file=sys.stderr,
        )
        return None
    with tempfile.TemporaryDirectory() as folder:
        arrays = Path(folder) / "arrays.npz"
        np.savez(arrays, **{name: np.asarray(value) for name, value in peer_arrays(train).items()})
        flags = ["--updates", str(updates), "--repeats", str(repeats), "--batch", *map(str, batches)]
        program = [python, Path(__file__).parents[1] / "peers" / "offline_peer.py", arrays, *flags]
        return json.loads(
            subprocess.run(program, stdout=subprocess.PIPE, check=True, text=True).stdout.splitlines()[-1]
        )


def main():
    """Measure and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, nargs="+", default=[256, 1024])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 16])
    parser.add_argument("--updates", type=int, default=1000, help="updates of an epoch")
    parser.add_argument("--epochs", type=int, default=3, help="epochs that are timed")
    parser.add_argument("--peer", nargs="?", const=sys.executable, metavar="PYTHON")
    parser.add_argument(
        "--peer-updates", type=int, default=200, help="updates that are timed of the peer, for each way to make batches"
    )
    parser.add_argument("--out", type=Path, help="file to write the numbers to (json)")
    arguments = parser.parse_args()
    load, train = os.getloadavg()[0], make_train(configuration(256, arguments.updates))
    print(f"embodied_qa, bare CQL; {int(train.env.recorded.valid.sum()):,} recorded moves; {train.env.source}")
    print(f"{describe_machine()}; load before this run {load:.1f}\n", flush=True)
    peer = (
        run_peer(arguments.peer, train, arguments.batch, arguments.peer_updates, arguments.epochs)
        if arguments.peer
        else None
    )
    fastest = {}
    if peer:
        print(f"{peer['about']}, on the CPU\n\n| batch | batches of the peer | updates/s |\n|---|---|---|")
        for batch, rates in peer["updates_per_second"].items():
            fastest[int(batch)] = max((rate, way) for way, rate in rates.items() if way != "one batch again and again")
            print("".join(f"| {batch} | {way} | {rate:,.1f} |\n" for way, rate in rates.items()), end="")
        print()
    found = []
    print(
        "| batch | seeds | updates/s, each seed | all seeds | compile s | minutes for a million updates, all seeds | "
        "times the fastest peer |"
    )
    print("|---|---|---|---|---|---|---|")
    for batch in arguments.batch:
        train = make_train(configuration(batch, arguments.updates), train.env)
        for num_seeds in arguments.seeds:
            result = measure(train, num_seeds, arguments.epochs)
            rate = arguments.updates / min(result["epoch_seconds"])
            found.append({"batch": batch, "seeds": num_seeds, "updates_per_second": rate, **result})
            ratio = f"{num_seeds * rate / fastest[batch][0]:.1f}" if peer else ""
            print(
                f"| {batch} | {num_seeds} | {rate:,.1f} | {num_seeds * rate:,.1f} | {result['compile_seconds']:.1f} | "
                f"{MILLION / rate / 60:,.1f} "
                f"| {ratio} |",
                flush=True,
            )
    if arguments.out:
        arguments.out.write_text(
            json.dumps(
                {
                    "machine": describe_machine(),
                    "load": load,
                    "data": train.env.source,
                    "updates": arguments.updates,
                    "found": found,
                    "peer": peer,
                },
                indent=1,
            )
            + "\n"
        )


if __name__ == "__main__":
    main()
