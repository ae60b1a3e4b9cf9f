"""Floor plan of a synthetic house: rooms, furniture, objects, and the graph of places and moves.

Four rooms (kitchen, dining, living, bathroom) lie two and two along a corridor. Plan coordinates are metres: x along
the corridor, y across it, heights z above the floor; headings are counter-clockwise from x. Sizes, order of the rooms,
doors, furniture and objects vary with the seed; a draw that leaves a room or an object out of reach is drawn again.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from infogoal_jax.data.splits import AUTHORS_SPLIT
from infogoal_jax.errors import UserError
from infogoal_jax.stand_ins.house_inventory import FURNITURE, OBJECT_SIZES, Piece

WALL_THICKNESS, WALL_HEIGHT = 0.12, 2.5
CORRIDOR_WIDTH, HOUSE_LENGTH, ROOM_DEPTH = 1.6, 12.0, 3.75
CLOSET_WIDTH = 3.4  # a closed space between the two rooms of a side: the way from room to room is long enough to matter
DOOR_WIDTH, DOOR_HEIGHT = 1.0, 2.1
ROBOT_RADIUS, PASSING_CLEARANCE = 0.22, 0.12
HEADINGS = 12
SIDES = ("west", "east", "south", "north")
# The eight neighbours of a grid point at 0, 45, ..., 315 degrees.
NEIGHBOURS = np.array([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)])
MOVE_ANGLE = {"forward": 0, "backward": 180, "left": 90, "right": -90}


@dataclasses.dataclass(frozen=True)
class Room:
    """A rectangle of floor (metres) with one door of DOOR_WIDTH, centred at `door`, in its wall `door_side`."""

    name: str
    lower: tuple[float, float]
    upper: tuple[float, float]
    door: float
    door_side: str


@dataclasses.dataclass(frozen=True)
class Furniture:
    """A placed piece: its rectangle on the floor and the side of the room that its back faces ("" if free-standing)."""

    room: str
    piece: Piece
    lower: np.ndarray
    upper: np.ndarray
    side: str


@dataclasses.dataclass(frozen=True)
class PlacedObject:
    """An object on a piece of furniture: the middle of its foot [3], its size [3] along x, y, z, its form and
    carrier."""

    name: str
    room: str
    furniture: int
    foot: np.ndarray
    size: np.ndarray
    form: str


@dataclasses.dataclass(frozen=True)
class House:
    """`nodes` float [M, 2] metres; `neighbours` int [M, 8], the node in each direction of NEIGHBOURS or -1;
    `length` of the corridor in metres."""

    length: float
    rooms: tuple[Room, ...]
    furniture: tuple[Furniture, ...]
    objects: tuple[PlacedObject, ...]
    nodes: np.ndarray
    neighbours: np.ndarray


def layout(seed: int, node_spacing: float = 0.6) -> House:
    """Draw a house. The same seed and spacing (metres) give the same house."""
    rng = np.random.default_rng([seed, 1])
    for _ in range(100):
        house = _draw(rng, node_spacing)
        if house is not None:
            return house
    raise UserError(
        f"node_spacing = {node_spacing}: no house found that a robot can pass; try another seed, or 0.6 metres"
    )


def move_targets(house: House) -> dict[str, np.ndarray]:
    """Where each of the four translations leads: name -> int [M, HEADINGS], a node or -1.

    A move goes to the neighbour nearest to its direction, at most 15 degrees off; with headings of 30 degrees every
    direction has exactly one, so the opposite move leads back.
    """
    targets = {}
    for name, offset in MOVE_ANGLE.items():
        angle = 360 / HEADINGS * np.arange(HEADINGS) + offset
        direction = np.floor(angle / 45 + 0.5).astype(int)
        near = np.abs(angle - 45 * direction) <= 15 + 1e-6
        targets[name] = np.where(near, house.neighbours[:, direction % 8], -1)
    return targets


def _draw(rng: np.random.Generator, spacing: float) -> House | None:
    length = HOUSE_LENGTH + rng.uniform(-0.2, 0.3)
    columns = np.arange(rng.uniform(0.3, 0.3 + spacing), length, spacing)
    rooms = _draw_rooms(rng, length, columns)
    corridor = ((0.0, -CORRIDOR_WIDTH / 2), (length, CORRIDOR_WIDTH / 2))
    furniture: list[Furniture] = []
    objects: list[PlacedObject] = []
    for room in rooms:
        furnished = _furnish(rng, room, columns, spacing, corridor, len(furniture))
        if furnished is None:
            return None
        furniture += furnished[0]
        objects += furnished[1]
    floors = [(room.lower, room.upper) for room in rooms] + [corridor]
    nodes, neighbours, _ = _draw_nodes(columns, spacing, floors, [doorway(room) for room in rooms], furniture)
    return House(length, tuple(rooms), tuple(furniture), tuple(objects), nodes, neighbours)


def _furnish(
    rng: np.random.Generator, room: Room, columns: np.ndarray, spacing: float, corridor: tuple, first: int
) -> tuple[list[Furniture], list[PlacedObject]] | None:
    """Furniture and objects of one room, such that the robot can walk nearly all its floor and see every object."""
    wanted = 24 * (0.6 / spacing) ** 2
    for _ in range(300):
        furniture: list[Furniture] = []
        for piece in FURNITURE[room.name]:
            placed = _place_piece(rng, room, piece, furniture)
            if placed is None:
                break
            furniture.append(placed)
        else:
            objects = _place_objects(rng, room, furniture)
            floors = [(room.lower, room.upper), corridor]
            nodes, _, dropped = _draw_nodes(columns, spacing, floors, [doorway(room)], furniture)
            inside = nodes[((nodes > room.lower) & (nodes < room.upper)).all(1)]
            if dropped <= 2 and len(inside) >= wanted and _all_in_reach(objects, furniture, inside, spacing):
                return furniture, [dataclasses.replace(o, furniture=o.furniture + first) for o in objects]
    return None


def doorway(room: Room) -> tuple[tuple[float, float], tuple[float, float]]:
    """Rectangle of floor inside a door opening, through the thickness of the wall."""
    inner, outer = CORRIDOR_WIDTH / 2, CORRIDOR_WIDTH / 2 + WALL_THICKNESS
    low, high = (inner, outer) if room.door_side == "south" else (-outer, -inner)
    return (room.door - DOOR_WIDTH / 2, low), (room.door + DOOR_WIDTH / 2, high)


def _draw_rooms(rng: np.random.Generator, length: float, columns: np.ndarray) -> list[Room]:
    names = rng.permutation(list(FURNITURE))
    rooms = []
    for row, door_side in enumerate(("south", "north")):
        depth = ROOM_DEPTH + rng.uniform(-0.15, 0.25)
        middle = length / 2 + rng.uniform(-0.25, 0.25)
        near = CORRIDOR_WIDTH / 2 + WALL_THICKNESS
        low, high = (near, near + depth) if door_side == "south" else (-near - depth, -near)
        for place, (left, right) in enumerate(((0.0, middle - CLOSET_WIDTH / 2), (middle + CLOSET_WIDTH / 2, length))):
            fits = columns[(columns > left + DOOR_WIDTH / 2 + 0.1) & (columns < right - DOOR_WIDTH / 2 - 0.1)]
            # A door in the middle of a column of nodes: the robot passes it on the grid.
            rooms.append(
                Room(str(names[2 * row + place]), (left, low), (right, high), float(rng.choice(fits)), door_side)
            )
    return rooms


def _place_piece(rng: np.random.Generator, room: Room, piece: Piece, others: list[Furniture]) -> Furniture | None:
    low, high = np.array(room.lower), np.array(room.upper)
    into_room = 1 if room.door_side == "south" else -1
    threshold = low[1] if room.door_side == "south" else high[1]
    door_low = np.array([room.door - 0.65, min(threshold, threshold + into_room * 0.95)])
    door_high = np.array([room.door + 0.65, max(threshold, threshold + into_room * 0.95)])
    for _ in range(60):
        side = "" if piece.free_standing else str(rng.choice(SIDES))
        size = np.array([piece.width, piece.depth])
        if side in ("west", "east") or (not side and rng.random() < 0.5):
            size = size[::-1]
        corner = rng.uniform(low, high - size) if side else (low + high - size) / 2 + rng.uniform(-0.4, 0.4, 2)
        if side:  # flush with its wall
            axis = int(side in ("south", "north"))
            corner[axis] = low[axis] if side in ("west", "south") else high[axis] - size[axis]
        placed = Furniture(room.name, piece, corner, corner + size, side)
        overlaps = any((placed.lower < o.upper + 0.05).all() and (placed.upper > o.lower - 0.05).all() for o in others)
        blocks_door = (placed.lower < door_high).all() and (placed.upper > door_low).all()
        centre = (placed.lower + placed.upper) / 2
        # Both carriers of a room hold a training object: they must be different places to go to.
        crowded = piece.holds and any(
            o.piece.holds and np.linalg.norm((o.lower + o.upper) / 2 - centre) < 1.5 for o in others
        )
        if not (overlaps or blocks_door or crowded):
            return placed
    return None


def _place_objects(rng: np.random.Generator, room: Room, furniture: list[Furniture]) -> list[PlacedObject]:
    carriers = [i for i, f in enumerate(furniture) if f.room == room.name and f.piece.holds]
    index = AUTHORS_SPLIT.room_names.index(room.name)
    here = [name for name in AUTHORS_SPLIT.objects if AUTHORS_SPLIT.rooms[name] == index]
    train = [str(n) for n in rng.permutation([name for name in here if name in AUTHORS_SPLIT.train])]
    others = [str(n) for n in rng.permutation([name for name in here if name not in AUTHORS_SPLIT.train])]
    # A training object on each carrier, the others beside them in proportion to the carriers' widths.
    load = {carriers[0]: [train[0]], carriers[1]: [train[1]]}
    for name in others:
        load[min(carriers, key=lambda c: (len(load[c]) + 1) / furniture[c].piece.width)].append(name)
    return [placed for carrier in carriers for placed in _stand(rng, furniture, carrier, load[carrier])]


def _stand(rng: np.random.Generator, furniture: list[Furniture], carrier: int, names: list[str]) -> list[PlacedObject]:
    """Objects in a row along the carrier's front edge, in random order with random gaps of at least 5 cm."""
    piece, side = furniture[carrier].piece, furniture[carrier].side
    low, high = furniture[carrier].lower, furniture[carrier].upper
    names = [str(n) for n in rng.permutation(names)]
    widths = np.array([OBJECT_SIZES[name][0] for name in names])
    slack = piece.width - widths.sum() - 0.05 * (len(names) + 1)
    gaps = 0.05 + slack * rng.dirichlet(np.full(len(names) + 1, 2.0))
    along = np.cumsum(gaps[:-1]) + np.cumsum(widths) - widths / 2
    width_axis = int(high[1] - low[1] > high[0] - low[0])
    placed = []
    for name, offset in zip(names, along, strict=True):
        width, depth, height, form = OBJECT_SIZES[name]
        edge = rng.uniform(0.03, 0.10) + depth / 2
        at_lower = side in ("north", "east") or (not side and rng.random() < 0.5)
        foot, size = np.empty(3), np.empty(3)
        foot[width_axis], foot[2] = low[width_axis] + offset, piece.height
        foot[1 - width_axis] = low[1 - width_axis] + edge if at_lower else high[1 - width_axis] - edge
        size[width_axis], size[1 - width_axis], size[2] = width, depth, height
        placed.append(PlacedObject(name, furniture[carrier].room, carrier, foot, size, form))
    return placed


