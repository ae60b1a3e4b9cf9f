"""Fly test questions on the simulated drone, over its real protocol, beside the evaluation inside the program.

    python benchmarks/fidelity/drone_flights.py RUN --flights 100 --out FOLDER

Every flight is a process of `infogoal fly`. The evaluation takes the same questions from the same starts. The script
writes flights.json: success of both, and the time from an image to its command.
"""

import argparse
import itertools
import json
import shutil
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np

from infogoal_jax import load_run
from infogoal_jax.drone import log, simulated_tello
from infogoal_jax.report.export import export
from infogoal_jax.stand_ins import shelf
from infogoal_jax.train.evaluation import goal_starts
from infogoal_jax.train.rollout import run_episodes

ROLLOUTS = 10
"""Evaluations inside of the program that are averaged: which image of a place is seen is drawn."""


def main() -> None:
    """Fly, evaluate, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--speed", type=float, default=4.0, help="simulated seconds in a second")
    parser.add_argument("--workers", type=int, default=1, help="flights at the same time")
    options = parser.parse_args()
    run = load_run(options.run)
    options.out.mkdir(parents=True, exist_ok=True)
    policy = options.out / "policy.npz"
    export(run, policy, run.seeds[0])
    episodes, inside, all_inside = test_episodes(run, options.flights)
    generator_seed = run.config.env.generator_seed
    chunks = [range(worker, len(episodes), options.workers) for worker in range(options.workers)]
    common = (episodes, policy, options.out, options.speed, generator_seed)
    with ThreadPoolExecutor(options.workers) as pool:
        found = pool.map(lambda chunk: fly_all(chunk, *common), chunks)
        flown = dict(itertools.chain.from_iterable(found))
    flown = [flown[number] for number in range(len(episodes))]
    latency = 1000 * np.array([value for flight in flown for value in flight["latency"]])
    found = np.array([flight["found"] for flight in flown], float)
    difference = found - inside
    result = {
        "flights": len(flown),
        "success_flown": found.mean(),
        "success_inside_same_starts": inside.mean(),
        "success_inside_all_starts": all_inside,
        "difference": difference.mean(),
        "difference_standard_error": difference.std(ddof=1) / np.sqrt(len(difference)),
        "landed": sum(flight["landed"] for flight in flown),
        "latency_ms": {f"percentile_{at}": float(np.percentile(latency, at)) for at in (50, 99)},
        "moves": len(latency),
        "speed": options.speed,
        "data": run.data,
        "episodes": flown,
    }
    (options.out / "flights.json").write_text(json.dumps(result, indent=1, default=float))
    print(json.dumps({name: value for name, value in result.items() if name != "episodes"}, indent=1, default=float))


def test_episodes(run, count: int):
    """The questions and starts (column, row) of `count` episodes of the evaluation, the first start of every test
    question first; their success inside of the program [count]; and that of all test episodes."""
    env, num_starts = run.env, run.config.evaluation_starts
    starts = goal_starts(env, num_starts)
    policy = run.policy(run.seeds[0])
    rollout = jax.jit(lambda key: run_episodes(env, starts, policy, key).success)
    success = np.mean([np.asarray(rollout(jax.random.key(seed))) for seed in range(ROLLOUTS)], axis=0)
    is_test = np.asarray(env.goals.test_mask)[np.asarray(starts.goal)]
    order = np.flatnonzero(is_test).reshape(-1, num_starts).T.ravel()[:count]
    cells = np.round((np.asarray(env.position)[np.asarray(starts.node)] - shelf.FIRST) / shelf.STEP).astype(int)
    episodes = [(env.goals.names[int(starts.goal[row])], cells[row].tolist()) for row in order]
    return episodes, success[order], float(success[is_test].mean())


def fly_all(numbers, episodes, policy: Path, out: Path, speed: float, generator_seed: int) -> list[tuple[int, dict]]:
    """Fly these episodes, one after the other, with one simulated drone."""
    drone, flown = simulated_tello.start(simulated_tello.SimulatedTello(shelf_seed=generator_seed)), []
    try:
        for number in numbers:
            (question, start), folder = episodes[number], out / f"flight_{number:03d}"
            while not has_flown(folder):  # It has where the comparison was interrupted.
                fly(folder, policy, question, start, number, drone, speed, generator_seed)
            flown.append((number, read_flight(folder, question, start)))
            print(number, flown[-1][1]["reason"], flown[-1][1]["steps"], file=sys.stderr, flush=True)
    finally:
        drone.stop()
    return flown


def has_flown(folder: Path) -> bool:
    """Whether a flight in this folder came to its end in the air. What was refused on the ground, as a busy machine may
    be too slow for the checks, is cleared away."""
    if not (folder / log.NAME).exists():
        return False
    ends = log.events_of(log.read(folder / log.NAME), "end")
    if ends and not ends[0]["reason"].startswith("refused"):
        return True
    print(folder, ends, "is flown again", file=sys.stderr, flush=True)
    shutil.rmtree(folder)
    return False


def fly(folder: Path, policy: Path, question: str, start: list[int], seed: int, drone, speed: float, shelf_seed: int):
    """One flight of `infogoal fly` on this simulated drone."""
    ports = free_ports()
    first = tuple((shelf.FIRST + shelf.STEP * np.array(start)).tolist())
    drone.restart(
        simulated_tello.SimulatedTello(first, shelf_seed, seed, speed, state_port=ports[1], video_port=ports[2])
    )
    command = [
        sys.executable, "-m", "infogoal_jax", "fly", str(policy), "--question", question, "--simulate",
        "--simulated", str(drone.port), str(drone.truth_port), "--ports", *map(str, ports),
        "--start", *map(str, start), "--speed", str(speed), "--seed", str(seed), "--out", str(folder),
    ]  # fmt: skip
    subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=600, check=False)


def read_flight(folder: Path, question: str, start: list[int]) -> dict:
    """How the flight of this log ended, and its times from an image to the command, s."""
    events = log.read(folder / log.NAME)
    (end,) = log.events_of(events, "end")
    latency = [step["latency"] for step in log.events_of(events, "step")]
    return {"question": question, "start": start, "latency": latency} | end


def free_ports() -> tuple[int, int, int]:
    """Three UDP ports that nobody holds."""
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3)]
    for one in sockets:
        one.bind(("", 0))
    ports = tuple(one.getsockname()[1] for one in sockets)
    for one in sockets:
        one.close()
    return ports


if __name__ == "__main__":
    main()
