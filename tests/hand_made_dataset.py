"""Datasets made by hand: an image dataset of six frames, as records and as a file with faults planted in it; CIFAR-10
in its own format, with a few records of noise; and the sizes of a house that is built in a moment."""

from pathlib import Path

import cv2
import numpy as np

from infogoal_jax.data import backgrounds, frames
from infogoal_jax.data.frames import FrameDataset

TINY_HOUSE = {"node_spacing": 1.2, "image_width": 64}
"""Images of 64 x 36 pixels, nodes 1.2 m apart."""
BATCHES = (*backgrounds.TRAIN_BATCHES, *backgrounds.TEST_BATCHES)
"""Of CIFAR-10."""


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


def write_cifar10(folder: Path, records: int = 3) -> np.ndarray:
    """Six batches in the format of the binary version; the images of the first, uint8 [records, 32, 32, 3]."""
    folder.mkdir(parents=True)
    generator = np.random.default_rng(0)
    for name in reversed(BATCHES):
        pictures = generator.integers(0, 256, (records, 32, 32, 3), np.uint8)
        labels = generator.integers(0, 10, (records, 1), np.uint8)
        planes = pictures.transpose(0, 3, 1, 2).reshape(records, -1)
        (folder / name).write_bytes(np.concatenate([labels, planes], 1).tobytes())
    return pictures
