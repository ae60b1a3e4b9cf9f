"""Builds the shipped backgrounds: 32x32 crops of public-domain and CC0 photographs that come with scikit-image and
matplotlib.

    pip install scikit-image==0.26 matplotlib==3.11
    python tools/build_backgrounds.py FOLDER --seed 1

Only photographs whose licence is stated are taken, known by their checksum, and each is used either to train or to
test, so that a test background is never a piece of a photograph seen in training.
"""

import argparse
import dataclasses
import hashlib
import importlib.util
from pathlib import Path

import cv2
import numpy as np

from infogoal_jax.data.archives import new_folder
from infogoal_jax.data.backgrounds import CROP_SIZE, CROPS_FILE
from infogoal_jax.errors import UserError

MIN_CONTRAST = 8.0  # Grey levels: a crop of plain sky would change nothing but the brightness of a goal image.


@dataclasses.dataclass(frozen=True)
class Photograph:
    """A photograph in an installed package, where it is from, the licence it is under, and its use ("train" or
    "test")."""

    name: str
    package: str
    file: str
    sha256: str
    author: str
    source: str
    licence: str
    use: str


def _of_scikit_image(file: str, sha256: str, author: str, source: str, licence: str, use: str) -> Photograph:
    return Photograph(Path(file).stem, "skimage", f"data/{file}", sha256, author, source, licence, use)


PHOTOGRAPHS = (
    _of_scikit_image(
        "astronaut.png",
        "88431cd9653ccd539741b555fb0a46b61558b301d4110412b5bc28b5e3ea6cb5",
        "NASA",
        "NASA Great Images, https://flic.kr/p/r9qvLn",
        "public domain",
        "train",
    ),
    _of_scikit_image(
        "coffee.png",
        "cc02f8ca188b167c775a7101b5d767d1e71792cf762c33d6fa15a4599b5a8de7",
        "Rachel Michetti",
        "courtesy of Pikolo Espresso Bar",
        "CC0",
        "train",
    ),
    _of_scikit_image(
        "hubble_deep_field.jpg",
        "3a19c5dd8a927a9334bb1229a6d63711b1c0c767fb27e2286e7c84a3e2c2f5f4",
        "NASA",
        "http://hubblesite.org/newscenter/archive/releases/2012/37/image/a/",
        "public domain",
        "train",
    ),
    _of_scikit_image(
        "retina.jpg",
        "38a07f36f27f095e818aea7b96d34202c05176d30253c66733f2e00379e9e0e6",
        "Mikael Häggström",
        "https://commons.wikimedia.org/wiki/File:Fundus_photograph_of_normal_left_eye.jpg",
        "CC0",
        "train",
    ),
    _of_scikit_image(
        "camera.png",
        "b0793d2adda0fa6ae899c03989482bff9a42d3d5690fc7e3648f2795d730c23a",
        "Lav Varshney",
        "https://github.com/scikit-image/scikit-image/issues/3927",
        "CC0",
        "train",
    ),
    _of_scikit_image(
        "grass.png",
        "b6b6022426b38936c43a4ac09635cd78af074e90f42ffa8227ac8b7452d39f89",
        "linolafett",
        "https://www.deviantart.com/linolafett/art/Grass-01-434853879",
        "CC0",
        "train",
    ),
    _of_scikit_image(
        "chelsea.png",
        "596aa1e7cb875eb79f437e310381d26b338a81c2da23439704a73c4651e8c4bb",
        "Stefan van der Walt",
        "scikit-image",
        "CC0",
        "test",
    ),
    _of_scikit_image(
        "rocket.jpg",
        "c2dd0de7c538df8d111e479619b129464d0269d0ae5fd18ca91d33a7fdfea95c",
        "SpaceX",
        "https://www.flickr.com/photos/spacexphotos/16511594820/in/photostream/",
        "public domain",
        "test",
    ),
    Photograph(
        "grace_hopper",
        "matplotlib",
        "mpl-data/sample_data/grace_hopper.jpg",
        "a8ca6d734765703b09728ab47fe59f473d93ae3967fc24c7c0288c3c7adb7130",
        "United States Navy",
        "https://github.com/matplotlib/matplotlib/pull/1599",
        "public domain",
        "test",
    ),
    _of_scikit_image(
        "brick.png",
        "7966caf324f6ba843118d98f7a07746d22f6a343430add0233eca5f6eaaa8fcf",
        "CC0Textures",
        "https://cc0textures.com/view.php?tex=Bricks25",
        "CC0",
        "test",
    ),
    _of_scikit_image(
        "gravel.png",
        "c48615b451bf1e606fbd72c0aa9f8cc0f068ab7111ef7d93bb9b0f2586440c12",
        "CC0Textures",
        "https://cc0textures.com/view.php?tex=Gravel04",
        "CC0",
        "test",
    ),
    _of_scikit_image(
        "clock_motion.png",
        "f029226b28b642e80113d86622e9b215ee067a0966feaf5e60604a1e05733955",
        "Stefan van der Walt",
        "scikit-image",
        "public domain",
        "test",
    ),
)


