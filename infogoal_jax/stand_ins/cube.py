"""The generated stand-in for the object-manipulation dataset: an arm turns a Rubik's cube about three axes (paper,
section V-A.3, Fig. 5).

The paper's data are not public and it names the arm only as "IRB 1200"; here it is an ABB IRB 1200-7/0.7. Joints 1, 2
and 6 stand at multiples of 15 degrees and the others at 0, which orients the cube by exactly Rz(q1) Ry(q2) Rx(q6).
Different joints may so give one orientation: the 13,824 settings show 6,384 orientations (angles.orientation_classes
tells which are the same).
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from infogoal_jax.data.frames import FrameDataset
from infogoal_jax.stand_ins import cube_render

GENERATOR_VERSION = 1
STEP = 15  # degrees that one move turns a joint
ANGLES = np.arange(-180, 180, STEP)  # degrees, the 24 settings of each joint
MOVED = (0, 1, 5)  # indices of the joints that move
JOINT_NAMES = ("joint 1", "joint 2", "joint 6")
ACTIONS = tuple(f"{joint} {sign}" for joint in JOINT_NAMES for sign in "+-")
# Limits in degrees of the joints that move (ros-industrial/abb, abb_irb1200_support 1.3.1, 7/0.7).
LIMITS = ((-170, 170), (-100, 135), (-360, 360))
# Denavit-Hartenberg rows (standard): offset of theta, d, a, alpha; radians and metres, from the same source's joint
# origins.
QUARTER = np.pi / 2
DENAVIT_HARTENBERG = np.array(
    [
        (0, 0.3991, 0, -QUARTER),
        (-QUARTER, 0, 0.350, 0),
        (0, 0, 0.042, -QUARTER),
        (0, 0.351, 0, QUARTER),
        (0, 0, 0, -QUARTER),
        (np.pi, 0.082, 0, 0),
    ]
)
# The cube's middle at zero joints: behind the flange at x = 0.433 come a stub of 30 mm and half of the cube.
CUBE_AT_ZERO = np.array([0.433 + 0.030 + cube_render.CUBE_EDGE / 2, 0, 0.7911])


def link_frames(joints: np.ndarray) -> np.ndarray:
    """Denavit-Hartenberg frames of the base and the six links: radians [6] to [7, 4, 4]."""
    frames = [np.eye(4)]
    for angle, (offset, along, across, twist) in zip(joints, DENAVIT_HARTENBERG, strict=True):
        cosine, sine = np.cos(angle + offset), np.sin(angle + offset)
        cosine_twist, sine_twist = np.cos(twist), np.sin(twist)
        frames.append(
            frames[-1]
            @ np.array(
                [
                    (cosine, -sine * cosine_twist, sine * sine_twist, across * cosine),
                    (sine, cosine * cosine_twist, -cosine * sine_twist, across * sine),
                    (0, sine_twist, cosine_twist, along),
                    (0, 0, 0, 1),
                ]
            )
        )
    return np.stack(frames)


def link_motions(joints: np.ndarray) -> np.ndarray:
    """How each link moved from where it is at zero joints, in the base's frame: radians [6] to [7, 4, 4]."""
    return link_frames(joints) @ np.linalg.inv(link_frames(np.zeros(6)))


def cube_pose(motions: np.ndarray) -> np.ndarray:
    """Orientation and middle of the cube, [4, 4], for `motions` = link_motions(joints). At zero joints the cube's axes
    are those of the base."""
    at_zero = np.eye(4)
    at_zero[:3, 3] = CUBE_AT_ZERO
    return motions[6] @ at_zero


def all_joints(setting: np.ndarray) -> np.ndarray:
    """Radians of joints 1, 2, 6 [3] to those of all six."""
    joints = np.zeros(6)
    joints[list(MOVED)] = setting
    return joints


def settings(physical_limits: bool) -> np.ndarray:
    """Index 0 to 23 of joints 1, 2 and 6 in each frame, joint 6 fastest: int [K, 3]."""
    inside = [
        np.flatnonzero((low <= ANGLES) & (high >= ANGLES)) if physical_limits else np.arange(len(ANGLES))
        for low, high in LIMITS
    ]
    return np.stack(np.meshgrid(*inside, indexing="ij"), -1).reshape(-1, 3)