def _draw_nodes(columns, spacing, floors, doorways, furniture) -> tuple[np.ndarray, np.ndarray, int]:
    """Free grid points, their neighbours, and how many free points were dropped because nothing leads there."""
    half = CORRIDOR_WIDTH / 2
    phase = spacing / 2 if spacing / 2 <= half - ROBOT_RADIUS - 0.05 else 0.0
    reach = half + WALL_THICKNESS + ROOM_DEPTH + 1.0
    rows = np.arange(phase - spacing * np.ceil(reach / spacing), reach, spacing)
    grid = np.stack(np.meshgrid(np.arange(len(columns)), np.arange(len(rows)), indexing="ij"), -1).reshape(-1, 2)
    points = np.stack([columns[grid[:, 0]], rows[grid[:, 1]]], -1)
    grid = grid[_is_free(points, floors, doorways, furniture, ROBOT_RADIUS)]
    points = np.stack([columns[grid[:, 0]], rows[grid[:, 1]]], -1)
    number = {tuple(place): index for index, place in enumerate(grid.tolist())}
    # Four directions only: the other four are these, seen from the other end, so every move has its inverse.
    ends = [
        (index, direction, number[tuple(place)])
        for direction in range(4)
        for index, place in enumerate((grid + NEIGHBOURS[direction]).tolist())
        if tuple(place) in number
    ]
    start, direction, end = np.array(ends, int).reshape(-1, 3).T
    between = points[start, None] + np.linspace(0, 1, 25)[:, None] * (points[end] - points[start])[:, None]
    passable = _is_free(between.reshape(-1, 2), floors, doorways, furniture, PASSING_CLEARANCE).reshape(-1, 25).all(1)
    neighbours = np.full((len(grid), 8), -1)
    neighbours[start[passable], direction[passable]] = end[passable]
    neighbours[end[passable], direction[passable] + 4] = start[passable]
    group = np.arange(len(grid))
    for _ in range(len(grid)):  # each node takes the smallest number that it can reach
        smallest = np.where(neighbours >= 0, group[neighbours], len(grid)).min(1)
        if (smallest >= group).all():
            break
        group = np.minimum(group, smallest)
    keep = group == np.bincount(group).argmax()
    renumber = np.append(np.where(keep, np.cumsum(keep) - 1, -1), -1)
    return points[keep], renumber[neighbours[keep]], int((~keep).sum())


