"""The stickers of a Rubik's cube: a scramble whose orientations look different, and where each sticker lies."""

import numpy as np

CUBE_EDGE = 0.057
STICKER_SHARE = 0.84  # side of a sticker, of a third of the edge


def face_normals() -> np.ndarray:
    """Outward normals of the cube's faces +x -x +y -y +z -z: [6, 3]."""
    return np.kron(np.eye(3), [[1], [-1]])


def cube_quads() -> np.ndarray:
    """Corners of each face's plastic and of its nine stickers (row by row), in edges from the cube's middle: [6, 10, 4,
    3]."""
    return _QUADS


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


_QUADS = np.array([_face_quads(face) for face in range(6)])


def cube_numbers(stickers: np.ndarray, face: int) -> list[int]:
    return [7 * int(face) + 6, *(7 * int(face) + stickers[face].reshape(-1)).tolist()]
