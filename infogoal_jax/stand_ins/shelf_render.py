"""Drawing the generated shelf with OpenCV: one large picture of the whole wall, and what a camera in front of it sees
of it.

The camera is that of the drone's video stream: 960 x 720 pixels, 55.0 by 42.8 degrees, one metre away.
"""

import cv2
import numpy as np

from infogoal_jax.stand_ins.shelf_objects import DRAWINGS, draw

STREAM = (720, 960)
"""Height and width of the video stream, pixels."""
DISTANCE = 1.0
"""From the camera to the shelf, m."""
VIEW = 2 * DISTANCE * np.tan(np.deg2rad(np.array([55.0, 42.8])) / 2)
"""Width and height of what is seen there, m: 1.04 x 0.78."""
PIXELS_PER_METRE = STREAM[1] / VIEW[0]
MARGIN = 0.8
"""Of wall beyond the shelf on every side, m: a camera at the edge sees it."""
COARSER = 3
"""Blurred images are reduced by this first."""
BOARD = 0.03
"""Thickness of boards and uprights, m."""


def draw_wall(
    size: np.ndarray,
    boards: list[float],
    uprights: np.ndarray,
    places: dict[str, np.ndarray],
    random: np.random.Generator,
) -> np.ndarray:
    """The whole wall with its shelf and objects, uint8 RGB [H, W, 3]; row 0 is the top.

    size: width and height of the shelf, m; boards: heights of their upper sides; uprights: x of each; places: left end
    and foot of each object.
    """
    width, height = np.round((size + 2 * MARGIN) * PIXELS_PER_METRE).astype(int)
    wall = wallpaper(height, width, random)
    wood = random.uniform(70, 190) * np.array([1.0, random.uniform(0.65, 0.85), random.uniform(0.4, 0.65)])
    for x in uprights:
        fill(wall, (x - BOARD / 2, 0.0), (x + BOARD / 2, size[1]), size, wood * random.uniform(0.75, 1.1))
    for board in boards:
        fill(wall, (0.0, board - BOARD), (size[0], board), size, wood)
        fill(wall, (0.0, board - BOARD - 0.012), (size[0], board - BOARD), size, wood * 0.45)  # The board's shadow.
    for name, place in places.items():
        paste(wall, draw(*DRAWINGS[name], PIXELS_PER_METRE), place, size)
    return wall


def wallpaper(height: int, width: int, random: np.random.Generator) -> np.ndarray:
    """A painted wall, uint8 [height, width, 3]: colours that change slowly, and spots by which one place is told from
    another."""
    coarse = random.uniform(0, 1, (5, 14, 3)) * 70 + random.uniform(60, 150, 3)
    wall = cv2.resize(coarse.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    wall = np.clip(wall, 0, 255).astype(np.uint8)
    for _ in range(int(width * height / (0.35 * PIXELS_PER_METRE) ** 2)):
        centre = (int(random.integers(width)), int(random.integers(height)))
        radius = int(random.uniform(0.03, 0.09) * PIXELS_PER_METRE)
        colour = np.clip(wall[centre[1], centre[0]] + random.uniform(-60, 60, 3), 0, 255).tolist()
        if random.random() < 0.5:
            cv2.circle(wall, centre, radius, colour, cv2.FILLED, cv2.LINE_AA)
        else:
            corners = cv2.boxPoints((centre, (2 * radius, radius), random.uniform(0, 180)))
            cv2.fillPoly(wall, [np.int32(corners)], colour, cv2.LINE_AA)
    return wall


def pixel_of(point, size: np.ndarray) -> np.ndarray:
    """The pixel (column, row) of points [..., 2] on the shelf, m from its lower left corner; not rounded."""
    point = np.asarray(point, float)
    return np.stack([point[..., 0] + MARGIN, size[1] + MARGIN - point[..., 1]], axis=-1) * PIXELS_PER_METRE


def fill(wall: np.ndarray, low, high, size: np.ndarray, colour: np.ndarray) -> None:
    """Paint the rectangle between two corners (m)."""
    (left, bottom), (right, top) = np.round(pixel_of([low, high], size)).astype(int)
    wall[top:bottom, left:right] = np.clip(colour, 0, 255)


def paste(wall: np.ndarray, picture: np.ndarray, place: np.ndarray, size: np.ndarray) -> None:
    """Lay a picture [h, w, 4] (RGB times opacity, and opacity) on the wall, its lower left corner at `place` (m)."""
    left, bottom = np.round(pixel_of(place, size)).astype(int)
    region = wall[bottom - picture.shape[0] : bottom, left : left + picture.shape[1]]
    region[:] = np.clip(picture[..., :3] + region * (1 - picture[..., 3:] / 255.0), 0, 255).astype(np.uint8)


def camera(centre: np.ndarray, roll: float, size: np.ndarray) -> np.ndarray:
    """The affine map [2, 3] from pixels of the wall to those of the video stream, for a camera before `centre` (m),
    turned by `roll` (radians)."""
    column, row = pixel_of(centre, size)
    turn = cv2.getRotationMatrix2D((float(column), float(row)), np.rad2deg(roll), 1.0)
    turn[:, 2] += np.array([STREAM[1] / 2 - column, STREAM[0] / 2 - row])
    return turn


def see(wall: np.ndarray, view: np.ndarray, size: tuple[int, int], blur: np.ndarray | None = None) -> np.ndarray:
    """What the camera sees, uint8 [height, width, 3] of this size. blur: movement while the shutter is open, pixels of
    the stream [2]; None: none."""
    image = cv2.warpAffine(wall, view, STREAM[::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    if blur is not None:
        # Blurring 720 rows takes ten times as long.
        image = cv2.resize(image, None, fx=1 / COARSER, fy=1 / COARSER, interpolation=cv2.INTER_AREA)
        blur = blur / COARSER
        length = int(np.ceil(np.abs(blur).max())) | 1
        kernel = np.zeros((length, length), np.float32)
        middle = length // 2
        end = np.round(blur / 2).astype(int)
        cv2.line(kernel, (middle - end[0], middle - end[1]), (middle + end[0], middle + end[1]), 1.0)
        image = cv2.filter2D(image, -1, kernel / kernel.sum())
    return cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA)
