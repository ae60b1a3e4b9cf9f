"""What a policy that was trained in our Fetch tasks reaches in the reference, Gymnasium-Robotics v4 on C MuJoCo 3.3.7,
beside what it reaches in ours: the same goals, and the same places of the object.

The reference needs an environment of its own (record_fetch_reference.py), whose Python is named here:

    infogoal export RUN --out policy.npz                       # a run of fetch_push_positions, for example
    python -m benchmarks.fidelity.fetch_transfer policy.npz --reference scratch/bin/python --episodes 500

An episode has the reference's 50 steps and goes on at the goal. `reached` are the episodes that were at their goal
after some step, `at_end` those that are after the last one. Intervals have 95 %: Wilson's of a share, Student's t of
the difference, which is known better because episodes are paired.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from infogoal_jax.envs.fetch.tasks import TASKS
from infogoal_jax.policy_file import ExportedPolicy

ROOT = Path(__file__).parents[2]
SUFFIX = "_positions"
EPISODE_STEPS = 50
NORMAL = 1.959964


def play_reference(policy: ExportedPolicy, task: str, episodes: int, seed: int) -> dict[str, np.ndarray]:
    """Episodes of the policy in the reference: first observation [E, D], goal [E, 3] and whether it was at the goal
    after each step, bool [E, T]."""
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make(TASKS[task].reference, max_episode_steps=EPISODE_STEPS)
    first, goals, at_goal = [], [], np.zeros((episodes, EPISODE_STEPS), bool)
    for episode in range(episodes):
        seen, _ = env.reset(seed=seed + episode)
        first.append(seen["observation"])
        goals.append(seen["desired_goal"])
        target = None
        for step in range(EPISODE_STEPS):
            action, target = policy.drive(seen["observation"], seen["desired_goal"], step, target)
            seen, _, _, _, info = env.step(action)
            at_goal[episode, step] = info["is_success"]
    return {"observation": np.array(first), "goal": np.array(goals), "at_goal": at_goal}


def play_ours(
    policy: ExportedPolicy, task: str, first: np.ndarray, goals: np.ndarray, faithful: bool
) -> dict[str, np.ndarray]:
    """Episodes of the policy in our task for the same goals and places of the object: at the goal after each step, bool
    [E, T], and whether it diverged, bool [E]."""
    import jax

    from infogoal_jax.envs.fetch.environment import make
    from infogoal_jax.envs.fetch.tasks import FetchConfig

    env = make(task, FetchConfig(faithful=faithful, ends_at_goal=False, episode_length=EPISODE_STEPS))

    def begin(first, goal):
        motion = env.physics.start()
        if env.task.object_height is not None:
            # The reference's puck lies 6.5 mm deep in the table: ours stands at its own height.
            motion = env.physics.place_object(motion, first[3:5] if env.task.puck else first[3:6])
        return env.begin(motion, goal)

    def advance(state, action):
        state = env.step(state, action)
        return state, env.reached(env.achieved(state), state.desired_goal)

    states = jax.jit(jax.vmap(begin))(first.astype(np.float32), goals.astype(np.float32))
    step = jax.jit(jax.vmap(advance))
    at_goal, diverged = [], np.zeros(len(goals), bool)
    targets = [None] * len(goals)
    for number in range(EPISODE_STEPS):
        seen = np.asarray(states.observation)
        driven = [policy.drive(*one, number, target) for *one, target in zip(seen, goals, targets, strict=True)]
        targets = [target for _, target in driven]
        states, near = step(states, np.stack([action for action, _ in driven]).astype(np.float32))
        at_goal.append(np.asarray(near))
        diverged |= np.asarray(states.diverged)
    return {"at_goal": np.stack(at_goal, 1), "diverged": diverged}


def share(successes: np.ndarray) -> dict[str, float]:
    """The share of successes [E] with Wilson's 95 % interval."""
    count, mean, square = len(successes), float(successes.mean()), NORMAL**2
    centre = (mean + square / (2 * count)) / (1 + square / count)
    half = NORMAL / (1 + square / count) * np.sqrt(mean * (1 - mean) / count + square / (4 * count**2))
    return {"mean": mean, "low": max(0.0, centre - float(half)), "high": min(1.0, centre + float(half))}


def in_reference(python: str, path: Path, episodes: int, seed: int) -> dict[str, np.ndarray]:
    """What `play_reference` gives in the environment of this Python."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "reference.npz"
        words = [str(path.absolute()), "--episodes", str(episodes), "--seed", str(seed), "--record", str(out)]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        subprocess.run([python, str(Path(__file__).absolute()), *words], check=True, env=environment)
        with np.load(out) as found:
            return dict(found)


def main() -> None:
    """Play the policy in both, and print a table and a line of json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", type=Path, help="file of `infogoal export` of a run of fetch_*_positions")
    parser.add_argument("--reference", default=sys.executable, help="Python that has gymnasium-robotics")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="of the reference's first episode")
    parser.add_argument("--faithful", action="store_true", help="simulate ours as the reference does")
    parser.add_argument("--out", type=Path, help="file for the numbers, json")
    parser.add_argument("--record", type=Path, help="play in the reference alone and write the episodes here, npz")
    arguments = parser.parse_args()
    policy = ExportedPolicy(arguments.policy)
    trained = policy.about["task"]
    task = trained.removesuffix(SUFFIX)
    if task not in TASKS or "goal_low" not in policy.about:
        parser.error(f"{arguments.policy}: is a policy of {trained}; give one of a Fetch task with positions as goals")
    if arguments.episodes < 2:
        parser.error("--episodes: give 2 or more")
    if arguments.record is not None:
        np.savez(arguments.record, **play_reference(policy, task, arguments.episodes, arguments.seed))
        return
    from infogoal_jax.report.statistics import describe_machine, paired_difference

    reference = in_reference(arguments.reference, arguments.policy, arguments.episodes, arguments.seed)
    ours = play_ours(policy, task, reference["observation"], reference["goal"], arguments.faithful)
    found = {"task": trained, "method": policy.about["method"], "episodes": arguments.episodes, "seed": arguments.seed}
    found |= {"faithful": arguments.faithful, "diverged": int(ours["diverged"].sum()), "machine": describe_machine()}
    print(f"{trained}, {policy.about['method']}: {arguments.episodes} episodes with the same goals")
    for name, count in (("reached", lambda at_goal: at_goal.any(1)), ("at_end", lambda at_goal: at_goal[:, -1])):
        here, there = count(ours["at_goal"]), count(reference["at_goal"])
        difference = paired_difference(here.astype(float), there.astype(float))
        found[name] = {"ours": share(here), "reference": share(there)}
        found[name] |= {"difference": float(difference.mean), "half_width": float(difference.half_width)}
        shown = (f"{each['mean']:.3f} [{each['low']:.3f}, {each['high']:.3f}]" for each in (share(here), share(there)))
        print(f"{name:8} ours {next(shown)}  reference {next(shown)}  difference {difference.show(3)}")
    print(json.dumps(found))
    if arguments.out is not None:
        arguments.out.write_text(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
