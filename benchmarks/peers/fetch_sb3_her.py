"""Stable-Baselines3's SAC with hindsight experience replay on Fetch: success against steps and seconds.

Without --reference the task is ours, through the Gymnasium bridge; with it, it is Gymnasium-Robotics' own, which C
MuJoCo simulates, and our packages of physics are not imported.

Stable-Baselines3 is no dependency of the project; it needs a scratch environment (CPU torch, about 1 GB):

    python3.11 -m venv scratch && scratch/bin/pip install torch --index-url https://download.pytorch.org/whl/cpu
    scratch/bin/pip install -c constraints.txt -e '.[gymnasium]' stable-baselines3
    scratch/bin/python benchmarks/peers/fetch_sb3_her.py --task fetch_reach --steps 6000 --seeds 3 --out FOLDER
    infogoal pretrain fetch_reach --seeds 3 --num-epochs 6 --out OTHER

    scratch/bin/pip install gymnasium-robotics mujoco==3.3.7
    scratch/bin/python benchmarks/peers/fetch_sb3_her.py --reference --task fetch_push --steps 1000000 --every 5000 \\
        --minutes 60 --out FOLDER

FOLDER/numbers.csv has a row for each seed and evaluation, written as it comes. `python -m infogoal_paper.pages sb3_her
--take FOLDER`, and the same of OTHER, which has curve.csv, put them into docs/results/sb3_her and the page.

Hyperparameters of --reference are those of RL Zoo for the task. RL Zoo has them for TQC, which is not in
Stable-Baselines3; here its sizes and rates train SAC.
"""

import argparse
import csv
import time
from pathlib import Path

import gymnasium
import numpy as np
import torch
from stable_baselines3 import SAC, HerReplayBuffer, __version__
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from infogoal_jax.envs.fetch.tasks import TASKS
from infogoal_jax.report.statistics import describe_machine

ZOO_REACH = {
    "learning_rate": 1e-3,
    "buffer_size": 1_000_000,
    "learning_starts": 1000,
    "batch_size": 256,
    "gamma": 0.95,
    "policy_kwargs": {"net_arch": [64, 64]},
}
BRIDGED = ZOO_REACH | {"buffer_size": 100_000, "tau": 0.05}
"""Of tasks of ours: nearly RL Zoo's of FetchReach."""
ZOO_OBJECT = {
    "learning_rate": 1e-3,
    "buffer_size": 1_000_000,
    "batch_size": 2048,
    "gamma": 0.95,
    "tau": 0.05,
    "policy_kwargs": {"net_arch": [512, 512, 512], "n_critics": 2},
}
ZOO = {
    "fetch_reach": ZOO_REACH,
    "fetch_push": ZOO_OBJECT,
    "fetch_pick_and_place": ZOO_OBJECT | {"batch_size": 1024},
    "fetch_slide": ZOO_OBJECT,
}
"""RL Zoo's of hyperparams/tqc.yml. What stands in neither file has Stable-Baselines3's default."""


def make_env(task: str, reference: bool) -> gymnasium.Env:
    """The task of ours, or Gymnasium-Robotics' own."""
    if not reference:
        from infogoal_jax.bridges import gymnasium as bridge

        return bridge.make(task)
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make(TASKS[task].reference)


def learner(task: str, reference: bool, seed: int, device: str) -> SAC:
    """SAC with four relabelled goals for each real one. Observations of our tasks are normalised, as RL Zoo does for
    FetchReach alone: without it nothing is learnt of goals that differ by centimetres only."""
    env = DummyVecEnv([lambda: make_env(task, reference)])
    if not reference or task == "fetch_reach":
        env = VecNormalize(env, norm_reward=reference, gamma=0.95)
    return SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        seed=seed,
        device=device,
        **(ZOO[task] if reference else BRIDGED),
    )


