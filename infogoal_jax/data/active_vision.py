"""Reader of the Active Vision Dataset (Ammirato et al., ICRA 2017) as scenes to search objects in.

The paper's object search (section V-A.2) turns the dataset into a graph: a state is an image, an action one of the six
annotated moves, and a goal is reached where the object's box is large enough for "a clear view". The same reader
serves the real scenes and the synthetic house that is written in their format. Each image is read once, shrunk to a
small grey square and cached, so that a training run holds a kilobyte an image.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from infogoal_jax.data.pictures import CHECK_HINT, scene_pictures
from infogoal_jax.errors import UserError, nearest
from infogoal_jax.files import from_json, read_text

ACTIONS = ("forward", "backward", "left", "right", "rotate_ccw", "rotate_cw")
# A box counts as a clear view where its shorter side is this share of the image height (119 pixels of the real 1080).
DEFAULT_MIN_BOX_SIZE = 0.11
MAX_DIFFICULTY = 4
SMALLEST_IMAGE, LARGEST_IMAGE = 4, 512  # Sides of the grey images, in pixels.


@dataclasses.dataclass(frozen=True)
class SearchScenes:
    """S states (images) of one or more scenes and N objects.

    Attributes:
      images: uint8 [S, H, W], grey.
      next_state: int32 [S, 6], where each of ACTIONS leads; the state itself where there is no move.
      visible: bool [S, N], whether the object is in clear view.
      position: float32 [S, 3], plan x and y in metres and heading in radians, counter-clockwise from x; NaN where
        unknown.
      scene: int32 [S], index into `scene_names`.
      image_names, scene_names, object_names: S file names, scene folders, N object names.
      source: what was read, in words, for reports.
    """

    images: np.ndarray
    next_state: np.ndarray
    visible: np.ndarray
    position: np.ndarray
    scene: np.ndarray
    image_names: tuple[str, ...]
    scene_names: tuple[str, ...]
    object_names: tuple[str, ...]
    source: str


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
    """Read scenes in the dataset's on-disk format.

    Args:
      root: folder that holds the scene folders and `all_instance_id_map.txt` (or `instance_id_map.txt`).
      objects: names of the objects that can be goals, as in that map; their order is that of `visible`.
      scenes: names of scene folders; all that are found by default.
      image_size: side of the grey images in pixels, 4 to 512.
      min_box_size: least shorter side of a box in image heights, so that it means the same at every resolution.
      max_difficulty: boxes of a higher annotated difficulty (1 easy to 5 hard) do not count.
      cache_dir: folder of the cache, by default the user's (`archives.user_cache`). One file a scene.

    Raises:
      UserError: where an argument cannot be used, the dataset is incomplete, or no state shows one of the objects.
    """
    root, objects = Path(root), tuple(objects)
    if not SMALLEST_IMAGE <= image_size <= LARGEST_IMAGE:
        raise UserError(f"image_size = {image_size!r}: must be {SMALLEST_IMAGE} to {LARGEST_IMAGE} pixels")
    if not 0 <= min_box_size < 1:
        raise UserError(f"min_box_size = {min_box_size!r}: must be a share of the image height, from 0 to below 1")
    identities = read_instance_map(root)
    for name in objects:
        if name not in identities:
            raise UserError(f"objects: {name!r} is not in the instance map of {root}.{nearest(name, list(identities))}")
    if not objects or len(set(objects)) < len(objects):
        raise UserError(f"objects = {objects!r}: give at least one, each once")
    columns = {identities[name]: column for column, name in enumerate(objects)}
    found = find_scenes(root)
    names = found if scenes is None else tuple(scenes)
    unknown = [name for name in names if name not in found]
    if unknown:
        raise UserError(
            f"scenes = {names!r}: {root} has no scene {unknown[0]!r}.{nearest(unknown[0], list(found))} "
            f"It has {', '.join(found)}"
        )
    if not names or len(set(names)) < len(names):
        raise UserError(f"scenes = {names!r}: give at least one, each once; {root} has {', '.join(found)}")

    parts, image_names, start = [], [], 0
    for index, name in enumerate(names):
        annotations = read_annotations(root / name)
        images, sizes, position = scene_pictures(root / name, sorted(annotations), image_size, cache_dir)
        visible = _in_clear_view(annotations, sizes, columns, min_box_size, max_difficulty)
        next_state = _moves(root / name, annotations) + start
        parts.append((images, next_state, visible, position, np.full(len(images), index, np.int32)))
        image_names.extend(sorted(annotations))
        start += len(images)
    images, next_state, visible, position, scene = (np.concatenate(column) for column in zip(*parts, strict=True))
    unseen = [name for name, seen in zip(objects, visible.any(0), strict=True) if not seen]
    if unseen:
        raise UserError(
            f"objects: {', '.join(unseen)} in clear view from no image of {', '.join(names)}; leave out, add scenes, "
            f"or lower min_box_size = {min_box_size} (max_difficulty = {max_difficulty})"
        )
    source = f"{_origin(root)}, {len(names)} scene{'s' if len(names) > 1 else ''}, {len(images)} images"
    return SearchScenes(images, next_state, visible, position, scene, tuple(image_names), tuple(names), objects, source)


def read_instance_map(root: Path) -> dict[str, int]:
    """Object name -> instance id, from the map at the dataset's root."""
    if not root.is_dir():
        raise UserError(f"dataset {root}: no such folder; give the folder that holds the scenes (Home_001_1, ...)")
    for name in ("all_instance_id_map.txt", "instance_id_map.txt"):
        if (root / name).is_file():
            try:
                pairs = [line.split() for line in read_text(root / name).splitlines() if line.strip()]
                return {object_name: int(identity) for object_name, identity in pairs}
            except (OSError, ValueError) as error:
                raise UserError(
                    f"{root / name}: wants lines of `name id` ({error}); {CHECK_HINT.format(root)}"
                ) from error
    raise UserError(f"dataset {root}: has no all_instance_id_map.txt; {CHECK_HINT.format(root)}")


