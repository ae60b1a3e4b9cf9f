"""Stable-Baselines3's SAC with hindsight experience replay on a Fetch task of ours, through the Gymnasium bridge:
success against steps.

Stable-Baselines3 is no dependency of the project; it needs a scratch environment (CPU torch, about 1 GB):

    python3.11 -m venv scratch && scratch/bin/pip install torch --index-url https://download.pytorch.org/whl/cpu
    scratch/bin/pip install -c constraints.txt -e '.[gymnasium]' stable-baselines3
    scratch/bin/python benchmarks/peers/fetch_sb3_her.py --task fetch_reach --steps 6000 --seeds 3 --out FOLDER
    infogoal pretrain fetch_reach --seeds 3 --num-epochs 6 --out OTHER

FOLDER/numbers.csv has a row for each seed and evaluation. `python -m infogoal_paper.pages sb3_her --take FOLDER`,
and the same of OTHER, which has curve.csv, put them into docs/results/sb3_her and the page.
"""

import argparse
import csv
import time
from pathlib import Path

import numpy as np
import torch
from stable_baselines3 import SAC, HerReplayBuffer, __version__
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from infogoal_jax.bridges import gymnasium as bridge
from infogoal_jax.report.statistics import describe_machine


def learner(task: str, seed: int) -> SAC:
    """SAC with four relabelled goals for each real one; sizes and rates as in RL Zoo's FetchReach. Without normalised
    observations nothing is learnt: goals differ by centimetres only."""
    env = VecNormalize(DummyVecEnv([lambda: bridge.make(task)]), norm_reward=False)
    return SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        learning_rate=1e-3,
        buffer_size=100_000,
        learning_starts=1000,
        batch_size=256,
        gamma=0.95,
        tau=0.05,
        seed=seed,
        device="cpu",
        policy_kwargs={"net_arch": [64, 64]},
    )


def success_rate(model: SAC, env, episodes: int, first_seed: int) -> float:
    """Share of episodes that end at the goal, with the policy's mean action."""
    at_goal = []
    for episode in range(episodes):
        seen, _ = env.reset(seed=first_seed + episode)
        ended = False
        while not ended:
            action, _ = model.predict(model.get_vec_normalize_env().normalize_obs(seen), deterministic=True)
            seen, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
        at_goal.append(info["is_success"])
    return float(np.mean(at_goal))


def curve(task: str, seed: int, steps: int, every: int, episodes: int, test_env) -> list[dict]:
    """Train a seed. A row for each evaluation: steps, seconds of the CPU that learning took, success."""
    model, seconds, rows = learner(task, seed), 0.0, []
    for done in range(every, steps + 1, every):
        started = time.process_time()
        model.learn(every, reset_num_timesteps=False)
        seconds += time.process_time() - started
        success = success_rate(model, test_env, episodes, 1_000_000)
        rows.append({"seed": seed, "env_steps": done, "cpu_seconds": round(seconds, 1), "success_rate": success})
        print(f"{seed:5d} {done:8d} {seconds:9.1f} {success:9.2f}", flush=True)
    return rows


def main():
    """Train and print a line for each evaluation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=list(bridge.IDS), default="fetch_reach")
    parser.add_argument("--steps", type=int, default=10_000, help="environment steps of training")
    parser.add_argument("--every", type=int, default=1000, help="steps between evaluations")
    parser.add_argument("--episodes", type=int, default=50, help="episodes of an evaluation")
    parser.add_argument("--seeds", type=int, default=1, help="seeds, one after the other")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder to write numbers.csv to")
    arguments = parser.parse_args()

    machine = f"{describe_machine()}; stable-baselines3 {__version__}, torch {torch.__version__.split('+')[0]}"
    print(f"{arguments.task}; {machine}", flush=True)
    test_env = bridge.make(arguments.task)
    test_env.reset(seed=0)
    test_env.step(test_env.action_space.sample())  # Compiles before the clock starts.
    print(" seed    steps CPU seconds  success")
    sizes = arguments.steps, arguments.every, arguments.episodes
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    rows = [row for seed in seeds for row in curve(arguments.task, seed, *sizes, test_env)]
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        with open(arguments.out / "numbers.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, [*rows[0], "machine"])
            writer.writeheader()
            writer.writerows(row | {"machine": machine} for row in rows)


if __name__ == "__main__":
    main()
