"""Background images that corrupt goal images (Sec. V-A): CIFAR-10, any folder of images, or the crops that are shipped.

Training and test backgrounds never share an image; of the shipped crops, not even a photograph. CIFAR-10 has no licence
that would allow to ship it, so it is downloaded on demand. The mixing itself is `goals.corrupt`.
"""

import dataclasses
import os
import tarfile
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from infogoal_jax.data import archives, members, pictures
from infogoal_jax.data.archives import user_cache
from infogoal_jax.data.members import Member
from infogoal_jax.errors import UserError, require
from infogoal_jax.files import expanded, read_bytes
from infogoal_jax.stopping import temporary

SIZE = 64
CROP_SIZE = 32  # As in CIFAR-10, so that either is as blurred as the other when it is enlarged.
SHIPPED_CROPS = Path(__file__).parent / "files" / "backgrounds"
CROPS_FILE = "photographs.npz"
CROPS = {
    "train": Member("uint8", ("training crops", "rows of pixels", "columns of pixels", 3)),
    "test": Member("uint8", ("test crops", "rows of pixels", "columns of pixels", 3)),
    "train_photographs": Member("text", ("training photographs",)),
    "test_photographs": Member("text", ("test photographs",)),
}
"""The crops, and the photographs that they were cut from."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp")
CIFAR10_URL = "https://www.cs.toronto.edu/~kriz/cifar-10-binary.tar.gz"
CIFAR10_SHA256 = "c4a38c50a1bc5f3a1c5537f2155ab9d68f9f25eb1ed8d9ddda3db29a59bca1dd"
CIFAR10_FOLDER = "cifar-10-batches-bin"
ARCHIVE = "cifar-10-binary.tar.gz"
TRAIN_BATCHES = tuple(f"data_batch_{number}.bin" for number in range(1, 6))
TEST_BATCHES = ("test_batch.bin",)
REMEDY = "give a folder of images or of CIFAR-10's binary version; without one, shipped photographs are taken"
RECORD = 1 + 3 * CROP_SIZE * CROP_SIZE  # Bytes: a label, then the red, the green and the blue plane.


@dataclasses.dataclass(frozen=True)
class Backgrounds:
    """Background images, RGB, and what they are.

    train: uint8 [M1, 64, 64, 3].
    test: uint8 [M2, 64, 64, 3], of other images.
    source: in words, for reports.
    """

    train: np.ndarray
    test: np.ndarray
    source: str


def load(path: str | os.PathLike = "", count: int = 1000) -> Backgrounds:
    """The backgrounds at `path`, at most `count` for training and as many for test, as the paper's authors use.

    path: empty, the shipped crops of photographs; "cifar10", what `infogoal data download cifar10` left in the cache;
    otherwise a folder: CIFAR-10's binary version or the folder above it, what `tools/build_backgrounds.py` wrote,
    or images.

    Raises UserError if there is no such folder, or if it has none of these or a damaged one.
    """
    require(count >= 1, "count", count, "give at least 1")
    if not str(path):
        return _read_crops(SHIPPED_CROPS, count)
    folder = user_cache() if str(path) == "cifar10" else expanded(path)
    if str(path) == "cifar10":
        require(
            (folder / CIFAR10_FOLDER).exists(),
            "backgrounds",
            str(path),
            f"not in {folder}; get it with: infogoal data download cifar10",
        )
    try:
        return _read_folder(folder, count)
    except OSError as error:
        raise UserError(
            f"backgrounds = {str(path)!r}: {error.filename or folder} cannot be read: {error.strerror or error}"
        ) from error


def _read_folder(folder: Path, count: int) -> Backgrounds:
    """Whichever kind of backgrounds the folder holds."""
    require(folder.exists(), "backgrounds", str(folder), f"there is no such folder; {REMEDY}")
    require(folder.is_dir(), "backgrounds", str(folder), "is a file; give the folder that holds it")
    names = sorted(entry.name for entry in folder.iterdir())
    require(len(names) > 0, "backgrounds", str(folder), f"is empty; {REMEDY}")
    if CIFAR10_FOLDER in names:
        return _read_cifar10(folder / CIFAR10_FOLDER, count)
    if set(names) & {*TRAIN_BATCHES, *TEST_BATCHES}:
        return _read_cifar10(folder, count)
    if CROPS_FILE in names:
        return _read_crops(folder, count)
    return _read_images(folder, names, count)


def _chosen(total: int, count: int) -> np.ndarray:
    """The first `count` of a fixed shuffle of `range(total)`."""
    return np.random.default_rng(0).permutation(total)[:count]


def _read_crops(folder: Path, count: int) -> Backgrounds:
    """Crops of photographs, as `tools/build_backgrounds.py` writes them."""
    with archives.naming("backgrounds", folder / CROPS_FILE, REMEDY):
        train, test, *names = members.read_file(folder / CROPS_FILE, CROPS, REMEDY).values()
        photographs = {name for each in names for name in each.ravel().tolist()}
    train, test = (
        np.stack([pictures.resized(crops[index], SIZE, SIZE) for index in _chosen(len(crops), count)])
        for crops in (train, test)
    )
    return Backgrounds(
        train, test, f"crops of {len(photographs)} public-domain and CC0 photographs, stand-in for CIFAR-10"
    )


def _read_images(folder: Path, names: list[str], count: int) -> Backgrounds:
    """Images of a folder, in order of their names in turn for training and for test."""
    files = [
        folder / name for name in names if not name.startswith(".") and Path(name).suffix.lower() in IMAGE_SUFFIXES
    ]
    files = [file for file in files if not file.is_dir()]
    kinds = ", ".join(suffix[1:] for suffix in IMAGE_SUFFIXES)
    require(
        len(files) > 0, "backgrounds", str(folder), f"has neither images ({kinds}) nor CIFAR-10's binary version in it"
    )
    require(
        len(files) > 1,
        "backgrounds",
        str(folder),
        f"has one image only, {files[0].name}; give at least 2, one to train and one to test with",
    )
    train, test = (
        np.stack([_read_image(part[index]) for index in _chosen(len(part), count)])
        for part in (files[0::2], files[1::2])
    )
    return Backgrounds(train, test, f"images in {folder}")


def _read_image(file: Path) -> np.ndarray:
    """One image, uint8 RGB [SIZE, SIZE, 3], whatever its own shape."""
    image = pictures.decoded(read_bytes(file))
    if image is None:
        raise UserError(
            f"backgrounds = {str(file.parent)!r}: {file.name} cannot be decoded as an image; repair or remove it"
        )
    return pictures.resized(image, SIZE, SIZE)


def _read_cifar10(folder: Path, count: int) -> Backgrounds:
    """CIFAR-10's binary version: data batches for training, test batch for test."""
    missing = [name for name in (*TRAIN_BATCHES, *TEST_BATCHES) if not (folder / name).exists()]
    require(
        not missing,
        "backgrounds",
        str(folder),
        f"CIFAR-10 without {', '.join(missing)}; remove it and download it again",
    )
    train, test = (
        np.concatenate([_read_batch(folder / name) for name in names]) for names in (TRAIN_BATCHES, TEST_BATCHES)
    )
    train, test = (
        np.stack([pictures.resized(images[index], SIZE, SIZE) for index in _chosen(len(images), count)])
        for images in (train, test)
    )
    return Backgrounds(train, test, f"CIFAR-10, {folder}")


