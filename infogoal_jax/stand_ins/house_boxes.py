"""The synthetic house as the boxes that are drawn: walls, floors, furniture, pictures and windows, objects, each with
its surfaces.

Coordinates are those of the floor plan (house_layout.py), in metres. Surfaces are named; house_textures.py paints them.
"""

import itertools

import numpy as np

from infogoal_jax.stand_ins import house_layout, house_render
from infogoal_jax.stand_ins.house_inventory import INSTANCE_IDS
from infogoal_jax.stand_ins.house_layout import House

# Metres of wall that one texture covers: longer than any wall it is on, so that no pattern comes twice.
WALL_TILE, CORRIDOR_TILE = 5.0, 13.0


def furnish(house: House, seed: int) -> tuple[house_render.Boxes, list[str]]:
    """Everything that can be seen, as boxes, and the names of the surfaces that their textures index."""
    blocks = []

    def add(lower, upper, surfaces, tile=(0.0, 0.0), instance=0):
        """`surfaces`: one name, or the names of the faces -x, +x, -y, +y, -z, +z."""
        six = (surfaces,) * 6 if isinstance(surfaces, str) else tuple(surfaces)
        blocks.append((lower, upper, six, tile, instance))

    _add_walls(add, house)
    for furniture in house.furniture:
        _add_furniture(add, furniture)
    _add_decoration(add, house, np.random.default_rng([seed, 4]))
    for placed in house.objects:
        half = placed.size * (0.5, 0.5, 0)
        low, high = placed.foot - half, placed.foot + placed.size - half
        surface, instance = f"object:{placed.name}", INSTANCE_IDS[placed.name]
        if placed.form == "bottle":
            shoulder = low[2] + 0.68 * placed.size[2]
            middle, neck = placed.foot[:2], placed.size[:2] * 0.22
            add(low, [*high[:2], shoulder], surface, instance=instance)
            add([*(middle - neck), shoulder], [*(middle + neck), high[2]], surface, instance=instance)
        else:
            add(low, high, surface, instance=instance)
    names = sorted({name for block in blocks for name in block[2]})
    number = {name: index for index, name in enumerate(names)}
    lower, upper, faces, tile, instance = zip(*blocks, strict=True)
    texture = np.array([[number[name] for name in six] for six in faces])
    boxes = house_render.Boxes(
        np.array(lower, np.float32),
        np.array(upper, np.float32),
        texture,
        np.array(tile, np.float32),
        np.array(instance),
    )
    return boxes, names


def _add_walls(add, house: House) -> None:
    thick, high = house_layout.WALL_THICKNESS, house_layout.WALL_HEIGHT
    half = house_layout.CORRIDOR_WIDTH / 2

    def floor_and_ceiling(low, up, name):
        add([*low, -0.1], [*up, 0], f"floor:{name}", (1.2, 1.2))
        add([*low, high], [*up, high + 0.1], f"ceiling:{name}", (1.2, 1.2))

    def wall_with_doors(first, last, doors, low, up, surface, tile):
        """A wall along x in layers, so that its two sides differ; the cut faces are door frames."""
        faces = ("plain:60", "plain:60", surface, surface, "plain:60", "plain:60")
        edges = [first, *(x for door in sorted(doors) for x in (door - door_half, door + door_half)), last]
        for index in range(len(edges) - 1):
            bottom = house_layout.DOOR_HEIGHT if index % 2 else 0
            add([edges[index], low, bottom], [edges[index + 1], up, high], faces, tile)

    door_half = house_layout.DOOR_WIDTH / 2
    floor_and_ceiling((0, -half), (house.length, half), "corridor")
    for x, side in ((-thick, "west"), (house.length, "east")):
        add([x, -half, 0], [x + thick, half, high], f"wall:corridor:{side}", (CORRIDOR_TILE, high))
    for door_side, side, low in (("south", "north", half), ("north", "south", -half - thick / 2)):
        doors = [room.door for room in house.rooms if room.door_side == door_side]
        wall_with_doors(
            -thick, house.length + thick, doors, low, low + thick / 2, f"wall:corridor:{side}", (CORRIDOR_TILE, high)
        )
    for room in house.rooms:
        (left, low), (right, up) = room.lower, room.upper
        wall = {side: f"wall:{room.name}:{side}" for side in house_layout.SIDES}
        tile = (WALL_TILE, high)
        floor_and_ceiling(room.lower, room.upper, room.name)
        floor_and_ceiling(*house_layout.doorway(room), "corridor")
        add([left - thick, low, 0], [left, up, high], wall["west"], tile)
        add([right, low, 0], [right + thick, up, high], wall["east"], tile)
        if room.door_side == "south":
            near, far = (low - thick / 2, low), (up, up + thick)
        else:
            near, far = (up, up + thick / 2), (low - thick, low)
        far_side = "north" if room.door_side == "south" else "south"
        add([left - thick, far[0], 0], [right + thick, far[1], high], wall[far_side], tile)
        wall_with_doors(left - thick, right + thick, [room.door], *near, wall[room.door_side], tile)


