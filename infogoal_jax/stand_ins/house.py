"""A synthetic house, photographed and written to disk in the format of the Active Vision Dataset.

It stands in for the real dataset, whose licence does not let it be shipped: four rooms along a corridor, the authors'
24 objects in the authors' rooms (splits.AUTHORS_SPLIT), twelve views from every node of a grid. Files, names and
fields are those of the real scenes, so the one reader (active_vision.py) serves both; a note `synthetic.json` at the
root says that the data are generated.

Difficulty, whose real scale is undocumented, is 1 to 5 by the visible share of an object's outline:
1 from 90 %, 2 from 70 %, 3 from 50 %, 4 from 25 %, 5 below.
"""

from __future__ import annotations

import io
import itertools
import json
import os
import re
from pathlib import Path

import cv2
import numpy as np
import scipy.io

from infogoal_jax.data.active_vision import ACTIONS
from infogoal_jax.errors import UserError
from infogoal_jax.stand_ins import house_layout, house_render, house_textures
from infogoal_jax.stand_ins.house_layout import HEADINGS, House

GENERATOR_VERSION = 1
DIFFICULTY_SHARES = (0.9, 0.7, 0.5, 0.25)
# Metres of wall that one texture covers: longer than any wall it is on, so that no pattern comes twice.
WALL_TILE, CORRIDOR_TILE = 5.0, 13.0
LEAST_PIXELS = 4  # objects with fewer visible pixels are not annotated
# COLMAP's arbitrary unit: positions in image_structs.mat times this are millimetres. Not 1000, so that a reader which forgets it is wrong.
POSITION_SCALE = 800.0
MATLAB_FIELDS = (
    "image_name t R world_pos direction quat scaled_world_pos image_id camera_id cluster_id "
    "rotate_cw rotate_ccw translate_forward translate_backward translate_right translate_left"
).split()

# The instance map of the real dataset, ids 1 to 33.
INSTANCE_NAMES = """
advil_liqui_gels aunt_jemima_original_syrup bumblebee_albacore cholula_chipotle_hot_sauce coca_cola_glass_bottle
crest_complete_minty_fresh crystal_hot_sauce expo_marker_red hersheys_bar honey_bunches_of_oats_honey_roasted
honey_bunches_of_oats_with_almonds hunts_sauce listerine_green mahatma_rice nature_valley_granola_thins_dark_chocolate
nutrigrain_harvest_blueberry_bliss pepto_bismol pringles_bbq progresso_new_england_clam_chowder quaker_chewy_low_fat_chocolate_chunk
red_bull softsoap_clear softsoap_gold softsoap_white spongebob_squarepants_fruit_snaks
tapatio_hot_sauce vo5_tea_therapy_healthful_green_tea_smoothing_shampoo
nature_valley_sweet_and_salty_nut_almond nature_valley_sweet_and_salty_nut_cashew nature_valley_sweet_and_salty_nut_peanut
nature_valley_sweet_and_salty_nut_roasted_mix_nut paper_plate red_cup
""".split()
INSTANCE_IDS = {name: identity for identity, name in enumerate(INSTANCE_NAMES, 1)}


