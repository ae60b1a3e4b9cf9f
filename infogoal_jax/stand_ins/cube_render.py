"""Pictures of a six-axis arm that holds a Rubik's cube, with the enlarged cube in the lower left, drawn with OpenCV and
numpy (no OpenGL).

Every surface is flat and has a number. A posture of the arm is drawn once as an image of surface numbers with a depth
buffer; the cube is then set into it, and the light turns numbers into colours. So the 24 turns of joint 6, and any
light, cost one copy and one look-up each. Lengths in metres. Pictures are drawn four times larger and averaged down.
"""

import dataclasses

import cv2
import numpy as np

from infogoal_jax.stand_ins.cube_shapes import (
    CUBE_EDGE,
    CUBE_QUADS,
    PEDESTAL_HEIGHT,
    Part,
    arm,
    cube_numbers,
    face_normals,
    scramble,
)

OVERSAMPLING = 4
INSET_SHARE = 0.5  # of the picture's side
INSET_DISTANCE = 6.0  # of the inset's own camera from the cube's middle, in edges
SHOULDER = np.array([0, 0, 0.3991])
SHIFT = 4  # binary digits of a pixel that OpenCV's polygons keep

WHITE, YELLOW, RED, ORANGE, BLUE, GREEN = (
    (240, 240, 240),
    (250, 225, 20),
    (190, 15, 35),
    (255, 120, 0),
    (20, 75, 215),
    (0, 150, 65),
)
# RGB, each opposite the next one on a solved cube
STICKER_COLOURS = np.array([WHITE, YELLOW, RED, ORANGE, BLUE, GREEN], float)
PLASTIC = (24, 24, 26)

# Surface numbers: 7 for each face of the cube (six colours and the plastic), then the inset's two, the room's, the
# arm's.
BACKDROP, BORDER = 42, 43
FLOOR, FLOOR_SHADOW, LEFT_WALL, RIGHT_WALL, STRIPE = 44, 45, 46, 47, 48
FIRST_OF_ARM = 49
NOTHING = 65535


@dataclasses.dataclass(frozen=True)
class Scene:
    """What a seed fixes: the camera, the room, the cube's stickers.

    size: pixels of the finished picture.
    eye: [3].
    axes: [3, 3], rows right, down, forward.
    focal, centre: a number and [2], in pixels of the large picture.
    room: uint16 [L, L], surface numbers of the empty room, L = 4 size.
    colours, normals: [F, 3] RGB, and [F, 3], of all surfaces (those that move: at zero joints).
    stickers: int [6, 3, 3], colour number, faces +x -x +y -y +z -z.
    parts: of the arm.
    """

    size: int
    eye: np.ndarray
    axes: np.ndarray
    focal: float
    centre: np.ndarray
    room: np.ndarray
    colours: np.ndarray
    normals: np.ndarray
    stickers: np.ndarray
    parts: tuple[Part, ...]

    def project(self, points: np.ndarray) -> np.ndarray:
        """World points [..., 3] to pixels [..., 2] of the large picture."""
        view = (points - self.eye) @ self.axes.T
        return self.focal * view[..., :2] / view[..., 2:] + self.centre


@dataclasses.dataclass(frozen=True)
class Light:
    """Direction towards the light [..., 3], unit length, and its colour times brightness [..., 3], 1 for plain white
    light."""

    direction: np.ndarray
    colour: np.ndarray


@dataclasses.dataclass(frozen=True)
class Posture:
    """The arm without its cube: uint16 [L, L] surface numbers, [L, L] inverse depth (0: the room), normals [F, 3] of
    all surfaces."""

    surface: np.ndarray
    inverse_depth: np.ndarray
    normals: np.ndarray


def scene(seed: int, size: int) -> Scene:
    """Room, camera and stickers of a seed."""
    random = np.random.default_rng([seed, 0])
    azimuth, elevation = np.radians(random.uniform(-48, -32)), np.radians(random.uniform(17, 25))
    distance = random.uniform(1.95, 2.15)
    backwards = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
    axes = np.stack([right, np.cross(-backwards, right), -backwards])
    large = size * OVERSAMPLING
    # The shoulder stands right of and above the middle, because the inset hides the lower left.
    view = {
        "eye": SHOULDER + distance * backwards,
        "axes": axes,
        "focal": 0.64 * large * distance,
        "centre": large * np.array([0.57, 0.45]),
    }
    parts = arm()
    wall, floor, stripe, backdrop = (_muted(random, brightness) for brightness in (205, 150, 120, 190))
    fixed = [PLASTIC] * 42 + [backdrop, (60, 60, 64), floor, floor * 0.72, wall, wall * 0.94, stripe]
    colours = np.concatenate([np.array(fixed, float), *(part.colours for part in parts)])
    colours[:42].reshape(6, 7, 3)[:, :6] = STICKER_COLOURS
    faces = np.repeat(face_normals(), 7, 0)
    still = [backwards, backwards, (0, 0, 1), (0, 0, 1), (1, 0, 0), (0, 1, 0), (1, 0, 0)]
    normals = np.concatenate([faces, np.array(still, float), *(part.normals for part in parts)])
    room = _room(large, random, **view)
    return Scene(size, **view, room=room, colours=colours, normals=normals, stickers=scramble(random), parts=parts)


