"""An image dataset of six frames, as records and as a file with faults planted in it."""

import cv2
import numpy as np

from infogoal_jax.data import frames
from infogoal_jax.data.frames import FrameDataset


def small(**changes) -> FrameDataset:
    """Six frames of five states in a row; two trajectories: 0 1 2 3 to the right, 4 5 0 to the left."""
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 10, 3), np.uint8)
    turns = [cv2.Rodrigues(np.array([0.1, 0.2, 0.3]) * row)[0] for row in range(6)]
    fields = {
        "frames": pixels,
        "state": np.array([0, 1, 2, 3, 4, 4], np.int32),
        "actions": ("right", "left ←"),
        "frame": np.array([0, 1, 2, 4, 5], np.int32),
        "action": np.array([0, 0, 0, 1, 0], np.int32),
        "next_frame": np.array([1, 2, 3, 5, 0], np.int32),
        "trajectory": np.array([3, 3, 3, 7, 7], np.int32),
        "time": np.array([0, 1, 2, 0, 1], np.int32),
        "terminal": np.array([False, False, True, False, True]),
        "about": {"name": "a row of five", "stand_in": True, "made_by": "a test", "seed": 3},
        "rotation": np.array(turns, np.float32),
        "joints": np.arange(12, dtype=np.float32).reshape(6, 2),
        "joint_names": ("shoulder", "rail_m"),
        "position": np.arange(12, dtype=np.float32).reshape(6, 2) / 3,
        "detected": np.eye(6, 2, dtype=bool),
        "objects": ("a red mug", "una caña"),
    }
    return FrameDataset(**(fields | changes))


MOVES = ("frame", "action", "next_frame", "trajectory", "time", "terminal")
OPTIONAL = {"rotation": None, "joints": None, "position": None, "detected": None, "objects": (), "joint_names": ()}


def planted(path, **changes) -> None:
    """A file of `small` with other members; None leaves one out."""
    members = frames.members_of(small()) | changes
    np.savez(path, **{name: value for name, value in members.items() if value is not None})
