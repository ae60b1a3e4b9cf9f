"""`infogoal data build ...`: the stand-ins for data that cannot be shipped, backgrounds and banks of goal images."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from tyro.conf import FlagCreatePairsOff, Positional

from infogoal_jax.cli.commands import Group, check_seed, empty_folder
from infogoal_jax.errors import UserError, require


def house(path: Positional[str], seed: int = 0) -> int:
    """Build a synthetic house, a stand-in in the format of the Active Vision Dataset.

    Args:
        path: Folder to write to; must not exist yet, or be empty.
        seed: Seed of the generator: rooms, furniture, objects and textures.
    """
    from infogoal_jax.data.archives import new_folder
    from infogoal_jax.stand_ins.house import build_house

    check_seed(seed)
    folder = empty_folder(path, "path")
    with new_folder(folder, "path") as beside:
        build_house(beside, seed=seed)
    print(f"{folder}: built from seed {seed}")
    return 0


def backgrounds(path: Positional[str], seed: int = 0, crops_of_each: int = 84) -> int:
    """Cut the shipped background images out of photographs again (needs `pip install 'infogoal-jax[backgrounds]'`).

    Args:
        path: Folder to write to; must not exist yet, or be empty.
        seed: Seed of the crops' places and sizes; 0: the shipped ones.
        crops_of_each: Crops of each photograph.
    """
    from infogoal_jax.stand_ins.photographs import build_backgrounds

    check_seed(seed)
    require(0 < crops_of_each <= 10_000, "crops_of_each", crops_of_each, "give 1 to 10000")
    folder = empty_folder(path, "path")
    build_backgrounds(folder, seed, crops_of_each)
    print(f"{folder}: built from seed {seed}")
    return 0


def fetch(
    path: Positional[str], seed: int = 0, tasks: tuple[str, ...] = ("fetch_reach", "fetch_push", "fetch_pick_and_place")
) -> int:
    """Draw banks of goal images of Fetch tasks (needs `pip install 'infogoal-jax[goal-images]'` and OpenGL;
    docs/goal_inputs.md).

    Args:
        path: Folder to write to, one file a task; files that are there already are never overwritten.
        seed: Seed of the goals for training, validation and tests; 0: the shipped ones.
        tasks: The tasks.
    """
    check_seed(seed)
    from rich.progress import track

    from infogoal_jax.data import goal_images
    from infogoal_jax.envs.fetch import goal_rendering

    files = {name: Path(path) / f"{name}.npz" for name in tasks}
    for file in files.values():
        if file.exists():
            raise UserError(f"path = {str(file)!r}: is there already; give a new folder")
    goal_rendering.check(tuple(files), seed)
    for name, file in files.items():
        start = time.perf_counter()
        bank = goal_rendering.build(name, seed, lambda goals, name: track(goals, name, disable=not sys.stdout.isatty()))
        goal_images.save(file, bank)
        seconds = time.perf_counter() - start
        print(f"{file}: {len(bank.images)} images, {file.stat().st_size / 1e6:.2f} MB, built in {seconds:.0f} s")
        for field, words in bank.about.items():
            print(f"  {field}: {words}")
    return 0


def cube(path: Positional[str], seed: int = 0, physical_limits: FlagCreatePairsOff[bool] = False) -> int:
    """Draw the stand-in for the object-manipulation data: an arm turns a Rubik's cube (docs/datasets.md).

    Args:
        path: File to write, an npz; must not exist yet.
        seed: Seed of stickers, camera, room and light.
        physical_limits: Leave out what the limits of the real arm's joints do not allow.
    """
    check_seed(seed)
    from infogoal_jax.stand_ins import cube

    return write_frames(path, "drawing the cube", lambda bar: cube.build(seed, physical_limits, progress=bar))


def shelf(path: Positional[str], seed: int = 0, hovering: FlagCreatePairsOff[bool] = False) -> int:
    """Draw the stand-in for the embodied question answering data: a drone flies along a shelf (docs/datasets.md).

    Args:
        path: File to write, an npz; must not exist yet.
        seed: Seed of the shelf and of the flights.
        hovering: The drone drifts where it hovers, so that a state has several images.
    """
    check_seed(seed)
    from infogoal_jax.stand_ins import shelf

    return write_frames(path, "drawing the shelf", lambda bar: shelf.build(seed, hovering, progress=bar))


def write_frames(path: str, words: str, build: Callable) -> int:
    """Build an image dataset, write it to a new file and say what it is. build: takes what is to be told the share
    done."""
    from infogoal_jax.data import frames

    new_file(path)
    with progress_bar(words) as bar:
        dataset = build(bar)
    frames.save(path, dataset)
    print_size(path, dataset)
    return 0


def new_file(path: str) -> None:
    """Raise `UserError` if the path of an image dataset does not end in .npz, or leads to what is there already."""
    if Path(path).suffix != ".npz":
        raise UserError(f"path = {path!r}: is the file of an image dataset; let it end in .npz")
    if Path(path).exists():
        raise UserError(f"path = {path!r}: is there already; give a new file")


def print_size(path: str, dataset) -> None:
    """What a file of an image dataset holds, in one line, and what it takes."""
    *_, height, width, channels = dataset.frames.shape
    print(
        f"{path}: {dataset.about['name']}; {len(dataset.frames)} frames of {height} x {width} x {channels}, "
        f"{dataset.num_states} states, "
        f"{len(dataset.frame)} moves of {len(dataset.actions)} actions; {Path(path).stat().st_size / 1e6:.1f} MB on "
        "disk, "
        f"{dataset.nbytes / 1e6:.1f} MB on the device"
    )


@contextlib.contextmanager
def progress_bar(words: str) -> Iterator[Callable[[float], None]]:
    """A bar on stderr, where that is a terminal. What it gives is to be told the share done, 0 to 1."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True) as progress:
        task = progress.add_task(words, total=1.0)
        yield lambda share: progress.update(task, completed=share)


BUILD = Group(
    "Build stand-ins for data that cannot be shipped, backgrounds and goal images.",
    {"house": house, "cube": cube, "shelf": shelf, "backgrounds": backgrounds, "fetch": fetch},
)