def lights(seed: int, number: int, scene: Scene) -> Light:
    """One light a frame, [number, 3]: from the camera's side, above; 72 to 112 % bright; from warm to cool white."""
    random = np.random.default_rng([seed, 1])
    towards = -scene.axes[2]
    azimuth = np.arctan2(towards[1], towards[0]) + np.radians(random.uniform(-65, 65, number))
    elevation = np.radians(random.uniform(25, 65, number))
    direction = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1
    )
    warmth, brightness = random.uniform(-1, 1, (number, 1)), random.uniform(0.72, 1.12, (number, 1))
    return Light(direction, brightness * (1 + warmth * np.array([0.10, 0.0, -0.16])))


def draw_posture(scene: Scene, links: np.ndarray) -> Posture:
    """The arm in the room. `links` [7, 4, 4]: how the base and each of the six links moved from where they are at zero
    joints."""
    surface, inverse_depth = scene.room.copy(), np.zeros(scene.room.shape, np.float32)
    normals = scene.normals.copy()
    moved = [part.vertices @ links[part.link, :3, :3].T + links[part.link, :3, 3] for part in scene.parts]
    for vertices in moved:
        # lamps are right above
        shadow = cv2.convexHull(_fixed_point(scene.project(vertices * [1, 1, 0] - [0, 0, PEDESTAL_HEIGHT])))
        patch = np.zeros(surface.shape, np.uint8)
        cv2.fillConvexPoly(patch, shadow, 1, cv2.LINE_8, SHIFT)
        surface[(patch == 1) & (surface == FLOOR)] = FLOOR_SHADOW
    first = FIRST_OF_ARM
    for part, vertices in zip(scene.parts, moved, strict=True):
        turned = part.normals @ links[part.link, :3, :3].T
        normals[first : first + len(turned)] = turned
        pixels = _fixed_point(scene.project(vertices))
        polygons = [(face, [(pixels[corners], first + face)]) for face, corners in enumerate(part.faces)]
        distances = np.array([vertices[corners[0]] - scene.eye for corners in part.faces])
        _draw_convex(scene, surface, inverse_depth, turned, (turned * distances).sum(-1), polygons)
        first += len(turned)
    return Posture(surface, inverse_depth, normals)


def draw(scene: Scene, posture: Posture, cube: np.ndarray, light: Light) -> np.ndarray:
    """The finished picture, RGB uint8 [size, size, 3]. `cube` [4, 4]: orientation and place of the cube's middle."""
    surface, normals = posture.surface.copy(), posture.normals.copy()
    turned = face_normals() @ cube[:3, :3].T
    normals[:42] = np.repeat(turned, 7, 0)
    polygons = [
        (face, list(zip(pixels, cube_numbers(scene.stickers, face), strict=True)))
        for face, pixels in enumerate(
            _fixed_point(scene.project(CUBE_EDGE * CUBE_QUADS @ cube[:3, :3].T + cube[:3, 3]))
        )
    ]
    distance = turned @ (cube[:3, 3] - scene.eye) + CUBE_EDGE / 2
    _draw_convex(scene, surface, posture.inverse_depth, turned, distance, polygons, keep_depth=True)
    side = round(len(surface) * INSET_SHARE)
    surface[-side:, :side] = draw_inset(scene, cube[:3, :3], side)
    colours = _colours(scene, normals, light)
    large = np.take(colours, surface, mode="clip").view(np.uint8).reshape(*surface.shape, 4)
    return cv2.resize(large, (scene.size, scene.size), interpolation=cv2.INTER_AREA)[..., :3]


def draw_inset(scene: Scene, rotation: np.ndarray, side: int) -> np.ndarray:
    """Surface numbers, uint16 [side, side], of the enlarged cube: oriented as the camera sees it, looked at straight,
    with nothing in front of it.

    It depends on the orientation alone, not on where the arm holds the cube, so that every orientation looks the same
    from any posture.
    """
    inset = np.full((side, side), BACKDROP, np.uint16)
    turned = face_normals() @ (scene.axes @ rotation).T
    pixels = _fixed_point(inset_pixels(scene, CUBE_QUADS, rotation, side))
    # A face is seen if the eye, at minus INSET_DISTANCE along the view, is before its plane.
    for face in np.flatnonzero(turned @ [0, 0, -INSET_DISTANCE] > 0.5):
        for quad, number in zip(pixels[face], cube_numbers(scene.stickers, face), strict=True):
            cv2.fillConvexPoly(inset, quad, number, cv2.LINE_8, SHIFT)
    inset[:OVERSAMPLING] = inset[:, -OVERSAMPLING:] = BORDER  # one finished pixel
    return inset


