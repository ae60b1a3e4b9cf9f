"""What watches a run: the progress bar, and TensorBoard or Weights & Biases when asked for (imported only then)."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

from infogoal_jax import presets
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import UserError
from infogoal_jax.train import host
from infogoal_jax.train.progress import progress_line

SHOWN = {"train_goal/success_rate": "train", "test_goal/success_rate": "test"}


class Listeners(NamedTuple):
    """compiling: called before the program is compiled; progress: called after each chunk; end_progress: called after
    the last, so that what is printed stands below the bar; pictures: called with files of figures (PNG) and videos
    (GIF), which TensorBoard and Weights & Biases are to show."""

    compiling: Callable[[], None]
    progress: tuple[host.Listener, ...]
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


@contextmanager
def make_listeners(
    folder: Path, config: TrainConfig, num_seeds: int, tensorboard: bool = False, wandb: str = ""
) -> Iterator[Listeners]:
    """The listeners of a run, closed at its end. Raises `UserError` if one that was asked for is not installed."""
    closing, listeners, showing = [], [], []
    if tensorboard:
        try:
            from tensorboardX import SummaryWriter
        except ImportError as error:
            raise UserError("tensorboard = True: needs `pip install tensorboardX`") from error
        writers = []  # Opened with the first numbers, so that a mistake found before leaves nothing on disk.

        def write(progress: host.Progress):
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
        sessions = []

        def log(progress: host.Progress):
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

        def advance(progress: host.Progress):
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
