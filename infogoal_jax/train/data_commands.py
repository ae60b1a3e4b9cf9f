"""The commands `infogoal data ...`. A command is a dataclass; its fields are the flags (tyro)."""

import contextlib
import dataclasses
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import tyro

from infogoal_jax.errors import UserError


@dataclasses.dataclass(frozen=True)
class CheckCommand:
    """List everything that is wrong with a dataset: a folder in the format of the Active Vision Dataset, or the file of an image dataset."""

    path: tyro.conf.Positional[str]
    """Folder that holds the scenes, or an npz (docs/datasets.md)."""


@dataclasses.dataclass(frozen=True)
class BuildHouseCommand:
    """Build a synthetic house, a stand-in in the format of the Active Vision Dataset."""

    path: tyro.conf.Positional[str]
    """Folder to write to; must not exist yet, or be empty."""
    seed: int = 0
    """Seed of the generator: rooms, furniture, objects and textures."""


@dataclasses.dataclass(frozen=True)
class BuildBackgroundsCommand:
    """Cut the shipped background images out of photographs again (needs `pip install 'infogoal-jax[backgrounds]'`)."""

    path: tyro.conf.Positional[str]
    """Folder to write to; must not exist yet, or be empty."""
    seed: int = 0
    """Seed of the crops' places and sizes; 0: the shipped ones."""
    crops_of_each: int = 84
    """Crops of each photograph."""


@dataclasses.dataclass(frozen=True)
class BuildFetchCommand:
    """Draw banks of goal images of Fetch tasks (needs `pip install 'infogoal-jax[goal-images]'` and OpenGL; docs/goal_images.md)."""

    path: tyro.conf.Positional[str]
    """Folder to write to, one file a task; files that are there already are never overwritten."""
    seed: int = 0
    """Seed of the goals for training, validation and tests; 0: the shipped ones."""
    tasks: tuple[str, ...] = ("fetch_reach", "fetch_push", "fetch_pick_and_place")
    """The tasks."""


@dataclasses.dataclass(frozen=True)
class BuildCubeCommand:
    """Draw the stand-in for the object-manipulation data: an arm turns a Rubik's cube (docs/datasets.md)."""

    path: tyro.conf.Positional[str]
    """File to write, an npz; must not exist yet."""
    seed: int = 0
    """Seed of stickers, camera, room and light."""
    physical_limits: bool = False
    """Leave out what the limits of the real arm's joints do not allow."""


@dataclasses.dataclass(frozen=True)
class BuildShelfCommand:
    """Draw the stand-in for the embodied question answering data: a drone flies along a shelf (docs/datasets.md)."""

    path: tyro.conf.Positional[str]
    """File to write, an npz; must not exist yet."""
    seed: int = 0
    """Seed of the shelf and of the flights."""
    hovering: bool = False
    """The drone drifts where it hovers, so that a state has several images."""


@dataclasses.dataclass(frozen=True)
class ImportCommand:
    """Make an image dataset of a folder of images and a CSV that says what each shows (docs/datasets.md)."""

    images: tyro.conf.Positional[str]
    """Folder of the images."""
    table: tyro.conf.Positional[str]
    """CSV with a header: image, trajectory, time, action; or image and joint_NAME; and what else is known."""
    out: str
    """File to write, an npz."""
    size: tuple[int, int] | None = None
    """Height and width to shrink the images to; None: as they are, then all must have one size."""
    wrap: tuple[str, ...] = ()
    """Joints of a grid of poses that go round a full turn."""
    name: str = ""
    """Of the dataset, in words; empty: the folder's."""


@dataclasses.dataclass(frozen=True)
class ExportMinariCommand:
    """Write the trajectories of an image dataset as a Minari dataset (needs `pip install "minari[hdf5]" pillow`)."""

    path: tyro.conf.Positional[str]
    """The image dataset, an npz."""
    out: str
    """Folder to write, FOLDER/NAME-v0; must not exist yet."""


@dataclasses.dataclass(frozen=True)
class DownloadCifar10Command:
    """Download CIFAR-10's binary version, 170 MB, as background images (docs/backgrounds.md)."""

    path: tyro.conf.Positional[str] = ""
    """Folder to unpack into; empty: the user's cache, where `cifar10` as the path of the backgrounds finds it."""
    url: str = ""
    """Where the archive is; empty: its authors' page. A mirror must have the same file, by its checksum."""