def build_house(
    out_dir: str | os.PathLike,
    seed: int = 0,
    scene: str = "Home_101_1",
    *,
    node_spacing: float = 0.6,
    image_width: int = 160,
    jpeg_quality: int = 70,
) -> Path:
    """Build one scene under `out_dir`, which may hold other scenes already; returns the scene's folder.

    Args:
      seed: of the layout and the textures; the same seed writes the same files.
      scene: Home_NNN_N or Office_NNN_N.
      node_spacing: metres between nodes, 0.4 to 1.2.
      image_width: pixels, at least 32; the images are 16:9.
      jpeg_quality: 1 to 100.

    Raises:
      UserError: where an argument is out of range or the scene exists already.
    """
    if not re.fullmatch(r"(Home|Office)_\d{3}_\d", scene):
        raise UserError(f"scene = {scene!r}: must be like Home_101_1 (Home or Office, three digits, one digit)")
    if not 0.4 <= node_spacing <= 1.2:
        raise UserError(f"node_spacing = {node_spacing}: must be 0.4 to 1.2 metres")
    if image_width < 32:
        raise UserError(f"image_width = {image_width}: must be at least 32 pixels")
    root = Path(out_dir)
    folder = root / scene
    if folder.exists() and any(folder.iterdir()):
        raise UserError(f"{folder}: exists already; choose another folder or scene name")
    (folder / "jpg_rgb").mkdir(parents=True, exist_ok=True)

    house = house_layout.layout(seed, node_spacing)
    camera = house_render.Camera(image_width, round(image_width * 9 / 16))
    names = [image_name(scene, index) for index in range(len(house.nodes) * HEADINGS)]
    boxes, surfaces = furnish(house, seed)
    levels = house_render.texture_levels(house_textures.paint(surfaces, [*(r.name for r in house.rooms), "corridor"], seed))
    annotations = _edges(house, names)
    for index, (picture, sightings) in enumerate(_photograph(house, boxes, levels, camera)):
        _, encoded = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, jpeg_quality))
        (folder / "jpg_rgb" / names[index]).write_bytes(encoded.tobytes())
        annotations[names[index]]["bounding_boxes"] = [
            [*sighting.box, sighting.instance, difficulty(sighting.visible_fraction)] for sighting in sightings
        ]
    present = sorted({placed.name for placed in house.objects}, key=INSTANCE_IDS.get)
    (folder / "annotations.json").write_text(json.dumps(annotations, separators=(",", ":")), encoding="utf-8")
    (folder / "present_instance_names.txt").write_text("\n".join(present) + "\n", encoding="utf-8")
    _write_cameras(folder, camera)
    _write_image_structs(folder, house, camera, names, annotations)
    for name in ("all_instance_id_map.txt", "instance_id_map.txt"):
        (root / name).write_text("".join(f"{n} {i}\n" for n, i in INSTANCE_IDS.items()), encoding="utf-8")
    note = {"generator": "infogoal data build house", "version": GENERATOR_VERSION, "seed": seed}
    (root / "synthetic.json").write_text(json.dumps(note) + "\n", encoding="utf-8")
    return folder


def image_name(scene: str, index: int) -> str:
    """Fifteen digits: building, scene, scan, image index, camera 01, kind 01 (colour)."""
    building, number, scan = scene.split("_")
    return f"{0 if building == 'Home' else 1}{number}{scan}{index + 1:06d}0101.jpg"


def difficulty(visible_fraction: float) -> int:
    """1 (whole) to 5 (nearly hidden) by the visible share of an object's outline."""
    return 1 + sum(visible_fraction < share for share in DIFFICULTY_SHARES)


def furnish(house: House, seed: int) -> tuple[house_render.Boxes, list[str]]:
    """Everything that can be seen, as boxes, and the names of the surfaces that their textures index."""
    blocks = []

    def add(lower, upper, surfaces, tile=(0.0, 0.0), instance=0):
        """`surfaces`: one name, or the names of the faces -x, +x, -y, +y, -z, +z."""
        six = (surfaces,) * 6 if isinstance(surfaces, str) else tuple(surfaces)
        blocks.append((lower, upper, six, tile, instance))

    _add_walls(add, house)
    for index, furniture in enumerate(house.furniture):
        _add_furniture(add, index, furniture)
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
        np.array(lower, np.float32), np.array(upper, np.float32), texture, np.array(tile, np.float32), np.array(instance)
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
        wall_with_doors(-thick, house.length + thick, doors, low, low + thick / 2, f"wall:corridor:{side}", (CORRIDOR_TILE, high))
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


