"""First-person pictures of a world made of axis-aligned boxes, drawn with numpy alone (no OpenGL).

The synthetic house (house.py) needs pictures that differ from place to place and honest bounding boxes: what a wall,
a table or another object hides must not be annotated. Every box is tested against the rays of its own screen rectangle
only (slab test with a depth buffer); texture and shade are then looked up once for the whole picture.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

TEXTURE_SIZE = 128
LEVELS = (
    6  # a texture is stored at full size and averaged over 2, 4, ... 32 texels, so that far patterns do not flicker
)
NEAR = 0.05
# How bright the faces -x, +x, -y, +y, -z, +z are: a light from one side makes corners visible in grey.
FACE_LIGHT = np.array([0.80, 0.95, 0.88, 1.0, 0.70, 1.0], np.float32)
EDGES = np.array([(i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if i < i ^ bit])


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks horizontally. Lengths in metres, the field of view in degrees, sizes in pixels."""

    width: int = 160
    height: int = 90
    horizontal_field_of_view: float = 80.0
    above_floor: float = 1.2

    @property
    def focal_length(self) -> float:
        """Focal length in pixels."""
        return self.width / 2 / np.tan(np.radians(self.horizontal_field_of_view) / 2)


@dataclasses.dataclass(frozen=True)
class Boxes:
    """N boxes. `lower`, `upper` float32 [N, 3] metres; `texture` int [N, 6], one index a face (-x, +x, -y, +y, -z, +z);
    `tile` float32 [N, 2], metres that one copy of the texture covers (0: stretched over the face);
    `instance` int [N], the object that a box belongs to (0: none). All textures have one size."""

    lower: np.ndarray
    upper: np.ndarray
    texture: np.ndarray
    tile: np.ndarray
    instance: np.ndarray


@dataclasses.dataclass(frozen=True)
class Sighting:
    """Visible part of an object: box in pixels (maxima exclusive), how many pixels show it, and which fraction of its
    whole outline they are."""

    instance: int
    box: tuple[int, int, int, int]
    pixels: int
    visible_fraction: float


def texture_levels(textures: np.ndarray) -> np.ndarray:
    """Blurred copies for distant surfaces: uint8 [K, size, size, 3] to [LEVELS, K, size, size, 3]."""
    levels = [textures]
    for level in range(1, LEVELS):
        size = TEXTURE_SIZE >> level
        small = (cv2.resize(texture, (size, size), interpolation=cv2.INTER_AREA) for texture in textures)
        levels.append(np.stack([s.repeat(1 << level, 0).repeat(1 << level, 1) for s in small]))
    return np.stack(levels)


def camera_axes(heading: float) -> np.ndarray:
    """Right, down and forward of a camera with this heading (radians, counter-clockwise from x): float32 [3, 3]."""
    cosine, sine = np.cos(heading), np.sin(heading)
    return np.array([[sine, -cosine, 0], [0, 0, -1], [cosine, sine, 0]], np.float32)


def rays(camera: Camera, heading: float) -> np.ndarray:
    """Ray through the middle of each pixel, scaled to depth 1: float32 [3, height, width]."""
    column = (np.arange(camera.width, dtype=np.float32) + 0.5 - camera.width / 2) / camera.focal_length
    row = (np.arange(camera.height, dtype=np.float32) + 0.5 - camera.height / 2) / camera.focal_length
    right, down, forward = camera_axes(heading)[:, :, None, None]
    direction = forward + column[None, None, :] * right + row[None, :, None] * down
    return np.where(np.abs(direction) < 1e-6, np.float32(1e-6), direction).astype(np.float32)


def _project(boxes: Boxes, camera: Camera, position: np.ndarray, heading: float) -> tuple[np.ndarray, np.ndarray]:
    """Outline points of each box in pixels, cut off at the near plane: [N, 20, 2], and which of them count: [N, 20]."""
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    corners = np.where(bits, boxes.upper[:, None], boxes.lower[:, None]) - position  # [N, 8, 3]
    points = corners @ camera_axes(heading).T
    first, second = points[:, EDGES[:, 0]], points[:, EDGES[:, 1]]
    crosses = (first[..., 2] > NEAR) != (second[..., 2] > NEAR)
    rise = np.where(crosses, second[..., 2] - first[..., 2], 1)
    cut = first + ((NEAR - first[..., 2]) / rise)[..., None] * (second - first)
    counts = np.concatenate([points[..., 2] > NEAR, crosses], 1)
    points = np.concatenate([points, cut], 1)
    depth = np.where(counts, np.maximum(points[..., 2], NEAR), 1)[..., None]
    middle = np.array([camera.width / 2, camera.height / 2], np.float32)
    return points[..., :2] / depth * np.float32(camera.focal_length) + middle, counts


