"""Records the reference Fetch environments, Gymnasium-Robotics v4 on C MuJoCo 3.3.7: resets and whole episodes, to
compare ours with.

The reference's classes fail on the MuJoCo that this project needs, so they run in a scratch environment (about 400 MB):

    python3.11 -m venv scratch && scratch/bin/pip install mujoco==3.3.7 gymnasium-robotics==1.4.2
    scratch/bin/python benchmarks/fidelity/record_fetch_reference.py --resets tests/fixtures/fetch_resets.npz
    scratch/bin/python benchmarks/fidelity/record_fetch_reference.py --episodes fetch_episodes.npz --number 12

Arrays of a task, float32 in metres, radians and (velocities) metres or radians per control step: `<task>/observation
[E, T + 1, D]`, `achieved_goal [E, T + 1, 3]`, `desired_goal [E, 1, 3]`, `action [E, T, 4]`, `reward [E, T]`; resets
have no time axis and no actions. Episode e plays random actions (e % 3 == 0), random actions held for five steps (1) or
a script that does what the task asks for (2).
"""

import argparse

import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np

ENV_IDS = {
    "fetch_reach": "FetchReach-v4",
    "fetch_push": "FetchPush-v4",
    "fetch_pick_and_place": "FetchPickAndPlace-v4",
    "fetch_slide": "FetchSlide-v4",
}
KINDS = ("random", "held", "scripted")
EPISODE_STEPS = 50
HELD_STEPS = 5
HOVER_STEPS, DESCENT_STEPS, GRASP_STEPS = 12, 8, 8
STRIKE_STEPS = 9
GAIN = 10.0  # action per metre of error: closes a third of the gap in a control step
FINGERS_OPEN, FINGERS_CLOSED = 1.0, -1.0
PUCK_FRICTION, GRAVITY = 0.1, 9.81
FULL_SPEED = 0.78  # m/s of the gripper under the largest action


def towards(gripper: np.ndarray, target: np.ndarray, fingers: float, gain: float = GAIN) -> np.ndarray:
    """Action [4] that moves `gripper` [3] to `target` [3] (metres)."""
    return np.append(gain * (target - gripper), fingers)


def scripted_reach(gripper, observation, goal, step):
    """Straight to the goal."""
    return towards(gripper, goal, 0.0)


def scripted_push(gripper, observation, goal, step):
    """Down behind the object, then slowly along x, off the table's edge if the episode lasts."""
    if step < HOVER_STEPS + DESCENT_STEPS:
        height = 0.1 if step < HOVER_STEPS else 0.0
        return towards(gripper, observation[3:6] + np.array([-0.08, 0.0, height]), FINGERS_CLOSED)
    return np.array([0.4, 0.0, 0.0, FINGERS_CLOSED])


def scripted_pick_and_place(gripper, observation, goal, step):
    """Down over the object, grasp it, carry it to the goal."""
    position = observation[3:6]
    if step < HOVER_STEPS + DESCENT_STEPS:
        height = 0.08 if step < HOVER_STEPS else 0.0
        return towards(gripper, position + np.array([0.0, 0.0, height]), FINGERS_OPEN)
    if step < HOVER_STEPS + DESCENT_STEPS + GRASP_STEPS:
        return np.array([0.0, 0.0, 0.0, FINGERS_CLOSED])
    return towards(position, goal, FINGERS_CLOSED, gain=6.0)


def scripted_slide(gripper, observation, goal, step):
    """Down behind the puck on the line to the goal, then one strike of the speed that friction eats up on the way
    there."""
    to_goal = goal[:2] - observation[3:5]
    distance = np.linalg.norm(to_goal)
    direction = np.append(to_goal / distance, 0.0)
    if step < HOVER_STEPS + DESCENT_STEPS:
        height = 0.1 if step < HOVER_STEPS else 0.0
        return towards(gripper, observation[3:6] - 0.08 * direction + np.array([0.0, 0.0, height]), FINGERS_CLOSED)
    if step < HOVER_STEPS + DESCENT_STEPS + STRIKE_STEPS:
        speed = np.sqrt(2 * PUCK_FRICTION * GRAVITY * distance)
        return np.append(min(1.0, speed / FULL_SPEED) * direction, FINGERS_CLOSED)
    return np.zeros(4)


