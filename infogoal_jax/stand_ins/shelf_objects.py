"""The 24 objects of the generated shelf, drawn with simple shapes: none is the artwork of a brand.

A drawing is a width, a height and a list of shapes, all in centimetres: x to the right from the left end, y up from the
foot. Objects are larger than in life, so that one is told from another in a picture 64 pixels wide.
"""

import cv2
import numpy as np
from PIL import ImageColor

SUPERSAMPLING = 3  # Objects are drawn this much larger and reduced, which gives them soft edges.

# name -> (width, height, shapes). A shape is (kind, colour, numbers):
#   box x0 y0 x1 y1 | oval x y radius_x radius_y | shape x y x y ... | line width x y x y ... | text x y width, centred,
# with its letters at the end.
DRAWINGS = {
    "globe": (28, 33, (
        ("shape", "#6b4423", 5, 0, 23, 0, 18, 3, 10, 3), ("box", "#6b4423", 13, 2, 15, 8),
        ("oval", "#c9a227", 14, 19, 14, 14), ("oval", "#1f6fd0", 14, 19, 12.5, 12.5),
        ("shape", "#3fa34d", 5, 24, 12, 28, 14, 23, 10, 20, 11, 15, 8, 11, 7, 18),
        ("shape", "#3fa34d", 16, 27, 23, 24, 25, 19, 21, 17, 20, 12, 17, 16, 15, 22),
        ("oval", "#8fc1f0", 9, 26, 2, 1.3))),
    "can of tomato soup": (18, 26, (
        ("box", "#c4161c", 0, 1, 18, 25), ("box", "#c9ccd1", 0, 0, 18, 2), ("box", "#c9ccd1", 0, 24, 18, 26),
        ("box", "#f7efe0", 0, 11, 18, 22), ("text", "#c4161c", 9, 19.5, 15, "TOMATO"),
        ("text", "#333333", 9, 15, 9, "SOUP"), ("oval", "#f05a3c", 9, 7, 4, 3.4),
        ("shape", "#2e8b3d", 6, 10, 9, 8.5, 12, 10, 9, 11.5))),
    "toy robot": (24, 32, (
        ("line", "#555555", 1, 12, 26, 12, 31), ("oval", "#ff2d2d", 12, 31, 1.2, 1), ("box", "#8fd3e0", 6, 19, 18, 28),
        ("oval", "#ffd400", 9, 24, 2, 2), ("oval", "#ffd400", 15, 24, 2, 2), ("box", "#333333", 8.5, 20, 15.5, 21.3),
        ("box", "#4fb3c8", 4, 7, 20, 18), ("box", "#2c7f94", 0, 9, 3.4, 18), ("box", "#2c7f94", 20.6, 9, 24, 18),
        ("box", "#2c7f94", 6, 0, 10.5, 7), ("box", "#2c7f94", 13.5, 0, 18, 7), ("box", "#e8eef0", 7, 10, 17, 16),
        ("oval", "#e03131", 9, 13, 1.3, 1.3), ("oval", "#ffd400", 12, 13, 1.3, 1.3),
        ("oval", "#37b24d", 15, 13, 1.3, 1.3))),
    "blue vase": (18, 32, (
        ("shape", "#1b2fa8", 5, 0, 13, 0, 16, 6, 18, 14, 15, 21, 11.5, 25, 12, 29, 14, 32, 4, 32, 6, 29, 6.5, 25, 3,
        21, 0, 14, 2, 6), ("line", "#f2f5ff", 1.4, 1, 12, 4, 16, 7, 12, 10, 16, 13, 12, 17, 16),
        ("line", "#9db4ff", 0.9, 3, 7, 15, 7), ("line", "#9db4ff", 0.9, 6, 25, 12, 25))),
    "cookbook": (22, 30, (
        ("box", "#e8731a", 0, 0, 22, 30), ("box", "#9c4707", 0, 0, 4, 30), ("oval", "#ffffff", 13, 11, 7, 7),
        ("oval", "#e9dcc6", 13, 11, 4.6, 4.6), ("line", "#7a5a3a", 1, 13, 7, 13, 15),
        ("text", "#fff6d6", 13, 26, 14, "COOK"), ("text", "#fff6d6", 13, 21.5, 14, "BOOK"))),
    "teddy bear": (26, 32, (
        ("oval", "#8a5a2b", 6, 29, 3.6, 3), ("oval", "#8a5a2b", 20, 29, 3.6, 3), ("oval", "#8a5a2b", 4, 13, 4, 6),
        ("oval", "#8a5a2b", 22, 13, 4, 6), ("oval", "#96632f", 13, 10, 9, 10), ("oval", "#96632f", 13, 23, 9, 8),
        ("oval", "#8a5a2b", 6, 3.6, 5, 3.6), ("oval", "#8a5a2b", 20, 3.6, 5, 3.6),
        ("oval", "#e0bd8a", 13, 10, 5.4, 6.4), ("oval", "#e0bd8a", 13, 20.5, 4, 3),
        ("oval", "#1a1a1a", 13, 21.6, 1.5, 1), ("oval", "#1a1a1a", 9.5, 25, 1, 1.2),
        ("oval", "#1a1a1a", 16.5, 25, 1, 1.2), ("shape", "#c81e4a", 8, 13.5, 13, 15.5, 8, 18),
        ("shape", "#c81e4a", 18, 13.5, 13, 15.5, 18, 18))),
    "alarm clock": (26, 27, (
        ("line", "#444444", 1.8, 5, 0.9, 8, 5), ("line", "#444444", 1.8, 21, 0.9, 18, 5),
        ("line", "#444444", 1.2, 13, 22, 13, 26.3), ("oval", "#f2b705", 6, 23, 4.5, 3.6),
        ("oval", "#f2b705", 20, 23, 4.5, 3.6), ("oval", "#0f9d8a", 13, 12.5, 11.5, 11.5),
        ("oval", "#ffffff", 13, 12.5, 9, 9), ("line", "#111111", 1.2, 13, 12.5, 13, 19.5),
        ("line", "#111111", 1.5, 13, 12.5, 17.5, 10), ("text", "#111111", 13, 6, 3, "6"),
        ("oval", "#e03131", 13, 12.5, 1, 1))),
    "cactus": (20, 33, (
        ("shape", "#c65d2e", 4, 0, 16, 0, 18.5, 10, 1.5, 10), ("box", "#a4481f", 1, 8.5, 19, 11.5),
        ("oval", "#2f8f46", 10, 21, 4, 12), ("line", "#2f8f46", 3.6, 10, 17, 3, 18, 3, 25),
        ("line", "#2f8f46", 3.6, 10, 19.5, 17, 20.5, 17, 27), ("line", "#bfe3a5", 0.5, 10, 12, 10, 32),
        ("line", "#bfe3a5", 0.5, 7.8, 13, 7.8, 30), ("line", "#bfe3a5", 0.5, 12.2, 13, 12.2, 30),
        ("oval", "#ff4fa0", 10, 31.6, 2, 1.4))),
    "bottle of olive oil": (12, 33, (
        ("shape", "#5d6b12", 0, 0, 12, 0, 12, 18, 8, 23, 8, 30, 4, 30, 4, 23, 0, 18),
        ("box", "#1c1c1c", 3.6, 29, 8.4, 33), ("shape", "#8a9a1e", 1, 1, 3, 1, 3, 17, 1, 17),
        ("box", "#f4ecc8", 0, 4, 12, 15), ("text", "#3d4a08", 6, 12.5, 10, "OLIVE"),
        ("oval", "#4a7a1c", 4.5, 7.5, 2.2, 1.7), ("oval", "#33330f", 8, 7, 2, 1.6))),
    "toy sailboat": (32, 33, (
        ("line", "#6b4423", 1, 15, 5, 15, 32.4), ("shape", "#f6f6f2", 14, 32, 14, 9, 1, 9),
        ("shape", "#d92b2b", 16, 30, 16, 9, 30, 9), ("shape", "#7b3f14", 0, 7.5, 32, 7.5, 26, 0, 6, 0),
        ("line", "#f2d59b", 1.2, 2, 6, 30, 6), ("text", "#d92b2b", 9.5, 14, 4, "7"))),
    "box of cereal": (22, 32, (
        ("box", "#ffcc12", 0, 0, 22, 32), ("box", "#d9a600", 19, 0, 22, 32),
        ("text", "#7a1fa2", 9.5, 26.5, 16, "CEREAL"), ("oval", "#fff8e1", 9.5, 12.5, 7.5, 2.5),
        ("shape", "#7a1fa2", 2, 12, 17, 12, 14, 4, 5, 4), ("oval", "#c97c1a", 7, 13, 2, 1.2),
        ("oval", "#c97c1a", 11, 12.7, 2, 1.2), ("oval", "#e53935", 9, 18, 2, 2), ("oval", "#e53935", 14, 19.5, 2, 2))),
    "marble statue": (18, 33, (
        ("box", "#1d1d22", 2, 0, 16, 5), ("shape", "#e9e9ee", 1, 5, 17, 5, 16, 11, 12, 14, 12, 18, 6, 18, 6, 14, 2, 11),
        ("oval", "#f4f4f7", 9, 23, 5.6, 7.4), ("oval", "#cfcfd8", 9, 29.5, 6, 3.4), ("oval", "#cfcfd8", 4, 26, 2, 4),
        ("oval", "#cfcfd8", 14, 26, 2, 4), ("line", "#9a9aa6", 0.7, 9, 24, 8.3, 20.8, 10, 20.8),
        ("line", "#9a9aa6", 0.7, 7, 18.6, 11, 18.6), ("line", "#9a9aa6", 0.8, 5.5, 24, 7.5, 24),
        ("line", "#9a9aa6", 0.8, 10.5, 24, 12.5, 24))),
    "soccer ball": (25, 25, (
        ("oval", "#f5f5f5", 12.5, 12.5, 12.5, 12.5),
        ("shape", "#151515", 12.5, 17.5, 17.2, 14, 15.4, 8.5, 9.6, 8.5, 7.8, 14),
        ("shape", "#151515", 8, 23.8, 17, 23.8, 12.5, 21.2), ("shape", "#151515", 0.6, 16, 3.8, 16, 3.6, 20.8, 2, 19),
        ("shape", "#151515", 24.4, 16, 21.2, 16, 21.4, 20.8, 23, 19),
        ("shape", "#151515", 3.5, 4, 7, 4.8, 7.5, 1.2, 6, 1.8),
        ("shape", "#151515", 21.5, 4, 18, 4.8, 17.5, 1.2, 19, 1.8), ("line", "#555555", 0.5, 12.5, 17.5, 12.5, 21.5),
        ("line", "#555555", 0.5, 7.8, 14, 3.8, 16), ("line", "#555555", 0.5, 17.2, 14, 21.2, 16),
        ("line", "#555555", 0.5, 9.6, 8.5, 7, 4.8), ("line", "#555555", 0.5, 15.4, 8.5, 18, 4.8))),
    "coffee mug": (26, 22, (
        ("oval", "#6a2fb0", 19, 11, 6.5, 7), ("oval", "clear", 19, 11, 4, 4.6), ("box", "#7d3cc8", 0, 0, 19, 22),
        ("oval", "#ffffff", 7, 13, 3.2, 3), ("oval", "#ffffff", 12, 13, 3.2, 3),
        ("shape", "#ffffff", 4, 12, 15, 12, 9.5, 5), ("box", "#cdb2f0", 0, 20.5, 19, 22))),
    "radio": (33, 25, (
        ("line", "#9aa0a6", 0.9, 27, 18, 32.4, 24.6), ("box", "#5a2d12", 0, 0, 33, 19),
        ("box", "#7b4420", 1.5, 1.5, 31.5, 17.5), ("oval", "#f0e2c0", 9.5, 9.5, 7, 7),
        ("oval", "#bda878", 9.5, 9.5, 5, 5), ("oval", "#f0e2c0", 9.5, 9.5, 2, 2),
        ("box", "#f0e2c0", 18.5, 10, 30.5, 16), ("line", "#c4161c", 0.9, 23, 10.3, 23, 15.7),
        ("oval", "#1c1c1c", 21.5, 5.5, 2.6, 2.6), ("oval", "#1c1c1c", 28, 5.5, 2.6, 2.6))),
    "watering can": (33, 27, (
        ("oval", "#b01667", 14, 19, 8, 8), ("oval", "clear", 14, 18.6, 5.6, 5.8),
        ("line", "#d81b7a", 2.6, 18, 6, 27, 20), ("shape", "#d81b7a", 23, 22.5, 30, 17, 33, 21.5, 26.5, 26.5),
        ("shape", "#e6308f", 3, 0, 23, 0, 21.5, 18, 4.5, 18), ("line", "#ffc2e0", 1.3, 4, 4, 22, 4),
        ("oval", "#ffe04a", 12.5, 10.5, 2.6, 2.6), ("oval", "#ffffff", 12.5, 10.5, 1.2, 1.2))),
    "sunflower painting": (30, 30, (
        ("box", "#8c6510", 0, 0, 30, 30), ("box", "#d4a62a", 1, 1, 29, 29), ("box", "#86c5ee", 3.5, 3.5, 26.5, 26.5),
        ("line", "#2e7d32", 1.8, 15, 4.4, 15, 13), ("shape", "#2e7d32", 15, 6, 22, 6, 24, 10),
        ("shape", "#ffb300", 15, 26, 17.5, 21, 23, 22.5, 20.5, 17.5, 24, 15.5, 20, 13.5, 20.5, 9.5, 16.5, 11, 13.5,
        9.5, 9.5, 9.5, 10, 13.5, 6, 15.5, 9.5, 17.5, 7, 22.5, 12.5, 21), ("oval", "#4e2a0b", 15, 16, 4.2, 4.2))),
    "jar of honey": (19, 24, (
        ("box", "#d98200", 0, 0, 19, 19), ("box", "#f5a91b", 1.5, 1, 6, 18), ("box", "#f6f1e2", 1, 19, 18, 24),
        ("line", "#d44", 0.8, 1, 21.5, 18, 21.5),
        ("shape", "#fff3c4", 9.5, 1.5, 16.5, 5.5, 16.5, 13.5, 9.5, 17.5, 2.5, 13.5, 2.5, 5.5),
        ("text", "#7a4300", 9.5, 7, 12, "HONEY"), ("oval", "#1c1c1c", 9.5, 12.5, 2.6, 1.8),
        ("box", "#ffd400", 9, 10.8, 10, 14.2), ("oval", "#cfe6f5", 8.5, 14.8, 1.6, 1))),
    "rubber duck": (29, 27, (
        ("oval", "#ffd91a", 13, 8, 13, 8), ("shape", "#ffd91a", 0, 8, 0, 16, 8, 13),
        ("oval", "#ffe23d", 18.5, 19.5, 7.4, 7.4), ("shape", "#f2711c", 24, 21, 29, 19.5, 28, 17, 24, 16.5),
        ("oval", "#111111", 20.5, 22, 1.4, 1.6), ("oval", "#e6b800", 11, 8.5, 5.5, 3.6),
        ("oval", "#ffffff", 21, 22.5, 0.5, 0.5))),
    "desk lamp": (27, 33, (
        ("oval", "#222222", 9, 1.6, 9, 1.6), ("line", "#333333", 1.6, 9, 2, 4, 16, 15, 27),
        ("oval", "#b71c1c", 4, 16, 1.6, 1.6), ("shape", "#b71c1c", 12, 32, 18, 32.8, 26.6, 21.5, 11.5, 18.5),
        ("shape", "#fff3a8", 11.5, 18.5, 26.6, 21.5, 22, 16.6, 16, 15.6))),
    "first aid kit": (31, 24, (
        ("line", "#1b4d2b", 1.6, 11, 19, 11, 22.8, 20, 22.8, 20, 19), ("box", "#12813c", 0, 0, 31, 20),
        ("box", "#0b5e2a", 0, 13.6, 31, 14.6), ("box", "#ffffff", 13, 3, 18, 18), ("box", "#ffffff", 8, 8, 23, 13),
        ("box", "#c9ccd1", 3.5, 12.6, 6, 15.6), ("box", "#c9ccd1", 25, 12.6, 27.5, 15.6))),
    "ukulele": (17, 33, (
        ("oval", "#a85a14", 8.5, 7, 8.5, 7), ("oval", "#a85a14", 8.5, 15, 6.4, 5.6),
        ("oval", "#d9873a", 8.5, 7, 7.5, 6.1), ("oval", "#d9873a", 8.5, 15, 5.4, 4.7),
        ("box", "#3b2110", 7, 13, 10, 28), ("oval", "#24140a", 8.5, 12, 2.7, 2.7),
        ("shape", "#5c3317", 6, 28, 11, 28, 11.8, 33, 5.2, 33), ("box", "#3b2110", 5.5, 4.5, 11.5, 5.8),
        ("line", "#f4f1e6", 0.3, 7.8, 5, 7.8, 31), ("line", "#f4f1e6", 0.3, 9.2, 5, 9.2, 31))),
    "potted orchid": (23, 33, (
        ("shape", "#f1f1f4", 6, 0, 16, 0, 18, 9, 4, 9), ("line", "#3f8f3a", 1, 11, 8, 10, 18, 14, 28, 20, 31),
        ("shape", "#2f7d32", 11, 9, 0, 13, 3, 9.5), ("shape", "#2f7d32", 11, 9, 22, 14, 19, 9.5),
        ("oval", "#e05ad0", 10, 20, 4.2, 3.4), ("oval", "#f08ae4", 14.5, 25.5, 4.4, 3.4),
        ("oval", "#e05ad0", 19, 30, 3.8, 2.8), ("oval", "#ffe96b", 10, 20, 1.3, 1.2),
        ("oval", "#ffe96b", 14.5, 25.5, 1.3, 1.2), ("oval", "#ffe96b", 19, 30, 1.2, 1),
        ("line", "#8fa7c9", 0.8, 5, 5, 17, 5))),
    "carton of milk": (17, 30, (
        ("box", "#eaf5ff", 0, 0, 17, 21), ("shape", "#3d8fe0", 0, 21, 17, 21, 14, 27, 3, 27),
        ("box", "#2a6fb8", 2.6, 26.5, 14.4, 30), ("box", "#3d8fe0", 0, 0, 17, 4),
        ("text", "#1d4f91", 8.5, 17, 13, "MILK"), ("oval", "#20242b", 4, 10, 3, 2.3),
        ("oval", "#20242b", 12, 8, 3.4, 2.6), ("oval", "#20242b", 10, 12.6, 1.8, 1.1))),
}  # fmt: skip


