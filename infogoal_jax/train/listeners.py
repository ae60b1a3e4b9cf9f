"""What watches a run: the progress bar, and TensorBoard or Weights & Biases when asked for (imported only then)."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from infogoal_jax import presets
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import UserError
from infogoal_jax.train import host

SHOWN = {"train_goal/success_rate": "train", "test_goal/success_rate": "test"}


def seed_means(rows: list[dict]) -> dict[str, float]:
    """Mean over seeds of every single number in rows of one epoch."""
    names = [name for name, value in rows[0].items() if name not in ("seed", "epoch") and not isinstance(value, list)]
    return {name: fmean(row[name] for row in rows) for name in names}


@contextmanager
def make_listeners(
    folder: Path, config: TrainConfig, num_seeds: int, tensorboard: bool = False, wandb: str = ""
) -> Iterator[tuple[host.Listener, ...]]:
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
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[numbers]}"),
        console=Console(),
        refresh_per_second=2,
    )
    line = bar.add_task(
        f"{config.task} {presets.name_of(config)} x {num_seeds}", total=config.num_epochs, numbers="compiling"
    )

    def advance(progress: host.Progress):
        means = seed_means(progress.evaluations)
        numbers = "  ".join(f"{label} {means[name]:.2f}" for name, label in SHOWN.items() if name in means)
        numbers += f"  {progress.env_steps_per_second:,.0f} env steps/s  {progress.updates_per_second:,.0f} updates/s"
        bar.update(line, completed=progress.epoch, numbers=numbers)
        if not bar.console.is_terminal:  # A log file gets a line for each evaluation instead of a moving bar.
            bar.console.print(f"epoch {progress.epoch}/{progress.num_epochs}  {numbers}", soft_wrap=True)

    listeners.append(advance)
    try:
        if bar.console.is_terminal:
            with bar:
                yield tuple(listeners)
        else:
            yield tuple(listeners)
    finally:
        for close in closing:
            close()