def _add_furniture(add, furniture: house_layout.Furniture) -> None:
    piece, (left, low), (right, up) = furniture.piece, furniture.lower, furniture.upper
    front, top = f"front:{piece.name}", f"top:{piece.name}"
    if piece.form == "table":
        add([left, low, piece.height - 0.05], [right, up, piece.height], top)
        for x in (left, right - 0.06):
            for y in (low, up - 0.06):
                add([x, y, 0], [x + 0.06, y + 0.06, piece.height - 0.05], top)
        return
    body = 0.45 if piece.form == "sofa" else piece.height
    add([left, low, 0], [right, up, body], (front, front, front, front, top, top))
    if piece.form in ("sofa", "screen"):  # a back rest, or a screen, along the wall that the piece stands at
        thickness, height = (0.22, piece.height) if piece.form == "sofa" else (0.08, piece.height + 0.65)
        axis = 0 if furniture.side in ("west", "east") else 1
        back_low, back_high = np.array([left, low, body]), np.array([right, up, height])
        if furniture.side in ("west", "south"):
            back_high[axis] = back_low[axis] + thickness
        else:
            back_low[axis] = back_high[axis] - thickness
        add(back_low, back_high, front if piece.form == "sofa" else "screen:television")


def _add_decoration(add, house: House, rng: np.random.Generator) -> None:
    """Pictures and windows on the walls: they tell one stretch of a wall from the next."""

    def hang(name, side, low, up, wall):
        """Put something flat on a wall, somewhere between `low` and `up` along it; `wall` is where its surface is."""
        along = 0 if side in ("south", "north") else 1
        width, bottom = min(rng.uniform(0.6, 1.1), up - low), rng.uniform(1.2, 1.6)
        start = rng.uniform(low, up - width)
        inward = wall + (0.02 if side in ("west", "south") else -0.02)
        lower, upper = np.empty(3), np.empty(3)
        lower[[along, 1 - along, 2]] = start, min(wall, inward), bottom
        upper[[along, 1 - along, 2]] = start + width, max(wall, inward), bottom + rng.uniform(0.5, 0.8)
        add(lower, upper, name)

    clear = house_layout.DOOR_WIDTH / 2 + 0.1
    for room in house.rooms:
        for side in house_layout.SIDES:
            along = 0 if side in ("south", "north") else 1
            low, up = room.lower[along] + 0.1, room.upper[along] - 0.1
            wall = (room.lower if side in ("west", "south") else room.upper)[1 - along]
            kind = "window" if side != room.door_side and rng.random() < 0.4 else "picture"
            if side == room.door_side:  # beside the door, where there is more wall
                low, up = (low, room.door - clear) if room.door - low > up - room.door else (room.door + clear, up)
                hang(f"{kind}:{room.name}:{side}", side, low, up, wall)
            else:
                middle = (low + up) / 2
                hang(f"{kind}:{room.name}:{side}", side, low, middle - 0.1, wall)
                hang(f"picture:{room.name}:{side}:second", side, middle + 0.1, up, wall)
    half = house_layout.CORRIDOR_WIDTH / 2
    for side, door_side, wall in (("north", "south", half), ("south", "north", -half)):
        doors = sorted(room.door for room in house.rooms if room.door_side == door_side)
        stretches = (
            (0.1, doors[0] - clear),
            (doors[0] + clear, doors[1] - clear),
            (doors[1] + clear, house.length - 0.1),
        )
        for number, (low, up) in enumerate(stretches):
            # About one picture for every two metres of corridor wall.
            cuts = np.linspace(low, up, max(2, round((up - low) / 1.8) + 1))
            for place, (first, last) in enumerate(itertools.pairwise(cuts)):
                hang(
                    f"picture:corridor:{side}:{number}:{place}", side, first + 0.05, max(last - 0.05, first + 0.3), wall
                )
