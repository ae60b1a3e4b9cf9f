"""Colour images as OpenCV reads them, and at another size."""

import numpy as np


def decoded(content: bytes) -> np.ndarray | None:
    """The image in these bytes, uint8 RGB [H, W, 3]; None where they are damaged or no image that OpenCV reads."""
    import cv2  # Only now: it takes a tenth of a second.

    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
    except cv2.error:
        image = None
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """An image at this size. What shrinks is averaged over areas: interpolation between single pixels would alias."""
    import cv2

    shrinks = image.shape[0] >= height and image.shape[1] >= width
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
