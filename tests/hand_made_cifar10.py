"""CIFAR-10 in its own format, with a few records of noise."""

from pathlib import Path

import numpy as np

from infogoal_jax.data import backgrounds

BATCHES = (*backgrounds.TRAIN_BATCHES, *backgrounds.TEST_BATCHES)


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