SCRIPTS = {
    "fetch_reach": scripted_reach,
    "fetch_push": scripted_push,
    "fetch_pick_and_place": scripted_pick_and_place,
    "fetch_slide": scripted_slide,
}


def record_episode(env: gymnasium.Env, task: str, kind: str, seed: int) -> dict[str, np.ndarray]:
    """One episode of `EPISODE_STEPS` control steps, its arrays without the leading axis of episodes."""
    generator = np.random.default_rng((seed, 1))  # not the stream that the reset draws from
    state, _ = env.reset(seed=seed)
    states, actions, rewards = [state], [], []
    for step in range(EPISODE_STEPS):
        if kind == "scripted":
            action = SCRIPTS[task](state["observation"][:3], state["observation"], state["desired_goal"], step)
        elif kind == "random" or step % HELD_STEPS == 0:
            action = generator.uniform(-1.0, 1.0, size=4)
        action = np.clip(action, -1.0, 1.0).astype(np.float32)
        state, reward, _, _, _ = env.step(action)
        states.append(state)
        actions.append(action)
        rewards.append(reward)
    return {
        "observation": np.stack([state["observation"] for state in states]),
        "achieved_goal": np.stack([state["achieved_goal"] for state in states]),
        "desired_goal": states[0]["desired_goal"][None],
        "action": np.stack(actions),
        "reward": np.array(rewards),
    }


def record_episodes(env: gymnasium.Env, task: str, number: int, first_seed: int) -> dict[str, np.ndarray]:
    """`number` episodes, kinds in turn; every array has a leading axis of episodes."""
    episodes = [
        record_episode(env, task, KINDS[episode % len(KINDS)], first_seed + episode) for episode in range(number)
    ]
    return {name: np.stack([episode[name] for episode in episodes]) for name in episodes[0]}


def record_resets(env: gymnasium.Env, number: int, first_seed: int) -> dict[str, np.ndarray]:
    """First states of `number` resets: `observation` [number, D], `achieved_goal` and `desired_goal` [number, 3]."""
    states = [env.reset(seed=first_seed + reset)[0] for reset in range(number)]
    return {
        name: np.stack([state[name] for state in states]) for name in ("observation", "achieved_goal", "desired_goal")
    }


def save(file: str, recordings: dict[str, dict[str, np.ndarray]]) -> None:
    """Write `{task: {name: array}}` as float32 arrays `<task>/<name>`, and where they come from as `source`."""
    arrays = {
        f"{task}/{name}": array.astype(np.float32)
        for task, recording in recordings.items()
        for name, array in recording.items()
    }
    versions = (
        f"mujoco {mujoco.__version__}, gymnasium-robotics {gymnasium_robotics.__version__}, gymnasium "
        f"{gymnasium.__version__}"
    )
    np.savez_compressed(file, **arrays, source=f"{', '.join(ENV_IDS[task] for task in recordings)}; {versions}")


def main():
    """Record what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resets", metavar="FILE", help="write resets to FILE")
    parser.add_argument("--episodes", metavar="FILE", help="write episodes to FILE")
    parser.add_argument("--tasks", nargs="+", choices=ENV_IDS, default=list(ENV_IDS))
    parser.add_argument("--number", type=int, help="resets (1000 unless told) or episodes (12 unless told) a task")
    parser.add_argument("--seed", type=int, default=0, help="of the first reset or episode; each further one adds 1")
    arguments = parser.parse_args()
    if not (arguments.resets or arguments.episodes):
        parser.error("nothing to record: give --resets FILE or --episodes FILE")

    gymnasium.register_envs(gymnasium_robotics)
    envs = {task: gymnasium.make(ENV_IDS[task]) for task in arguments.tasks}
    if arguments.resets:
        save(
            arguments.resets,
            {task: record_resets(env, arguments.number or 1000, arguments.seed) for task, env in envs.items()},
        )
    if arguments.episodes:
        save(
            arguments.episodes,
            {task: record_episodes(env, task, arguments.number or 12, arguments.seed) for task, env in envs.items()},
        )


if __name__ == "__main__":
    main()
