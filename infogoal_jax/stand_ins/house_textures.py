"""Generated pictures for the surfaces of the synthetic house: walls, floors, furniture, pictures, and object labels.

A surface is named by a string ("wall:kitchen:north", "object:hersheys_bar"); `paint` draws a set of them. The rooms
must differ in grey at 32 x 32 pixels, so every wall of the house has its own pattern and brightness. No photographs and
no brand artwork: a label is a colour, a pattern and the printed name.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from infogoal_jax.stand_ins.house_layout import SIDES
from infogoal_jax.stand_ins.house_render import TEXTURE_SIZE

SIZE = TEXTURE_SIZE
CORRIDOR = "corridor"
ROW, COLUMN = np.mgrid[0:SIZE, 0:SIZE]
# Patterns as masks. A wall's texture covers 5 m by 2.5 m, so a period of 16 columns by 32 rows is 0.6 m by 0.6 m.
PATTERNS = (
    COLUMN % 16 < 8,  # broad upright stripes
    ROW % 32 < 16,  # broad level stripes
    (ROW // 32 + COLUMN // 16) % 2 == 0,  # checks
    (ROW % 32 < 4) | ((COLUMN + 8 * (ROW // 32 % 2)) % 16 < 2),  # bricks
    (ROW > 80) & ~((ROW > 88) & (ROW < 120) & (COLUMN % 16 > 2) & (COLUMN % 16 < 14)),  # panels below
    (ROW + 2 * COLUMN) % 64 < 32,  # slanted stripes
    ((ROW % 32 - 16) / 2) ** 2 + (COLUMN % 16 - 8) ** 2 < 25,  # dots
    (COLUMN % 24 < 3) | (ROW > 104),  # narrow posts over a dark base
)
FLOOR_PATTERNS = (
    (ROW // 32 + COLUMN // 32) % 2 == 0,
    ROW % 16 < 2,
    np.zeros((SIZE, SIZE), bool),
    (ROW % 32 < 2) | (COLUMN % 32 < 2),
    (COLUMN % 32 < 4) | ((ROW + 64 * (COLUMN // 32 % 2)) % 128 < 4),
)


def paint(surfaces: Sequence[str], room_names: Sequence[str], seed: int) -> np.ndarray:
    """Draw the named surfaces: BGR uint8 [K, TEXTURE_SIZE, TEXTURE_SIZE, 3]; the same seed paints the same pixels."""
    walls = _wall_styles(room_names, seed)
    painted = []
    for surface in surfaces:
        kind, _, rest = surface.partition(":")
        # A surface has its own stream of random numbers: a picture more changes no other.
        rng = np.random.default_rng([seed, 2, *surface.encode()])
        if kind == "wall":
            painted.append(_faded(rng, _two_tone(*walls[rest])))
        elif kind in ("floor", "ceiling"):
            painted.append(_floor(rng, list(room_names).index(rest), kind))
        else:
            painted.append(PAINTERS[kind](rng, rest))
    return np.stack(painted)


def _wall_styles(room_names: Sequence[str], seed: int) -> dict[str, tuple]:
    """Pattern and two colours of every wall. The four walls of a room have four patterns, two dark and two light;
    rooms that share a pattern have it at the other brightness, the corridor lies between: no two walls look alike."""
    rng = np.random.default_rng([seed, 3])
    order = rng.permutation(len(PATTERNS))
    styles = {}
    for index, room in enumerate(room_names):
        tint = rng.uniform(0.85, 1.15, 3)
        for place, side in enumerate(SIDES):
            pattern = PATTERNS[order[(4 * index + place) % len(PATTERNS)]]
            light = (place + index // 2) % 2 == 0
            ground = rng.uniform(165, 195) if light else rng.uniform(60, 90)
            if room == CORRIDOR:
                ground = rng.uniform(125, 150)
            figure = ground + (-1 if light else 1) * rng.uniform(60, 80)
            styles[f"{room}:{side}"] = (pattern, ground * tint, figure * tint)
    return styles


def _two_tone(pattern: np.ndarray, ground: np.ndarray, figure: np.ndarray) -> np.ndarray:
    picture = np.where(pattern[..., None], figure, ground)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _faded(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    """Light that changes along the wall, so that the same pattern a metre on is not the same picture."""
    left, middle, right = rng.permutation([0.75, 0.95, 1.15])
    light = np.interp(np.arange(SIZE), [0, SIZE / 2, SIZE], [left, middle, right])
    return np.clip(np.rint(picture * light[None, :, None]), 0, 255).astype(np.uint8)


def _floor(rng: np.random.Generator, index: int, kind: str) -> np.ndarray:
    if kind == "ceiling":
        return _plain(rng.uniform(200, 250), rng)
    ground = (70, 170, 110, 140, 95)[index % 5] * rng.uniform(0.85, 1.15, 3)
    return _two_tone(FLOOR_PATTERNS[index % 5], ground, ground * (0.65 if index % 2 else 1.5))


def _plain(brightness: float, rng: np.random.Generator) -> np.ndarray:
    return np.broadcast_to((brightness * rng.uniform(0.9, 1.1, 3)).clip(0, 255).astype(np.uint8), (SIZE, SIZE, 3))


def _furniture_front(rng: np.random.Generator, name: str) -> np.ndarray:
    """Drawers, doors or shelves: a grid of dark outlines on one colour."""
    colour = rng.uniform(50, 200) * rng.uniform(0.8, 1.2, 3)
    picture = np.broadcast_to(np.clip(colour, 0, 255), (SIZE, SIZE, 3)).copy()
    rows, columns = rng.integers(2, 5), rng.integers(2, 5)
    lines = (ROW % (SIZE // rows) < 5) | (COLUMN % (SIZE // columns) < 5)
    if name == "bookcase":
        picture *= rng.uniform(0.4, 1.6, SIZE // 8).repeat(8)[None, :, None]
        lines = ROW % 42 < 5
    picture[lines] *= 0.4
    return np.clip(picture, 0, 255).astype(np.uint8)


def _picture(rng: np.random.Generator, name: str) -> np.ndarray:
    """A framed abstract painting: a few discs and bars."""
    picture = np.ascontiguousarray(_plain(rng.uniform(40, 220), rng))
    for _ in range(4):
        colour = tuple(int(c) for c in rng.integers(0, 256, 3))
        x, y, size = (int(v) for v in rng.integers((0, 0, 16), (SIZE, SIZE, 52)))
        if rng.random() < 0.5:
            cv2.circle(picture, (x, y), size, colour, -1)
        else:
            cv2.rectangle(picture, (x - size, y - size // 2), (x + size, y + size // 2), colour, -1)
    cv2.rectangle(picture, (0, 0), (SIZE - 1, SIZE - 1), (20, 20, 20), 10)
    return picture


def _window(rng: np.random.Generator, name: str) -> np.ndarray:
    """Bright sky over a darker ground behind a white cross."""
    picture = np.ascontiguousarray(np.broadcast_to(np.array([255, 245, 235], np.uint8), (SIZE, SIZE, 3)))
    picture[int(rng.uniform(70, 100)) :] = (90, 140, 110)
    cv2.line(picture, (SIZE // 2, 0), (SIZE // 2, SIZE), (255, 255, 255), 8)
    cv2.rectangle(picture, (0, 0), (SIZE - 1, SIZE - 1), (250, 250, 250), 8)
    return picture


def _label(rng: np.random.Generator, name: str) -> np.ndarray:
    """A product label: two strong colours in a pattern of its own, and the first words of the name."""
    hue = np.array([[[int(rng.integers(0, 180)), int(rng.integers(120, 256)), int(rng.integers(90, 256))]]], np.uint8)
    first = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0].astype(float)
    picture = _two_tone(PATTERNS[rng.integers(len(PATTERNS))], first, 255 - first).copy()
    cv2.rectangle(picture, (8, 44), (SIZE - 9, 84), (245, 245, 245), -1)
    for line, word in enumerate(name.split("_")[:2]):
        cv2.putText(picture, word[:8].upper(), (12, 61 + 19 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (10, 10, 10), 2)
    return picture


PAINTERS = {
    "front": _furniture_front,
    "top": lambda rng, name: _plain(rng.uniform(90, 220), rng),
    "picture": _picture,
    "window": _window,
    "object": _label,
    "screen": lambda rng, name: _two_tone(
        (ROW > 8) & (ROW < 116) & (COLUMN > 6) & (COLUMN < 120), np.full(3, 70.0), np.full(3, 20.0)
    ),
    "plain": lambda rng, name: _plain(float(name), rng),
}
