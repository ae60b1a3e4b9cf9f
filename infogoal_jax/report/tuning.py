"""What `infogoal tune` and `infogoal final` show and leave behind: a line of progress, a table of the best trials, and
the files of a search."""

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.table import Table

from infogoal_jax import presets
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import counted
from infogoal_jax.hyperparameters import search_space
from infogoal_jax.presets.loading import train_flags
from infogoal_jax.runner.progress import progress_line
from infogoal_jax.runner.search import Trial, TuneResult, Watch
from infogoal_jax.runs.configuration import Description
from infogoal_jax.runs.search import Best, TrialLine, read_plan, read_trials, write_scores

SHOWN = 5
"""Trials in the table, besides the preset."""
GROUPS = {"validation": "validation goals", "train": "training goals, for want of validation goals"}


def save(result: TuneResult, folder: Path) -> None:
    """Write what each trial came to so far, and the best."""
    lines = [
        TrialLine(
            trial=trial.number,
            preset=trial.number == 0,
            values=trial.values,
            seeds=result.seeds,
            goals=result.group,
            epochs=result.epochs,
            success=trial.success,
            loss=trial.loss,
            score=trial.score,
            diverged=trial.diverged,
        )
        for trial in result.trials
    ]
    best = result.best
    chosen = Best(
        trial=best.number,
        score=best.score,
        score_of_preset=result.trials[0].score,
        goals=result.group,
        epoch=result.epochs[-1],
        finished=result.finished,
        values=best.values,
        task=result.config.task,
        flags=train_flags(result.config_of(best)),
        command=command_of(result),
        compile_seconds=result.compile_seconds,
        run_seconds=result.run_seconds,
    )
    write_scores(folder, lines, chosen)


def read(folder: Path) -> tuple[Description, list[Trial]]:
    """What a finished search was of, and its trials. Raises `UserError` if FOLDER holds none, or one that cannot be
    read."""
    about, lines = read_trials(folder)
    return about, [Trial(line.trial, line.values, line.success, line.loss, line.diverged) for line in lines]


def read_drawn(folder: Path) -> tuple[Description, list[Trial]]:
    """What a search or a final is of, and the trials that it was to run. Raises `UserError` if FOLDER holds none."""
    about, plan = read_plan(folder)
    return about, [Trial(drawn.trial, drawn.values, [], [], []) for drawn in plan.drawn]


def command_of(result: TuneResult) -> str:
    """The command that trains with the best trial's values."""
    return shlex.join(["infogoal", "train", result.config.task, *train_flags(result.config_of(result.best))])


@contextmanager
def watching(config: TrainConfig, trials: int, seeds: int, folder: Path, command: str = "tune") -> Iterator[Watch]:
    """What accompanies a search: files after each evaluation, and a line of progress. command: of the command line that
    goes on with it."""
    words = f"{config.task} {presets.name_of(config)}: {counted(trials, 'trial')} x {counted(seeds, 'seed')}"
    with progress_line(words, config.num_epochs) as line:

        def evaluated(result: TuneResult) -> None:
            save(result, folder)
            best = result.best
            numbers = f"best now {best.score:.2f} (trial {best.number}), preset {result.trials[0].score:.2f}"
            line.advance(result.epochs[-1], numbers)

        yield Watch(folder, command, line.compiling, evaluated)


def print_result(result: TuneResult) -> None:
    """The best trials and the preset, what they were scored on, how long it took, and how to train with the best."""
    console, ranked = Console(), sorted(result.trials, key=lambda trial: trial.order, reverse=True)
    table = Table()
    rows = [
        (
            "0 (preset)" if trial.number == 0 else str(trial.number),
            f"{trial.score:.2f}" + (f", {len(trial.diverged)} diverged" if trial.diverged else ""),
            *(f"{trial.values[field]:.4g}" for field in result.fields),
        )
        for trial in ranked[:SHOWN] + [trial for trial in ranked[SHOWN:] if trial.number == 0]
    ]
    for title, cells in zip(("trial", "success", *result.fields), zip(*rows, strict=True), strict=True):
        # Titles are broken where the terminal is narrow, numbers never.
        table.add_column(title, justify="right", overflow="fold", min_width=max(map(len, cells)))
    for row in rows:
        table.add_row(*row)
    console.print(table, crop=False)
    first, *more = result.seeds
    seeds = f"mean of {len(result.seeds)} seeds ({first} to {more[-1]})" if more else f"seed {first}"
    lines = [
        f"scores      success on {GROUPS[result.group]}, {seeds}, after epoch {result.epochs[-1]}",
        f"data        {result.about.data}",
        f"time        {result.compile_seconds:.1f} s compiling, {result.run_seconds:.1f} s running",
        f"best        {command_of(result)}",
    ]
    space = search_space(result.config.hyper)
    floored = [field for field, value in result.best.values.items() if space[field].is_at_floor(value)]
    if floored:
        lines.append(f"floor       at the lower end of its range: {', '.join(floored)}; below it the term would be off")
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