def render(
    boxes: Boxes, levels: np.ndarray, camera: Camera, position: np.ndarray, heading: float, directions: np.ndarray
) -> tuple[np.ndarray, list[Sighting]]:
    """Draw one picture.

    `position` float32 [3] metres; `heading` radians; `directions` = rays(camera, heading), passed in because a
    house looks in the same twelve directions from every node; `levels` from texture_levels.
    Returns a BGR picture uint8 [height, width, 3] and the objects in it.
    """
    outline, counts = _project(boxes, camera, position, heading)
    size = np.array([camera.width, camera.height])
    first = np.where(counts[..., None], outline, np.inf).min(1)
    last = np.where(counts[..., None], outline, -np.inf).max(1)
    first = np.clip(np.floor(first), 0, size)
    last = np.clip(np.ceil(last), 0, size)
    inside = counts.any(1) & (last > first).all(1)
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    nearest = np.zeros((camera.height, camera.width), np.int32)
    face = np.zeros((camera.height, camera.width), np.int8)
    inverse = 1 / directions
    to_lower, to_upper = boxes.lower - position, boxes.upper - position
    for box in np.flatnonzero(inside):
        (left, top), (right, bottom) = first[box].astype(int), last[box].astype(int)
        window = (slice(top, bottom), slice(left, right))
        slope = inverse[(slice(None), *window)]
        one, other = to_lower[box, :, None, None] * slope, to_upper[box, :, None, None] * slope
        entry, leave = np.minimum(one, other), np.maximum(one, other)
        entering = entry.max(0)
        hit = (entering <= leave.min(0)) & (entering > NEAR / 2) & (entering < depth[window])
        if hit.any():
            np.copyto(depth[window], entering, where=hit)
            np.copyto(nearest[window], np.int32(box), where=hit)
            np.copyto(face[window], entry.argmax(0).astype(np.int8), where=hit)
    picture = _shade(boxes, levels, camera, position, directions, depth, nearest, face)
    instance = np.where(np.isfinite(depth), boxes.instance[nearest], 0)
    return picture, _sightings(boxes, instance, outline, counts)


def _shade(boxes, levels, camera, position, directions, depth, nearest, axis) -> np.ndarray:
    """Texture and light of what each pixel shows: uint8 [height, width, 3]."""
    far = ~np.isfinite(depth)
    reach = np.where(far, 1, depth)
    point = position[:, None, None] + reach * directions  # [3, height, width]
    axis = axis.astype(np.intp)
    along = _at(directions, axis)
    face = 2 * axis + (along < 0)  # a ray that goes up the axis meets the lower face
    across = np.where(axis == 0, 1, 0)
    upward = np.where(axis == 2, 1, 2)
    extent, tile = boxes.upper - boxes.lower, boxes.tile[nearest]

    def coordinate(axes: np.ndarray, repeat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        stretched = repeat == 0
        start = np.where(stretched, boxes.lower[nearest, axes], 0)
        length = np.where(stretched, extent[nearest, axes], repeat)
        return (_at(point, axes) - start) / length, length

    u, width = coordinate(across, tile[..., 0])
    v, _ = coordinate(upward, tile[..., 1])
    u = np.where((face == 0) | (face == 3), -u, u)  # so that printed names read from left to right
    column = np.floor(u * TEXTURE_SIZE).astype(np.int32) % TEXTURE_SIZE
    row = np.floor(-v * TEXTURE_SIZE).astype(np.int32) % TEXTURE_SIZE
    cosine = np.abs(along) / np.linalg.norm(directions, axis=0)
    texels = reach / camera.focal_length / np.maximum(cosine, 0.25) / (width / TEXTURE_SIZE)
    level = np.clip(np.rint(np.log2(np.maximum(texels, 1e-3))), 0, LEVELS - 1).astype(np.int32)
    texel = np.ravel_multi_index((level, boxes.texture[nearest, face], row, column), levels.shape[:-1])
    colour = levels.reshape(-1, 3).take(texel, 0).astype(np.float32)
    light = FACE_LIGHT[face] * (1 / (1 + 0.03 * reach))
    colour = np.where(far[..., None], 0, colour * light[..., None])
    return np.clip(np.rint(colour), 0, 255).astype(np.uint8)


def _at(values: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Of values [3, height, width] those of the axis [height, width] that each pixel asks for: [height, width]."""
    return values.reshape(-1).take(axis * axis.size + np.arange(axis.size).reshape(axis.shape))


def _sightings(boxes: Boxes, instance: np.ndarray, outline: np.ndarray, counts: np.ndarray) -> list[Sighting]:
    """Every object with visible pixels. The whole outline is the projected hull of its boxes, also outside the
    frame."""
    sightings = []
    for number in np.unique(instance[instance > 0]):
        rows, columns = np.nonzero(instance == number)
        whole = 0.0
        for box in np.flatnonzero(boxes.instance == number):
            points = outline[box][counts[box]].astype(np.float32)
            whole += cv2.contourArea(cv2.convexHull(points)) if len(points) > 2 else 0.0
        box = (int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1)
        sightings.append(Sighting(int(number), box, len(rows), min(1.0, len(rows) / max(whole, 1.0))))
    return sightings