def find_scenes(root: Path) -> tuple[str, ...]:
    """Names of the folders under `root` that hold a scene, sorted."""
    found = tuple(
        sorted(p.name for p in root.iterdir() if (p / "annotations.json").exists() or (p / "jpg_rgb").is_dir())
    )
    if not found:
        raise UserError(f"dataset {root}: no scene folder (one with annotations.json and jpg_rgb) in it")
    return found


def read_annotations(scene: Path) -> dict[str, dict]:
    """Image name -> moves and boxes of one scene, checked for the fields that are used."""
    path = scene / "annotations.json"
    try:
        annotations = from_json(read_text(path))
        for record in annotations.values():
            for action in ACTIONS:
                record[action].startswith("")
            for box in record["bounding_boxes"]:
                _, _, _, _, _, _ = (value + 0 for value in box)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror or error}; {CHECK_HINT.format(scene.parent)}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        reason = f"has no field {error}" if isinstance(error, KeyError) else f"damaged or cut short ({error})"
        raise UserError(f"{path}: {reason}; {CHECK_HINT.format(scene.parent)}") from error
    if not annotations:
        raise UserError(f"{path}: names no image; {CHECK_HINT.format(scene.parent)}")
    return annotations


def _moves(scene: Path, annotations: Mapping[str, dict]) -> np.ndarray:
    """Successor of each state under each action, the state itself where there is no edge: int32 [S, 6]."""
    number = {name: index for index, name in enumerate(sorted(annotations))}
    moves = np.empty((len(number), len(ACTIONS)), np.int32)
    for name, index in number.items():
        for column, action in enumerate(ACTIONS):
            target = annotations[name][action]
            if target and target not in number:
                raise UserError(
                    f"{scene}: {action} of {name} leads to {target}, which is not annotated; "
                    f"{CHECK_HINT.format(scene.parent)}"
                )
            moves[index, column] = number[target] if target else index
    return moves


def _in_clear_view(
    annotations: Mapping[str, dict],
    sizes: np.ndarray,
    columns: Mapping[int, int],
    min_box_size: float,
    max_difficulty: int,
) -> np.ndarray:
    """Which objects each image shows large enough: bool [S, N]. `sizes` int [S, 2] are widths and heights in pixels."""
    visible = np.zeros((len(annotations), len(columns)), bool)
    for index, name in enumerate(sorted(annotations)):
        for left, top, right, bottom, identity, difficulty in annotations[name]["bounding_boxes"]:
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
