"""Everything that is wrong with a folder in the Active Vision Dataset's format, found in one pass.

The reader (active_vision.py) stops at the first fault; whoever has a damaged copy of some ten gigabytes wants the whole
list. An error is what makes the data unusable or a goal impossible. A warning is what costs little, such as no
positions. Each image is read once.
"""

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from infogoal_jax.data import active_vision, pictures
from infogoal_jax.data.active_vision import DEFAULT_MIN_BOX_SIZE, MAX_DIFFICULTY, Annotation, Report
from infogoal_jax.data.members import Finding
from infogoal_jax.errors import UserError
from infogoal_jax.files import read_text

Sizes = Mapping[str, tuple[int, int]]
"""Width and height of each image that can be decoded, by name."""


def check_active_vision(path: str | os.PathLike) -> list[Finding]:
    """Every fault of the dataset at `path`, the folder that holds the scenes; empty if there is none."""
    root, findings = Path(path), []

    def error(where: str, problem: str) -> None:
        findings.append(Finding("error", where or str(root), problem))

    def warn(where: str, problem: str) -> None:
        findings.append(Finding("warning", where, problem))

    scenes = active_vision.find_scenes(root, error)
    identities = active_vision.read_instance_map(root, error) if scenes else {}
    for name in scenes:
        _check_scene(root / name, identities, error, warn)
    return findings


def _check_scene(scene: Path, identities: Mapping[str, int], error: Report, warn: Report) -> None:
    annotations = active_vision.read_annotations(scene, error)
    present = _read_present(scene, identities, error, warn)
    sizes = _read_images(scene, set(annotations), error)
    if not (scene / "image_structs.mat").exists():
        warn(f"{scene.name}/image_structs.mat", "missing: positions are unknown, trajectories cannot be drawn")
    else:
        try:
            pictures.read_positions(scene, list(annotations))
        except UserError:
            error(f"{scene.name}/image_structs.mat", "cannot be read, or cut short")
    for name, annotation in annotations.items():
        _check_boxes(f"{scene.name}/{name}", annotation, sizes.get(name), set(identities.values()), error)
    if annotations:
        _check_objects(scene, annotations, sizes, present, error, warn)


def _read_present(scene: Path, identities: Mapping[str, int], error: Report, warn: Report) -> dict[str, int]:
    """The objects that a scene says it has, with their ids."""
    where = f"{scene.name}/present_instance_names.txt"
    try:
        listed = read_text(scene / "present_instance_names.txt", errors="replace").split()
    except OSError:
        warn(where, "missing: objects that no image shows cannot be found out")
        return {}
    for name in listed:
        if name not in identities:
            error(where, f"{name!r} is not in the instance map")
    return {name: identities[name] for name in listed if name in identities}


def _read_images(scene: Path, annotated: set[str], error: Report) -> Sizes:
    """The sizes of the images. Decoding is by threads, a file a thread at a time."""
    folder = scene / "jpg_rgb"
    if not folder.is_dir():
        error(f"{scene.name}/jpg_rgb", "missing")
        return {}
    files = set(os.listdir(folder))
    for name in sorted(annotated - files):
        error(f"{scene.name}/jpg_rgb/{name}", "missing, but annotated")
    present = sorted(annotated & files)
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as threads:
        sizes = dict(zip(present, threads.map(lambda name: _size(folder / name), present), strict=True))
    for name in present:
        if sizes[name] is None:
            error(f"{scene.name}/jpg_rgb/{name}", "not a whole JPEG image")
    return {name: size for name, size in sizes.items() if size is not None}


def _size(path: Path) -> tuple[int, int] | None:
    """Width and height of an image that decodes to its end, else None."""
    try:
        return pictures.read_grey(path, 1)[1]
    except UserError:
        return None


def _check_boxes(
    where: str, annotation: Annotation, size: tuple[int, int] | None, known: set[int], error: Report
) -> None:
    for box in map(list, annotation.boxes):
        left, top, right, bottom, identity, _ = box
        if right <= left or bottom <= top:
            error(where, f"box {box}: inverted or empty")
        if size is not None and (
            min(left, right) < 0 or min(top, bottom) < 0 or max(left, right) > size[0] or max(top, bottom) > size[1]
        ):
            error(where, f"box {box}: outside the image of {size[0]} x {size[1]} pixels")
        if identity not in known:
            error(where, f"box {box}: id {identity} is not in the instance map")


def _check_objects(
    scene: Path,
    annotations: Mapping[str, Annotation],
    sizes: Sizes,
    present: Mapping[str, int],
    error: Report,
    warn: Report,
) -> None:
    """Objects that are in no image, in no clear view, or only in images that no move from elsewhere leads to."""
    shown: dict[int, set[str]] = {}
    clear: dict[int, set[str]] = {}
    entrances: dict[str, set[str]] = {}
    for name, (moves, boxes) in annotations.items():
        for left, top, right, bottom, identity, difficulty in boxes:
            shown.setdefault(identity, set()).add(name)
            large = name in sizes and min(right - left, bottom - top) >= DEFAULT_MIN_BOX_SIZE * sizes[name][1]
            if large and difficulty <= MAX_DIFFICULTY:
                clear.setdefault(identity, set()).add(name)
        for target in moves.values():
            entrances.setdefault(target, set()).add(name)
    for name, identity in sorted(present.items()):
        where = f"{scene.name}: {name}"
        if identity not in shown:
            error(where, "can be seen from nowhere: no image has a box of it")
            continue
        if identity not in clear:
            least = f"min_box_size {DEFAULT_MIN_BOX_SIZE}, max_difficulty {MAX_DIFFICULTY}"
            warn(where, f"no box of it is a clear view ({least})")
        views = clear.get(identity, shown[identity])
        if not any(entrances.get(view, set()) - views for view in views) and len(views) < len(annotations):
            error(where, f"can be reached from nowhere: no move leads to the {len(views)} images that show it")
