"""Videos: pictures to an mp4 file through OpenCV or to a GIF through Pillow, and whole episodes of Fetch and of tasks
that draw themselves. No screen and no OpenGL needed."""

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
from PIL import Image

from infogoal_jax import checks, files
from infogoal_jax.envs.environment import Environment
from infogoal_jax.envs.fetch.environment import Fetch
from infogoal_jax.envs.fetch.scene import draw_fetch
from infogoal_jax.errors import UserError, require
from infogoal_jax.report.runs import evaluated_masks
from infogoal_jax.runs.disk import check_out, disk_error
from infogoal_jax.stopping import temporary
from infogoal_jax.train.rollout import Policy

LAST_PICTURE = 25
"""The last picture of an episode stays for this many frames: a second."""
ENDINGS = (".mp4", ".gif")
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
        """Write the file."""
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


def can_draw(env: Any) -> bool:
    """Whether states of a task can be drawn, and its agent acts in it as it is."""
    draws = isinstance(env, Fetch) or getattr(type(env), "draw", Environment.draw) is not Environment.draw
    return env is env.unwrapped and draws


def painter(env: Any, height: int) -> tuple[Callable[[Any], np.ndarray], int]:
    """What makes a picture uint8 [height, W, 3] of a state, and pictures a second. It raises `UserError` for a picture
    of the task's own that is no uint8 [H, W, 3]."""
    if isinstance(env, Fetch):
        return lambda state: draw_fetch(env, state, (height, height * 4 // 3)), 25
    draw = jax.jit(env.draw)

    def scaled(state: Any) -> np.ndarray:
        (frame,) = of_one_size([draw(state)])
        width = max(round(frame.shape[1] * height / frame.shape[0]), 1)
        return cv2.resize(frame, (width, height), interpolation=cv2.INTER_NEAREST)

    return scaled, 10


def drawn_video(env: Any, policy: Policy, path: str | Path, episodes: int, seed: int, height: int) -> list[bool]:
    """Play episodes of a policy on the task's test goals, or on its training goals where there are none, and write
    pictures of this height, as `painter` makes them. Returns whether each episode ends at its goal."""
    policy, reached = jax.jit(policy), []
    masks = evaluated_masks(env.goals)
    goals = env.goals.evaluated[masks.get("test", masks["train"])]
    step, observe = jax.jit(env.step), jax.jit(env.observe)
    picture, fps = painter(env, height)

    def frames() -> Iterator[np.ndarray]:
        for episode in range(episodes):
            key, goal_key, start_key = jax.random.split(jax.random.fold_in(jax.random.key(seed), episode), 3)
            goal = jax.random.choice(goal_key, goals)
            state = env.reset_to(start_key, goal)
            yield picture(state)
            for number in range(env.episode_length):
                one = jax.tree.map(lambda leaf: leaf[None], observe(state))
                action = policy(one, goal[None], jax.random.fold_in(key, number))[0]
                state = step(state, action)
                yield picture(state)
                if state.terminated | state.truncated:
                    break
            reached.append(bool(env.reached(env.achieved(state), goal)))
            for _ in range(fps):
                yield picture(state)

    write_video(path, frames(), fps)
    return reached
