"""Where bodies touch: contact points of the few pairs that matter in the Fetch tasks, cheap enough for thousands of robots.

A contact is a point, a frame whose first row is the normal (from the first body to the second), and a distance, negative when the bodies overlap.
Boxes meet face to face here, with four points; edge against edge is taken for the nearest face. The points of MuJoCo's box against box differ
little where it
matters (fingers, cube and table are seldom tilted), and its search over fifteen axes would cost more than all the rest.
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

FAR = 1.0
"""Distance (m) of a point that touches nothing."""
FACE_CORNERS = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]], np.float32)
UPRIGHT = np.eye(3, dtype=np.float32)


@flax.struct.dataclass
class Contacts:
    """n contact points: distance [n] (m), position [n, 3] (m, world), frame [n, 3, 3] (rows: normal, two tangents)."""

    distance: jax.Array
    position: jax.Array
    frame: jax.Array


@flax.struct.dataclass
class Box:
    """center [3], rotation [3, 3] (columns: the box's axes), half edges [3]; m."""

    center: jax.Array
    rotation: jax.Array
    half: jax.Array


@flax.struct.dataclass
class Capsule:
    """center [3], half axis [3] from the center to an end, radius []; m. A sphere has a half axis of zero."""

    center: jax.Array
    half: jax.Array
    radius: jax.Array


def block(corners: np.ndarray) -> Box:
    """The upright box between its lowest and its highest corner, [2, 3]."""
    return Box(jnp.asarray(corners.mean(0)), jnp.asarray(UPRIGHT), jnp.asarray((corners[1] - corners[0]) / 2))


def separation(reference: Box, other: Box) -> jax.Array:
    """How far the other box is from each pair of the reference box's faces, [3] (m): negative where they overlap along that axis."""
    middle = reference.rotation.T @ (other.center - reference.center)
    reach = (jnp.abs(reference.rotation.T @ other.rotation) * other.half).sum(-1)
    return jnp.abs(middle) - reference.half - reach


def box_on_box(first: Box, second: Box, handicap: jax.Array | float = 0.0) -> Contacts:
    """Four contacts of two boxes, on the face of either that separates them most.

    handicap: [3], taken from the separation along the first box's axes, to keep some of its faces out.
    """
    of_first, of_second = separation(first, second) - handicap, separation(second, first)
    on_first = of_first.max() >= of_second.max()
    reference = jax.tree.map(lambda one, other: jnp.where(on_first, one, other), first, second)
    incident = jax.tree.map(lambda one, other: jnp.where(on_first, other, one), first, second)
    axis = jnp.argmax(jnp.where(on_first, of_first, of_second))
    found = face_contacts(reference, incident, axis)
    normal = jnp.where(on_first, 1.0, -1.0) * found.frame[0, 0]
    return found.replace(frame=jnp.broadcast_to(frame_of(normal), (4, 3, 3)))


def box_on_table(table: Box, box: Box) -> Contacts:
    """Four contacts of a box with the top, a side or an edge of the table, but never with its underside."""
    below = box.center[2] < table.center[2]
    return box_on_box(table, box, jnp.where(below, FAR, 0.0) * np.array([0.0, 0.0, 1.0], np.float32))


def box_on_ground(table: Box, box: Box) -> Contacts:
    """Four contacts of a box with the table or, when it has fallen off, with the floor at height 0."""
    on_table = box_on_table(table, box)
    floor = Box(jnp.array([0.0, 0.0, -10.0]), jnp.asarray(UPRIGHT), jnp.array([100.0, 100.0, 10.0]))
    on_floor = face_contacts(floor, box, 2)
    fallen = box.center[2] < 0.5 * table.half[2]
    return jax.tree.map(lambda high, low: jnp.where(fallen, low, high), on_table, on_floor)


def face_contacts(reference: Box, incident: Box, axis) -> Contacts:
    """Four contacts of a box with one face of the reference box: the face along `axis` (0 to 2) that looks at it.

    The corners of the incident box's facing side, moved onto the reference face where they stick out, are the points. A point that leaves the
    incident side by being moved does not touch. So a box rests as far as the table reaches, and tips over its edge.
    """
    local = reference.rotation.T
    turned = local @ incident.rotation
    middle = local @ (incident.center - reference.center)
    order = (axis + np.arange(3)) % 3  # The face's normal first, then the two axes that span it.
    middle, turned, half = middle[order], turned[order], reference.half[order]
    side = jnp.where(middle[0] < 0, -1.0, 1.0)

    facing = jnp.argmax(jnp.abs(turned[0]))
    others = (facing + np.arange(1, 3)) % 3
    outward = -side * jnp.sign(turned[0, facing]) * turned[:, facing]
    edges = turned[:, others] * incident.half[others]  # [3, 2]
    center = middle + outward * incident.half[facing]
    corners = center + FACE_CORNERS @ edges.T  # [4, 3]

    moved = jnp.clip(corners[:, 1:], -half[1:], half[1:])
    offset = moved - center[1:]
    toward = jnp.where(jnp.abs(outward[0]) < 0.1, -0.1 * side, outward[0])
    height = center[0] - (offset * outward[1:]).sum(-1) / toward
    # Where the moved points lie on the incident side, in half edges.
    spread = jnp.concatenate([(height - center[0])[:, None], offset], -1) @ edges / incident.half[others] ** 2
    within = (jnp.abs(spread) < 1.01).all(-1)
    distance = jnp.where(within, side * height - half[0], FAR)
    point = jnp.concatenate([(side * (half[0] + 0.5 * distance))[:, None], moved], -1)
    axes = reference.rotation[:, order]  # Columns in the face's order.
    normal = side * axes[:, 0]
    return Contacts(distance, reference.center + point @ axes.T, jnp.broadcast_to(frame_of(normal), (4, 3, 3)))


def capsule_on_capsule(first: Capsule, second: Capsule) -> Contacts:
    """The contact of two capsules."""
    offset = second.center - first.center
    aa, bb, ab = (first.half**2).sum(), (second.half**2).sum(), (first.half * second.half).sum()
    to_first, to_second = (offset * first.half).sum(), (offset * second.half).sum()
    along = jnp.clip((to_first * bb - to_second * ab) / jnp.maximum(aa * bb - ab * ab, 1e-12), -1.0, 1.0)
    other_along = jnp.clip((along * ab - to_second) / bb, -1.0, 1.0)
    along = jnp.clip((other_along * ab + to_first) / aa, -1.0, 1.0)
    return between_spheres(first.center + along * first.half, first.radius, second.center + other_along * second.half, second.radius)


def sphere_on_box(box: Box, center: jax.Array, radius: float) -> Contacts:
    """The contact of a box with a sphere whose center lies outside of it."""
    nearest = jnp.clip(box.rotation.T @ (center - box.center), -box.half, box.half)
    return between_spheres(box.center + box.rotation @ nearest, 0.0, center, radius)


def puck_on_ground(table: Box, center: jax.Array, rotation: jax.Array, radius: float, half_height: float) -> Contacts:
    """Four contacts of a flat cylinder with the table or the floor: those of the square inscribed in its side."""
    across = radius / np.sqrt(2)
    return box_on_ground(table, Box(center, rotation, jnp.array([across, across, half_height])))


def box_on_puck(box: Box, center: jax.Array, rotation: jax.Array, radius: float, half_height: float) -> Contacts:
    """The contact of a box with a flat cylinder: where the box comes nearest to its center, on the rim or on the lid."""
    nearest = box.center + box.rotation @ jnp.clip(box.rotation.T @ (center - box.center), -box.half, box.half)
    axis = rotation[:, 2]
    between = center - nearest
    high = (between * axis).sum()
    outward = between - high * axis
    length = jnp.sqrt((outward**2).sum() + 1e-12)
    on_lid = jnp.abs(high) - half_height > length - radius
    distance = jnp.where(on_lid, jnp.abs(high) - half_height, length - radius)
    normal = jnp.where(on_lid, jnp.sign(high) * axis, outward / length)
    return Contacts(distance[None], (nearest + 0.5 * distance * normal)[None], frame_of(normal)[None])


def between_spheres(center: jax.Array, radius, other_center: jax.Array, other_radius) -> Contacts:
    """The contact of two spheres."""
    between = other_center - center
    length = jnp.sqrt((between**2).sum() + 1e-12)
    normal = between / length
    distance = length - radius - other_radius
    position = center + normal * (radius + 0.5 * distance)
    return Contacts(distance[None], position[None], frame_of(normal)[None])


def frame_of(normal: jax.Array) -> jax.Array:
    """A frame [3, 3] whose first row is the normal [3]; its tangents are MuJoCo's, on which the friction pyramid depends."""
    side = jnp.where(jnp.abs(normal[1]) < 0.5, np.array([0.0, 1.0, 0.0], np.float32), np.array([0.0, 0.0, 1.0], np.float32))
    first = side - normal * (normal * side).sum()
    first = first / jnp.sqrt((first**2).sum())
    return jnp.stack([normal, first, jnp.cross(normal, first)])
