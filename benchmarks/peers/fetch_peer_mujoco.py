"""Speed of the reference Fetch models on C MuJoCo: random actions in several processes, to set beside our own on an
accelerator.

    python benchmarks/peers/fetch_peer_mujoco.py --assets .../gymnasium_robotics/envs/assets/fetch [--tasks fetch_reach]
    [--processes 2]

Gymnasium-Robotics' classes fail on the MuJoCo that this project needs, its model files load: unpack its wheel anywhere
and give the path. A control step does what the reference's does (mocap body set, 20 substeps, fingers held shut in all
but PickAndPlace, observation, reward) without its look-ups by name, so the rate is the peer's at its best. Episodes
last 50 steps and resets are within the time measured.
"""

import argparse
import multiprocessing
import os
import time
from pathlib import Path

import mujoco
import numpy as np

SUBSTEPS, EPISODE_STEPS = 20, 50
SETTLING_STEPS = 200
SUCCESS_DISTANCE = 0.05  # metres
STEP_METRES = 0.05  # the largest displacement that an action asks for
GRIPPER_ROTATION = np.array([1.0, 0.0, 1.0, 0.0])
EXTRA_HEIGHT = {"fetch_reach": 0.2, "fetch_push": 0.0, "fetch_pick_and_place": 0.2, "fetch_slide": -0.02}
BASE_X = {"fetch_reach": 0.4049, "fetch_push": 0.405, "fetch_pick_and_place": 0.405, "fetch_slide": 0.05}
OBJECT_START = {
    "fetch_push": (1.25, 0.53, 0.4),
    "fetch_pick_and_place": (1.25, 0.53, 0.4),
    "fetch_slide": (1.7, 1.1, 0.41),
}
OBJECT_RANGE = {"fetch_push": 0.15, "fetch_pick_and_place": 0.15, "fetch_slide": 0.1}


class Peer:
    """One reference environment: `reset(generator)` and `step(action [4])` return an observation [10] or [25] (step:
    and a reward)."""

    def __init__(self, assets: Path, task: str):
        self.task, self.has_object = task, task in OBJECT_START
        self.fingers_move = task == "fetch_pick_and_place"
        self.model = mujoco.MjModel.from_xml_path(str(assets / f"{task.removeprefix('fetch_')}.xml"))
        self.data = mujoco.MjData(self.model)
        self.gripper = self.model.body("robot0:gripper_link").id
        self.grip = self.model.site("robot0:grip").id
        self.fingers = [self.model.joint(f"robot0:{side}_gripper_finger_joint") for side in "rl"]
        self.finger_position = [joint.qposadr[0] for joint in self.fingers]
        self.finger_velocity = [joint.dofadr[0] for joint in self.fingers]
        self.object = self.model.site("object0").id if self.has_object else None
        self.jacobian, self.rotation_jacobian = np.zeros((2, 3, self.model.nv))
        self.settle()

    def settle(self) -> None:
        """Moves the gripper to where episodes start, keeps that state."""
        model, data = self.model, self.data
        model.eq_data[:, :7] = (0, 0, 0, 0, 0, 0, 1)
        for joint, position in (("slide0", BASE_X[self.task]), ("slide1", 0.48), ("slide2", 0.0)):
            data.joint(f"robot0:{joint}").qpos = position
        if self.has_object:
            data.joint("object0:joint").qpos = (*OBJECT_START[self.task], 1, 0, 0, 0)
        mujoco.mj_forward(model, data)
        data.mocap_pos[0] = data.site_xpos[self.grip] + (-0.498, 0.005, -0.431 + EXTRA_HEIGHT[self.task])
        data.mocap_quat[0] = GRIPPER_ROTATION
        mujoco.mj_step(model, data, nstep=SETTLING_STEPS)
        self.start = data.qpos.copy(), data.qvel.copy()
        self.start_grip = data.site_xpos[self.grip].copy()
        self.goal = self.start_grip

    def reset(self, generator: np.random.Generator) -> np.ndarray:
        """Start state, object and goal near the gripper (the goals of Push and Slide lie elsewhere in the reference: no
        matter for speed)."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = self.start
        if self.has_object:
            offset = np.zeros(2)
            while np.linalg.norm(offset) < 0.1:
                offset = generator.uniform(-1, 1, size=2) * OBJECT_RANGE[self.task]
            self.data.joint("object0:joint").qpos[:2] = self.start_grip[:2] + offset
        self.goal = self.start_grip + generator.uniform(-0.15, 0.15, size=3)
        mujoco.mj_forward(self.model, self.data)
        return self.observation()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float]:
        """A control step of 20 x 2 ms."""
        model, data = self.model, self.data
        action = np.clip(action, -1.0, 1.0)
        if self.fingers_move:  # actuators: left finger, right finger
            data.ctrl[:] = data.qpos[self.finger_position[::-1]] + action[3]
        data.mocap_pos[0] = data.xpos[self.gripper] + STEP_METRES * action[:3]
        data.mocap_quat[0] = data.xquat[self.gripper] + GRIPPER_ROTATION
        mujoco.mj_step(model, data, nstep=SUBSTEPS)
        if not self.fingers_move:
            data.qpos[self.finger_position] = 0.0
            mujoco.mj_forward(model, data)
        achieved = data.site_xpos[self.object if self.has_object else self.grip]
        return self.observation(), -float(np.linalg.norm(achieved - self.goal) > SUCCESS_DISTANCE)

    def site_velocity(self, site: int) -> np.ndarray:
        """Linear and angular velocity [6] of a site, per control step."""
        mujoco.mj_jacSite(self.model, self.data, self.jacobian, self.rotation_jacobian, site)
        velocity = np.concatenate([self.jacobian @ self.data.qvel, self.rotation_jacobian @ self.data.qvel])
        return velocity * SUBSTEPS * self.model.opt.timestep

    def observation(self) -> np.ndarray:
        """[10] of the gripper, with an object [25], in the reference's order."""
        data = self.data
        grip, grip_velocity = data.site_xpos[self.grip], self.site_velocity(self.grip)[:3]
        finger_velocity = data.qvel[self.finger_velocity] * SUBSTEPS * self.model.opt.timestep
        position, of_object = data.qpos[self.finger_position], []
        if self.has_object:
            place, velocity = data.site_xpos[self.object], self.site_velocity(self.object)
            of_object = [euler(data.site_xmat[self.object].reshape(3, 3)), velocity[:3] - grip_velocity, velocity[3:]]
            position = np.concatenate([place, place - grip, position])
        return np.concatenate([grip, position, *of_object, grip_velocity, finger_velocity])


