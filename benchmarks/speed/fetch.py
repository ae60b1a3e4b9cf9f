"""Speed of the Fetch tasks: whole episodes of random actions under one jit, resets included, beside peers measured in
the same run.

    python benchmarks/speed/fetch.py [--tasks fetch_reach fetch_pick_and_place] [--batch 8192 32768] [--faithful]
        [--jaxgcrl CHECKOUT]    JaxGCRL's arms on the same device (peers/fetch_peer_mjx.py)
        [--assets FOLDER]       the reference's models on C MuJoCo in two processes (peers/fetch_peer_mujoco.py)

Compile time and run time are told apart; the run is the better of two.
"""

import argparse
import sys
import time
from pathlib import Path

import jax

from infogoal_jax import compiled, envs
from infogoal_jax.envs.fetch.environment import Fetch
from infogoal_jax.envs.fetch.tasks import TASKS, FetchConfig
from infogoal_jax.report.statistics import describe_machine

PEER = {
    "fetch_reach": "panda_reach",
    "fetch_push": "panda_push_easy",
    "fetch_pick_and_place": "panda_push_easy",
    "fetch_slide": "panda_push_easy",
}


def timed(function, *arguments) -> tuple[float, float]:
    """Seconds to compile, and seconds of the better of two runs after a first one."""
    started = time.perf_counter()
    program = compiled(function, *arguments)
    compile_seconds = time.perf_counter() - started
    jax.block_until_ready(program(*arguments))
    runs = []
    for _ in range(2):
        started = time.perf_counter()
        jax.block_until_ready(program(*arguments))
        runs.append(time.perf_counter() - started)
    return compile_seconds, min(runs)


def measure(env: Fetch, batch: int) -> tuple[float, float]:
    """Compile seconds, and environment steps a second of `batch` episodes with random actions."""

    def episodes(key):
        reset_key, action_key = jax.random.split(key)
        states = jax.vmap(env.reset)(jax.random.split(reset_key, batch))

        def step(states, step_key):
            states = jax.vmap(env.step)(states, jax.random.uniform(step_key, (batch, 4), minval=-1.0, maxval=1.0))
            return states, (env.reward(env.achieved(states), states.desired_goal), states.diverged)

        states, (rewards, diverged) = jax.lax.scan(step, states, jax.random.split(action_key, env.episode_length))
        return states.observation, rewards.mean(), diverged.sum()

    compile_seconds, run_seconds = timed(episodes, jax.random.key(0))
    return compile_seconds, batch * env.episode_length / run_seconds


def print_rates(arguments) -> None:
    """Print the table of speeds."""
    sys.path.append(str(Path(__file__).parents[1] / "peers"))  # Peers are imported only where they are asked for.
    print(
        f"{'faithful' if arguments.faithful else 'default'} setting, random actions, episodes of 50 steps; "
        f"{describe_machine()}\n"
    )
    print(
        "| task | batch | env steps/s | physics steps/s | compile s | peer env steps/s | ratio "
        "|\n|---|---|---|---|---|---|---|"
    )
    peers = {}
    for task in arguments.tasks:
        if arguments.jaxgcrl and PEER[task] not in peers:
            from fetch_peer_mjx import measure_jaxgcrl

            peers[PEER[task]] = max(
                measure_jaxgcrl(arguments.jaxgcrl, PEER[task], batch, 20)[1] for batch in arguments.batch
            )
        name, rate = PEER[task], peers.get(PEER[task])
        if arguments.assets:
            from fetch_peer_mujoco import measure as measure_mujoco

            name, rate = "C MuJoCo, 2 processes", measure_mujoco(arguments.assets, task, arguments.seconds, 2)
        env = envs.load(task, FetchConfig(faithful=arguments.faithful, ends_at_goal=False))
        for batch in arguments.batch:
            compile_seconds, ours = measure(env, batch)
            peer = f"{rate:,.0f} ({name}) | {ours / rate:.1f}" if rate else "|"
            print(
                f"| {task} | {batch} | {ours:,.0f} | {env.physics.setting.substeps * ours:,.0f} | "
                f"{compile_seconds:.1f} | {peer} |",
                flush=True,
            )


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--tasks", nargs="+", choices=TASKS, default=["fetch_reach", "fetch_push", "fetch_pick_and_place"]
    )
    parser.add_argument("--batch", type=int, nargs="+", default=[8192])
    parser.add_argument("--faithful", action="store_true")
    parser.add_argument("--jaxgcrl", type=Path)
    parser.add_argument("--assets", type=Path)
    parser.add_argument("--seconds", type=float, default=10.0, help="for C MuJoCo")
    arguments = parser.parse_args()
    print_rates(arguments)


if __name__ == "__main__":
    main()
