"""Videos: pictures to an mp4 file through OpenCV or to a GIF through Pillow, and whole episodes of Fetch and of tasks
that draw themselves. No screen and no OpenGL needed."""

import os
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from infogoal_jax import checks, files
from infogoal_jax.envs.adapters import AdaptedTask
from infogoal_jax.envs.environment import draws_itself, failed_in, has_image_goals
from infogoal_jax.envs.fetch.environment import Fetch
from infogoal_jax.envs.fetch.scene import draw_fetch
from infogoal_jax.envs.target_states import SubgoalState
from infogoal_jax.errors import UserError, require
from infogoal_jax.report.canvas import Subject
from infogoal_jax.report.robots import RobotPainter
from infogoal_jax.report.runs import evaluated_masks
from infogoal_jax.runner.compilation import jit
from infogoal_jax.runs.disk import check_out, disk_error
from infogoal_jax.stopping import temporary
from infogoal_jax.train.contracts import check_simulated
from infogoal_jax.train.evaluation import corrupted_images
from infogoal_jax.train.rollout import Policy

SHORTEST = {".mp4": 2, ".gif": 1}
"""Pixels of a side, by the ending of the file."""
ENDINGS = tuple(SHORTEST)
HEIGHTS = 64, 1620
"""Of a picture of Fetch, whose width is 4/3 of it."""
COLOURS = 128
"""Of a GIF: one palette for all frames, chosen by eight of them."""


class GifWriter:
    """Frames to a GIF that repeats: what a browser, a notebook and a README show as it is. Used like OpenCV's
    writer."""

    def __init__(self, path: Path, fps: float):
        self.path, self.duration, self.frames = path, max(20, round(1000 / fps)), []

    def write(self, frame: np.ndarray) -> None:
        """Add a frame (BGR)."""
        self.frames.append(Image.fromarray(np.ascontiguousarray(frame[..., ::-1])))

    def release(self) -> None:
        spread = self.frames[:: -(-len(self.frames) // 8)]
        palette = Image.fromarray(np.concatenate([np.asarray(frame) for frame in spread])).quantize(COLOURS)
        first, *rest = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in self.frames)
        first.save(self.path, save_all=True, append_images=rest, duration=self.duration, loop=0, optimize=True)


def open_writer(path: Path, fps: float, size: tuple[int, int]) -> Any:
    """What takes the frames of a video of this width and height. Raises `UserError` where nothing can be written."""
    if path.suffix == ".gif":
        return GifWriter(path, fps)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), fps, size)
    if not writer.isOpened():
        raise UserError(
            f"{path}: could not be written; choose a folder that you may write to, and an OpenCV that encodes mp4v"
        )
    return writer


LARGEST_RATE = 1000
"""Frames a second, of any video."""


def write_video(path: str | Path, frames: Iterable[np.ndarray], fps: float = 25) -> None:
    """Write frames, uint8 [H, W, 3] (RGB) all of one size, as an mp4 or a GIF. It is written beside its place and
    renamed: the file is whole or not there.

    25 frames a second are a Fetch task's own time. Raises `UserError` where the folder is missing, the ending is
    another, no frames are given, or the disk refuses.
    """
    path = check_path(path)
    fps = checks.number(fps, "fps", 0, LARGEST_RATE)
    require(fps > 0, "fps", fps, "give a number greater than 0")
    several = isinstance(frames, Iterable) and getattr(frames, "ndim", 1) > 0
    require(several, "frames", frames, "give frames, uint8 [H, W, 3]")
    beside = files.beside(path, path.suffix)
    writer, count = None, 0
    with temporary(beside):
        try:
            for frame in of_one_size(frames):
                if writer is None:
                    height, width, _ = frame.shape
                    remedy = f"a {path.suffix} has sides of at least {SHORTEST[path.suffix]}; give larger frames"
                    require(min(height, width) >= SHORTEST[path.suffix], "frames", f"{height} x {width}", remedy)
                    writer = open_writer(beside, fps, (width, height))
                writer.write(frame[..., ::-1])
                count += 1
            require(writer is not None, "frames", "none", "give at least one")
            writer.release()
            if path.suffix != ".gif" and frames_in(beside) != count:  # OpenCV's writer says nothing of a full disk.
                raise UserError(f"{path}: could not be written to its end; free some space, or choose another folder")
            os.replace(beside, path)
        except OSError as error:
            raise disk_error(path, error) from error
        finally:
            if isinstance(writer, cv2.VideoWriter):
                writer.release()