@dataclasses.dataclass(frozen=True)
class EmbedCommand:
    """Embed the text of goals with the real weights of all-MiniLM-L6-v2 (docs/text_goals.md)."""

    texts: tyro.conf.Positional[tuple[str, ...]]
    """The texts."""
    out: str
    """File to write, or to add to: an npz for --env.text-embeddings."""
    weights: str = ""
    """Folder with model.safetensors, tokenizer.json and config.json; empty: the installed package."""
    allow_other_weights: bool = False
    """Take weights with another checksum than the official one; the checksum is recorded."""


def data_check(arguments: list[str]) -> int:
    """`infogoal data check PATH`: 1 if anything is an error."""
    command = tyro.cli(CheckCommand, prog="infogoal data check", args=arguments)
    is_file = Path(command.path).is_file() or Path(command.path).suffix == ".npz"
    if is_file:
        from infogoal_jax.data.frames_check import check_frames as check
    else:
        from infogoal_jax.data.check import check_active_vision as check

    findings = check(command.path)
    for finding in findings:
        print(f"{finding.severity:8s} {finding.where}: {finding.problem}")
    errors = sum(finding.severity == "error" for finding in findings)
    print(f"{command.path}: {errors} errors, {len(findings) - errors} warnings")
    if is_file and not errors:
        from infogoal_jax.data import frames

        print_size(command.path, frames.load(command.path))
    return 1 if errors else 0


def print_size(path: str, dataset) -> None:
    """What a file of an image dataset holds, in one line, and what it takes."""
    *_, height, width, channels = dataset.frames.shape
    print(
        f"{path}: {dataset.about['name']}; {len(dataset.frames)} frames of {height} x {width} x {channels}, {dataset.num_states} states, "
        f"{len(dataset.frame)} moves of {len(dataset.actions)} actions; {Path(path).stat().st_size / 1e6:.1f} MB on disk, "
        f"{dataset.nbytes / 1e6:.1f} MB on the device"
    )


def data_build(arguments: list[str]) -> int:
    """`infogoal data build DATASET PATH`."""
    if not arguments or arguments[0] not in BUILDERS:
        raise UserError(f"data build {arguments[0] if arguments else ''!r}: no such dataset. Known: {', '.join(BUILDERS)}")
    return BUILDERS[arguments[0]](arguments[1:])


def data_build_house(arguments: list[str]) -> int:
    """`infogoal data build house PATH`."""
    command = tyro.cli(BuildHouseCommand, prog="infogoal data build house", args=arguments)
    from infogoal_jax.stand_ins.house import build_house

    target = new_folder(command.path)
    build_house(target, seed=command.seed)
    print(f"{target}: built from seed {command.seed}")
    return 0


def new_folder(path: str) -> Path:
    """The path of a folder that does not exist yet, or is empty."""
    target = Path(path)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise UserError(f"path = {path!r}: is there already and not empty; give a new folder")
    return target


def data_build_backgrounds(arguments: list[str]) -> int:
    """`infogoal data build backgrounds PATH`."""
    command = tyro.cli(BuildBackgroundsCommand, prog="infogoal data build backgrounds", args=arguments)
    from infogoal_jax.stand_ins.photographs import build_backgrounds

    target = new_folder(command.path)
    build_backgrounds(target, command.seed, command.crops_of_each)
    print(f"{target}: built from seed {command.seed}")
    return 0


def data_build_fetch(arguments: list[str]) -> int:
    """`infogoal data build fetch PATH`: a file a task, and what is in it."""
    command = tyro.cli(BuildFetchCommand, prog="infogoal data build fetch", args=arguments)
    from rich.progress import track

    from infogoal_jax.data import goal_images
    from infogoal_jax.envs.fetch import goal_rendering

    paths = {name: Path(command.path) / f"{name}.npz" for name in command.tasks}
    for path in paths.values():
        if path.exists():
            raise UserError(f"path = {str(path)!r}: is there already; give a new folder")
    goal_rendering.check(tuple(paths), command.seed)
    for name, path in paths.items():
        start = time.perf_counter()
        bank = goal_rendering.build(name, command.seed, lambda goals, name: track(goals, name, disable=not sys.stdout.isatty()))
        goal_images.save(path, bank)
        seconds = time.perf_counter() - start
        print(f"{path}: {len(bank.images)} images, {path.stat().st_size / 1e6:.2f} MB, built in {seconds:.0f} s")
        for field, words in bank.about.items():
            print(f"  {field}: {words}")
    return 0


