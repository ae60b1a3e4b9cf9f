"""A synthetic house, photographed and written to disk in the format of the Active Vision Dataset; the one of a seed is
kept in the user's cache.

It stands in for the real dataset, whose licence does not let it be shipped: four rooms along a corridor, the authors'
24 objects in the authors' rooms (splits.AUTHORS_SPLIT), twelve views from every node of a grid. Files, names and
fields are those of the real scenes, so the one reader (active_vision.py) serves both; a note `synthetic.json` at the
root says that the data are generated.

Difficulty, whose real scale is undocumented, is 1 to 5 by the visible share of an object's outline:
1 from 90 %, 2 from 70 %, 3 from 50 %, 4 from 25 %, 5 below.
"""

from __future__ import annotations

import io
import json
import os
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from infogoal_jax.data import active_vision, archives, check
from infogoal_jax.data.active_vision import ACTIONS
from infogoal_jax.errors import UserError
from infogoal_jax.stand_ins import house_boxes, house_layout, house_render, house_textures
from infogoal_jax.stand_ins.house_inventory import INSTANCE_IDS
from infogoal_jax.stand_ins.house_layout import HEADINGS, House
from infogoal_jax.stopping import temporary

GENERATOR_VERSION = 1
SCENE = "Home_101_1"
DIFFICULTY_SHARES = (0.9, 0.7, 0.5, 0.25)
JPEG_QUALITY = 70
LEAST_PIXELS = 4  # objects with fewer visible pixels are not annotated
# COLMAP's arbitrary unit: positions in image_structs.mat times this are millimetres. Not 1000, so that a reader which
# forgets it is wrong.
POSITION_SCALE = 800.0
MATLAB_FIELDS = (
    "image_name t R world_pos direction quat scaled_world_pos image_id camera_id cluster_id "
    "rotate_cw rotate_ccw translate_forward translate_backward translate_right translate_left"
).split()


def load(seed: int = 0, **reading) -> active_vision.SearchScenes:
    """The house of this seed, from the user's cache; it is built there first if it is not there yet, or damaged.

    reading: what `active_vision.load` takes beside the folder. Building is announced on stderr. A cache that cannot be
    written to costs only time.
    """
    folder = cached_folder(seed)
    why = "is not in the cache yet"
    if folder.exists():
        try:
            return active_vision.load(folder, **reading)
        except UserError:
            if not check.check_active_vision(folder):
                raise  # The house is sound: something else is asked of it than it has.
            why = "in the cache is damaged"
    print(
        f"infogoal: the dataset {folder.name} {why}; it is built now, which takes ten seconds, and kept as {folder}",
        file=sys.stderr,
    )
    try:
        _build_cached(folder, seed)
    except OSError as error:
        print(
            f"infogoal: {folder} cannot be written ({error.strerror or error}); it will be built again next time",
            file=sys.stderr,
        )
        with tempfile.TemporaryDirectory() as elsewhere, temporary(Path(elsewhere)):
            build_house(elsewhere, seed)
            return active_vision.load(elsewhere, **{"cache_dir": elsewhere} | reading)
    return active_vision.load(folder, **reading)


def cached_folder(seed: int = 0) -> Path:
    """Where `load` keeps the house of this seed, in the format of the Active Vision Dataset."""
    return archives.user_cache() / f"house-{seed}-{GENERATOR_VERSION}"


def _build_cached(folder: Path, seed: int) -> None:
    """Build a house beside and rename it, so that `folder` always holds a whole one. Raises `OSError` if the disk
    refuses."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as beside, temporary(Path(beside)):
        whole = Path(beside) / folder.name
        build_house(whole, seed)
        if folder.exists() and check.check_active_vision(folder):
            folder.rename(Path(beside) / "damaged")
        try:
            whole.rename(folder)
        except OSError:
            if not folder.is_dir():
                raise
            # Another process was faster, and its house is the same.


def build_house(
    out_dir: str | os.PathLike, seed: int = 0, *, node_spacing: float = 0.6, image_width: int = 160
) -> None:
    """Build the house as the one scene of a dataset in this folder.

    seed: of the layout and the textures; the same seed writes the same files.
    node_spacing: metres between nodes, 0.4 to 1.2.
    image_width: pixels, at least 32; the images are 16:9.
    """
    root = Path(out_dir)
    folder = root / SCENE
    (folder / "jpg_rgb").mkdir(parents=True)

    house = house_layout.layout(seed, node_spacing)
    camera = house_render.Camera(image_width, round(image_width * 9 / 16))
    # Fifteen digits: building (0: Home), scene, scan, image index, camera 01, kind 01 (colour).
    names = [f"01011{index + 1:06d}0101.jpg" for index in range(len(house.nodes) * HEADINGS)]
    boxes, surfaces = house_boxes.furnish(house, seed)
    levels = house_render.texture_levels(
        house_textures.paint(surfaces, [*(r.name for r in house.rooms), "corridor"], seed)
    )
    annotations = _edges(house, names)
    for index, (picture, sightings) in enumerate(_photograph(house, boxes, levels, camera)):
        _, encoded = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))
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


def difficulty(visible_fraction: float) -> int:
    """1 (whole) to 5 (nearly hidden) by the visible share of an object's outline."""
    return 1 + sum(visible_fraction < share for share in DIFFICULTY_SHARES)


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
        leads = {
            "rotate_ccw": node * HEADINGS + (heading + 1) % HEADINGS,
            "rotate_cw": node * HEADINGS + (heading - 1) % HEADINGS,
        }
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
            name,
            -rotation @ world,
            rotation,
            world,
            rotation[2][:, None],
            _quaternion(heading),
            millimetres,
            float(index + 1),
            1.0,
            float(node + 1),
            edges["rotate_cw"],
            edges["rotate_ccw"],
            edges["forward"],
            edges["backward"],
            edges["right"],
            edges["left"],
        )
    import scipy.io  # Only now: it takes a tenth of a second.

    content = io.BytesIO()
    scipy.io.savemat(content, {"image_structs": records, "scale": POSITION_SCALE}, do_compression=True)
    # The first 116 bytes are free text, where scipy puts the time of day: the same seed shall write the same file.
    header = b"MATLAB 5.0 MAT-file, infogoal data build house".ljust(116)
    (folder / "image_structs.mat").write_bytes(header + content.getvalue()[116:])


def _quaternion(heading: int) -> np.ndarray:
    """Rotation world to camera as (w, x, y, z): a turn about the vertical axis from forward = z to the heading."""
    turn = 2 * np.pi * heading / HEADINGS - np.pi / 2
    return np.array([[np.cos(turn / 2)], [0.0], [np.sin(turn / 2)], [0.0]])
