"""What tests of goal images share: the tasks that have banks, and how images differ."""

import numpy as np

NAMES = ("fetch_reach", "fetch_push", "fetch_pick_and_place")


def differing_pixels(images: np.ndarray, others: np.ndarray) -> np.ndarray:
    """In how many pixels images [..., H, W, 3] differ by more than 16 of 255 in some colour."""
    difference = np.maximum(images, others) - np.minimum(images, others)  # Of bytes, without going below 0.
    return (difference.max(-1) > 16).sum((-1, -2))
