"""Reader of the Active Vision Dataset (Ammirato et al., ICRA 2017) as scenes to search objects in.

The paper's object search (section V-A.2) turns the dataset into a graph: a state is an image, an action one of the six
annotated moves, and a goal is reached where the object's box is large enough for "a clear view". The same reader
serves the real scenes and the synthetic house that is written in their format. Each image is read once, shrunk to a
small grey square and cached, so that a training run holds a kilobyte an image.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from infogoal_jax.data.pictures import CHECK_HINT, scene_pictures
from infogoal_jax.errors import UserError, counted, nearest, shown, typed
from infogoal_jax.files import from_json, read_text

ACTIONS = ("forward", "backward", "left", "right", "rotate_ccw", "rotate_cw")
# A box counts as a clear view where its shorter side is this share of the image height (119 pixels of the real 1080).
DEFAULT_MIN_BOX_SIZE = 0.11
MAX_DIFFICULTY = 4
MAPS = ("all_instance_id_map.txt", "instance_id_map.txt")
SCENE_NAME = re.compile(r"(Home|Office)_\d{3}_\d")
Report = Callable[[str, str], None]
"""Is told what is wrong: where, a path below the dataset, and the problem. `load` stops there, `check` goes on."""


class Annotation(NamedTuple):
    """What is annotated of one image."""

    moves: dict[str, str]
    """The image that each action leads to, "" where there is no move."""
    boxes: list[tuple[float, float, float, float, int, int]]
    """Left, top, right and bottom in pixels, the object's id and the difficulty, 1 to 5."""


@dataclasses.dataclass(frozen=True)
class SearchScenes:
    """S states (images) of one or more scenes and N objects, as they were asked for."""

    images: np.ndarray
    """uint8 [S, H, W], grey."""
    next_state: np.ndarray
    """int32 [S, 6], where each of ACTIONS leads; the state itself where there is no move."""
    visible: np.ndarray
    """bool [S, N], whether the object is in clear view."""
    position: np.ndarray
    """float32 [S, 3], plan x and y (m) and heading (radians), counter-clockwise from x; NaN where unknown."""
    scene: np.ndarray
    """int32 [S], number of the scene among those that were read."""
    source: str
    """What was read, in words."""


def load(
    root: str | os.PathLike,
    *,
    objects: Iterable[str],
    scenes: Iterable[str] | None = None,
    image_size: int = 32,
    min_box_size: float = DEFAULT_MIN_BOX_SIZE,
    max_difficulty: int = MAX_DIFFICULTY,
    cache_dir: str | os.PathLike | None = None,
) -> SearchScenes:
    """Read scenes in the dataset's on-disk format, from the folder of the scene folders and of the map of instances.

    objects: names of those that can be goals, as in that map, in the order of `visible`. scenes: names of scene
    folders; None: all. image_size: side of the grey images in pixels, 4 to 512. min_box_size: least shorter side of a
    box in image heights. max_difficulty: boxes of a higher annotated difficulty (1 easy to 5 hard) do not count.
    cache_dir: of a file a scene; None: the user's. Raises `UserError` where an argument cannot be used, the dataset is
    incomplete, or no state shows one of the objects.
    """
    root, objects = Path(root), tuple(objects)

    def stop(where: str, problem: str) -> None:
        raise UserError(f"{root / where}: {problem}; {CHECK_HINT.format(typed(root))}")

    found = find_scenes(root, stop)
    identities = read_instance_map(root, stop)
    for name in objects:
        if name not in identities:
            raise UserError(f"objects: {name!r} is not in the instance map of {root}.{nearest(name, list(identities))}")
    if not objects or len(set(objects)) < len(objects):
        raise UserError(f"objects = {objects!r}: give at least one, each once")
    columns = {identities[name]: column for column, name in enumerate(objects)}
    names = found if scenes is None else tuple(scenes)
    unknown = [name for name in names if name not in found]
    if unknown:
        raise UserError(
            f"scenes = {names!r}: {root} has no scene {unknown[0]!r}.{nearest(unknown[0], list(found))} "
            f"It has {', '.join(found)}"
        )
    if not names or len(set(names)) < len(names):
        raise UserError(f"scenes = {names!r}: give at least one, each once; {root} has {', '.join(found)}")

    parts, start = [], 0
    for index, name in enumerate(names):
        annotations = read_annotations(root / name, stop)
        images, sizes, position = scene_pictures(root / name, list(annotations), image_size, cache_dir)
        visible = _in_clear_view(annotations, sizes, columns, min_box_size, max_difficulty)
        next_state = _moves(annotations) + start
        parts.append((images, next_state, visible, position, np.full(len(images), index, np.int32)))
        start += len(images)
    images, next_state, visible, position, scene = (np.concatenate(column) for column in zip(*parts, strict=True))
    unseen = [name for name, seen in zip(objects, visible.any(0), strict=True) if not seen]
    if unseen:
        raise UserError(
            f"objects: {', '.join(unseen)} in clear view from no image of {', '.join(names)}; leave out, add scenes, "
            f"or lower min_box_size = {min_box_size} (max_difficulty = {max_difficulty})"
        )
    source = f"{_origin(root)}, {counted(len(names), 'scene')}, {len(images)} images"
    return SearchScenes(images, next_state, visible, position, scene, source)


