"""Files of image datasets on the command line: where they may be written, what is in them, and how far writing one
is."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from infogoal_jax.errors import UserError


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
