"""A small renderer without OpenGL: rays through a pinhole camera against boxes, capsules, cylinders and ellipsoids,
with soft shadows on level ground.

numpy is fast enough for a handful of shapes: a shape is cast only over the rectangle of the picture that it can cover.
Lengths in m, or in what else a scene is measured in; colours RGB in [0, 1].
"""

import dataclasses

import cv2
import numpy as np

TOWARDS_LIGHT = np.array([0.30, -0.45, 0.84], np.float32) / np.float32(np.linalg.norm([0.30, -0.45, 0.84]))
SUPERSAMPLING = 2
"""Rays along each side of a pixel."""
SHADOW = 0.42
"""Share of the light that a shadow takes away."""
GROUND_COLOUR, SKY_COLOUR = (0.80, 0.81, 0.83), (0.93, 0.945, 0.96)
GOAL, REACHED, INK = (0.90, 0.16, 0.13), (0.10, 0.66, 0.25), (0.27, 0.29, 0.32)
"""Of a goal, of one that is reached, and of words."""
NOTHING, GROUND, TOP = 0, 1, 2
"""What a pixel of the still scene shows, as far as shadows care: no level surface, the ground, the top of the table."""


@dataclasses.dataclass(frozen=True)
class Box:
    """center [3], rotation [3, 3] to the world, half lengths [3]."""

    center: np.ndarray
    rotation: np.ndarray
    half: np.ndarray
    colour: tuple[float, float, float]

    def corners(self) -> np.ndarray:
        """Points whose convex hull holds the shape, [N, 3]."""
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
        return self.center + (signs * self.half) @ self.rotation.T

    def hit(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances [N] along rays [N, 3] (unit vectors; infinite where they miss) and outward normals [N, 3]."""
        start = (origin - self.center) @ self.rotation
        along = rays @ self.rotation
        along = np.where(np.abs(along) < 1e-9, 1e-9, along)
        nearer = (-np.sign(along) * self.half - start) / along
        farther = (np.sign(along) * self.half - start) / along
        axis = nearer.argmax(1)
        distance = nearer.max(1)
        misses = (distance > farther.min(1)) | (distance < 0)
        rows = np.arange(len(rays))
        normal = -np.sign(along[rows, axis])[:, None] * self.rotation.T[axis]
        return np.where(misses, np.inf, distance), normal


@dataclasses.dataclass(frozen=True)
class Capsule:
    """A line from start [3] to end [3], as thick as its radius; a sphere where both are one point."""

    start: np.ndarray
    end: np.ndarray
    radius: float
    colour: tuple[float, float, float]

    def corners(self) -> np.ndarray:
        """Points whose convex hull holds the shape, [N, 3]."""
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * self.radius
        return np.concatenate([self.start + signs, self.end + signs])

    def hit(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `Box.hit`."""
        axis, offset = self.end - self.start, origin - self.start
        length = axis @ axis
        along, across = rays @ axis, rays @ offset
        place = np.zeros(len(rays))
        if length > 1e-12:
            before = axis @ offset
            size = length * (offset @ offset - self.radius**2) - before**2
            distance = first_root(length - along**2, length * across - before * along, size)
            place = np.where(
                np.isfinite(distance), before + np.where(np.isfinite(distance), distance, 0.0) * along, 0.0
            )
        else:
            distance = np.full(len(rays), np.inf)
        beyond = (place <= 0) | (place >= length)
        if beyond.any():  # There the ends are spheres; a ray can only hit the one that it comes to first.
            places = [
                first_root(1.0, rays @ (origin - end), (origin - end) @ (origin - end) - self.radius**2)
                for end in (self.start, self.end)
            ]
            distance = np.where(beyond, np.minimum(*places), distance)
        distance = np.where(np.isfinite(distance), distance, np.inf)
        point = origin + np.where(np.isfinite(distance), distance, 0.0)[:, None] * rays
        share = np.clip((point - self.start) @ axis / max(length, 1e-12), 0.0, 1.0)
        return distance, (point - self.start - share[:, None] * axis) / self.radius


@dataclasses.dataclass(frozen=True)
class Cylinder:
    """center [3], rotation [3, 3] whose last column is the axis, radius, half length."""

    center: np.ndarray
    rotation: np.ndarray
    radius: float
    half: float
    colour: tuple[float, float, float]

    def corners(self) -> np.ndarray:
        """Points whose convex hull holds the shape, [N, 3]."""
        turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        rim = self.radius / np.cos(np.pi / 24) * np.stack([np.cos(turn), np.sin(turn), np.zeros(24)], 1)
        up = np.array([0.0, 0.0, self.half])
        return self.center + np.concatenate([rim + up, rim - up]) @ self.rotation.T

    def hit(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `Box.hit`."""
        start, along = (origin - self.center) @ self.rotation, rays @ self.rotation
        flat = along[:, :2]
        side = first_root((flat**2).sum(1), flat @ start[:2], start[:2] @ start[:2] - self.radius**2)
        side = np.where(
            np.abs(start[2] + np.where(np.isfinite(side), side, 0) * along[:, 2]) <= self.half, side, np.inf
        )
        climb = np.where(np.abs(along[:, 2]) < 1e-9, 1e-9, along[:, 2])
        lid = (-np.sign(climb) * self.half - start[2]) / climb
        on_lid = (lid > 0) & (((start[:2] + lid[:, None] * flat) ** 2).sum(1) <= self.radius**2)
        lid = np.where(on_lid, lid, np.inf)
        distance = np.minimum(side, lid)
        point = start + np.where(np.isfinite(distance), distance, 0.0)[:, None] * along
        wall = np.concatenate([point[:, :2] / self.radius, np.zeros((len(rays), 1))], 1)
        normal = np.where((lid < side)[:, None], -np.sign(climb)[:, None] * np.array([0.0, 0.0, 1.0]), wall)
        return distance, normal @ self.rotation.T


class Ellipsoid(Box):
    """The ellipsoid that touches all sides of the box."""

    def hit(self, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `Box.hit`."""
        start, along = (origin - self.center) @ self.rotation / self.half, rays @ self.rotation / self.half
        distance = first_root((along**2).sum(1), along @ start, start @ start - 1.0)
        point = start + np.where(np.isfinite(distance), distance, 0.0)[:, None] * along
        normal = (point / self.half) @ self.rotation.T
        return distance, normal / np.linalg.norm(normal, axis=1, keepdims=True)


Shape = Box | Capsule | Cylinder | Ellipsoid


def first_root(square: np.ndarray, half_linear: np.ndarray, constant: float | np.ndarray) -> np.ndarray:
    """The smaller root of square x^2 + 2 half_linear x + constant, infinite where there is none ahead."""
    discriminant = half_linear**2 - square * constant
    root = (-half_linear - np.sqrt(np.maximum(discriminant, 0.0))) / np.maximum(square, 1e-12)
    return np.where((discriminant >= 0) & (root > 0), root, np.inf)


def direction(around: float, above: float) -> np.ndarray:
    """The unit vector [3] that is turned around the vertical and rises above the ground by so many degrees."""
    around, above = np.radians((around, above))
    return np.array([np.cos(around) * np.cos(above), np.sin(around) * np.cos(above), np.sin(above)])


class Camera:
    """A pinhole camera at `position`, turned to `target` [3], with z up; size: pixels (height, width); view: angle of
    its height, in degrees."""

    def __init__(self, position, target, size: tuple[int, int], view: float = 38.0):
        self.position, self.size = np.asarray(position, float), size
        self.height, self.width = (SUPERSAMPLING * side for side in size)
        forward = np.asarray(target, float) - self.position
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right = right / np.linalg.norm(right)
        self.axes = np.stack([right, np.cross(forward, right), forward])  # To the right, down, ahead.
        self.focus = self.height / 2 / np.tan(np.radians(view) / 2)
        rows, columns = np.mgrid[: self.height, : self.width] + 0.5
        self.rays = (
            np.stack(
                [(columns - self.width / 2) / self.focus, (rows - self.height / 2) / self.focus, np.ones(rows.shape)],
                -1,
            )
            @ self.axes
        )
        self.rays = (self.rays / np.linalg.norm(self.rays, axis=-1, keepdims=True)).astype(np.float32)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Columns and rows of the supersampled picture, [N, 2], of points [N, 3] ahead of the camera."""
        seen = (points - self.position) @ self.axes.T
        return seen[:, :2] / np.maximum(seen[:, 2:], 0.05) * self.focus + [self.width / 2, self.height / 2]

    def rectangle(self, shape: Shape) -> tuple[slice, slice]:
        """Rows and columns that the shape can cover."""
        places = self.project(shape.corners())
        low = np.clip(np.floor(places.min(0)), 0, [self.width, self.height]).astype(int)
        high = np.clip(np.ceil(places.max(0)), 0, [self.width, self.height]).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])


@dataclasses.dataclass(frozen=True)
class Picture:
    """Supersampled: colour [H, W, 3], depth [H, W] along the rays, surface [H, W]: NOTHING, GROUND or TOP."""

    colour: np.ndarray
    depth: np.ndarray
    surface: np.ndarray

    def copy(self) -> "Picture":
        """A copy to draw on."""
        return Picture(self.colour.copy(), self.depth.copy(), self.surface.copy())


def shaded(colour, normal: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Light from above and from the sky, and a slight gloss: colours [N, 3]."""
    light = np.maximum(normal @ TOWARDS_LIGHT, 0.0)
    sky = 0.5 + 0.5 * normal[:, 2]
    gloss = np.maximum(normal @ TOWARDS_LIGHT * 2 * -(rays * normal).sum(1) + rays @ TOWARDS_LIGHT, 0.0) ** 24
    return np.clip(np.asarray(colour) * (0.33 + 0.22 * sky + 0.5 * light)[:, None] + 0.12 * gloss[:, None], 0.0, 1.0)


def empty_picture(camera: Camera) -> Picture:
    """The ground at height 0, which fades into the sky with the distance."""
    fall = np.minimum(camera.rays[..., 2], -1e-6)
    distance = -camera.position[2] / fall
    nearness = np.exp(-np.maximum(distance - 2.0, 0.0) / 1.6)[..., None]
    colour = (nearness * GROUND_COLOUR + (1 - nearness) * SKY_COLOUR).astype(np.float32)
    return Picture(colour, distance, np.where(distance < 30, GROUND, NOTHING).astype(np.uint8))


def cast(picture: Picture, camera: Camera, shape: Shape, top: bool = False) -> None:
    """Draw a shape into the picture, where nothing is in front of it. top: its upper side receives shadows as TOP."""
    area = camera.rectangle(shape)
    rays = camera.rays[area].reshape(-1, 3)
    if not len(rays):
        return
    distance, normal = shape.hit(camera.position, rays)
    seen = distance < picture.depth[area].ravel()
    place = seen.reshape(picture.depth[area].shape)
    picture.colour[area][place] = shaded(shape.colour, normal[seen], rays[seen])
    picture.depth[area][place] = distance[seen]
    picture.surface[area][place] = np.where(normal[seen, 2] > 0.99, TOP, NOTHING) if top else NOTHING


def cast_shadows(picture: Picture, camera: Camera, shapes: list[Shape], heights: dict[int, float]) -> None:
    """Darken the level surfaces of these heights (m) where the shapes keep the light off."""
    for surface, height in heights.items():
        mask = np.zeros(picture.depth.shape, np.uint8)
        for shape in shapes:
            points = shape.corners() if not isinstance(shape, Capsule) else rounded(shape)
            if points[:, 2].max() < height:
                continue
            rise = np.maximum(points[:, 2:] - height, 0.0)
            ground = points - rise * TOWARDS_LIGHT / TOWARDS_LIGHT[2]
            hull = cv2.convexHull(camera.project(ground).astype(np.float32))
            cv2.fillConvexPoly(mask, np.round(hull * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
        soft = cv2.GaussianBlur(mask, (0, 0), camera.height / 240)
        dark = (picture.surface == surface) & (soft > 0)
        picture.colour[dark] *= 1 - np.float32(SHADOW / 255) * soft[dark][:, None]


def rounded(capsule: Capsule) -> np.ndarray:
    """Points on the capsule's outline as seen from the light, [N, 3]."""
    side = np.cross(TOWARDS_LIGHT, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    turn = np.linspace(0, 2 * np.pi, 16, endpoint=False)[:, None]
    circle = capsule.radius * (np.cos(turn) * side + np.sin(turn) * np.cross(TOWARDS_LIGHT, side))
    return np.concatenate([capsule.start + circle, capsule.end + circle])


def cast_marker(picture: Picture, camera: Camera, sphere: Capsule, opacity: float, hidden_opacity: float) -> None:
    """Draw a translucent marker, which is also visible through shapes in front of it."""
    area = camera.rectangle(sphere)
    rays = camera.rays[area].reshape(-1, 3)
    distance, normal = sphere.hit(camera.position, rays)
    depth = picture.depth[area].ravel()
    share = np.where(distance < depth, opacity, np.where(np.isfinite(distance), hidden_opacity, 0.0))[:, None]
    before = picture.colour[area]
    picture.colour[area] = (share * shaded(sphere.colour, normal, rays) + (1 - share) * before.reshape(-1, 3)).reshape(
        before.shape
    )


def developed(picture: Picture, camera: Camera) -> np.ndarray:
    """Average the rays of each pixel: the picture as uint8 [H, W, 3]."""
    small = cv2.resize(picture.colour, camera.size[::-1], interpolation=cv2.INTER_AREA)
    return np.round(255 * np.clip(small, 0.0, 1.0)).astype(np.uint8)


def write_words(frame: np.ndarray, words: str, colour) -> None:
    """Write a line of text at the lower left."""
    scale = frame.shape[0] / 900
    place = (round(24 * scale), frame.shape[0] - round(26 * scale))
    cv2.putText(
        frame,
        words,
        place,
        cv2.FONT_HERSHEY_SIMPLEX,
        scale,
        tuple(255 * part for part in colour),
        max(1, round(2 * scale)),
        cv2.LINE_AA,
    )