def check_path(path: str | Path, field: str = "path") -> Path:
    """The path. Raises `UserError`, naming the field, if its ending is not that of a video, or its folder is not
    there."""
    path = Path(checks.path(path, field))
    require(path.suffix in ENDINGS, field, str(path), f"give a file that ends in {' or '.join(ENDINGS)}")
    require(path.parent.is_dir(), field, str(path), "its folder is not there; make it first, or give another")
    check_out(path, field)
    return path


def of_one_size(frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """The frames as arrays. Raises `UserError` for one that is not uint8 [H, W, 3], or of another size than the
    first."""
    shape = None
    for number, frame in enumerate(frames):
        frame = np.asarray(checks.array(frame, f"frames[{number}]", "numbers", remedy="give uint8 [H, W, 3]"))
        require(
            frame.dtype == np.uint8
            and frame.ndim == 3
            and frame.shape[2] == 3
            and frame.shape == (shape or frame.shape),
            f"frames[{number}]",
            f"{frame.dtype} {frame.shape}",
            f"give uint8 {shape or ('height', 'width', 3)}, all of one size",
        )
        shape = frame.shape
        yield frame


def frames_in(path: Path) -> int:
    """How many frames a video has; 0 for a file that is none."""
    video = cv2.VideoCapture(str(path))
    count = int(video.get(cv2.CAP_PROP_FRAME_COUNT)) if video.isOpened() else 0
    video.release()
    return count


class Painter(NamedTuple):
    """What makes a picture uint8 [height, W, 3] of a state, and how many steps a second are."""

    draw: Callable[[Any], np.ndarray]
    fps: int


def painter_of(env: Any, height: int) -> Painter | None:
    """The painter of a task: of a Fetch robot, of another library's robot, or of the pictures that the task draws
    itself; None for a task that cannot be drawn. Raises `UserError` for a height that a robot is not drawn in; what it
    makes does for a picture of the task's own that is no uint8 [H, W, 3]."""
    task = env.unwrapped
    robot = getattr(task, "robot", task)

    def inside(state: Any) -> Any:
        """The task's own state, of one that is driven by subgoals."""
        return state.inner if isinstance(state, SubgoalState) else state

    def scene(state: Any) -> np.ndarray:
        state = inside(state)
        return draw_fetch(robot, getattr(state, "robot", state), (height, height * 4 // 3))

    def drawn(state: Any) -> np.ndarray:
        (frame,) = of_one_size([draw(inside(state))])
        width = max(round(frame.shape[1] * height / frame.shape[0]), 1)
        return cv2.resize(frame, (width, height), interpolation=cv2.INTER_NEAREST)

    is_adapted = isinstance(task, AdaptedTask) and task.mujoco_model() is not None
    if isinstance(robot, Fetch) or is_adapted:
        low, high = HEIGHTS
        require(low <= height <= high, "height", height, f"give {low} to {high} pixels")
    if isinstance(robot, Fetch):
        return Painter(scene, 25)
    if is_adapted:
        paint, seconds = RobotPainter(task, (height, height * 4 // 3)), float(getattr(task.env, "dt", 0.05))
        return Painter(lambda state: paint(inside(state)), round(np.clip(1 / seconds, 5, 60)))
    if not draws_itself(task):
        return None
    draw = jax.jit(task.draw)
    return Painter(drawn, 10)


def policy_video(
    subject: Subject, path: str | Path, episodes: int = 1, seed: int = 0, corruption: float = 0.0, height: int = 480
) -> list[bool]:
    """Write a video of the trained policy on test goals drawn from the seed, or on training goals where there are none;
    goals that are images stand in the corner. Returns whether each episode ends at its goal.

    corruption: weight of the backgrounds of the goal images, 0: clean. Raises `UserError` for a run without parameters,
    or of a task that cannot be drawn.
    """
    env, name = subject.train.env, subject.run.name
    check_simulated(env, "run", name)
    require(episodes > 0, "episodes", episodes, "give at least 1")
    require(seed >= 0, "seed", seed, "give 0 or more")
    require(0 <= corruption <= 1, "corruption", corruption, "give a weight from 0 to 1, for example 0.4")
    drawn = "videos are of Fetch, of robots that have a MuJoCo model, and of tasks with a draw(state)"
    undrawn = f"is of {subject.run.config.task}; {drawn}"
    require(painter_of(env, height) is not None, "run", name, undrawn)
    require(subject.params is not None, "run", name, "holds no parameters yet, or every seed diverged; train it first")
    goals = drawn_goals(env, episodes, seed)
    policy, seen, images = subject.train.policy(subject.params, subject.run.config.hyper, env), goals, None
    if has_image_goals(env):
        images = jit(partial(corrupted_images, num_starts=1, weight=corruption, seed=seed))(env, goals)[:, 0]
        seen = jit(subject.train.parts.learner.encode)(subject.params["goal"], images)
    else:
        require(corruption == 0, "corruption", corruption, "goes with image goals; leave it out")
    return drawn_video(env, policy, path, goals, seed, height, seen, images)


def drawn_goals(env: Any, episodes: int, seed: int) -> np.ndarray:
    """So many of the task's test goals [E, *shape], drawn from the seed; of its training goals where there are none."""
    masks = evaluated_masks(env.goals)
    goals = np.asarray(env.goals.evaluated)[masks.get("test", masks["train"])]
    return goals[np.resize(np.random.default_rng(seed).permutation(len(goals)), episodes)]


def drawn_video(
    env: Any,
    policy: Policy,
    path: str | Path,
    goals: np.ndarray,
    seed: int,
    height: int,
    seen: Any = None,
    images: np.ndarray | None = None,
) -> list[bool]:
    """Play an episode of a policy for each of these goals [E, *shape], and write pictures of this height. Returns
    whether each ends at its goal, without a failure.

    seen: what the policy is given of each goal [E, ...]; None: the goals. images: uint8 [E, H, W, C], shown in the
    corner.
    """
    reached, seen = [], goals if seen is None else seen
    policy, step, observe = jax.jit(policy), jax.jit(env.step), jax.jit(env.observe)
    draw, fps = painter_of(env, height)

    def states(start: Any, shown: Any, key: jax.Array) -> Iterator[Any]:
        """Those of an episode, the last one for a second."""
        yield start
        state = start
        for number in range(env.episode_length):
            one = jax.tree.map(lambda leaf: leaf[None], observe(state))
            state = step(state, policy(one, shown, jax.random.fold_in(key, number))[0])
            yield state
            if state.terminated | state.truncated:
                break
        at_goal = env.reached(env.achieved(state), state.desired_goal)
        reached.append(bool(at_goal & ~failed_in(env, state)))
        yield from [state] * fps

    def frames() -> Iterator[np.ndarray]:
        for episode, goal in enumerate(goals):
            key, start_key = jax.random.split(jax.random.fold_in(jax.random.key(seed), episode))
            shown = jax.tree.map(lambda leaf, place=episode: jnp.asarray(leaf[place])[None], seen)
            for state in states(env.reset_to(start_key, jnp.asarray(goal)), shown, key):
                picture = draw(state)
                yield picture if images is None else with_inset(picture, np.asarray(images[episode]))

    write_video(path, frames(), fps)
    return reached


def with_inset(picture: np.ndarray, image: np.ndarray) -> np.ndarray:
    """The picture with the goal's image in its upper right corner, in a white frame; beside what is narrower than 4 by
    3."""
    height, width = picture.shape[:2]
    side, gap = max(32, round(0.3 * height)), max(2, height // 60)
    picture = np.pad(picture, ((0, 0), (0, max(height * 4 // 3 - width, 0)), (0, 0)), constant_values=40)
    picture[gap : side + 3 * gap, -side - 3 * gap : -gap] = 255
    inset = cv2.resize(image, (side, side), interpolation=cv2.INTER_CUBIC)
    picture[2 * gap : side + 2 * gap, -side - 2 * gap : -2 * gap] = inset
    return picture
