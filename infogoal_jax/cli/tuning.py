"""`infogoal tune TASK` and `infogoal final SEARCH`."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import FlagCreatePairsOff, Positional

from infogoal_jax.cli.choice import preset_of, read_choice
from infogoal_jax.cli.commands import TaskCommands
from infogoal_jax.cli.folders import empty_folder, new_folder
from infogoal_jax.errors import UserError

HELP = "Look for hyperparameters by random search. `infogoal tune TASK --help` shows the flags of a task."


def tune(
    parts: Annotated[Any, tyro.conf.arg(name="")] = None,
    config: Annotated[Any, tyro.conf.arg(name="")] = None,
    trials: int = 16,
    seeds: int = 2,
    first_seed: int = 1000,
    space_seed: int = 0,
    fields: tuple[str, ...] = (),
    out: str = "",
    help_all: FlagCreatePairsOff[bool] = False,
) -> int:
    """Look for hyperparameters by random search, on validation goals.

    Args:
        parts: Their names, which are in the configuration already.
        config: That of the task and the parts.
        trials: Settings that are tried; the first is the preset.
        seeds: Seeds of each setting.
        first_seed: Number of the first seed: 1000 or more, because reported runs have the seeds 0, 1, 2, ...
        space_seed: Seed of the draws from the space; methods that are to be compared have the same.
        fields: Hyperparameters to search, such as learning_rate discount; empty: all that matter to the method.
        out: Folder of the search; empty: a new one under runs/.
        help_all: Show all flags, of each part and the hyperparameters too.

    Returns:
        0 when it finished, 130 when it was stopped by Ctrl-C (with the scores until then).
    """
    import jax

    from infogoal_jax.train import tune as search

    numbers = range(first_seed, first_seed + seeds)
    fields = tuple(field.replace("-", "_") for field in fields)
    key = jax.random.key(space_seed)
    return watch_search(
        config,
        trials,
        seeds,
        search_folder(out, config, "tuning"),
        lambda watch: search.tune(config, trials, numbers, key, fields, watch=watch),
    )


def tasks(arguments: list[str]) -> TaskCommands:
    """`tune` for each task; for one that is named, with the preset of the method that is chosen as its defaults."""
    from infogoal_jax.cli.by_task import all_tasks, of_task
    from infogoal_jax.train.tune import same_budget

    task, choice = read_choice(arguments, "infogoal tune")
    return (
        of_task(tune, same_budget(preset_of(task, choice)), choice, arguments)
        if task
        else all_tasks(tune, HELP, arguments)
    )


def final(
    search: Positional[str], trials: int = 4, seeds: int = 8, first_seed: int | None = None, out: str = ""
) -> int:
    """Run the preset and the best trials of a search again, with other seeds.

    Args:
        search: Folder of an `infogoal tune` that came to its end. Its task, method and configuration are those of the
            final.
        trials: How many, the preset among them.
        seeds: Seeds of each.
        first_seed: Number of the first seed; none: the one after the search's last.
        out: Folder of the final; empty: a new one under runs/.

    Returns:
        0 when it finished, 130 when it was stopped by Ctrl-C (with the scores until then).
    """
    from infogoal_jax.report import tuning
    from infogoal_jax.train import tune as searching

    run, found = tuning.read(Path(search))
    finalists = searching.finalists(found, trials)
    first = max(run.seeds) + 1 if first_seed is None else first_seed
    numbers = range(first, first + seeds)
    if set(numbers) & set(run.seeds):
        raise UserError(
            f"first_seed = {first}: the search had the seeds {run.seeds}; give others, or leave the flag out"
        )
    return watch_search(
        run.config,
        trials,
        seeds,
        search_folder(out, run.config, "final"),
        lambda watch: searching.final(run.config, finalists, numbers, watch=watch),
    )


def search_folder(out: str, config: Any, kind: str) -> Path:
    """The folder that was given, which must be empty, or a new one."""
    from infogoal_jax import presets

    return empty_folder(out, "out") if out else new_folder(config.task, presets.name_of(config), kind)


def watch_search(config: Any, trials: int, seeds: int, folder: Path, run: Callable[[Callable], Any]) -> int:
    """Run a search or a final, given what watches it. Returns the exit status."""
    from infogoal_jax.report import tuning
    from infogoal_jax.train.compilation import use_compilation_cache

    use_compilation_cache()
    try:
        with tuning.watching(config, trials, seeds, folder) as watch:
            result = run(watch)
    except KeyboardInterrupt:
        print(f"Stopped. The scores until then, if there are any, are in {folder}")
        return 130
    tuning.print_result(result)
    return 0
