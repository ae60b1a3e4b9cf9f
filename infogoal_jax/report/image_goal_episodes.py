"""Episodes of a trained policy on image goals, clean or corrupted, as what can be drawn: states of a robot, or frames;
and the video of them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.envs.fetch.image_goals import ImageGoals
from infogoal_jax.envs.fetch.scene import draw_fetch
from infogoal_jax.errors import UserError, require
from infogoal_jax.report.canvas import Subject
from infogoal_jax.report.video import LAST_PICTURE, write_video
from infogoal_jax.train.evaluation import draw_starts, run_side_by_side
from infogoal_jax.train.hierarchy import SubgoalState
from infogoal_jax.train.rollout import Episodes, Policy
from infogoal_jax.train.settings import corrupted_images, corrupted_view, has_image_goals

PICTURES_A_FRAME = 8
"""How often each frame of a walk is shown: about three steps a second."""


@flax.struct.dataclass
class Watched:
    """A simulated environment whose observation is the robot's whole state, so that a rollout keeps it."""

    env: Any

    @property
    def episode_length(self) -> int:
        """Steps after which an episode is truncated."""
        return self.env.episode_length

    def step(self, state, action):
        """One step of the environment."""
        return self.env.step(state, action)

    def observe(self, state):
        """The robot's state, `FetchState`."""
        return (state.inner if isinstance(state, SubgoalState) else state).robot

    def policy(self, policy: Policy) -> Policy:
        """The policy on these observations."""
        return lambda robot, goal, key: policy(robot.observation, goal, key)


def is_fetch(env: Any) -> bool:
    """Whether a robot can be drawn."""
    return isinstance(env.unwrapped, ImageGoals)


def seen_images(env: Any, goals: np.ndarray, weight: float, seed: int) -> np.ndarray:
    """The corrupted images uint8 [M, H, W, 3] of these goals [M] that the policy of `policy_episodes` looks at."""
    return np.asarray(corrupted_images(env, jnp.asarray(goals, jnp.int32), 1, weight, seed))[:, 0]


def policy_episodes(subject: Subject, which: np.ndarray, weights: Sequence[float], seed: int) -> list[Episodes]:
    """For each weight of the backgrounds (0: clean images) an episode to each of the goals `which` [E], all in one
    rollout.

    Their observations are states of the robot [E, T + 1], or the observations of a task that is a walk among frames.
    Starts, noise and backgrounds follow from the seed and are the same for every weight.
    """

    @jax.jit
    def run(params, env):
        goals, policy = jnp.asarray(which, jnp.int32), subject.train.policy(params, subject.run.config.hyper, env)
        views = [corrupted_view(subject.train.parts, params, env, goals, 1, weight, seed) for weight in weights]
        starts, key = draw_starts(env, goals, 1, seed), jax.random.key(seed + 1)
        watched = Watched(env) if is_fetch(env) else env
        acting = watched.policy(policy) if is_fetch(env) else policy
        found = run_side_by_side(watched, acting, views, starts, key)
        return [jax.tree.map(lambda leaf, view=view: leaf[view, :, 0], found) for view in range(len(views))]

    return jax.device_get(run(subject.params, subject.train.env))


def policy_video(
    subject: Subject,
    path: str | Path,
    episodes: int = 1,
    seed: int = 0,
    corruption: float = 0.0,
    size: tuple[int, int] = (480, 640),
) -> list[bool]:
    """Write a video of the trained policy on test goals drawn from the seed, each goal's image in the corner; whether
    each goal was reached.

    corruption: weight of the backgrounds of the images, 0: clean. Raises `UserError` for a run without parameters, or
    of a task without image goals.
    """
    env = subject.train.env
    require(episodes > 0, "episodes", episodes, "give at least 1")
    require(seed >= 0, "seed", seed, "give 0 or more")
    require(0 <= corruption <= 1, "corruption", corruption, "give a weight from 0 to 1, for example 0.4")
    if not has_image_goals(env):
        raise UserError(
            f"run = {str(subject.run.folder)!r}: is of {subject.run.config.task}; videos are of tasks with image goals"
        )
    if subject.params is None:
        raise UserError(
            f"run = {str(subject.run.folder)!r}: holds no parameters yet, or every seed diverged; train it first"
        )
    if "test" not in env.goals.groups:
        raise UserError(
            f"run = {str(subject.run.folder)!r}: its goal images have no test goals to show; give others with "
            "--env.goal-images"
        )
    which = np.resize(
        np.random.default_rng(seed).permutation(np.flatnonzero(np.asarray(env.goals.test_mask))), episodes
    )
    images, outcomes = seen_images(env, which, corruption, seed), []

    def frames():
        (found,) = policy_episodes(subject, which, [corruption], seed)
        outcomes.extend(found.success.tolist())
        for episode, (steps, image) in enumerate(zip(found.steps, images, strict=True)):
            for step in range(steps + 1):
                observation = jax.tree.map(lambda leaf, place=(episode, step): leaf[place], found.observations)
                picture = with_inset(draw_observation(env, observation, size), image)
                for _ in range(1 if is_fetch(env) else PICTURES_A_FRAME):
                    yield picture
            for _ in range(LAST_PICTURE):
                yield picture

    write_video(path, frames())
    return outcomes


def draw_observation(env: Any, observation: Any, size: tuple[int, int]) -> np.ndarray:
    """A picture uint8 [height, width, 3] of one observation of `policy_episodes`: the scene, or the frame, as large as
    it fits, on the left."""
    if is_fetch(env):
        return draw_fetch(env.unwrapped.robot, observation, size)
    frame = np.asarray(env.render(observation))
    scale = min(size[0] / frame.shape[0], size[1] / frame.shape[1])
    frame = cv2.resize(
        frame, (round(scale * frame.shape[1]), round(scale * frame.shape[0])), interpolation=cv2.INTER_CUBIC
    )
    picture = np.full((*size, 3), 40, np.uint8)
    picture[: frame.shape[0], : frame.shape[1]] = frame
    return picture


def with_inset(picture: np.ndarray, image: np.ndarray) -> np.ndarray:
    """The picture with the goal's image in its upper right corner, in a white frame."""
    side, gap = max(32, round(0.3 * picture.shape[0])), max(2, picture.shape[0] // 60)
    inset = cv2.resize(image, (side, side), interpolation=cv2.INTER_CUBIC)
    picture = picture.copy()
    picture[gap : side + 3 * gap, -side - 3 * gap : -gap] = 255
    picture[2 * gap : side + 2 * gap, -side - 2 * gap : -2 * gap] = inset
    return picture
