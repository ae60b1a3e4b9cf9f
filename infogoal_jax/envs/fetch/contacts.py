"""Contact points of the few pairs of bodies that matter in the Fetch tasks, cheap enough for thousands of robots.

A contact is a point, a normal (from the first body to the second) and a distance, negative when the bodies overlap.
Pairs of one kind are computed side by side: each component of a vector here is an array [P] over pairs.

Boxes meet face to face, with four points; edge against edge is taken for the nearest face. The points of MuJoCo's box
against box differ little where it matters (fingers, cube and table are seldom tilted), and its search over fifteen axes
would cost more than all the rest.
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from infogoal_jax.envs.fetch.vectors import Rotation, Vector

FAR = 1.0
"""Distance (m) of a point that touches nothing."""
CORNERS = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]], np.float32)
"""The corners of a face, along its two edges."""


@flax.struct.dataclass
class Contacts:
    """n contact points: distance [n] (m), position (m, world) and normal, vectors of arrays [n]."""

    distance: jax.Array
    position: Vector
    normal: Vector


@flax.struct.dataclass
class Box:
    """P boxes: center (m), rotation, and half edges along the box's axes (m), each of arrays [P]."""

    center: Vector
    rotation: Rotation
    half: Vector


@flax.struct.dataclass
class Capsule:
    """P capsules: center, half axis from the center to an end, and radius, in m. A sphere has a half axis of zero."""

    center: Vector
    half: Vector
    radius: jax.Array


def block(corners: np.ndarray) -> Box:
    """The upright box between its lowest and its highest corner, [2, 3], as one of P = 1."""
    upright = Rotation.of(np.eye(3, dtype=np.float32)[None])
    return Box(Vector.of(corners.mean(0, keepdims=True)), upright, Vector.of((corners[1:] - corners[:1]) / 2))


FLOOR = block(np.float32([[-100, -100, -20], [100, 100, 0]]))


def box_on_box(first: Box, second: Box, handicap: Vector) -> Contacts:
    """Four contacts of each of P pairs of boxes, on the face of either box that separates the two most: arrays [4 P],
    first those of all pairs' first corners.

    handicap: taken from the separation (m) along the first box's axes, to keep some of its faces out (or, if negative,
    in).
    """
    of_first, of_second = separations(first, second)
    of_first = of_first - handicap
    on_first = largest(of_first) >= largest(of_second)
    reference, incident = chosen(on_first, first, second), chosen(on_first, second, first)
    found = face_contacts(reference, incident, chosen(on_first, of_first, of_second))
    return found.replace(normal=found.normal * jnp.tile(jnp.where(on_first, 1.0, -1.0), 4))


def separations(first: Box, second: Box) -> tuple[Vector, Vector]:
    """How far each box is from each pair of the other's faces (m), by the axes of the first and of the second: negative
    where they overlap along that axis."""
    offset = second.center - first.center
    axes, others = ((box.rotation.x, box.rotation.y, box.rotation.z) for box in (first, second))
    along = [[jnp.abs(axis.dot(other)) for other in others] for axis in axes]

    def separation(reference: Box, half: Vector, turned: list) -> Vector:
        reach = Vector(*(x * half.x + y * half.y + z * half.z for x, y, z in turned))
        return absolute(reference.rotation.inverse(offset)) - reference.half - reach

    return separation(first, second.half, along), separation(second, first.half, list(zip(*along, strict=True)))


def face_contacts(reference: Box, incident: Box, separations: Vector) -> Contacts:
    """Four contacts of each incident box with one face of its reference box: of those along the axis of largest
    separation, the one that looks at it.

    The corners of the incident box's facing side, moved onto the reference face where they stick out, are the points. A
    point that leaves the incident side by being moved does not touch. So a box rests as far as the table reaches, and
    tips over its edge.
    """
    normal, (across, along), depth, (width, length) = face(reference, separations)
    apart = incident.center - reference.center
    side = jnp.where(normal.dot(apart) < 0, -1.0, 1.0)
    facing, edges, thickness, spans = face(incident, absolute(incident.rotation.inverse(normal)))
    outward = facing * -(side * jnp.sign(normal.dot(facing)))
    middle = apart + outward * thickness
    edges = [edge * half for edge, half in zip(edges, spans, strict=True)]

    # From here on by the reference face's axes, with the four corners: [4, P] or, where they share it, [1, P].
    normal, across, along, depth, width, length, side, outward, middle, edges, spans, center = jax.tree.map(
        lambda leaf: leaf[None],
        (normal, across, along, depth, width, length, side, outward, middle, edges, spans, reference.center),
    )
    up, right, ahead = (axis.dot(middle) for axis in (normal, across, along))
    tilt, lean, slope = (axis.dot(outward) for axis in (normal, across, along))
    places = [[axis.dot(edge) for axis in (normal, across, along)] for edge in edges]
    corner = [
        sum(sign[:, None] * place[axis] for sign, place in zip(CORNERS.T, places, strict=True)) for axis in (1, 2)
    ]
    moved = jnp.clip(right + corner[0], -width, width), jnp.clip(ahead + corner[1], -length, length)
    offset = moved[0] - right, moved[1] - ahead
    rise = -(offset[0] * lean + offset[1] * slope) / jnp.where(jnp.abs(tilt) < 0.1, -0.1 * side, tilt)
    # Where the moved points lie on the incident side, in half edges.
    spread = [
        (rise * place[0] + offset[0] * place[1] + offset[1] * place[2]) / span**2
        for place, span in zip(places, spans, strict=True)
    ]
    within = (jnp.abs(spread[0]) < 1.01) & (jnp.abs(spread[1]) < 1.01)
    distance = jnp.where(within, side * (up + rise) - depth, FAR)
    normal = normal * side
    position = center + normal * (depth + 0.5 * distance) + across * moved[0] + along * moved[1]
    return jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, distance.shape).reshape(-1), Contacts(distance, position, normal)
    )


