"""What `infogoal tune` shows and leaves behind: a line of progress, a table of the best trials, and the files of a
search.

FOLDER/config.json   configuration, seeds, data, versions, and the ranges that were searched
FOLDER/trials.jsonl  a line a trial: values, seeds, success and loss of every evaluation
FOLDER/best.json     the best trial, with the flags to give to `infogoal train`
"""

import json
import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from infogoal_jax import presets
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import UserError
from infogoal_jax.hyperparameters import search_space
from infogoal_jax.presets.saved import train_flags
from infogoal_jax.report.runs import Run, load_run
from infogoal_jax.train import files
from infogoal_jax.train.tune import Trial, TuneResult

SHOWN = 5
"""Trials in the table, besides the preset."""
GROUPS = {"validation": "validation goals", "train": "training goals, for want of validation goals"}


def save(result: TuneResult, folder: Path) -> None:
    """Write what is known so far: FOLDER/trials.jsonl, a line a trial; FOLDER/best.json, with the flags of the best;
    FOLDER/config.json."""
    files.make_folder(folder)
    space = {
        field: search._asdict() for field, search in search_space(result.config.hyper).items() if field in result.fields
    }
    about = result.description | {"trials": len(result.trials), "space": space}
    lines = [
        {
            "trial": trial.number,
            "preset": trial.number == 0,
            "values": trial.values,
            "seeds": result.seeds,
            "goals": result.group,
            "epochs": result.epochs,
            "success": trial.success,
            "loss": trial.loss,
            "score": trial.score,
            "diverged": trial.diverged,
        }
        for trial in result.trials
    ]
    best = result.best
    chosen = {
        "trial": best.number,
        "score": best.score,
        "score_of_preset": result.trials[0].score,
        "goals": result.group,
        "epoch": result.epochs[-1],
        "finished": len(result.epochs) == result.config.num_evaluations,
        "values": best.values,
        "task": result.config.task,
        "flags": train_flags(result.config_of(best)),
        "command": command_of(result),
        "compile_seconds": result.compile_seconds,
        "run_seconds": result.run_seconds,
    }
    contents = {
        "config.json": json.dumps(about, indent=2),
        "trials.jsonl": "\n".join(json.dumps(line) for line in lines),
        "best.json": json.dumps(chosen, indent=2),
    }
    for name, text in contents.items():
        files.write_atomically(folder / name, lambda file, text=text: file.write(f"{text}\n".encode()))


def read(folder: Path) -> tuple[Run, list[Trial]]:
    """What a finished search was of, and its trials. Raises `UserError` if FOLDER holds none, or one that cannot be
    read."""
    path = folder / "trials.jsonl"
    if not path.is_file():
        raise UserError(
            f"search = {str(folder)!r}: holds no trials.jsonl; give the folder of a search, the --out of an `infogoal "
            "tune`"
        )
    run = load_run(folder)
    try:
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        trials = [
            Trial(line["trial"], dict(line["values"]), line["success"], line["loss"], line["diverged"])
            for line in lines
        ]
        if not trials or [trial.number for trial in trials] != list(range(len(trials))) or not run.seeds:
            raise ValueError("it should have the trials 0, 1, 2, ... and seeds; of a final there is no final")
        if any(trial.values.keys() != trials[0].values.keys() for trial in trials):
            raise ValueError("its trials have different fields")
        done = min(len(trial.success) for trial in trials)
    except OSError as error:
        raise UserError(f"{path}: could not be read ({error.strerror})") from error
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: is damaged ({error}); search again, or bring back a copy of the file") from error
    if done < run.config.num_evaluations:
        raise UserError(
            f"search = {str(folder)!r}: was stopped after {done} of {run.config.num_evaluations} evaluations; search "
            "again to the end"
        )
    return run, trials


def command_of(result: TuneResult) -> str:
    """The command that trains with the best trial's values."""
    return shlex.join(["infogoal", "train", result.config.task, *train_flags(result.config_of(result.best))])


@contextmanager
def watching(config: TrainConfig, trials: int, seeds: int, folder: Path) -> Iterator[Callable[[TuneResult], None]]:
    """What watches a search: files after each evaluation, and a bar on a terminal, or a line for each evaluation in a
    log file."""
    console = Console()
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[numbers]}"),
        console=console,
        refresh_per_second=2,
        disable=not console.is_terminal,
    )
    line = bar.add_task(
        f"{config.task} {presets.name_of(config)}: {trials} trials x {seeds} seeds",
        total=config.num_epochs,
        numbers="compiling",
    )

    def watch(result: TuneResult) -> None:
        save(result, folder)
        best = result.best
        numbers = f"best so far {best.score:.2f} (trial {best.number}), preset {result.trials[0].score:.2f}"
        bar.update(line, completed=result.epochs[-1], numbers=numbers)
        if not console.is_terminal:
            console.print(f"epoch {result.epochs[-1]}/{config.num_epochs}  {numbers}", soft_wrap=True, highlight=False)

    with bar:
        yield watch


def print_result(result: TuneResult) -> None:
    """The best trials and the preset, what they were scored on, how long it took, and how to train with the best."""
    console, ranked = Console(), sorted(result.trials, key=lambda trial: trial.order, reverse=True)
    table = Table()
    for title in ("trial", "success", *result.fields):
        table.add_column(title, justify="right", overflow="fold")
    for trial in ranked[:SHOWN] + [trial for trial in ranked[SHOWN:] if trial.number == 0]:
        lost = f", {len(trial.diverged)} diverged" if trial.diverged else ""
        name = "0 (preset)" if trial.number == 0 else str(trial.number)
        table.add_row(name, f"{trial.score:.2f}{lost}", *(f"{value:.4g}" for value in trial.values.values()))
    console.print(table)
    lines = [
        f"scores      success on {GROUPS[result.group]}, mean of {len(result.seeds)} seeds ({result.seeds[0]} to "
        f"{result.seeds[-1]}), "
        f"after epoch {result.epochs[-1]}",
        f"data        {result.description['data']}",
        f"time        {result.compile_seconds:.1f} s compiling, {result.run_seconds:.1f} s running",
        f"best        {command_of(result)}",
    ]
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)
