"""What the settings of a sweep came to: a table with intervals over seeds, and one figure of all."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from infogoal_jax import checks
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import require
from infogoal_jax.report.comparison_figures import draw_comparison, titles_of
from infogoal_jax.report.figures import draw_figures
from infogoal_jax.report.runs import diverged_seeds, load_run, table_of
from infogoal_jax.report.statistics import mean_interval
from infogoal_jax.report.summary import number_table, print_run, seeds_in_words
from infogoal_jax.runner.executors import Outcome, run_here
from infogoal_jax.runner.jobs import Plan, combinations, run_plan
from infogoal_jax.runner.progress import say
from infogoal_jax.runner.training import checked_seeds

SHOWN = ("train_goal/success_rate", "validation_goal/success_rate", "test_goal/success_rate")


class SweepResult:
    """The runs of a sweep.

    folder: of the sweep.
    folders: of the runs, by their settings in words.
    """

    def __init__(self, folder: Path, plan: Plan):
        self.folder, self.plan = folder, plan
        self.folders = {name: folder / name if name else folder for name in plan.names}

    def __repr__(self) -> str:
        return f"SweepResult in {self.folder}: {'; '.join(filter(None, self.folders)) or 'one setting'}"

    def rows(self) -> list[dict[str, Any]]:
        """A row for each setting and seed: the values that differ, the seed, whether it diverged, and every single
        number of its last evaluation. `pandas.DataFrame(result.rows())` takes them."""
        found = []
        for folder, setting in zip(self.folders.values(), self.plan.settings, strict=True):
            table, diverged = table_of(folder, "evaluations"), diverged_seeds(folder)
            for place, seed in enumerate(table.seeds):
                numbers = {name: float(values[place, -1]) for name, values in table.values.items() if values.ndim == 2}
                about = {"seed": seed, "diverged": seed in diverged, "epoch": int(table.epochs[-1])}
                found.append({**setting, **about, **numbers})
        return found

    def figure(self, path: str | Path | None = None) -> Path:
        """One figure of all settings, success while training with intervals over seeds. Returns its path. Raises
        `UserError` where every seed of each diverged."""
        path = Path(path or self.folder / "comparison.png")
        return draw_comparison(list(self.folders.values()), path, labels=tuple(filter(None, self.folders)))


def sweep(
    config: TrainConfig,
    seeds: Iterable[int],
    folder: str | Path,
    resume: bool = False,
    seeds_at_once: int = 0,
    execute: Callable[..., Outcome] = run_here,
    **values: Sequence[float],
) -> SweepResult:
    """Train every combination of these values of float hyperparameters with each of these seeds.

    Args:
        config: what the settings are changes of.
        seeds: of every setting.
        folder: gets a run for each setting, as `infogoal train` leaves it.
        resume: go on in the folder of a sweep that was stopped.
        seeds_at_once: in one program at most; 0: all.
        execute: an executor of `runner.executors`: `run_here`, or `run_on_ray` with its arguments bound.
        values: of each float, such as learning_rate=[1e-4, 3e-4]; one of a part as learner__beta_step=[...].

    Raises `UserError`, before anything is compiled or written, for what cannot be run.
    """
    require(isinstance(config, TrainConfig), "config", config, "give a TrainConfig, such as presets.load makes")
    checks.path(folder, "folder", "give the folder of the sweep")
    resume = checks.flag(resume, "resume")
    seeds_at_once = checks.whole(seeds_at_once, "seeds_at_once", 0)
    checks.function(execute, "execute", 2, "give an executor, such as runner.executors.run_here")
    named = {name.replace("__", "."): listed for name, listed in values.items()}
    for name, listed in named.items():
        given = checks.array(listed, name, "numbers", ("N",), "give a list of numbers, such as [1e-4, 3e-4]")
        require(len(given) > 0, name, listed, "give at least one value")
    plan = Plan(combinations(named), list(checked_seeds(seeds)), seeds_at_once)
    run_plan(config, plan, Path(folder), resume, execute)
    return SweepResult(Path(folder), plan)


def print_sweep(folder: Path, plan: Plan) -> None:
    """Print success at the last evaluation of each setting, mean and 95 % interval over seeds, and its epoch where one
    was trained for longer than another; of a single run what is always printed of one."""
    if plan.settings == [{}]:
        print_run(folder)
        return
    result, names = SweepResult(folder, plan), list(plan.settings[0])
    settings = [[setting[name] for name in names] for setting in plan.in_words()]
    print_last_evaluations(list(result.folders.values()), names, settings)
    say(Console(), f"{folder}/SETTING, each a run for evaluate, report and compare", "runs")


def print_comparison(runs: Sequence[str | Path], labels: Sequence[str] = ()) -> None:
    """Print success at the last evaluation of each run, as `print_sweep` does. labels: their names, in this order;
    none: those of `comparison_figures.titles_of`."""
    loaded = [load_run(run) for run in runs]
    print_last_evaluations([run.folder for run in loaded], ["run"], [[title] for title in labels or titles_of(loaded)])


def print_last_evaluations(runs: Sequence[Path], names: Sequence[str], cells: Sequence[Sequence[str]]) -> None:
    """Print success at the last evaluation of each of these runs, behind cells of its own, whose titles are names."""
    console, rows, epochs, counts = Console(), [], [], []
    for run, own in zip(runs, cells, strict=True):
        diverged = diverged_seeds(run)
        table = table_of(run, "evaluations", diverged)
        scores = [
            mean_interval(table.values[name][:, -1]).show(2) if name in table.values and len(table.seeds) else ""
            for name in SHOWN
        ]
        rows.append([*own, *scores, str(len(diverged) or "")])
        counts += [len(table.seeds)] * any(scores)
        epochs.append(str(table.epochs[-1]) if len(table.epochs) else "")
    titles = [*names, *(name.partition("_goal")[0] + " goals" for name in SHOWN), "diverged"]
    if len(set(epochs)) > 1:
        titles, rows = [*titles, "epoch"], [[*row, epoch] for row, epoch in zip(rows, epochs, strict=True)]
    console.print(number_table(titles, rows), crop=False)
    if counts:
        say(console, f"success at the last evaluation: {seeds_in_words(*counts)}")


def draw_sweep(folder: Path, plan: Plan) -> list[Path]:
    """The figures of a single run, or the one figure of all settings; none where every seed diverged."""
    if plan.settings == [{}]:
        return draw_figures(folder)
    result = SweepResult(folder, plan)
    lost = [len(diverged_seeds(run)) == len(plan.seeds) for run in result.folders.values()]
    return [] if all(lost) else [result.figure()]
