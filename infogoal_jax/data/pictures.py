"""Colour images as OpenCV reads them, and at another size; and the images of a scene of the Active Vision Dataset,
shrunk to small grey squares and cached."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
from pathlib import Path

import numpy as np

from infogoal_jax.data import archives, members
from infogoal_jax.data.members import Member
from infogoal_jax.errors import UserError
from infogoal_jax.files import read_bytes

CACHE_VERSION = 1
CHECK_HINT = "`infogoal data check {}` lists everything that is wrong"


def decoded(content: bytes) -> np.ndarray | None:
    """The image in these bytes, uint8 RGB [H, W, 3]; None where they are damaged or no image that OpenCV reads."""
    import cv2  # Only now: it takes a tenth of a second.

    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
    except cv2.error:
        image = None
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """An image at this size. What shrinks is averaged over areas: interpolation between single pixels would alias."""
    import cv2

    shrinks = image.shape[0] >= height and image.shape[1] >= width
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def scene_pictures(
    scene: Path, names: list[str], image_size: int, cache_dir: str | os.PathLike | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grey images uint8 [S, H, W], original sizes int32 [S, 2] and positions float32 [S, 3], from the cache if it
    fits."""
    key = cache_key(scene, names, image_size)
    path = Path(cache_dir or archives.user_cache()) / f"active_vision_{scene.name}_{key}.npz"
    cached = {
        "images": Member("uint8", (len(names), image_size, image_size)),
        "sizes": Member("int32", (len(names), 2)),
        "position": Member("float32", (len(names), 3), finite=False),
    }
    with contextlib.suppress(OSError, UserError):  # Absent or damaged: it is made again below.
        return tuple(members.read_file(path, cached, "it is made again").values())
    images, sizes = (np.empty(cached[name].shape, cached[name].kind) for name in ("images", "sizes"))
    for index, name in enumerate(names):
        images[index], sizes[index] = read_grey(scene / "jpg_rgb" / name, image_size)
    position = read_positions(scene, names)
    with contextlib.suppress(OSError):  # A folder that cannot be written costs only the cache.
        archives.write(path, {"images": images, "sizes": sizes, "position": position})
    return images, sizes, position


def read_grey(path: Path, image_size: int) -> tuple[np.ndarray, tuple[int, int]]:
    """One image as a small grey square, and its own width and height. Raises `UserError` if it is no whole image."""
    import cv2  # Only now: it takes a tenth of a second.
    from PIL import Image

    try:
        with Image.open(io.BytesIO(read_bytes(path))) as image:
            size = image.size
            # The decoder itself can skip detail: a full HD frame is read at an eighth, sixty times less memory.
            image.draft("L", (2 * image_size, 2 * image_size))
            grey = np.asarray(image.convert("L"))
    except Exception as error:  # Pillow raises errors of many kinds for a damaged file.
        raise UserError(f"{path}: not a whole JPEG image ({error}); {CHECK_HINT.format(path.parents[2])}") from error
    return cv2.resize(grey, (image_size, image_size), interpolation=cv2.INTER_AREA), size


def read_positions(scene: Path, names: list[str]) -> np.ndarray:
    """Plan position (metres) and heading (radians) of each image from image_structs.mat; NaN where it says nothing."""
    position = np.full((len(names), 3), np.nan, np.float32)
    path = scene / "image_structs.mat"
    if not path.is_file():
        return position
    import scipy.io  # Only now: it takes a tenth of a second.

    try:
        content = scipy.io.loadmat(path)
        scale, records = float(content["scale"].ravel()[0]), content["image_structs"].ravel()
        number = {name: index for index, name in enumerate(names)}
        for record in records:
            index = number.get(str(np.ravel(record["image_name"])[0]))
            world, direction = np.ravel(record["world_pos"]), np.ravel(record["direction"])
            if index is None or len(world) != 3 or len(direction) != 3:
                continue
            # world_pos * scale is in millimetres; height is the middle component.
            position[index, :2] = world[[0, 2]] * scale / 1000
            position[index, 2] = np.arctan2(direction[2], direction[0])
    except Exception as error:  # scipy raises errors of many kinds for a damaged file
        raise UserError(f"{path}: cannot be read ({error}); {CHECK_HINT.format(scene.parent)}") from error
    return position


def cache_key(scene: Path, names: list[str], image_size: int) -> str:
    """Digest of what decides a scene's pictures: its path, and name, size and time of every file that is read."""
    digest = hashlib.sha256(f"{CACHE_VERSION} {image_size} {scene.resolve()}".encode())
    try:
        with os.scandir(scene / "jpg_rgb") as entries:
            stamps = {entry.name: entry.stat() for entry in entries}
    except OSError as error:
        raise UserError(f"{scene / 'jpg_rgb'}: {error.strerror or error}; {CHECK_HINT.format(scene.parent)}") from error
    missing = [name for name in names if name not in stamps]
    if missing:
        raise UserError(
            f"{scene / 'jpg_rgb'}: {len(missing)} of {len(names)} annotated images are missing, the first "
            f"{missing[0]}; "
            f"{CHECK_HINT.format(scene.parent)}"
        )
    for name in names:
        digest.update(f"{name} {stamps[name].st_size} {stamps[name].st_mtime_ns}\n".encode())
    for path in (scene / "annotations.json", scene / "image_structs.mat"):
        if path.is_file():
            digest.update(f"{path.name} {path.stat().st_size} {path.stat().st_mtime_ns}\n".encode())
    return digest.hexdigest()[:24]