def moves(physical_limits: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frame, action and next frame of every move there is: int32 [M] each, by frame, then by action.

    Without limits every joint goes round and round. With limits joints 1 and 2 stop, and joint 6, whose limits are two
    whole turns apart, still goes round: its turns are not counted.
    """
    setting = settings(physical_limits)
    number = np.full((len(ANGLES),) * 3, -1)
    number[tuple(setting.T)] = np.arange(len(setting))
    turn = np.kron(np.eye(3, dtype=int), [[1], [-1]])  # [actions, joints]
    after = setting[:, None] + turn
    next_frame = number[tuple(np.moveaxis(after % len(ANGLES), -1, 0))]  # [K, actions]
    # Settings within the limits of joint 1 or 2 never meet across 180 degrees, so that a joint that stops cannot wrap
    # into another one.
    frame, action = np.nonzero(next_frame >= 0)
    return frame.astype(np.int32), action.astype(np.int32), next_frame[frame, action].astype(np.int32)


def build(
    seed: int = 0, physical_limits: bool = False, size: int = 64, progress: Callable[[float], None] | None = None
) -> FrameDataset:
    """Draw the dataset: 24 x 24 x 24 frames of `size` x `size` RGB pixels and every move between them once, as a
    trajectory of one step.

    The real arm cannot do this: its joint 1 reaches 23 of the 24 settings and its joint 2 only 16, and stretched out it
    would meet its own base. The paper turns the cube freely, so the stand-in widens the limits; `physical_limits`
    leaves the 23 x 16 x 24 frames that the arm's limits allow. `seed` chooses stickers, camera, room and the light of
    each frame; the same seed gives the same bytes. `progress` is told the share done.
    """
    scene = cube_render.scene(seed, size)
    setting = settings(physical_limits)
    joints = np.radians(ANGLES)[setting]
    # a frame has the same light with and without limits
    every = np.ravel_multi_index(tuple(setting.T), (len(ANGLES),) * 3)
    light = cube_render.lights(seed, len(ANGLES) ** 3, scene)
    frames = np.empty((len(setting), size, size, 3), np.uint8)
    rotation = np.empty((len(setting), 3, 3), np.float32)

    def draw_turns(first: int) -> None:
        """The 24 frames from `first` on, which differ in joint 6 alone."""
        posture = cube_render.draw_posture(scene, link_motions(all_joints(joints[first])))
        for frame in range(first, first + len(ANGLES)):
            cube = cube_pose(link_motions(all_joints(joints[frame])))
            lit = cube_render.Light(light.direction[every[frame]], light.colour[every[frame]])
            frames[frame] = cube_render.draw(scene, posture, cube, lit)
            rotation[frame] = cube[:3, :3]

    starts = range(0, len(setting), len(ANGLES))
    with ThreadPoolExecutor(
        min(8, os.cpu_count() or 1)
    ) as threads:  # threads suffice: OpenCV and numpy's large operations let others run
        for done, _ in enumerate(threads.map(draw_turns, starts), 1):
            if progress is not None:
                progress(done / len(starts))
    frame, action, next_frame = moves(physical_limits)
    command = f"infogoal data build cube --seed {seed}{' --physical-limits' if physical_limits else ''}"
    return FrameDataset(
        frames=frames,
        state=np.arange(len(setting), dtype=np.int32),
        actions=ACTIONS,
        frame=frame,
        action=action,
        next_frame=next_frame,
        trajectory=np.arange(len(frame), dtype=np.int32),
        time=np.zeros(len(frame), np.int32),
        terminal=np.ones(len(frame), bool),
        rotation=rotation,
        joints=joints.astype(np.float32),
        joint_names=JOINT_NAMES,
        about={
            "name": "a generated arm turns a Rubik's cube, "
            + ("within" if physical_limits else "beyond")
            + " the limits of the IRB 1200's joints",
            "stand_in": True,
            "made_by": command,
            "seed": seed,
            "physical_limits": physical_limits,
            "generator": GENERATOR_VERSION,
        },
    )