def data_build_cube(arguments: list[str]) -> int:
    """`infogoal data build cube PATH.npz`."""
    command = tyro.cli(BuildCubeCommand, prog="infogoal data build cube", args=arguments)
    from infogoal_jax.stand_ins import cube

    return write_frames(command.path, "drawing the cube", lambda bar: cube.build(command.seed, command.physical_limits, progress=bar))


def data_build_shelf(arguments: list[str]) -> int:
    """`infogoal data build shelf PATH.npz`."""
    command = tyro.cli(BuildShelfCommand, prog="infogoal data build shelf", args=arguments)
    from infogoal_jax.stand_ins import shelf

    return write_frames(command.path, "drawing the shelf", lambda bar: shelf.build(command.seed, command.hovering, progress=bar))


def write_frames(path: str, words: str, build: Callable) -> int:
    """Build an image dataset, write it to a new file and say what it is. build: takes what is to be told the share done."""
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


@contextlib.contextmanager
def progress_bar(words: str) -> Iterator[Callable[[float], None]]:
    """A bar on stderr, where that is a terminal. What it gives is to be told the share done, 0 to 1."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True) as progress:
        task = progress.add_task(words, total=1.0)
        yield lambda share: progress.update(task, completed=share)


def data_import(arguments: list[str]) -> int:
    """`infogoal data import FOLDER CSV --out FILE.npz`."""
    command = tyro.cli(ImportCommand, prog="infogoal data import", args=arguments)
    from infogoal_jax.data.frames_import import import_folder

    new_file(command.out)
    with progress_bar("reading the images") as bar:
        dataset = import_folder(command.images, command.table, command.out, command.size, command.wrap, command.name, bar)
    print_size(command.out, dataset)
    print(f"Next: infogoal data check {shlex.quote(command.out)}")
    return 0


def data_export_minari(arguments: list[str]) -> int:
    """`infogoal data export-minari FILE.npz --out FOLDER/NAME-v0`."""
    command = tyro.cli(ExportMinariCommand, prog="infogoal data export-minari", args=arguments)
    from infogoal_jax.bridges.minari import to_minari
    from infogoal_jax.data import frames

    dataset = frames.load(command.path)
    with progress_bar("writing the episodes") as bar:
        out = to_minari(dataset, command.out, bar)
    print(f"{out}: {dataset.terminal.sum()} episodes, {len(dataset.frame)} steps; read it with MINARI_DATASETS_PATH={shlex.quote(str(out.parent))}")
    return 0


def data_download(arguments: list[str]) -> int:
    """`infogoal data download cifar10 [PATH]`."""
    if not arguments or arguments[0] != "cifar10":
        raise UserError(f"data download {arguments[0] if arguments else ''!r}: no such dataset. Known: cifar10")
    command = tyro.cli(DownloadCifar10Command, prog="infogoal data download cifar10", args=arguments[1:])
    from infogoal_jax.data.backgrounds import CIFAR10_URL, download_cifar10

    print(f"{download_cifar10(command.path, command.url or CIFAR10_URL)}: CIFAR-10, complete")
    return 0


def data_embed(arguments: list[str]) -> int:
    """`infogoal data embed TEXT ... --out FILE`."""
    command = tyro.cli(EmbedCommand, prog="infogoal data embed", args=arguments)
    if not command.texts:
        raise UserError("texts = (): give at least one text to embed")
    from infogoal_jax.data.sentence_encoder import embed_file

    embeddings = embed_file(command.texts, command.out, command.weights or None, command.allow_other_weights)
    print(f"{command.out}: {len(embeddings.texts)} texts")
    return 0


BUILDERS = {
    "house": data_build_house, "cube": data_build_cube, "shelf": data_build_shelf, "backgrounds": data_build_backgrounds, "fetch": data_build_fetch,
}
DATA_COMMANDS = {
    "check": data_check, "build": data_build, "import": data_import, "export-minari": data_export_minari, "download": data_download,
    "embed": data_embed,
}
