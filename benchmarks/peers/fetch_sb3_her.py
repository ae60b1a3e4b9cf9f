"""Stable-Baselines3's SAC with hindsight experience replay on a Fetch task of ours, through the Gymnasium bridge:
success against steps.

Stable-Baselines3 is no dependency of the project; it needs a scratch environment (CPU torch, about 1 GB):

    python3.11 -m venv scratch && scratch/bin/pip install torch --index-url https://download.pytorch.org/whl/cpu
    scratch/bin/pip install -c constraints.txt -e '.[gymnasium]' stable-baselines3
    scratch/bin/python benchmarks/peers/fetch_sb3_her.py --task fetch_reach --steps 10000
"""

import argparse
import time

import numpy as np
from stable_baselines3 import SAC, HerReplayBuffer, __version__
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from infogoal_jax.bridges import gymnasium as bridge
from infogoal_jax.report.machine import describe_machine


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


def main():
    """Train and print a line for each evaluation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=list(bridge.IDS), default="fetch_reach")
    parser.add_argument("--steps", type=int, default=10_000, help="environment steps of training")
    parser.add_argument("--every", type=int, default=1000, help="steps between evaluations")
    parser.add_argument("--episodes", type=int, default=50, help="episodes of an evaluation")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    print(f"{describe_machine()}; stable-baselines3 {__version__}; {arguments.task}, seed {arguments.seed}", flush=True)
    test_env = bridge.make(arguments.task)
    test_env.reset(seed=0)
    test_env.step(test_env.action_space.sample())  # Compiles before the clock starts.
    model, seconds = learner(arguments.task, arguments.seed), 0.0
    print("   steps   seconds   success")
    for steps in range(arguments.every, arguments.steps + 1, arguments.every):
        start = time.perf_counter()
        model.learn(arguments.every, reset_num_timesteps=False)
        seconds += time.perf_counter() - start
        print(
            f"{steps:8d} {seconds:9.1f} {success_rate(model, test_env, arguments.episodes, 1_000_000):9.2f}", flush=True
        )


if __name__ == "__main__":
    main()
