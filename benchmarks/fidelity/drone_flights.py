"""Fly test questions on the simulated drone, over its real protocol, beside the evaluation inside the program.

    python benchmarks/fidelity/drone_flights.py shipped/embodied_qa --flights 100 --out FOLDER

Every flight is a process of `infogoal fly`. The evaluation takes the same policy, questions and starts, and images of a
hovering drone. The script writes flights.json: how every flight ended, and the times from an image to its command.
`python -m infogoal_paper.pages drone --take FOLDER` puts it into docs/results/drone.json.xz and the page. Flights that
are in FOLDER already are not flown again.
"""

import argparse
import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
from drone_faults import ATTEMPTS, SPEED, conditions, free_ports

from infogoal_drone import records, simulated_tello
from infogoal_jax import envs, evaluate, load_run
from infogoal_jax.report.export import export
from infogoal_jax.stand_ins import shelf
from infogoal_jax.train.evaluation import draw_starts

ROLLOUTS = 10
"""Evaluations inside of the program that are averaged: which image of a place is seen is drawn."""


def main() -> None:
    """Fly and evaluate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="run of embodied_qa on a generated shelf, or shipped/embodied_qa")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--flights", type=int, default=100)
    options = parser.parse_args()
    run = load_run(options.run)
    options.out.mkdir(parents=True, exist_ok=True)
    policy = options.out / "policy.npz"
    method = export(run, policy, run.seeds[0]).about["method"]
    episodes, inside_all = evaluate_inside(run, options.flights)
    shelf_seed, flown = run.config.env.generator_seed, []
    drone = simulated_tello.start(
        simulated_tello.SimulatedTello(shelf_seed=shelf_seed, gathered=run.config.env.gathered)
    )
    try:
        for number, episode in enumerate(episodes):
            folder = options.out / f"flight_{number:03d}"
            fly(folder, policy, episode["question"], episode["start"], number, drone, shelf_seed)
            flown.append(episode | read_flight(folder))
            print(number, episode["inside"], flown[-1]["reason"], flown[-1]["steps"], file=sys.stderr, flush=True)
    finally:
        drone.stop()
    about = {"run": options.run, "method": method, "data": run.data, "inside_all": inside_all}
    (options.out / "flights.json").write_text(json.dumps(conditions() | about | {"flights": flown}, indent=0) + "\n")


def evaluate_inside(run, count: int) -> tuple[list[dict], float]:
    """Question, start (column, row) and success inside of the program of `count` episodes of the evaluation, the first
    start of every test question first; and the success rate in all test episodes. Images are those of a hovering
    drone, also for a policy that was trained without."""
    env, num_starts = envs.load("embodied_qa", dataclasses.replace(run.config.env, hovering=True)), 5
    goals = env.goals.evaluated[np.asarray(env.goals.test_mask)[np.asarray(env.goals.evaluated)]]
    starts = draw_starts(env, goals, num_starts)
    policy = run.train.policy(run.params(run.seeds[0]), run.config.hyper, env, False)

    @jax.jit
    def rollout(seed):
        keys = jax.random.split(jax.random.key(seed), starts.key.shape)

        def of_this_seed(observation, goal, key):
            return policy(observation, goal, jax.random.fold_in(key, seed))

        return evaluate(of_this_seed, env, goals, starts.replace(key=keys)).success

    success = np.mean([np.asarray(rollout(seed)) for seed in range(ROLLOUTS)], axis=0)
    cells = np.round((np.asarray(env.position)[np.asarray(starts.node)] - shelf.FIRST) / shelf.STEP).astype(int)
    episodes = [
        {
            "question": env.goals.names[goal],
            "start": cells[row, start].tolist(),
            "inside": round(float(success[row, start]), 4),
        }
        for start in range(num_starts)
        for row, goal in enumerate(np.asarray(goals).tolist())
    ]
    return episodes[:count], float(success.mean())


def fly(folder: Path, policy: Path, question: str, start: list[int], seed: int, drone, shelf_seed: int) -> None:
    """One flight of `infogoal fly` on this simulated drone, unless it is in the folder. One that was refused on the
    ground, as a busy machine may be too slow for the checks, is tried again."""
    for _ in range(ATTEMPTS):
        if has_flown(folder):
            return
        shutil.rmtree(folder, ignore_errors=True)
        ports = free_ports()
        first = tuple((shelf.FIRST + shelf.STEP * np.array(start)).tolist())
        drone.restart(
            simulated_tello.SimulatedTello(first, shelf_seed, seed, SPEED, state_port=ports[1], video_port=ports[2])
        )
        command = [
            sys.executable, "-m", "infogoal_jax", "fly", str(policy), "--question", question, "--simulate",
            "--simulated", str(drone.port), str(drone.truth_port), "--ports", *map(str, ports),
            "--start", *map(str, start), "--speed", str(SPEED), "--seed", str(seed), "--out", str(folder),
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
        folder.mkdir(exist_ok=True)
        (folder / "load.json").write_text(json.dumps(os.getloadavg()[0]))
    if not has_flown(folder):
        sys.exit(f"{folder}: refused {ATTEMPTS} times\n{done.stdout}{done.stderr}")


def has_flown(folder: Path) -> bool:
    """Whether a flight in this folder came to its end in the air."""
    if not (folder / records.NAME).exists():
        return False
    ends = records.events_of(records.read(folder / records.NAME), "end")
    return bool(ends) and not ends[0]["reason"].startswith("refused")


def read_flight(folder: Path) -> dict:
    """How the flight of this log ended, its times from an image to the command (s), and the load of the machine."""
    events = records.read(folder / records.NAME)
    (end,) = records.events_of(events, "end")
    kept = {name: end[name] for name in ("found", "landed", "reason", "steps")}
    latency = [step["latency"] for step in records.events_of(events, "step")]
    return kept | {"load": json.loads((folder / "load.json").read_text()), "latency": latency}


if __name__ == "__main__":
    main()
