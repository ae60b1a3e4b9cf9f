"""How long a large dataset takes to load, and how much memory: 20 scenes of 1,000 images or more, first and second
time.

    python benchmarks/speed/dataset_loading.py [FOLDER] [--scenes 20] [--image-width 160]

The scenes are built cheaply: one synthetic house is drawn and photographed once, and its images, boxes and moves are
written under many scene names, with the digits of the names changed. Every scene has files of its own, so reading,
decoding and caching are the real work; the pictures are the same in every scene and smaller than the real 1920 x 1080
ones. With --enlarge the images are written at 1920 x 1080 (about 6 GB for 20 scenes), the decoder's work on the real
dataset. Without FOLDER a temporary one is used and removed. The two loads run in processes of their own: peak memory is
theirs alone.
"""

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2

from infogoal_jax.data import active_vision
from infogoal_jax.data.splits import AUTHORS_SPLIT
from infogoal_jax.stand_ins import house

LEAST_IMAGES = 1000


def build(root: Path, scenes: int, image_width: int, enlarge: bool) -> None:
    """Write `scenes` scenes with the pictures of one house under `root`."""
    first = house.build_house(root, seed=0, scene="Home_101_1", image_width=image_width)
    annotations = json.loads((first / "annotations.json").read_text())
    if len(annotations) < LEAST_IMAGES:
        raise SystemExit(f"a scene has {len(annotations)} images, fewer than {LEAST_IMAGES}")
    if enlarge:
        for record in annotations.values():
            record["bounding_boxes"] = [
                [*(1920 // image_width * v for v in box[:4]), *box[4:]] for box in record["bounding_boxes"]
            ]
        for path in (first / "jpg_rgb").iterdir():
            cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (1920, 1080), interpolation=cv2.INTER_CUBIC))
        (first / "annotations.json").write_text(json.dumps(annotations))
    text = (first / "annotations.json").read_text()
    for number in range(102, 101 + scenes):
        scene = root / f"Home_{number}_1"
        (scene / "jpg_rgb").mkdir(parents=True)
        for name in annotations:
            shutil.copyfile(first / "jpg_rgb" / name, scene / "jpg_rgb" / renamed(name, number))
        (scene / "annotations.json").write_text(text.replace('"01011', f'"0{number}1'))
        for name in ("cameras.txt", "present_instance_names.txt"):
            shutil.copyfile(first / name, scene / name)


def renamed(name: str, number: int) -> str:
    """The name of an image in the scene with this number."""
    return f"0{number}1{name[5:]}"


def load(root: Path, cache: Path) -> None:
    """Load everything once; print the time (seconds) and this process's peak memory."""
    start = time.perf_counter()
    scenes = active_vision.load(root, objects=AUTHORS_SPLIT.objects, cache_dir=cache)
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # Linux counts kibibytes
    print(
        f"{seconds:8.2f} s, peak memory {peak:.2f} GiB, {len(scenes.scene_names)} scenes, {len(scenes.images)} images",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "folder", nargs="?", type=Path, help="where to build; a folder that was built before is used as it is"
    )
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--image-width", type=int, default=160, help="of the rendered images, in pixels")
    parser.add_argument("--enlarge", action="store_true", help="write the images at 1920 x 1080")
    parser.add_argument("--load-only", type=Path, metavar="CACHE", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.load_only:
        load(arguments.folder, arguments.load_only)
        return
    with tempfile.TemporaryDirectory() as temporary:
        root = arguments.folder or Path(temporary) / "dataset"
        if not (root / "all_instance_id_map.txt").exists():
            start = time.perf_counter()
            build(root, arguments.scenes, arguments.image_width, arguments.enlarge)
            print(f"built   {time.perf_counter() - start:8.2f} s", flush=True)
        for label in ("first", "second"):
            print(f"{label:7s} ", end="", flush=True)
            subprocess.run(
                [sys.executable, __file__, str(root), "--load-only", str(Path(temporary) / "cache")], check=True
            )


if __name__ == "__main__":
    main()
