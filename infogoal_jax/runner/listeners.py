"""What watches a run: its line of progress; and TensorBoard or Weights & Biases when
asked for (imported only then)."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from infogoal_jax.checks import whole
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import UserError
from infogoal_jax.presets.loading import method_title, run_title
from infogoal_jax.runner import training
from infogoal_jax.runner.progress import ProgressLine, progress_line
from infogoal_jax.runs import tables
from infogoal_jax.runs.configuration import to_dict

NOTHING_SENT = ("offline", "dryrun", "disabled")
"""Values of WANDB_MODE with which Weights & Biases needs no login."""


SHOWN = {"train_goal/success_rate": "train", "test_goal/success_rate": "test"}


class Listeners(NamedTuple):
    """What hears of a run.

    phase: called when a phase of the run begins, with its name and the epochs that are done.
    progress: called after each chunk.
    end_progress: called after the last, so that what is printed stands below the bar.
    pictures: called with files of figures (PNG) and videos (GIF), which TensorBoard and Weights & Biases are to show.
    """

    phase: training.Phase
    progress: tuple[training.Listener, ...]
    end_progress: Callable[[], None]
    pictures: Callable[[Sequence[Path]], None]


def print_success(num_epochs: int, num_seeds: int = 1) -> Callable[[Any, dict[str, Any]], None]:
    """A callback for `make_train`, which prints a line after each evaluation of a compiled program: the epoch of so
    many, and the mean success of these seeds, which `jax.vmap` trains side by side."""
    whole(num_epochs, "num_epochs", 1)
    whole(num_seeds, "num_seeds", 1)
    heard: dict[int, list[dict[str, float]]] = {}  # Of one epoch at a time: seeds advance together.

    def advance(epoch, metrics):
        shown = {label: metrics[name] for name, label in SHOWN.items() if name in metrics}  # Some tasks test nothing.
        of_epoch = [*heard.get(int(epoch), []), shown]
        heard.clear()
        if len(of_epoch) < num_seeds:
            heard[int(epoch)] = of_epoch
            return
        numbers = [f"{label} {fmean(float(one[label]) for one in of_epoch):.2f}" for label in shown]
        print("  ".join([f"epoch {int(epoch)}/{num_epochs}", *numbers]), flush=True)

    return advance


def seed_means(rows: list[dict]) -> dict[str, float]:
    """Mean over seeds of every single number in rows of one epoch."""
    names = [name for name, value in rows[0].items() if name not in ("seed", "epoch") and not isinstance(value, list)]
    return {name: fmean(row[name] for row in rows) for name in names}


def success_in_words(evaluations: list[dict]) -> list[str]:
    """Mean success over seeds of one evaluation: `train 0.34`, `test 0.22`."""
    means = seed_means(evaluations)
    return [f"{label} {means[name]:.2f}" for name, label in SHOWN.items() if name in means]


def advancing(line: ProgressLine) -> training.Listener:
    """What shows on a line how far its run is, how well its seeds do that did not diverge, and how fast."""
    diverged: set[int] = set()

    def advance(progress: training.Progress) -> None:
        diverged.update(tables.diverged_seeds(progress.epochs))
        going_on = [row for row in progress.evaluations if row["seed"] not in diverged]
        numbers = "  ".join(success_in_words(going_on) if going_on else ["every seed diverged"])
        rates = [f"{progress.env_steps_per_second:,.0f} env steps/s"] * bool(progress.env_steps_per_second)
        line.advance(progress.epoch, numbers, "  ".join([*rates, f"{progress.updates_per_second:,.0f} updates/s"]))

    return advance


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
        sessions = {}

        def log(progress: training.Progress):
            evaluated = {(row["seed"], row["epoch"]): row for row in progress.evaluations}
            for row in progress.epochs:
                seed = row["seed"]
                if seed not in sessions:
                    sessions[seed] = weights_and_biases.init(
                        project=wandb,
                        group=folder.name,
                        name=f"{folder.name}-seed-{seed}",
                        config=to_dict(config) | {"method": method_title(config), "seed": seed},
                        dir=str(folder.parent),
                        reinit="create_new",  # A run for each seed, all at the same time.
                        settings=weights_and_biases.Settings(quiet=True),  # No page of numbers for each.
                    )
                    closing.append(sessions[seed].finish)
                numbers = row | evaluated.get((seed, row["epoch"]), {})
                sessions[seed].log(seed_means([numbers]), step=row["epoch"])

        def upload(paths: Sequence[Path]):
            """Of all seeds: they stand with the first."""
            if sessions and paths:
                kinds = {".gif": weights_and_biases.Video, ".png": weights_and_biases.Image}
                next(iter(sessions.values())).log(
                    {f"figures/{path.stem}": kinds[path.suffix](str(path)) for path in paths}
                )

        listeners.append(log)
        showing.append(upload)

    def pictures(paths: Sequence[Path]):
        for show in showing:
            show(paths)

    with ExitStack() as bar:
        words = f"{run_title(config)} x {num_seeds}"
        line = bar.enter_context(progress_line(words, config.num_epochs))
        listeners.append(advancing(line))
        try:
            yield Listeners(line.phase, tuple(listeners), bar.close, pictures)
        finally:
            for close in closing:
                close()