def success_rates(model: SAC, env: gymnasium.Env, episodes: int, first_seed: int) -> tuple[float, float]:
    """Shares of episodes that end at the goal, and that are there at some step, with the policy's mean action."""
    normalized, ends, reached = model.get_vec_normalize_env(), [], []
    for episode in range(episodes):
        seen, _ = env.reset(seed=first_seed + episode)
        at_goal, ended = [], False
        while not ended:
            action, _ = model.predict(normalized.normalize_obs(seen) if normalized else seen, deterministic=True)
            seen, _, terminated, truncated, info = env.step(action)
            at_goal.append(info["is_success"])
            ended = terminated or truncated
        ends.append(at_goal[-1])
        reached.append(max(at_goal))
    return float(np.mean(ends)), float(np.mean(reached))


def curve(words: argparse.Namespace, seed: int, test_env: gymnasium.Env):
    """Train a seed until its steps or minutes are spent; yields a row for each evaluation. Seconds are those of the
    learning: of the CPU, and of the clock. The minutes are the clock's, evaluations included but the last."""
    deadline = time.perf_counter() + 60 * words.minutes
    model = learner(words.task, words.reference, seed, words.device)
    cpu, wall = 0.0, 0.0
    while model.num_timesteps < words.steps and time.perf_counter() < deadline:
        started = time.process_time(), time.perf_counter()
        model.learn(words.every, lambda *_: time.perf_counter() < deadline, reset_num_timesteps=False)
        cpu += time.process_time() - started[0]
        wall += time.perf_counter() - started[1]
        done = model.num_timesteps
        ends, reached = success_rates(model, test_env, words.episodes, 1_000_000)
        print(f"{seed:5d} {done:8d} {cpu:11.1f} {wall:12.1f} {ends:8.2f} {reached:8.2f}", flush=True)
        yield {
            "seed": seed,
            "env_steps": done,
            "cpu_seconds": round(cpu, 1),
            "success_rate": ends,
            "wall_seconds": round(wall, 1),
            "reached_rate": reached,
        }


def main():
    """Train and print a line for each evaluation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=list(TASKS), default="fetch_reach")
    parser.add_argument("--reference", action="store_true", help="Gymnasium-Robotics' task instead of ours")
    parser.add_argument("--steps", type=int, default=10_000, help="environment steps of training")
    parser.add_argument("--every", type=int, default=1000, help="steps between evaluations")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="of a seed, with its evaluations")
    parser.add_argument("--episodes", type=int, default=50, help="episodes of an evaluation")
    parser.add_argument("--seeds", type=int, default=1, help="seeds, one after the other")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--device", default="cpu", help="of torch: cpu, with one thread, or cuda")
    parser.add_argument("--out", type=Path, help="folder to write numbers.csv to")
    words = parser.parse_args()

    torch.set_num_threads(1)
    versions = f"stable-baselines3 {__version__}, torch {torch.__version__.split('+')[0]} on {words.device}"
    if words.device != "cpu":
        versions += f" ({torch.cuda.get_device_name()})"
    if words.reference:
        import mujoco

        versions += f", mujoco {mujoco.__version__}"
    machine = f"{describe_machine()}; {versions}"
    print(f"{words.task}; {machine}", flush=True)
    test_env = make_env(words.task, words.reference)
    test_env.reset(seed=0)
    test_env.step(test_env.action_space.sample())  # Compiles before the clock starts.
    print(" seed    steps CPU seconds wall seconds  success  reached")
    rows = (
        {"task": words.task, "reference": words.reference} | row | {"machine": machine}
        for seed in range(words.first_seed, words.first_seed + words.seeds)
        for row in curve(words, seed, test_env)
    )
    if words.out is None:
        for _ in rows:
            pass
        return
    words.out.mkdir(parents=True, exist_ok=True)
    with open(words.out / "numbers.csv", "w", newline="") as file:
        writer = None
        for row in rows:
            if writer is None:
                writer = csv.DictWriter(file, list(row))
                writer.writeheader()
            writer.writerow(row)
            file.flush()


if __name__ == "__main__":
    main()
