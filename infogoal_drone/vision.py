"""What the drone sees: which images of its video may be trusted (recent, not black, not frozen, not torn), and whether
the object that a question asks about is in view.

Every image is reduced to the size that the policy sees as soon as it arrives; the checks look at these. A detector is a
function from a whole image to detections.
"""

import itertools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from infogoal_jax.errors import UserError, nearest

STALE_SECONDS = 1.0
"""Age from which the last image is stale."""
STEADY_IMAGES = 3
"""Images in a row that must agree: a torn one agrees neither with the one before nor with the one after."""
DARK, FLAT = 12.0, 4.0
"""Mean grey level below which an image is black, and standard deviation below which it shows nothing."""
BAND = 6
"""Rows of the reduced image that show one grey from left to right where a part of the image was lost."""
BAND_FLAT = 1.0
"""Standard deviation of such a band."""
BLUR, SHIFT = 2.0, 1
"""Of reduced images before they are compared, and pixels by which one may be moved: the blur of each image is another,
and the camera drifts."""
TORN_DIFFERENCE = 0.27
"""Mean difference in a band of rows, as a share of the image's contrast, from which two images disagree: part of one of
them is of another place. Images in the hover differ by 0.18 at most, torn ones by 0.34 and more (of the simulated
camera)."""
SAME = 0.25
"""Mean difference below which two images are the same: a hovering camera always moves a little."""
FROZEN_SECONDS = 2.0
"""Time for which all images are the same in a frozen video."""
UNMOVED = 3.0
"""Mean difference below which an image shows what was seen before a move of 20 cm."""
INSTALL = "pip install 'infogoal-jax[yolo]'"
EDGE = 1.0
"""Pixels from the edge of the image within which a box counts as cut off."""


class Picture(NamedTuple):
    """An image of the video.

    time: of arrival, s.
    small: uint8 RGB [H, W, 3].
    whole: uint8 RGB, as it was streamed.
    """

    time: float
    small: np.ndarray
    whole: np.ndarray | None


def reduced(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """An image in the policy's height and width, by averaging."""
    return cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)


def difference(one: np.ndarray, other: np.ndarray) -> float:
    """Mean absolute difference of two images in grey levels."""
    return float(np.abs(one.astype(np.int16) - other).mean())


def largest_band_difference(one: np.ndarray, other: np.ndarray) -> float:
    """Mean absolute difference of two images in the band of rows where it is largest, at the best of a few shifts, as a
    share of the contrast of the first."""
    one, other = (cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR) for image in (one, other))
    height, width = one.shape[:2]
    inside = one[SHIFT : height - SHIFT, SHIFT : width - SHIFT]
    shifts = range(2 * SHIFT + 1)
    shifted = (
        other[down : down + height - 2 * SHIFT, right : right + width - 2 * SHIFT]
        for down in shifts
        for right in shifts
    )
    rows = [np.abs(inside - moved).mean((1, 2)) for moved in shifted]
    largest = min(np.convolve(of_rows, np.full(BAND, 1 / BAND), "valid").max() for of_rows in rows)
    return float(largest / max(one.std((0, 1)).mean(), 1.0))


def has_lost_band(image: np.ndarray) -> bool:
    """Whether a band of rows shows one grey from left to right, as decoders fill what they did not get."""
    rows = image.reshape(len(image), -1, image.shape[-1]).std(1).mean(-1) < BAND_FLAT
    return bool(np.convolve(rows, np.ones(BAND), "valid").max() == BAND)


def fault_of(
    pictures: list[Picture],
    now: float,
    since: float,
    speed: float = 1.0,
    in_air: bool = False,
    before_move: np.ndarray | None = None,
) -> str:
    """What is wrong with the last of these pictures, in a word, or "" if it may be trusted.

    pictures: those of the last seconds, oldest first; since: when the drone had come to rest; speed: simulated seconds
    in a second; in_air: whether the camera always moves; before_move: what was seen before the take-off or move that
    led here, None if it is not known.
    """
    if not pictures or now - pictures[-1].time > STALE_SECONDS / speed:
        return "stale"
    last = pictures[-1].small
    if last.mean() < DARK or last.std() < FLAT:
        return "black"
    if has_lost_band(last):
        return "torn"
    fresh = [picture for picture in pictures if picture.time >= since]
    if len(fresh) < STEADY_IMAGES:
        return "waiting"
    steady = fresh[-STEADY_IMAGES:]
    if any(
        largest_band_difference(one.small, other.small) > TORN_DIFFERENCE for one, other in itertools.pairwise(steady)
    ):
        return "torn"
    if in_air:
        if before_move is not None and difference(before_move, last) < UNMOVED:
            return "frozen"
        recent = [picture for picture in pictures if picture.time >= now - FROZEN_SECONDS / speed]
        long_enough = recent[-1].time - recent[0].time > 0.8 * FROZEN_SECONDS / speed
        if long_enough and all(difference(recent[0].small, other.small) < SAME for other in recent[1:]):
            return "frozen"
    return ""


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
    from infogoal_drone.simulated_tello import ask
    from infogoal_jax.data import splits

    def detect(image: np.ndarray) -> list[Detection]:
        return [Detection(name, tuple(box)) for name, box in ask(truth_port, "boxes").items()]

    detect.names = splits.load_questions(splits.SHIPPED_QUESTIONS).objects
    return detect


def yolo_detector(weights: Path) -> Detector:
    """A YOLO network of ultralytics with these weights, on the CPU. Raises `UserError` if the library or the file is
    missing, or the file holds none."""
    if not weights.is_file():
        raise UserError(f"weights = {str(weights)!r}: no such file; give the weights of a YOLO network (.pt or .onnx)")
    try:
        from ultralytics import YOLO
    except ImportError as error:
        raise UserError(f"detection by YOLO needs ultralytics ({error}): {INSTALL}") from error
    if weights.suffix.lower() != ".onnx":
        print(
            f"infogoal: {weights} is a pickle, which can run any code when it is loaded: fly with weights of your own, "
            "or of those whom you trust; an .onnx file holds numbers alone",
            file=sys.stderr,
        )
    try:
        model = YOLO(str(weights))
        names = tuple(model.names.values())
    except Exception as error:  # ultralytics, torch and onnxruntime raise many kinds; the drone is on the ground.
        raise UserError(
            f"weights = {str(weights)!r}: cannot be read ({' '.join(str(error).split())}); give the weights of a YOLO "
            "network (.pt or .onnx)"
        ) from error

    def detect(image: np.ndarray) -> list[Detection]:
        (result,) = model.predict(np.ascontiguousarray(image[..., ::-1]), device="cpu", verbose=False)  # It takes BGR.
        rows = zip(result.boxes.cls.tolist(), result.boxes.xyxy.tolist(), result.boxes.conf.tolist(), strict=True)
        return [Detection(result.names[int(kind)], tuple(box), confidence) for kind, box, confidence in rows]

    detect.names = names
    return detect


def check_known(name: str, detector: Detector) -> None:
    """Raise `UserError` if the detector says which objects it knows, and this is none of them."""
    names = getattr(detector, "names", None)
    if names is not None and name not in names:
        hint = nearest(name, list(names))
        raise UserError(f"object = {name!r}: the detector does not know it.{hint} It knows: {', '.join(names)}")
