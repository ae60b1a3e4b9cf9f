"""The shapes that pictures of the cube are made of: the convex solids of the arm, each moving with one link, where they
are at zero joints; and the stickers of the cube that it holds, scrambled so that its orientations look different.
Lengths in metres."""

import dataclasses

import numpy as np

PEDESTAL_HEIGHT = 0.72  # high enough for the outstretched arm to turn below its base
PAINT, CASTING, STEEL = (232, 122, 44), (92, 95, 102), (150, 153, 160)  # RGB: orange shells, grey housings, bare metal
CUBE_EDGE = 0.057
STICKER_SHARE = 0.84  # side of a sticker, of a third of the edge


CORNERS = 20
"""Of a round outline."""


@dataclasses.dataclass(frozen=True)
class Part:
    """A convex solid that moves with one link of the arm, where it is at zero joints: `vertices` [V, 3]; each of the F
    faces lists its vertices; `normals` [F, 3] outwards; `colours` [F, 3] RGB."""

    link: int
    vertices: np.ndarray
    faces: tuple[np.ndarray, ...]
    normals: np.ndarray
    colours: np.ndarray


def arm() -> tuple[Part, ...]:
    """An arm on a pedestal at zero joints, with the joint axes of the ABB IRB 1200-7/0.7 and shells of roughly its
    size."""
    elbow, wrist = 0.7491, 0.7911  # heights of the third axis and of the fourth to sixth
    return (
        prism(
            0,
            ring(2, (0, 0, -PEDESTAL_HEIGHT), (0.13, 0.13)),
            ring(2, (0, 0, -PEDESTAL_HEIGHT + 0.02), (0.13, 0.13)),
            CASTING,
        ),
        prism(0, ring(2, (0, 0, -PEDESTAL_HEIGHT), (0.07, 0.07)), ring(2, (0, 0, -0.02), (0.07, 0.07)), (70, 74, 82)),
        prism(0, ring(2, (0, 0, -0.02), (0.12, 0.12)), ring(2, (0, 0, 0), (0.12, 0.12)), STEEL),
        prism(0, ring(2, (0, 0, 0), 0.1), ring(2, (0, 0, 0.19), 0.085), CASTING),
        prism(1, ring(2, (0, 0, 0.19), 0.085), ring(2, (0, 0, 0.37), 0.07), PAINT),
        prism(1, ring(1, (0, -0.085, 0.3991), 0.085), ring(1, (0, 0.085, 0.3991), 0.085), PAINT, CASTING),
        prism(2, ring(2, (0, 0, 0.3991), (0.066, 0.06)), ring(2, (0, 0, elbow), (0.05, 0.05)), PAINT),
        prism(2, ring(1, (0, -0.098, 0.3991), 0.06), ring(1, (0, 0.098, 0.3991), 0.06), CASTING, STEEL),
        prism(2, ring(1, (0, -0.07, elbow), 0.07), ring(1, (0, 0.07, elbow), 0.07), CASTING, STEEL),
        prism(3, ring(0, (-0.085, 0, wrist), (0.052, 0.045)), ring(0, (0.1, 0, wrist), (0.055, 0.055)), PAINT, CASTING),
        prism(4, ring(0, (0.1, 0, wrist), 0.05), ring(0, (0.33, 0, wrist), 0.036), PAINT),
        prism(5, ring(1, (0.351, -0.042, wrist), 0.042), ring(1, (0.351, 0.042, wrist), 0.042), CASTING, STEEL),
        prism(5, ring(0, (0.351, 0, wrist), 0.034), ring(0, (0.41, 0, wrist), 0.03), PAINT),
        prism(6, ring(0, (0.41, 0, wrist), 0.024), ring(0, (0.433, 0, wrist), 0.024), STEEL),
        prism(6, ring(0, (0.433, 0, wrist), 0.012), ring(0, (0.465, 0, wrist), 0.012), CASTING),
    )


def prism(
    link: int, start: np.ndarray, end: np.ndarray, colour: tuple[int, int, int], cap: tuple[int, int, int] | None = None
) -> Part:
    """Convex solid between two outlines [N, 3] with as many corners; `cap` is the colour of its two ends."""
    number = len(start)
    following = (np.arange(number) + 1) % number
    sides = np.stack([np.arange(number), following, following + number, np.arange(number) + number], -1)
    faces = (*sides, np.arange(number), np.arange(number) + number)
    vertices = np.concatenate([start, end])
    normals = np.array(
        [np.cross(vertices[face[1]] - vertices[face[0]], vertices[face[2]] - vertices[face[1]]) for face in faces]
    )
    outwards = np.array([vertices[face].mean(0) - vertices.mean(0) for face in faces])
    normals *= np.sign((normals * outwards).sum(-1, keepdims=True)) / np.linalg.norm(normals, axis=-1, keepdims=True)
    return Part(link, vertices, faces, normals, np.array([colour] * number + [cap or colour] * 2, float))