def _add_furniture(add, index: int, furniture: house_layout.Furniture) -> None:
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
        stretches = ((0.1, doors[0] - clear), (doors[0] + clear, doors[1] - clear), (doors[1] + clear, house.length - 0.1))
        for number, (low, up) in enumerate(stretches):
            # About one picture for every two metres of corridor wall.
            cuts = np.linspace(low, up, max(2, round((up - low) / 1.8) + 1))
            for place, (first, last) in enumerate(itertools.pairwise(cuts)):
                hang(f"picture:corridor:{side}:{number}:{place}", side, first + 0.05, max(last - 0.05, first + 0.3), wall)


def _photograph(house: House, boxes, levels, camera):
    """Picture and sightings of every node and heading, headings running fastest."""
    headings = 2 * np.pi / HEADINGS * np.arange(HEADINGS)
    directions = [house_render.rays(camera, heading) for heading in headings]
    for node in house.nodes:
        position = np.array([*node, camera.above_floor], np.float32)
        for heading, direction in zip(headings, directions, strict=True):
            picture, sightings = house_render.render(boxes, levels, camera, position, heading, direction)
            yield picture, [s for s in sightings if s.pixels >= LEAST_PIXELS]


def _edges(house: House, names: list[str]) -> dict[str, dict]:
    """Annotations without boxes: the six edges of each image."""
    targets = house_layout.move_targets(house)
    annotations = {}
    for index, name in enumerate(names):
        node, heading = divmod(index, HEADINGS)
        leads = {"rotate_ccw": node * HEADINGS + (heading + 1) % HEADINGS, "rotate_cw": node * HEADINGS + (heading - 1) % HEADINGS}
        for move, target in targets.items():
            leads[move] = target[node, heading] * HEADINGS + heading if target[node, heading] >= 0 else -1
        annotations[name] = {"bounding_boxes": []} | {a: names[leads[a]] if leads[a] >= 0 else "" for a in ACTIONS}
    return annotations


def _write_cameras(folder: Path, camera: house_render.Camera) -> None:
    focal, width, height = camera.focal_length, camera.width, camera.height
    (folder / "cameras.txt").write_text(
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 PINHOLE {width} {height} {focal:.4f} {focal:.4f} {width / 2} {height / 2}\n",
        encoding="utf-8",
    )


def _write_image_structs(folder: Path, house: House, camera, names: list[str], annotations: dict[str, dict]) -> None:
    """Camera poses as the dataset's MATLAB structs: world axes x (right), y (down), z, so the plan is (x, z)."""
    records = np.empty((1, len(names)), [(field, object) for field in MATLAB_FIELDS])
    for index, name in enumerate(names):
        node, heading = divmod(index, HEADINGS)
        axes = house_render.camera_axes(2 * np.pi * heading / HEADINGS).astype(float)
        rotation = np.stack([axes[:, 0], -axes[:, 2], axes[:, 1]], 1)  # rows right, down, forward in world axes
        plan = house.nodes[node]
        millimetres = 1000 * np.array([[plan[0]], [-camera.above_floor], [plan[1]]])
        world = millimetres / POSITION_SCALE
        edges = annotations[name]
        records[0, index] = (
            name, -rotation @ world, rotation, world, rotation[2][:, None], _quaternion(heading), millimetres,
            float(index + 1), 1.0, float(node + 1), edges["rotate_cw"], edges["rotate_ccw"],
            edges["forward"], edges["backward"], edges["right"], edges["left"],
        )  # fmt: skip
    content = io.BytesIO()
    scipy.io.savemat(content, {"image_structs": records, "scale": POSITION_SCALE}, do_compression=True)
    # The first 116 bytes are free text, where scipy puts the time of day: the same seed shall write the same file.
    header = b"MATLAB 5.0 MAT-file, infogoal data build house".ljust(116)
    (folder / "image_structs.mat").write_bytes(header + content.getvalue()[116:])


def _quaternion(heading: int) -> np.ndarray:
    """Rotation world to camera as (w, x, y, z): a turn about the vertical axis from forward = z to the heading."""
    turn = 2 * np.pi * heading / HEADINGS - np.pi / 2
    return np.array([[np.cos(turn / 2)], [0.0], [np.sin(turn / 2)], [0.0]])