def euler(rotation: np.ndarray) -> np.ndarray:
    """Angles [3] (radians, x-y-z) of a rotation matrix."""
    cosine = np.hypot(rotation[2, 2], rotation[1, 2])
    pitch = -np.arctan2(-rotation[0, 2], cosine)
    return np.array([-np.arctan2(rotation[1, 2], rotation[2, 2]), pitch, -np.arctan2(rotation[0, 1], rotation[0, 0])])


def rate(assets: Path, task: str, seconds: float, seed: int, ready) -> float:
    """Control steps a second of one process, from the moment when all are ready."""
    peer, generator = Peer(assets, task), np.random.default_rng(seed)
    ready.wait()
    started, steps = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        peer.reset(generator)
        for _ in range(EPISODE_STEPS):
            peer.step(generator.uniform(-1.0, 1.0, size=4))
        steps += EPISODE_STEPS
    return steps / (time.perf_counter() - started)


def measure(assets: Path | str, task: str, seconds: float = 10.0, processes: int = 2) -> float:
    """Control steps a second of `processes` processes together, each stepping its own environment for `seconds`."""
    context = multiprocessing.get_context("spawn")
    with context.Manager() as manager, context.Pool(processes) as pool:
        ready = manager.Barrier(processes)
        return sum(
            pool.starmap(rate, [(Path(assets), task, seconds, seed, ready) for seed in range(processes)], chunksize=1)
        )


def main():
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--assets", type=Path, required=True, help="folder of gymnasium_robotics/envs/assets/fetch")
    parser.add_argument("--tasks", nargs="+", choices=EXTRA_HEIGHT, default=list(EXTRA_HEIGHT))
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    print(f"C MuJoCo {mujoco.__version__}, {arguments.processes} processes on {os.cpu_count()} CPU cores\n")
    print("| task | env steps/s | physics steps/s |")
    print("|---|---|---|")
    for task in arguments.tasks:
        steps = measure(arguments.assets, task, arguments.seconds, arguments.processes)
        print(f"| {task} | {steps:,.0f} | {steps * SUBSTEPS:,.0f} |", flush=True)


if __name__ == "__main__":
    main()