def ring(axis: int, at: tuple[float, float, float], half: float | tuple[float, float]) -> np.ndarray:
    """Outline [N, 3] across an axis (0 x, 1 y, 2 z): a round one of radius `half`, or a rectangle of these half
    sides with cut corners."""
    if isinstance(half, tuple):
        cut = 0.7
        outline = (
            np.array([(1, cut), (cut, 1), (-cut, 1), (-1, cut), (-1, -cut), (-cut, -1), (cut, -1), (1, -cut)]) * half
        )
    else:
        angle = 2 * np.pi * (np.arange(CORNERS) + 0.5) / CORNERS
        outline = half * np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.array(at) + np.insert(outline, axis, 0, axis=1)


def face_normals() -> np.ndarray:
    """Outward normals of the cube's faces +x -x +y -y +z -z: [6, 3]."""
    return np.kron(np.eye(3), [[1], [-1]])


def scramble(random: np.random.Generator) -> np.ndarray:
    """Colours int [6, 3, 3] of a solvable, scrambled cube of which no two faces, turned in any way, agree in more than
    five of nine stickers.

    Sticker [face, row, column] is at row - 1 and column - 1 along the two axes that follow the face's own (x, y, z, x,
    y).
    """
    while True:
        place = np.array(
            [_sticker_place(face, row, column) for face in range(6) for row in range(3) for column in range(3)]
        )
        normal = np.repeat(face_normals().astype(int), 9, 0)
        for _ in range(30):
            axis, layer, direction = random.integers(3), random.choice([-1, 1]), random.choice([-1, 1])
            one, other = (axis + 1) % 3, (axis + 2) % 3
            layer = place[:, axis] == layer
            for vectors in (place, normal):
                vectors[layer, one], vectors[layer, other] = (
                    -direction * vectors[layer, other],
                    direction * vectors[layer, one],
                )
        axis = np.abs(normal).argmax(1)
        sticker = np.arange(54)
        face = 2 * axis + (normal[sticker, axis] < 0)
        stickers = np.zeros((6, 3, 3), int)
        stickers[face, place[sticker, (axis + 1) % 3] + 1, place[sticker, (axis + 2) % 3] + 1] = sticker // 9
        if _least_difference(stickers) >= 4:
            return stickers


def _least_difference(stickers: np.ndarray) -> int:
    """Fewest stickers in which two of the 24 views (six faces, four turns) of single faces differ."""
    # mirrored on the faces that look backwards
    outside = [face if number % 2 == 0 else face.T for number, face in enumerate(stickers)]
    views = np.array([np.rot90(face, turn).reshape(-1) for face in outside for turn in range(4)])
    different = (views[:, None] != views).sum(-1)
    return int(different[~np.eye(24, dtype=bool)].min())


def _sticker_place(face: int, row: int, column: int) -> np.ndarray:
    place = np.zeros(3, int)
    place[face // 2], place[(face // 2 + 1) % 3], place[(face // 2 + 2) % 3] = 1 - 2 * (face % 2), row - 1, column - 1
    return place


def _face_quads(face: int) -> np.ndarray:
    normal, one, other = (
        face_normals()[face] / 2,
        np.eye(3)[(face // 2 + 1) % 3] / 3,
        np.eye(3)[(face // 2 + 2) % 3] / 3,
    )
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    middles = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)]
    return np.array(
        [
            normal + 3 * square @ [one, other],
            *(normal + (np.array(at) + STICKER_SHARE * square) @ [one, other] for at in middles),
        ]
    )


CUBE_QUADS = np.array([_face_quads(face) for face in range(6)])
"""Corners of each face's plastic and of its nine stickers (row by row), in edges from the cube's middle: [6, 10, 4,
3]."""


def cube_numbers(stickers: np.ndarray, face: int) -> list[int]:
    return [7 * int(face) + 6, *(7 * int(face) + stickers[face].reshape(-1)).tolist()]
