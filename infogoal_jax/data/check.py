"""Everything that is wrong with a folder in the Active Vision Dataset's format, found in one pass.

The reader (active_vision.py) stops at the first fault; whoever has a damaged copy of some ten gigabytes wants the whole
list. An error is what makes the data unusable or a goal impossible. A warning is what costs little, such as no
positions. Each image is read once.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from infogoal_jax.data import pictures
from infogoal_jax.data.active_vision import ACTIONS, DEFAULT_MIN_BOX_SIZE, MAX_DIFFICULTY
from infogoal_jax.errors import UserError, shown
from infogoal_jax.files import from_json, read_bytes, read_text

MAPS = ("all_instance_id_map.txt", "instance_id_map.txt")
SCENE_NAME = re.compile(r"(Home|Office)_\d{3}_\d")


@dataclasses.dataclass(frozen=True)
class Finding:
    """One fault: `severity` is "error" or "warning", `where` the file or the image, `problem` what is wrong with it."""

    severity: str
    where: str
    problem: str


def check_active_vision(path: str | os.PathLike) -> list[Finding]:
    """Every fault of the dataset at `path`, the folder that holds the scenes; empty if there is none."""
    root = Path(path)
    if not root.is_dir():
        return [Finding("error", str(root), "no such folder")]
    if (root / "annotations.json").exists():
        return [Finding("error", str(root), f"this is a scene; give the folder above it, {root.resolve().parent}")]
    names, findings = _check_maps(root)
    scenes = sorted(
        p
        for p in root.iterdir()
        if p.is_dir()
        and (SCENE_NAME.fullmatch(p.name) or (p / "annotations.json").exists() or (p / "jpg_rgb").exists())
    )
    if not scenes:
        findings.append(
            Finding("error", str(root), "no scene folder (such as Home_001_1, with annotations.json and jpg_rgb) in it")
        )
    for scene in scenes:
        findings.extend(_check_scene(scene, names))
    return findings


def _check_maps(root: Path) -> tuple[dict[str, int], list[Finding]]:
    """Object name -> id, as far as it can be read, and what is wrong with the maps."""
    maps, findings = [], []
    for name in MAPS:
        if not (root / name).exists():
            continue
        entries: dict[str, int] = {}
        for number, line in enumerate(read_text(root / name, errors="replace").splitlines(), 1):
            words = line.split()
            if not words:
                continue
            if len(words) != 2 or not words[1].isdecimal() or len(words[1]) > 9:
                findings.append(Finding("error", f"{name}:{number}", f"{shown(line)} is not `name id`"))
            elif words[0] in entries or int(words[1]) in entries.values():
                findings.append(
                    Finding("error", f"{name}:{number}", f"the name or the id of {shown(line)} was given before")
                )
            else:
                entries[words[0]] = int(words[1])
        maps.append(entries)
    if not maps:
        findings.append(Finding("error", MAPS[0], "missing: no object has a name"))
        return {}, findings
    return maps[0], findings


def _check_scene(scene: Path, names: dict[str, int]) -> Iterator[Finding]:
    annotations, findings = _read_annotations(scene)
    yield from findings
    present, findings = _read_present(scene, names)
    yield from findings
    sizes, findings = _read_images(scene, set(annotations))
    yield from findings
    yield from _check_poses(scene, sorted(annotations))
    for name, record in sorted(annotations.items()):
        where = f"{scene.name}/{name}"
        yield from _check_moves(where, record, annotations)
        yield from _check_boxes(where, record, sizes.get(name), set(names.values()))
    if annotations:
        yield from _check_objects(scene, annotations, sizes, present)


def _read_annotations(scene: Path) -> tuple[dict[str, dict], list[Finding]]:
    """Records that are at least dictionaries, and what is wrong with the file."""
    where = f"{scene.name}/annotations.json"
    try:
        content = from_json(read_text(scene / "annotations.json"))
    except FileNotFoundError:
        return {}, [Finding("error", where, "missing")]
    except (OSError, ValueError) as error:
        return {}, [Finding("error", where, f"cannot be read, or cut short: {error}")]
    if not isinstance(content, dict) or not content:
        return {}, [Finding("error", where, "wants a dictionary with at least one image")]
    findings = [
        Finding("error", f"{scene.name}/{n}", "its annotation is not a dictionary")
        for n, r in content.items()
        if not isinstance(r, dict)
    ]
    return {name: record for name, record in content.items() if isinstance(record, dict)}, findings


def _read_present(scene: Path, names: dict[str, int]) -> tuple[dict[str, int], list[Finding]]:
    """The objects that a scene says it has, with their ids."""
    where = f"{scene.name}/present_instance_names.txt"
    findings = []
    if not (scene / "image_structs.mat").exists():
        unknown = "missing: positions are unknown, trajectories cannot be drawn"
        findings.append(Finding("warning", f"{scene.name}/image_structs.mat", unknown))
    try:
        listed = read_text(scene / "present_instance_names.txt", errors="replace").split()
    except OSError:
        return {}, [*findings, Finding("warning", where, "missing: objects that no image shows cannot be found out")]
    findings += [
        Finding("error", where, f"{name!r} is not in the instance map") for name in listed if name not in names
    ]
    return {name: names[name] for name in listed if name in names}, findings


def _read_images(scene: Path, annotated: set[str]) -> tuple[dict[str, tuple[int, int]], list[Finding]]:
    """Width and height of each image that can be decoded. Decoding is by threads, a file a thread at a time."""
    folder, findings = scene / "jpg_rgb", []
    if not folder.is_dir():
        return {}, [Finding("error", f"{scene.name}/jpg_rgb", "missing")]
    files = set(os.listdir(folder))
    findings += [
        Finding("error", f"{scene.name}/jpg_rgb/{name}", "missing, but annotated") for name in sorted(annotated - files)
    ]
    present = sorted(annotated & files)
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as threads:
        sizes = dict(zip(present, threads.map(lambda name: _decode(folder / name), present), strict=True))
    findings += [
        Finding("error", f"{scene.name}/jpg_rgb/{name}", "not a whole JPEG image")
        for name in present
        if sizes[name] is None
    ]
    return {name: size for name, size in sizes.items() if size is not None}, findings


def _decode(path: Path) -> tuple[int, int] | None:
    """Size of an image that decodes to its end, else None. An eighth of the resolution still reads all the data."""
    import cv2  # Only now: it takes a tenth of a second.

    try:
        data = read_bytes(path)
    except OSError:
        return None
    size = pictures.decode_size(data)
    if size is None or cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_REDUCED_GRAYSCALE_8) is None:
        return None
    return size


def _check_poses(scene: Path, names: list[str]) -> Iterator[Finding]:
    if not (scene / "image_structs.mat").exists():
        return
    try:
        pictures.read_positions(scene, names)
    except UserError:
        yield Finding("error", f"{scene.name}/image_structs.mat", "cannot be read, or cut short")


def _check_moves(where: str, record: dict, annotations: dict[str, dict]) -> Iterator[Finding]:
    for action in ACTIONS:
        target = record.get(action)
        if not isinstance(target, str):
            yield Finding("error", where, f"{action} is {target!r}: wants the name of an image, or an empty string")
        elif target and target not in annotations:
            yield Finding("error", where, f"{action} leads to {target}, which is not there")


def _boxes(record: dict) -> list[list]:
    """The boxes of a record that are six numbers."""
    boxes = record.get("bounding_boxes")
    return [box for box in boxes if _is_box(box)] if isinstance(boxes, list) else []


def _is_box(box: object) -> bool:
    return isinstance(box, list) and len(box) == 6 and all(type(value) in (int, float) for value in box)


def _check_boxes(where: str, record: dict, size: tuple[int, int] | None, known: set[int]) -> Iterator[Finding]:
    boxes = record.get("bounding_boxes")
    if not isinstance(boxes, list):
        yield Finding("error", where, f"bounding_boxes is {boxes!r}: wants a list")
        return
    for box in boxes:
        if not _is_box(box):
            yield Finding("error", where, f"box {box!r}: wants [xmin, ymin, xmax, ymax, id, difficulty]")
            continue
        left, top, right, bottom, identity, _ = box
        if right <= left or bottom <= top:
            yield Finding("error", where, f"box {box}: inverted or empty")
        if size is not None and (
            min(left, right) < 0 or min(top, bottom) < 0 or max(left, right) > size[0] or max(top, bottom) > size[1]
        ):
            yield Finding("error", where, f"box {box}: outside the image of {size[0]} x {size[1]} pixels")
        if identity not in known:
            yield Finding("error", where, f"box {box}: id {identity} is not in the instance map")


def _check_objects(
    scene: Path, annotations: dict[str, dict], sizes: dict[str, tuple[int, int]], present: dict[str, int]
) -> Iterator[Finding]:
    """Objects that are in no image, in no clear view, or only in images that no move from elsewhere leads to."""
    shown: dict[int, set[str]] = {}
    clear: dict[int, set[str]] = {}
    for name, record in annotations.items():
        for left, top, right, bottom, identity, difficulty in _boxes(record):
            shown.setdefault(identity, set()).add(name)
            large = name in sizes and min(right - left, bottom - top) >= DEFAULT_MIN_BOX_SIZE * sizes[name][1]
            if large and difficulty <= MAX_DIFFICULTY:
                clear.setdefault(identity, set()).add(name)
    entrances: dict[str, set[str]] = {}
    for name, record in annotations.items():
        for action in ACTIONS:
            if isinstance(record.get(action), str):
                entrances.setdefault(record[action], set()).add(name)
    for name, identity in sorted(present.items()):
        where = f"{scene.name}: {name}"
        if identity not in shown:
            yield Finding("error", where, "can be seen from nowhere: no image has a box of it")
            continue
        if identity not in clear:
            yield Finding(
                "warning",
                where,
                f"no box of it is a clear view (min_box_size {DEFAULT_MIN_BOX_SIZE}, max_difficulty {MAX_DIFFICULTY})",
            )
        views = clear.get(identity, shown[identity])
        if not any(entrances.get(view, set()) - views for view in views) and len(views) < len(annotations):
            yield Finding(
                "error", where, f"can be reached from nowhere: no move leads to the {len(views)} images that show it"
            )