def _read_batch(file: Path) -> np.ndarray:
    """The images of one batch, uint8 RGB [records, 32, 32, 3]."""
    batch = np.frombuffer(read_bytes(file), np.uint8)
    if batch.size == 0 or batch.size % RECORD:
        raise UserError(
            f"backgrounds = {str(file.parent)!r}: {file.name} has {batch.size} bytes, not a multiple of {RECORD}; "
            f"remove the folder and download it again"
        )
    records = batch.reshape(-1, RECORD)
    if records[:, 0].max() > 9:
        raise UserError(
            f"backgrounds = {str(file.parent)!r}: {file.name} has labels above 9, so it is not a batch of CIFAR-10"
        )
    return records[:, 1:].reshape(-1, 3, CROP_SIZE, CROP_SIZE).transpose(0, 2, 3, 1)


def download_cifar10(path: str | os.PathLike = "", url: str = CIFAR10_URL, sha256: str = CIFAR10_SHA256) -> Path:
    """Download CIFAR-10 (170 MB) into the folder `path`, by default the cache, and unpack it; the folder of its
    batches.

    What is there already is checked and kept. The archive and the unpacking live in a hidden folder beside, which goes
    away whatever happens; only complete batches are moved to their place.

    Raises UserError if the folder cannot be written to, the download breaks off, or the archive has another checksum.
    """
    require(url.startswith(("http://", "https://")), "url", url, "must begin with http:// or https://")
    folder = expanded(path) if str(path) else user_cache()
    batches = folder / CIFAR10_FOLDER
    if os.path.exists(batches):
        load(batches, 1)
        return batches
    try:
        existing = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
        with tempfile.TemporaryDirectory(prefix=".cifar-10-", dir=existing) as beside, temporary(Path(beside)):
            unpacked = _download(url, Path(beside), sha256)
            folder.mkdir(parents=True, exist_ok=True)
            unpacked.rename(batches)
    except OSError as error:
        raise UserError(
            f"path = {str(folder)!r}: {error.filename or folder} cannot be written to: {error.strerror or error}"
        ) from error
    return batches


def stream(url: str, file: str, asked_by: Any) -> None:
    """Download a file with a bar, as pooch asks for it. Raises `requests.RequestException`."""
    import requests
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

    columns = (TextColumn(ARCHIVE), BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    with requests.get(url, stream=True, timeout=30) as answer, open(file, "wb") as archive:
        answer.raise_for_status()
        size = int(answer.headers.get("content-length", 0)) or None  # A server need not say it.
        with Progress(*columns, console=Console(stderr=True)) as progress:
            task = progress.add_task("", total=size)
            for part in answer.iter_content(1 << 16):
                progress.advance(task, archive.write(part))


def _download(url: str, folder: Path, sha256: str) -> Path:
    """The six batches of the archive, which is checked and unpacked in the folder."""
    import pooch
    import requests

    pooch.get_logger().setLevel("WARNING")
    batches = pooch.Untar([f"{CIFAR10_FOLDER}/{name}" for name in (*TRAIN_BATCHES, *TEST_BATCHES)], ".")
    try:
        pooch.retrieve(url, f"sha256:{sha256}", ARCHIVE, folder, batches, stream)
    except requests.RequestException as error:
        raise UserError(
            f"url = {url!r}: the download of {ARCHIVE} broke off, nothing was kept: {error}. "
            f"Try again, or unpack a copy from elsewhere and give its folder as the path of the backgrounds"
        ) from error
    except (tarfile.TarError, KeyError, EOFError) as error:
        raise UserError(
            f"{ARCHIVE}: is not the archive of CIFAR-10's binary version, nothing was kept: {error}"
        ) from error
    except ValueError as error:
        raise UserError(f"url = {url!r}: {ARCHIVE} has a wrong checksum, nothing was kept: {error}") from error
    _read_cifar10(folder / CIFAR10_FOLDER, 1)
    return folder / CIFAR10_FOLDER
