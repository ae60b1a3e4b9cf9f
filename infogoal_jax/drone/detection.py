"""Whether the object that a question asks about is in view: a detector is a function from an image to detections."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from infogoal_jax.errors import UserError, nearest

INSTALL = "pip install 'infogoal-jax[yolo]'"
EDGE = 1.0
"""Pixels from the edge of the image within which a box counts as cut off."""


class Detection(NamedTuple):
    """An object in an image. box: left, top, right and bottom in pixels; confidence: in [0, 1]."""

    name: str
    box: tuple[float, float, float, float]
    confidence: float = 1.0


Detector = Callable[[np.ndarray], list[Detection]]
"""Image uint8 RGB [H, W, 3] to what is seen in it."""


def whole(detection: Detection, image: np.ndarray) -> bool:
    """Whether the box lies in the image with all of its corners, as in the data that policies learn from."""
    left, top, right, bottom = detection.box
    height, width = image.shape[:2]
    return left > EDGE and top > EDGE and right < width - EDGE and bottom < height - EDGE


def seen(detections: list[Detection], image: np.ndarray, confidence: float) -> set[str]:
    """The names of the objects that are wholly in the image, with at least this confidence."""
    return {one.name for one in detections if one.confidence >= confidence and whole(one, image)}


def simulated_detector(truth_port: int) -> Detector:
    """The boxes that the simulator knows, of where the simulated drone is now."""
    from infogoal_jax.data import questions
    from infogoal_jax.drone.simulated_tello import ask

    def detect(image: np.ndarray) -> list[Detection]:
        return [Detection(name, tuple(box)) for name, box in ask(truth_port, "boxes").items()]

    detect.names = questions.load(questions.SHIPPED).objects
    return detect


def yolo_detector(weights: Path) -> Detector:
    """A YOLO network of ultralytics with these weights, on the CPU. Raises `UserError` if the library or the file is
    missing."""
    if not weights.is_file():
        raise UserError(f"weights = {str(weights)!r}: no such file; give the weights of a YOLO network (.pt or .onnx)")
    try:
        from ultralytics import YOLO
    except ImportError as error:
        raise UserError(f"detection by YOLO needs ultralytics ({error}): {INSTALL}") from error
    model = YOLO(str(weights))

    def detect(image: np.ndarray) -> list[Detection]:
        (result,) = model.predict(np.ascontiguousarray(image[..., ::-1]), device="cpu", verbose=False)  # It takes BGR.
        rows = zip(result.boxes.cls.tolist(), result.boxes.xyxy.tolist(), result.boxes.conf.tolist(), strict=True)
        return [Detection(result.names[int(kind)], tuple(box), confidence) for kind, box, confidence in rows]

    detect.names = tuple(model.names.values())
    return detect


def check_known(name: str, detector: Detector) -> None:
    """Raise `UserError` if the detector says which objects it knows, and this is none of them."""
    names = getattr(detector, "names", None)
    if names is not None and name not in names:
        hint = nearest(name, list(names))
        raise UserError(f"object = {name!r}: the detector does not know it.{hint} It knows: {', '.join(names)}")
