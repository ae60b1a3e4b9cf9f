"""What watches a run: the progress bar, on a terminal, or lines in a log file; and TensorBoard or Weights & Biases when
asked for (imported only then)."""

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from infogoal_jax import presets
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import UserError
from infogoal_jax.runner import training

SIGN_OF_LIFE = 60.0
"""Seconds after which a log file gets another line while a program is compiled."""
COMPILING = "compiling, some minutes the first time"
NOTHING_SENT = ("offline", "dryrun", "disabled")
"""Values of WANDB_MODE with which Weights & Biases needs no login."""


class ProgressLine:
    """What is shown of a run. words: what is run; total: its epochs."""

    def __init__(self, words: str, total: int, bar: Progress):
        self.words, self.total, self.bar, self.started = words, total, bar, time.monotonic()
        self.line = bar.add_task(words, total=total, numbers="preparing")
        self.compiled = threading.Event()

    def compiling(self) -> None:
        """Say that the program is compiled now, and in a log file once a minute that it still is."""
        self.bar.update(self.line, numbers=COMPILING)
        if not self.bar.console.is_terminal:
            self.print(f"{self.words}: {COMPILING}")
            threading.Thread(target=self.repeat, daemon=True).start()

    def repeat(self) -> None:
        """Say that the program is still being compiled until it is not."""
        while not self.compiled.wait(SIGN_OF_LIFE):
            self.print(f"{self.words}: still compiling, {self.elapsed()}")

    def advance(self, epoch: int, numbers: str) -> None:
        """Show that so many epochs are done, and what came of them."""
        self.compiled.set()
        self.bar.update(self.line, completed=epoch, numbers=numbers)
        if not self.bar.console.is_terminal:
            self.print(f"epoch {epoch}/{self.total}  {self.elapsed()}  {numbers}")

    def elapsed(self) -> str:
        """Hours, minutes and seconds since the start."""
        minutes, seconds = divmod(int(time.monotonic() - self.started), 60)
        return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02d}"

    def print(self, words: str) -> None:
        """Write a line to a log file."""
        self.bar.console.print(words, soft_wrap=True, highlight=False, markup=False)


@contextmanager
def progress_line(words: str, total: int) -> Iterator[ProgressLine]:
    """What shows how far a run is, until the end of the block."""
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[numbers]}"),
        console=(console := Console()),
        refresh_per_second=2,
        disable=not console.is_terminal,
    )
    line = ProgressLine(words, total, bar)
    try:
        with bar:
            yield line
    finally:
        line.compiled.set()


SHOWN = {"train_goal/success_rate": "train", "test_goal/success_rate": "test"}


class Listeners(NamedTuple):
    """compiling: called before the program is compiled; progress: called after each chunk; end_progress: called after
    the last, so that what is printed stands below the bar; pictures: called with files of figures (PNG) and videos
    (GIF), which TensorBoard and Weights & Biases are to show."""

    compiling: Callable[[], None]
    progress: tuple[training.Listener, ...]
    end_progress: Callable[[], None]
    pictures: Callable[[Sequence[Path]], None]


def seed_means(rows: list[dict]) -> dict[str, float]:
    """Mean over seeds of every single number in rows of one epoch."""
    names = [name for name, value in rows[0].items() if name not in ("seed", "epoch") and not isinstance(value, list)]
    return {name: fmean(row[name] for row in rows) for name in names}


def add_picture(writer, path: Path, epoch: int) -> None:
    """Add a PNG or a GIF to TensorBoard as it is: the browser plays a GIF."""
    from PIL import Image
    from tensorboardX.proto.summary_pb2 import Summary

    with Image.open(path) as picture:
        width, height = picture.size
    encoded = Summary.Image(encoded_image_string=path.read_bytes(), width=width, height=height, colorspace=3)
    value = Summary.Value(tag=f"figures/{path.stem}", image=encoded)
    writer.file_writer.add_summary(Summary(value=[value]), epoch)


def log_in(wandb: Any, project: str) -> None:
    """Log in to Weights & Biases, which asks for a key on a terminal, unless nothing is to be sent. Raises `UserError`
    where there is no key, or none that it takes."""
    if os.environ.get("WANDB_MODE") in NOTHING_SENT:
        return
    try:
        wandb.login(verify=False)  # Nothing is sent for it, so that a key is not taken for wrong without a network.
    except (wandb.Error, ValueError) as error:
        reason = str(error).partition(". ")[0].rstrip(".")
        raise UserError(
            f"wandb = {project!r}: Weights & Biases has no login here ({reason}); run `wandb login` first, or set "
            "WANDB_MODE=offline to keep the numbers on this machine"
        ) from error


@contextmanager
def make_listeners(
    folder: Path, config: TrainConfig, num_seeds: int, tensorboard: bool = False, wandb: str = ""
) -> Iterator[Listeners]:
    """The listeners of a run, closed at its end. Raises `UserError` if one that was asked for is not installed, or not
    logged in to."""
    closing, listeners, showing = [], [], []
    if tensorboard:
        try:
            from tensorboardX import SummaryWriter
        except ImportError as error:
            raise UserError("tensorboard = True: needs `pip install tensorboardX`") from error
        writers = []  # Opened with the first numbers, so that a mistake found before leaves nothing on disk.

        def write(progress: training.Progress):
            if not writers:
                writers.append(SummaryWriter(str(folder)))
                closing.append(writers[0].close)
            writer = writers[0]
            for row in progress.epochs + progress.evaluations:
                for name, value in row.items():
                    if name not in ("seed", "epoch") and not isinstance(value, list):
                        writer.add_scalar(f"seed_{row['seed']}/{name}", value, row["epoch"])
            writer.flush()

        def show(paths: Sequence[Path]):
            for path in paths if writers else ():
                add_picture(writers[0], path, config.num_epochs)

        listeners.append(write)
        showing.append(show)
    if wandb:
        try:
            import wandb as weights_and_biases
        except ImportError as error:
            raise UserError(f"wandb = {wandb!r}: needs `pip install wandb`") from error
        log_in(weights_and_biases, wandb)
        sessions = []

        def log(progress: training.Progress):
            if not sessions:
                sessions.append(weights_and_biases.init(project=wandb, dir=str(folder.parent), name=folder.name))
                closing.append(sessions[0].finish)
            sessions[0].log(
                seed_means(progress.epochs[-num_seeds:]) | seed_means(progress.evaluations), step=progress.epoch
            )

        def upload(paths: Sequence[Path]):
            if sessions and paths:
                kinds = {".gif": weights_and_biases.Video, ".png": weights_and_biases.Image}
                sessions[0].log({f"figures/{path.stem}": kinds[path.suffix](str(path)) for path in paths})

        listeners.append(log)
        showing.append(upload)

    def pictures(paths: Sequence[Path]):
        for show in showing:
            show(paths)

    with ExitStack() as bar:
        words = f"{config.task} {presets.name_of(config)} x {num_seeds}"
        line = bar.enter_context(progress_line(words, config.num_epochs))

        def advance(progress: training.Progress):
            means = seed_means(progress.evaluations)
            numbers = "  ".join(f"{label} {means[name]:.2f}" for name, label in SHOWN.items() if name in means)
            if progress.env_steps_per_second:  # Who learns offline takes none.
                numbers += f"  {progress.env_steps_per_second:,.0f} env steps/s"
            line.advance(progress.epoch, f"{numbers}  {progress.updates_per_second:,.0f} updates/s")

        listeners.append(advance)
        try:
            yield Listeners(line.compiling, tuple(listeners), bar.close, pictures)
        finally:
            for close in closing:
                close()