def face(box: Box, scores: Vector) -> tuple[Vector, list[Vector], jax.Array, list[jax.Array]]:
    """The box's axis of the highest score and the two after it in turn, and the half edges along them."""
    axes, halves = (box.rotation.x, box.rotation.y, box.rotation.z), (box.half.x, box.half.y, box.half.z)
    first = (scores.x >= scores.y) & (scores.x >= scores.z)
    second = ~first & (scores.y >= scores.z)
    turned = [(axes[turn:] + axes[:turn], halves[turn:] + halves[:turn]) for turn in range(3)]
    (normal, *edges), (depth, *spans) = chosen(first, turned[0], chosen(second, turned[1], turned[2]))
    return normal, edges, depth, spans


def chosen(condition: jax.Array, first, second):
    """Select the first tree where the condition [P] holds, else the second."""
    return jax.tree.map(lambda *choice: jax.lax.select(*jnp.broadcast_arrays(condition, *choice)), first, second)


def absolute(vector: Vector) -> Vector:
    """The absolute values of the components."""
    return jax.tree.map(jnp.abs, vector)


def largest(vector: Vector) -> jax.Array:
    """The largest of the components."""
    return jnp.maximum(jnp.maximum(vector.x, vector.y), vector.z)


def table_under(table: Box, boxes: Box) -> tuple[Box, Vector]:
    """The table for each of the boxes, and the handicap that lets a box meet its top, a side or an edge, but never its
    underside."""
    below = jnp.where(boxes.center.z < table.center.z, FAR, 0.0)
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, below.shape), table), Vector(
        jnp.zeros_like(below), jnp.zeros_like(below), below
    )


def ground_under(table: Box, boxes: Box) -> tuple[Box, Vector]:
    """The support of each box, and its handicap: the table or, for a box that has fallen off, the floor, which has an
    upper face only."""
    above, handicap = table_under(table, boxes)
    fallen = boxes.center.z < 0.5 * table.half.z
    nothing = jnp.zeros_like(handicap.z)
    return chosen(fallen, FLOOR, above), chosen(fallen, Vector(nothing, nothing, nothing - 1e3 * FAR), handicap)


def capsule_on_capsule(first: Capsule, second: Capsule) -> Contacts:
    """The contacts of P pairs of capsules."""
    offset = second.center - first.center
    aa, bb, ab = first.half.dot(first.half), second.half.dot(second.half), first.half.dot(second.half)
    to_first, to_second = offset.dot(first.half), offset.dot(second.half)
    along = jnp.clip((to_first * bb - to_second * ab) / jnp.maximum(aa * bb - ab * ab, 1e-12), -1.0, 1.0)
    other_along = jnp.clip((along * ab - to_second) / bb, -1.0, 1.0)
    along = jnp.clip((other_along * ab + to_first) / aa, -1.0, 1.0)
    return between_spheres(
        first.center + first.half * along, first.radius, second.center + second.half * other_along, second.radius
    )


def sphere_on_box(box: Box, center: Vector, radius: float) -> Contacts:
    """The contacts of boxes with spheres whose centers lie outside of them."""
    return between_spheres(nearest_in(box, center), 0.0, center, radius)


def nearest_in(box: Box, point: Vector) -> Vector:
    """The nearest point of each box."""
    inside = jax.tree.map(
        lambda value, half: jnp.clip(value, -half, half), box.rotation.inverse(point - box.center), box.half
    )
    return box.center + box.rotation @ inside


def box_on_puck(box: Box, center: Vector, axis: Vector, radius: float, half_height: float) -> Contacts:
    """The contacts of boxes with a flat cylinder: where a box comes nearest to its center, on the rim or on the lid."""
    nearest = nearest_in(box, center)
    between = center - nearest
    high = between.dot(axis)
    outward = between - axis * high
    length = jnp.sqrt(outward.dot(outward) + 1e-12)
    on_lid = jnp.abs(high) - half_height > length - radius
    distance = jnp.where(on_lid, jnp.abs(high) - half_height, length - radius)
    normal = chosen(on_lid, axis * jnp.sign(high), outward * (1 / length))
    return Contacts(distance, nearest + normal * (0.5 * distance), normal)


def between_spheres(center: Vector, radius, other_center: Vector, other_radius) -> Contacts:
    """The contacts of pairs of spheres."""
    between = other_center - center
    length = jnp.sqrt(between.dot(between) + 1e-12)
    normal = between * (1 / length)
    distance = length - radius - other_radius
    return Contacts(distance, center + normal * (radius + 0.5 * distance), normal)


def tangents(normal: Vector) -> tuple[Vector, Vector]:
    """The two tangents of each contact: MuJoCo's, on which the friction pyramid depends."""
    upright = jnp.abs(normal.y) < 0.5
    along = jnp.where(upright, normal.y, normal.z)
    first = Vector(
        -normal.x * along,
        jnp.where(upright, 1.0, 0.0) - normal.y * along,
        jnp.where(upright, 0.0, 1.0) - normal.z * along,
    )
    first = first * (1 / first.norm())
    return first, normal.cross(first)
