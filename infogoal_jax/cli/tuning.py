"""`infogoal tune TASK` and `infogoal final SEARCH`."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import FlagCreatePairsOff, Positional

from infogoal_jax.cli.choice import all_tasks, check_left_out, check_same_parts, of_task, preset_of, read_choice
from infogoal_jax.cli.commands import TaskCommands, Words, check_resumed_in_place, check_seed, new_folder, seeds_from
from infogoal_jax.errors import UserError, require
from infogoal_jax.imports import typed_command

HELP = """Look for hyperparameters by random search. `infogoal tune TASK --help` shows the flags of a task, and
`infogoal tune --resume SEARCH` goes on with a search that was stopped."""


def tune(
    parts: Annotated[object, tyro.conf.arg(name="")] = None,
    config: Annotated[object, tyro.conf.arg(name="")] = None,
    resume: str = "",
    trials: int = 16,
    seeds: int = 2,
    first_seed: int = 1000,
    space_seed: int = 0,
    fields: Words = (),
    out: str = "",
    help_all: FlagCreatePairsOff[bool] = False,
) -> int:
    """Look for hyperparameters by random search, on validation goals.

    Args:
        parts: Their names, which are in the configuration already.
        config: That of the task and the parts.
        resume: Folder of a search to go on with; its trials and seeds are those that it has.
        trials: Settings that are tried; the first is the preset.
        seeds: Seeds of each setting.
        first_seed: Number of the first seed: 1000 or more, because reported runs have the seeds 0, 1, 2, ...
        space_seed: Seed of the draws from the space; methods that are to be compared have the same.
        fields: Hyperparameters to search, such as learning_rate discount; empty: all that matter to the method.
        out: Folder of the search; empty: a new one under runs/.
        help_all: Show all flags, of each part and the hyperparameters too.

    Returns:
        0 when it finished, 130 when it was stopped by a signal (it can be resumed).
    """
    check_resumed_in_place(resume, out)
    if resume:
        return go_on(resume, "tune", config)
    check_seed(space_seed, "space_seed")
    import jax

    from infogoal_jax.runner import search

    numbers = seeds_from(first_seed, seeds)
    fields = tuple(field.replace("-", "_") for field in fields)
    folder = search_folder(out, config, "tuning")
    return watch_search(
        config,
        trials,
        seeds,
        folder,
        "tune",
        lambda watch: search.tune(config, trials, numbers, jax.random.key(space_seed), fields, watch=watch),
    )


def tasks(arguments: list[str]) -> TaskCommands:
    """`tune` for each task; for one that is named, or known from a search to go on with, with the configuration that is
    chosen as its defaults."""
    task, choice = read_choice(arguments, "infogoal tune")
    if not task and not choice.resume:
        return all_tasks(tune, HELP, arguments, choice)
    if choice.resume:
        from infogoal_jax.runs.search import read_plan

        config = read_plan(Path(choice.resume))[0].config
        check_same_parts(config, task, choice)
        check_left_out(arguments, ("--trials", "--seeds", "--first-seed", "--space-seed", "--fields"), "search")
    else:
        from infogoal_jax.runner.search import same_budget

        config = same_budget(preset_of(task, choice))
    return of_task(tune, config, choice, arguments if task else [config.task, *arguments])


def check_final(arguments: list[str]) -> None:
    """Raise `UserError` for a flag beside --resume that the final to go on with has settled."""
    if any(word.partition("=")[0] == "--resume" for word in arguments):
        check_left_out(arguments, ("--trials", "--seeds", "--first-seed"), "final")


def final(
    search: Positional[str] = "",
    resume: str = "",
    trials: int | None = None,
    seeds: int = 8,
    first_seed: int | None = None,
    out: str = "",
) -> int:
    """Run the preset and the best trials of a search again, with other seeds.

    Args:
        search: Folder of an `infogoal tune` that came to its end. Its task, method and configuration are those of the
            final.
        resume: Folder of a final to go on with, in place of a search.
        trials: How many, the preset among them; none: 4, or all of a search that has fewer.
        seeds: Seeds of each.
        first_seed: Number of the first seed; none: the one after the search's last.
        out: Folder of the final; empty: a new one under runs/.

    Returns:
        0 when it finished, 130 when it was stopped by a signal (it can be resumed).
    """
    check_resumed_in_place(resume, out)
    require(bool(search) != bool(resume), "search", search, "give the folder of a search, or --resume with a final's")
    if resume:
        return go_on(resume, "final")
    from infogoal_jax.runner import search as searching
    from infogoal_jax.runs.search import read_trials

    about, found = read_trials(Path(search))
    finalists = searching.finalists(found, trials)
    first = max(about.seeds) + 1 if first_seed is None else first_seed
    numbers = seeds_from(first, seeds)
    if any(seed in numbers for seed in about.seeds):
        raise UserError(
            f"first_seed = {first}: the search had the seeds {about.seeds}; give others, or leave the flag out"
        )
    return watch_search(
        about.config,
        len(finalists),
        seeds,
        search_folder(out, about.config, "final"),
        "final",
        lambda watch: searching.final(about.config, finalists, numbers, watch=watch),
    )


def go_on(folder: str, command: str, config: Any = None) -> int:
    """Go on with the search or the final in this folder. Returns the exit status."""
    from infogoal_jax.runner import search as searching
    from infogoal_jax.runs.search import read_plan

    about, trials = read_plan(Path(folder))
    config = about.config if config is None else config
    return watch_search(
        config,
        len(trials),
        len(about.seeds),
        Path(folder),
        command,
        lambda watch: searching.final(config, trials, about.seeds, watch=watch, resume=True),
    )


def search_folder(out: str, config: Any, kind: str) -> Path:
    """The folder that was given, or a new one. Raises `UserError` if a search is in it already."""
    from infogoal_jax import presets
    from infogoal_jax.runs.folder import SEARCH, check_new

    folder = Path(out) if out else new_folder(config.task, presets.name_of(config), kind)
    check_new(folder, SEARCH)
    return folder


def watch_search(config: Any, trials: int, seeds: int, folder: Path, command: str, run: Callable[[Any], Any]) -> int:
    """Run a search or a final, given what accompanies it. Returns the exit status."""
    from infogoal_jax.report import tuning
    from infogoal_jax.runner.compilation import use_compilation_cache

    use_compilation_cache()
    with tuning.watching(config, trials, seeds, folder, command) as watch:
        result = run(watch)
    if not result.finished:
        onward = typed_command(command, "--resume", folder)
        print(f"Stopped. The scores until then are in {folder}; go on with: {onward}")
        return 130
    tuning.print_result(result)
    return 0
