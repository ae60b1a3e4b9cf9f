"""What `infogoal tune` and `infogoal final` show: a line of progress, and a table of the best trials."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from infogoal_jax import presets
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import counted
from infogoal_jax.hyperparameters import search_space
from infogoal_jax.report.summary import number_table
from infogoal_jax.runner.progress import progress_line, say
from infogoal_jax.runner.search import Watch
from infogoal_jax.runs.search import TuneResult, write_scores

SHOWN = 5
"""Trials in the table, besides the preset."""
GROUPS = {"validation": "validation goals", "train": "training goals, for want of validation goals"}


@contextmanager
def watching(config: TrainConfig, trials: int, seeds: int, folder: Path, command: str = "tune") -> Iterator[Watch]:
    """What accompanies a search: files after each evaluation, and a line of progress. command: of the command line that
    goes on with it."""
    words = f"{config.task} {presets.name_of(config)}: {counted(trials, 'trial')} x {counted(seeds, 'seed')}"
    with progress_line(words, config.num_epochs) as line:

        def evaluated(result: TuneResult) -> None:
            write_scores(folder, result)
            line.advance(result.epochs[-1], f"best {result.best.score:.2f}, preset {result.trials[0].score:.2f}")

        yield Watch(folder, command, line.compiling, evaluated)


def print_result(result: TuneResult) -> None:
    """The best trials and the preset, what they were scored on, how long it took, and how to train with the best."""
    console, ranked = Console(), sorted(result.trials, key=lambda trial: trial.order, reverse=True)
    rows = [
        (
            "0 (preset)" if trial.trial == 0 else str(trial.trial),
            f"{trial.score:.2f}" + (f", {len(trial.diverged)} diverged" if trial.diverged else ""),
            *(f"{trial.values[field]:.4g}" for field in result.fields),
        )
        for trial in ranked[:SHOWN] + [trial for trial in ranked[SHOWN:] if trial.trial == 0]
    ]
    console.print(number_table(("trial", "success", *result.fields), rows), crop=False)
    first, *more = result.seeds
    seeds = f"mean of {len(result.seeds)} seeds ({first} to {more[-1]})" if more else f"seed {first}"
    say(console, f"success on {GROUPS[result.group]}, {seeds}, after epoch {result.epochs[-1]}", "scores")
    say(console, result.about.data, "data")
    say(console, f"{result.compile_seconds:.1f} s compiling, {result.run_seconds:.1f} s running", "time")
    # Not broken between words: it is copied.
    console.print(f"best        {result.command}", highlight=False, markup=False, soft_wrap=True)
    space = search_space(result.config.hyper)
    floored = [field for field, value in result.best.values.items() if space[field].is_at_floor(value)]
    if floored:
        say(console, f"at the lower end of its range: {', '.join(floored)}; below it the term would be off", "floor")
