"""`infogoal data ...`: check, import, export, download, embed; what is built stands in data_building.py."""

import contextlib
import shlex
from pathlib import Path

from tyro.conf import FlagCreatePairsOff, Positional

from infogoal_jax.cli.commands import Group
from infogoal_jax.cli.data_building import BUILD, new_file, print_size, progress_bar
from infogoal_jax.errors import UserError


def check(path: Positional[str]) -> int:
    """List everything that is wrong with a dataset.

    Args:
        path: Folder of scenes of the Active Vision Dataset, or the npz of an image dataset (docs/datasets.md).

    Returns:
        1 if anything is an error.
    """
    is_file = Path(path).is_file() or Path(path).suffix == ".npz"
    if is_file:
        from infogoal_jax.data.frames_check import check_frames as find
    else:
        from infogoal_jax.data.check import check_active_vision as find

    findings = find(path)
    for finding in findings:
        print(f"{finding.severity:8s} {finding.where}: {finding.problem}")
    errors = sum(finding.severity == "error" for finding in findings)
    print(f"{path}: {errors} errors, {len(findings) - errors} warnings")
    if is_file and not errors:
        from infogoal_jax.data import frames

        print_size(path, frames.load(path))
    return 1 if errors else 0


def import_images(
    images: Positional[str],
    table: Positional[str],
    out: str,
    size: tuple[int, int] | None = None,
    wrap: tuple[str, ...] = (),
    name: str = "",
) -> int:
    """Make an image dataset of a folder of images and a CSV.

    Args:
        images: Folder of the images.
        table: CSV that says what each shows, with a header: image, trajectory, time, action; or image and joint_NAME
            (docs/datasets.md).
        out: File to write, an npz.
        size: Height and width to shrink the images to; None: as they are, then all must have one size.
        wrap: Joints of a grid of poses that go round a full turn.
        name: Of the dataset, in words; empty: the folder's.
    """
    from infogoal_jax.data.frames_import import import_folder

    new_file(out)
    with progress_bar("reading the images") as bar:
        dataset = import_folder(images, table, out, size, wrap, name, bar)
    print_size(out, dataset)
    if dataset.detected is None:
        print("No row names an object: embodied question answering needs a column `objects` that does.")
    print(f"Next: infogoal data check {shlex.quote(out)}")
    return 0


def export_minari(path: Positional[str], out: str) -> int:
    """Write an image dataset's trajectories for Minari (needs the extra `minari`).

    Args:
        path: The image dataset, an npz.
        out: Folder to write, FOLDER/NAME-v0; must not exist yet.
    """
    from infogoal_jax.bridges.minari import to_minari
    from infogoal_jax.data import frames

    dataset = frames.load(path)
    with progress_bar("writing the episodes") as bar:
        folder = to_minari(dataset, out, bar)
    print(
        f"{folder}: {dataset.terminal.sum()} episodes, {len(dataset.frame)} steps; "
        f"read it with MINARI_DATASETS_PATH={shlex.quote(str(folder.parent))}"
    )
    return 0


def cifar10(path: Positional[str] = "", url: str = "") -> int:
    """Download CIFAR-10, 170 MB, as background images (docs/goal_inputs.md).

    Args:
        path: Folder to unpack into; empty: the user's cache, where `cifar10` as the path of the backgrounds finds it.
        url: Where the archive is; empty: its authors' page. A mirror must have the same file, by its checksum.
    """
    from infogoal_jax.data.backgrounds import CIFAR10_URL, download_cifar10

    print(f"{download_cifar10(path, url or CIFAR10_URL)}: CIFAR-10, complete")
    return 0


def embed(
    texts: Positional[tuple[str, ...]],
    out: str,
    weights: str = "",
    allow_other_weights: FlagCreatePairsOff[bool] = False,
) -> int:
    """Embed the text of goals with the real weights of all-MiniLM-L6-v2 (docs/goal_inputs.md).

    Args:
        texts: The texts.
        out: File to write, or to add to: an npz for --env.text-embeddings.
        weights: Folder with model.safetensors, tokenizer.json and config.json; empty: the installed package.
        allow_other_weights: Take weights with another checksum than the official one; the checksum is recorded.
    """
    if not texts:
        raise UserError("texts = (): give at least one text to embed")
    from infogoal_jax.data.sentence_encoder import embed_file
    from infogoal_jax.runs.folder import locked

    path = Path(out)
    # The file is read and written again with more texts: of two at once, one would lose what the other added.
    alone = locked(path.parent / f".{path.name}.lock", path) if path.parent.is_dir() else contextlib.nullcontext()
    with alone:
        embeddings = embed_file(texts, out, weights or None, allow_other_weights)
    print(f"{out}: {len(embeddings.texts)} texts")
    return 0


DATA = Group(
    "Check, import, export, build and download datasets.",
    {
        "check": check,
        "import": import_images,
        "export-minari": export_minari,
        "build": BUILD,
        "download": Group("Download what others published.", {"cifar10": cifar10}),
        "embed": embed,
    },
)