def draw(width: float, height: float, shapes: tuple, pixels_per_metre: float) -> np.ndarray:
    """Shapes of a drawing as uint8 [H, W, 4], RGB times opacity and opacity; width and height in centimetres."""
    scale = pixels_per_metre / 100 * SUPERSAMPLING
    rows, columns = (round(pixels_per_metre / 100 * side) * SUPERSAMPLING for side in (height, width))
    colours, opacity = np.zeros((rows, columns, 3), np.uint8), np.zeros((rows, columns), np.uint8)
    for kind, colour, *numbers in shapes:
        value = (0, 0, 0) if colour == "clear" else ImageColor.getrgb(colour)
        for layer, its_value in ((colours, value), (opacity, 0 if colour == "clear" else 255)):
            _draw_shape(layer, kind, its_value, numbers, scale)
    # Light comes from the upper left: the left third is brightest, the right end darkest.
    across = np.linspace(0, 1, columns)
    shade = 1.06 - 0.12 * np.abs(across - 0.3) - 0.30 * np.clip(across - 0.6, 0, None)
    lit = np.clip(colours * shade[:, None], 0, 255) * (opacity[..., None] > 0)
    both = np.dstack([lit.astype(np.uint8), opacity])
    return cv2.resize(both, (columns // SUPERSAMPLING, rows // SUPERSAMPLING), interpolation=cv2.INTER_AREA)


def _draw_shape(layer: np.ndarray, kind: str, value, numbers: list, scale: float) -> None:
    """One shape on one layer [H, W] or [H, W, 3]; without smoothing, which the reduction does."""

    def pixels(values):
        return np.int32(np.round(np.reshape(values, (-1, 2)) * (scale, -scale) + (0, layer.shape[0])))

    if kind == "box":
        x0, y0, x1, y1 = numbers
        cv2.fillPoly(layer, [pixels((x0, y0, x1, y0, x1, y1, x0, y1))], value)
    elif kind == "oval":
        centre, radii = pixels(numbers[:2])[0], (np.array(numbers[2:]) * scale).round().astype(int)
        cv2.ellipse(layer, centre.tolist(), radii.tolist(), 0, 0, 360, value, cv2.FILLED)
    elif kind == "shape":
        cv2.fillPoly(layer, [pixels(numbers)], value)
    elif kind == "line":
        cv2.polylines(layer, [pixels(numbers[1:])], False, value, max(1, round(numbers[0] * scale)))
    elif kind == "text":
        x, y, width, letters = numbers
        (unit_width, unit_height), _ = cv2.getTextSize(letters, cv2.FONT_HERSHEY_DUPLEX, 1.0, 2)
        size = width * scale / unit_width
        corner = pixels((x, y))[0] + np.round(np.array((-unit_width, unit_height)) * size / 2).astype(int)
        cv2.putText(layer, letters, corner.tolist(), cv2.FONT_HERSHEY_DUPLEX, size, value, max(1, round(2.4 * size)))
