"""The shape of the arm that holds the cube: convex solids, each moving with one link, where they are at zero joints.
Lengths in metres."""

import dataclasses

import numpy as np

PEDESTAL_HEIGHT = 0.72  # high enough for the outstretched arm to turn below its base
PAINT, CASTING, STEEL = (232, 122, 44), (92, 95, 102), (150, 153, 160)  # RGB: orange shells, grey housings, bare metal


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


def ring(axis: int, at: tuple[float, float, float], half: float | tuple[float, float], corners: int = 20) -> np.ndarray:
    """Outline [corners, 3] across an axis (0 x, 1 y, 2 z): a round one of radius `half`, or a rectangle of these half
    sides with cut corners."""
    if isinstance(half, tuple):
        cut = 0.7
        outline = (
            np.array([(1, cut), (cut, 1), (-cut, 1), (-1, cut), (-1, -cut), (-cut, -1), (cut, -1), (1, -cut)]) * half
        )
    else:
        angle = 2 * np.pi * (np.arange(corners) + 0.5) / corners
        outline = half * np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.array(at) + np.insert(outline, axis, 0, axis=1)