def _is_free(points: np.ndarray, floors, doorways, furniture, clearance: float) -> np.ndarray:
    """Whether a robot of this radius stands clear of walls and furniture at each of the points [P, 2]: bool [P]."""
    on_floor = np.zeros(len(points), bool)
    for low, high in floors:
        on_floor |= ((points >= np.add(low, clearance)) & (points <= np.subtract(high, clearance))).all(1)
    for low, high in doorways:  # a doorway is open towards both its rooms
        margin = np.array([clearance, -clearance - 1e-9])
        on_floor |= ((points >= np.array(low) + margin) & (points <= np.array(high) - margin)).all(1)
    for piece in furniture:
        on_floor &= ~((points > piece.lower - clearance) & (points < piece.upper + clearance)).all(1)
    return on_floor


def _all_in_reach(objects, furniture, nodes, spacing: float) -> bool:
    """Whether every object has enough nodes around it from where it is seen well (as many as a free half circle)."""
    wanted = max(1, round(6 * (0.6 / spacing) ** 2))
    for placed in objects:
        carrier = furniture[placed.furniture]
        away = nodes - placed.foot[:2]
        distance = np.linalg.norm(away, axis=1)
        middle = (carrier.lower + carrier.upper) / 2
        in_front = (
            np.ones(len(nodes), bool) if not carrier.side else (away * np.sign(placed.foot[:2] - middle)).max(1) > 0
        )
        if ((distance < 1.6) & in_front).sum() < wanted:
            return False
    return True
