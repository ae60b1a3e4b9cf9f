"""What watches a run: the progress bar, and TensorBoard or Weights & Biases when asked for (imported only then)."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
    """compiling: called before the program is compiled; progress: called after each chunk."""

    compiling: Callable[[], None]
    progress: tuple[host.Listener, ...]


def seed_means(rows: list[dict]) -> dict[str, float]:
    """Mean over seeds of every single number in rows of one epoch."""
    names = [name for name, value in rows[0].items() if name not in ("seed", "epoch") and not isinstance(value, list)]
    return {name: fmean(row[name] for row in rows) for name in names}


@contextmanager
def make_listeners(
    folder: Path, config: TrainConfig, num_seeds: int, tensorboard: bool = False, wandb: str = ""
) -> Iterator[Listeners]:
    """The listeners of a run, closed at its end. Raises `UserError` if one that was asked for is not installed."""
    closing, listeners = [], []
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

        listeners.append(write)
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

        listeners.append(log)

    with progress_line(f"{config.task} {presets.name_of(config)} x {num_seeds}", config.num_epochs) as line:

        def advance(progress: host.Progress):
            means = seed_means(progress.evaluations)
            numbers = "  ".join(f"{label} {means[name]:.2f}" for name, label in SHOWN.items() if name in means)
            if progress.env_steps_per_second:  # Who learns offline takes none.
                numbers += f"  {progress.env_steps_per_second:,.0f} env steps/s"
            line.advance(progress.epoch, f"{numbers}  {progress.updates_per_second:,.0f} updates/s")

        listeners.append(advance)
        try:
            yield Listeners(line.compiling, tuple(listeners))
        finally:
            for close in closing:
                close()