def inset_pixels(scene: Scene, points: np.ndarray, rotation: np.ndarray, side: int) -> np.ndarray:
    """Where points of the cube [..., 3], in edges from its middle, are in an inset of `side` pixels: [..., 2]."""
    view = points @ (scene.axes @ rotation).T
    # the cube's outer sphere fills 94 % of the inset
    focal = 0.47 * side / np.tan(np.arcsin(np.sqrt(3) / 2 / INSET_DISTANCE))
    return focal * view[..., :2] / (view[..., 2:] + INSET_DISTANCE) + side / 2


def _muted(random: np.random.Generator, brightness: float) -> np.ndarray:
    return brightness * random.uniform(0.9, 1.05) * (1 + random.uniform(-0.09, 0.09, 3))


def _room(
    large: int, random: np.random.Generator, eye: np.ndarray, axes: np.ndarray, focal: float, centre: np.ndarray
) -> np.ndarray:
    """Surface numbers of floor and two walls, by one ray a pixel: uint16 [large, large]."""
    column, row = np.meshgrid(np.arange(large) + 0.5, np.arange(large) + 0.5)
    ray = np.stack([(column - centre[0]) / focal, (row - centre[1]) / focal, np.ones_like(row)], -1) @ axes
    left, right = -random.uniform(1.2, 1.6), random.uniform(1.2, 1.6)
    with np.errstate(divide="ignore"):
        reach = (np.array([left, right, -PEDESTAL_HEIGHT]) - eye) / ray
    reach[reach <= 0] = np.inf
    nearest = reach.argmin(-1)
    height = eye[2] + reach[..., 0] * ray[..., 2]
    room = np.array([LEFT_WALL, RIGHT_WALL, FLOOR], np.uint16)[nearest]
    bottom = random.uniform(-0.5, 0.0)
    room[(nearest == 0) & (height > bottom) & (height < bottom + 0.25)] = STRIPE
    return room


def _fixed_point(pixels: np.ndarray) -> np.ndarray:
    """Pixels for OpenCV's polygons, where whole numbers are pixel middles."""
    return np.round((pixels - 0.5) * (1 << SHIFT)).astype(np.int32)


def _draw_convex(scene, surface, inverse_depth, normals, distances, polygons, keep_depth=False) -> None:
    """Set a convex solid into the picture where it is nearest.

    `normals` [F, 3]; `distances` [F], of the faces' planes from the eye along them, negative where the face is seen;
    `polygons`: of each face its number and its polygons [N, 2] (OpenCV's fixed point) with their surface numbers, later
    ones on top.
    """
    seen = [(face, drawn) for face, drawn in polygons if distances[face] < -1e-9]
    corners = np.concatenate([polygon for _, drawn in seen for polygon, _ in drawn[:1]])
    low = np.clip((corners.min(0) >> SHIFT) - 1, 0, len(surface))
    high = np.clip((corners.max(0) >> SHIFT) + 3, 0, len(surface))
    if (low >= high).any():
        return
    patch = np.full((high[1] - low[1], high[0] - low[0]), NOTHING, np.uint16)
    for _, drawn in seen:
        for polygon, number in drawn:
            cv2.fillConvexPoly(patch, polygon - (low << SHIFT).astype(np.int32), number, cv2.LINE_8, SHIFT)
    # Inverse depth is linear in the pixel; of a convex solid's planes that are seen, the farthest is its surface.
    faces = [face for face, _ in seen]
    slope = (normals[faces] / distances[faces][:, None]) @ scene.axes.T  # [seen, 3]
    column = (np.arange(low[0], high[0]) + 0.5 - scene.centre[0]) / scene.focal
    row = (np.arange(low[1], high[1]) + 0.5 - scene.centre[1]) / scene.focal
    plane = slope[:, 0, None, None] * column + slope[:, 1, None, None] * row[:, None] + slope[:, 2, None, None]
    nearness = plane.min(0).astype(np.float32)
    window = (slice(low[1], high[1]), slice(low[0], high[0]))
    nearest = (patch != NOTHING) & (nearness > inverse_depth[window])
    np.copyto(surface[window], patch, where=nearest)
    if not keep_depth:
        np.copyto(inverse_depth[window], nearness, where=nearest)


def _colours(scene: Scene, normals: np.ndarray, light: Light) -> np.ndarray:
    """Colour of each surface in this light (Lambert's law, with more light from above than from below), four bytes in
    one number: uint32 [F]."""
    shade = 0.52 + 0.08 * normals[:, 2] + 0.5 * np.maximum(normals @ light.direction, 0)
    colour = np.zeros((len(shade), 4), np.uint8)
    colour[:, :3] = np.clip(np.rint(scene.colours * light.colour * shade[:, None]), 0, 255)
    return colour.view(np.uint32)[:, 0]