def find_scenes(root: Path, report: Report) -> tuple[str, ...]:
    """Names of the folders under `root` that hold a scene, sorted."""
    if not root.is_dir():
        report("", "no such folder; give the folder that holds the scenes (Home_001_1, ...)")
        return ()
    if (root / "annotations.json").exists():
        report("", f"this is a scene; give the folder above it, {root.resolve().parent}")
        return ()

    def is_scene(path: Path) -> bool:
        named = bool(SCENE_NAME.fullmatch(path.name))
        return path.is_dir() and (named or (path / "annotations.json").exists() or (path / "jpg_rgb").exists())

    found = tuple(sorted(path.name for path in root.iterdir() if is_scene(path)))
    if not found:
        report("", "no scene folder (such as Home_001_1, with annotations.json and jpg_rgb) in it")
    return found


def read_instance_map(root: Path, report: Report) -> dict[str, int]:
    """Object name -> instance id, from the map at the dataset's root."""
    name = next((name for name in MAPS if (root / name).is_file()), None)
    if name is None:
        report(MAPS[0], "missing: no object has a name")
        return {}
    identities: dict[str, int] = {}
    for number, line in enumerate(read_text(root / name, errors="replace").splitlines(), 1):
        words = line.split()
        if words and (len(words) != 2 or not words[1].isdecimal() or len(words[1]) > 9):
            report(f"{name}:{number}", f"{shown(line)} is not `name id`")
        elif words and (words[0] in identities or int(words[1]) in identities.values()):
            report(f"{name}:{number}", f"the name or the id of {shown(line)} was given before")
        elif words:
            identities[words[0]] = int(words[1])
    return identities


def read_annotations(scene: Path, report: Report) -> dict[str, Annotation]:
    """Image name -> moves and boxes of one scene, by name; what is wrong is reported and left out."""
    where = f"{scene.name}/annotations.json"
    try:
        content = from_json(read_text(scene / "annotations.json"))
    except FileNotFoundError:
        report(where, "missing")
        return {}
    except (OSError, ValueError) as error:
        report(where, f"cannot be read, or cut short: {error}")
        return {}
    if not isinstance(content, dict) or not content:
        report(where, "wants a dictionary with at least one image")
        return {}
    records = {}
    for name, record in sorted(content.items()):
        if isinstance(record, dict):
            records[name] = record
        else:
            report(f"{scene.name}/{name}", "its annotation is not a dictionary")
    return {name: _annotation(f"{scene.name}/{name}", records, name, report) for name in records}


def _annotation(where: str, records: Mapping[str, dict], name: str, report: Report) -> Annotation:
    """The moves and boxes of one image, without those that are wrong."""
    moves, boxes = dict.fromkeys(ACTIONS, ""), []
    for action in ACTIONS:
        target = records[name].get(action)
        if not isinstance(target, str):
            report(where, f"{action} is {target!r}: wants the name of an image, or an empty string")
        elif target and target not in records:
            report(where, f"{action} leads to {target}, which is not there")
        else:
            moves[action] = target
    given = records[name].get("bounding_boxes")
    if not isinstance(given, list):
        report(where, f"bounding_boxes is {given!r}: wants a list")
        return Annotation(moves, boxes)
    for box in given:
        if isinstance(box, list) and len(box) == 6 and all(type(value) in (int, float) for value in box):
            boxes.append(tuple(box))
        else:
            report(where, f"box {box!r}: wants [xmin, ymin, xmax, ymax, id, difficulty]")
    return Annotation(moves, boxes)


def _moves(annotations: Mapping[str, Annotation]) -> np.ndarray:
    """Successor of each state under each action, the state itself where there is no edge: int32 [S, 6]."""
    number = {name: index for index, name in enumerate(annotations)}
    targets = ([moves[action] or name for action in ACTIONS] for name, (moves, _) in annotations.items())
    return np.array([[number[target] for target in row] for row in targets], np.int32)


def _in_clear_view(
    annotations: Mapping[str, Annotation],
    sizes: np.ndarray,
    columns: Mapping[int, int],
    min_box_size: float,
    max_difficulty: int,
) -> np.ndarray:
    """Which objects each image shows large enough: bool [S, N]. `sizes` int [S, 2] are widths and heights in pixels."""
    visible = np.zeros((len(annotations), len(columns)), bool)
    for index, annotation in enumerate(annotations.values()):
        for left, top, right, bottom, identity, difficulty in annotation.boxes:
            large = min(right - left, bottom - top) >= min_box_size * sizes[index, 1]
            if large and difficulty <= max_difficulty and identity in columns:
                visible[index, columns[identity]] = True
    return visible


def _origin(root: Path) -> str:
    """What a dataset is, for reports: the builder of the synthetic house leaves a note at its root."""
    try:
        note = from_json(read_text(root / "synthetic.json"))
        return f"synthetic house, seed {note['seed']} (a stand-in for the Active Vision Dataset)"
    except (OSError, ValueError, KeyError, TypeError):
        return "Active Vision Dataset"
