"""A goal environment of Gymnasium made by hand: a mass that two motors push in a plane, on C MuJoCo."""

import gymnasium
import mujoco
import numpy as np
from gymnasium import spaces

MASS = """<mujoco><option timestep="0.02"/><worldbody><body name="mass">
<joint name="x" type="slide" axis="1 0 0" damping="1"/><joint name="y" type="slide" axis="0 1 0" damping="1"/>
<geom size="0.05"/><site name="tip"/></body></worldbody>
<actuator><motor joint="x"/><motor joint="y"/></actuator></mujoco>"""


class GoalEnv(gymnasium.Env):
    """A goal environment with goals [2] and a threshold; where it is and how it moves is left open."""

    distance_threshold = 0.3

    def __init__(self, low=(-1.0, -1.0), high=(1.0, 1.0)):
        parts = {"observation": 4, "achieved_goal": 2, "desired_goal": 2}
        boxes = {name: spaces.Box(-np.inf, np.inf, (size,), np.float64) for name, size in parts.items()}
        self.observation_space = spaces.Dict(boxes)
        self.action_space = spaces.Box(np.array(low, np.float32), np.array(high, np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.goal = self.np_random.uniform(-1, 1, 2)
        self.begin()
        return self.seen(), {}

    def step(self, action):
        self.move(action)
        seen = self.seen()
        success = np.linalg.norm(seen["achieved_goal"] - self.goal) < self.distance_threshold
        info = {"is_success": bool(success)}
        lost = np.abs(seen["achieved_goal"]).max() > 2
        return seen, float(success) - 1, bool(lost), False, info

    def compute_reward(self, achieved, desired, info):
        return -(np.linalg.norm(achieved - desired, axis=-1) > self.distance_threshold).astype(np.float32)


class Mass(GoalEnv):
    """A mass that motors push. What it sees is the place of the last substep, as in Gymnasium-Robotics, and its motors
    follow where that was."""

    def __init__(self, **given):
        super().__init__(**given)
        self.model = mujoco.MjModel.from_xml_string(MASS)
        self.data = mujoco.MjData(self.model)

    def begin(self):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.np_random.uniform(-0.1, 0.1, 2)
        mujoco.mj_forward(self.model, self.data)

    def move(self, action):
        self.data.ctrl[:] = 5 * action - self.data.site_xpos[0, :2]
        mujoco.mj_step(self.model, self.data, nstep=5)

    def seen(self):
        place = self.data.site_xpos[0, :2].copy()
        observation = np.concatenate([place, self.data.qvel])
        return {"observation": observation, "achieved_goal": place, "desired_goal": self.goal.copy()}