def build_backgrounds(folder: Path, seed: int = 0, crops_of_each: int = 84) -> None:
    """Write photographs.npz and LICENCES.md into the folder.

    photographs.npz: train, test uint8 RGB [M, 32, 32, 3]; train_photographs, test_photographs: str [M], the photograph
    of each crop.

    Raises UserError if a photograph's package is not installed or has another file under its name.
    """
    crops, names = {"train": [], "test": []}, {"train": [], "test": []}
    for number, photograph in enumerate(PHOTOGRAPHS):
        # A generator of its own for each, so that one more photograph leaves the crops of the others as they are.
        crops[photograph.use].append(cut_crops(read(photograph), crops_of_each, np.random.default_rng([seed, number])))
        names[photograph.use] += [photograph.name] * crops_of_each
    train, test = (np.concatenate(crops[use]) for use in ("train", "test"))
    with new_folder(folder, "path") as beside:
        np.savez_compressed(
            beside / CROPS_FILE,
            train=train,
            test=test,
            train_photographs=names["train"],
            test_photographs=names["test"],
        )
        (beside / "LICENCES.md").write_text(licences(), encoding="utf-8")


def read(photograph: Photograph) -> np.ndarray:
    """The photograph, uint8 RGB [height, width, 3], out of the installed package, which is not imported."""
    package = importlib.util.find_spec(photograph.package)
    if package is None:
        raise UserError(
            f"{photograph.name}: {photograph.package} is not installed; install it with: pip install "
            "scikit-image==0.26 matplotlib==3.11"
        )
    file = Path(package.submodule_search_locations[0]) / photograph.file
    if not file.exists():
        raise UserError(f"{photograph.name}: {file} is not there; install scikit-image 0.26 and matplotlib 3.11")
    content = file.read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if found != photograph.sha256:
        raise UserError(
            f"{photograph.name}: {file} is not the photograph whose licence is known: expected sha256 "
            f"{photograph.sha256}, found {found}. "
            f"Install scikit-image 0.26 and matplotlib 3.11"
        )
    return cv2.cvtColor(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def cut_crops(photograph: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """Square crops anywhere, from 32 pixels wide to all that fits, each octave alike, averaged down to uint8 [count,
    32, 32, 3]."""
    height, width = photograph.shape[:2]
    crops = []
    while len(crops) < count:
        side = round(np.exp(generator.uniform(np.log(CROP_SIZE), np.log(min(height, width)))))
        top, left = generator.integers(height - side + 1), generator.integers(width - side + 1)
        crop = cv2.resize(
            photograph[top : top + side, left : left + side], (CROP_SIZE, CROP_SIZE), interpolation=cv2.INTER_AREA
        )
        if crop.mean(axis=2).std() >= MIN_CONTRAST:
            crops.append(crop)
    return np.stack(crops)


def licences() -> str:
    """The text of LICENCES.md: each photograph with author, source, licence and use."""
    packages = {"skimage": "scikit-image 0.26", "matplotlib": "matplotlib 3.11"}
    rows = [
        f"| {each.name} | {each.author} | {each.source} | {packages[each.package]} | {each.licence} | {each.use} |"
        for each in PHOTOGRAPHS
    ]
    return "\n".join(
        (
            "# Photographs",
            "",
            f"`{CROPS_FILE}` holds crops of {len(PHOTOGRAPHS)} photographs, a stand-in for CIFAR-10, cut by "
            "`tools/build_backgrounds.py`.",
            "Licences are those stated by the package (scikit-image: docstrings of `skimage.data`; matplotlib: the "
            "pull request that",
            "is linked).",
            "",
            "| photograph | author | source | package | licence | use |",
            "|---|---|---|---|---|---|",
            *rows,
            "",
        )
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("folder", type=Path, help="must not exist yet, or be empty")
    parser.add_argument("--seed", type=int, default=0, help="of the crops' places and sizes; 0: the shipped ones")
    parser.add_argument("--crops-of-each", type=int, default=84)
    arguments = parser.parse_args()
    build_backgrounds(arguments.folder, arguments.seed, arguments.crops_of_each)
