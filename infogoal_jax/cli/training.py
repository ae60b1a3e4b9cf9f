"""`infogoal train TASK`."""

from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import FlagCreatePairsOff

from infogoal_jax.cli.choice import AUTO, all_tasks, config_of_run, of_task, preset_of, read_choice
from infogoal_jax.cli.commands import TaskCommands
from infogoal_jax.cli.folders import check_resumed_in_place, new_folder, seeds_from
from infogoal_jax.errors import require
from infogoal_jax.stopping import STATUS, stop_on_signal

HELP = """Train on a task. `infogoal train TASK --help` shows the flags of one, and
`infogoal train --resume RUN` goes on with a run from its last checkpoint."""


def train(
    parts: Annotated[object, tyro.conf.arg(name="")] = None,
    config: Annotated[object, tyro.conf.arg(name="")] = None,
    resume: str = "",
    seeds: int = 1,
    first_seed: int = 0,
    out: str = "",
    figures: bool = True,
    tensorboard: FlagCreatePairsOff[bool] = False,
    wandb: str = "",
    distributed: str = "",
    num_processes: int = 0,
    process: int = 0,
    help_all: FlagCreatePairsOff[bool] = False,
) -> int:
    """Train on a task, all seeds in one program.

    Args:
        parts: Their names, which are in the configuration already.
        config: That of the task and the parts.
        resume: Folder of a run to go on with, from its last checkpoint. auto: the run in --out, or the newest under
            runs/ of this configuration and these seeds; a new one where there is none.
        seeds: Seeds that are trained side by side: 0, 1, 2, ...
        first_seed: Number of the first seed.
        out: Folder of the run; empty: a new one under runs/.
        figures: Draw the figures at the end.
        tensorboard: Write the metrics for TensorBoard too, into the folder of the run.
        wandb: Project of Weights & Biases to log to (needs `pip install wandb`).
        distributed: This process is one of several, each of which trains its share of the seeds: HOST:PORT of the
            first one, or auto, where Slurm, Open MPI or Kubernetes says it.
        num_processes: How many there are; with HOST:PORT.
        process: Number of this one, from 0 on; the first writes the run.
        help_all: Show all flags, of each part and the hyperparameters too.

    Returns:
        0 when it finished, 130 when it was stopped by a signal (with a checkpoint).
    """
    numbers = seeds_from(first_seed, seeds)
    if resume != AUTO:
        check_resumed_in_place(resume, out)
    from infogoal_jax import presets
    from infogoal_jax.train import distributed as several
    from infogoal_jax.train import host
    from infogoal_jax.train.combinations import check_combination
    from infogoal_jax.train.compilation import use_compilation_cache
    from infogoal_jax.train.listeners import make_listeners

    require(bool(distributed) or not num_processes, "num_processes", num_processes, "goes with --distributed")
    require(not (distributed and resume == AUTO), "resume", resume, "name the run: several processes go on with it")
    if distributed:
        several.join(distributed, num_processes, process)
    use_compilation_cache()
    check_combination(config)
    if resume == AUTO:
        resume = run_to_go_on_with(config, numbers, out)
    elif resume and (seeds, first_seed) == (1, 0):
        from infogoal_jax.runs import description

        numbers = description.read(Path(resume)).seeds
    folder = Path(resume or out or new_folder(config.task, presets.name_of(config)))
    if not several.is_writer():
        sweep = host.run(config, numbers, folder, bool(resume))
        several.part()
        return STATUS if sweep.stopped else 0
    with make_listeners(folder, config, len(numbers), tensorboard=tensorboard, wandb=wandb) as listeners:
        sweep = host.run(config, numbers, folder, bool(resume), listeners.progress, compiling=listeners.compiling)
        several.part()  # Figures may take longer than the others would wait.
        listeners.end_progress()
        from infogoal_jax.report.summary import print_summary

        with stop_on_signal() as stop:
            stop.advice = f"the run in {folder} is whole; draw its figures with: infogoal report {folder}"
            print_summary(sweep)
            if sweep.stopped:
                print(f"Stopped. Go on with: infogoal train --resume {folder}")
                return STATUS
            if figures:
                from infogoal_jax.report.figures import draw_figures

                paths = draw_figures(folder, sweep.train.env)
                for path in paths:
                    print(f"figure      {path}")
                video = [draw_video(folder, sweep.train.env)] if tensorboard or wandb else []
                listeners.pictures([*paths, *filter(None, video)])
            return 0


def draw_video(folder: Path, env: Any) -> Path | None:
    """A GIF of one episode of the trained policy under RUN/figures; None for tasks whose goals are no images."""
    from infogoal_jax.report.figures import read_subject
    from infogoal_jax.report.image_goal_episodes import policy_video
    from infogoal_jax.train.settings import has_image_goals

    subject, path = read_subject(folder, env), folder / "figures" / "episode.gif"
    if not has_image_goals(env) or subject.params is None or "test" not in env.goals.groups:
        return None
    policy_video(subject, path, size=(180, 240))
    return path


def run_to_go_on_with(config: Any, seeds: range, out: str) -> str:
    """The folder of the run that `--resume auto` means, or nothing where a new run is to be started."""
    from infogoal_jax.runs.folder import newest_run

    if out:
        return out if (Path(out) / "config.json").exists() else ""
    newest = newest_run(Path("runs"), config, seeds)
    return str(newest) if newest else ""


def tasks(arguments: list[str]) -> TaskCommands:
    """`train` for each task; for one that is named, or known from a run to resume, with the configuration that is
    chosen as its defaults."""
    task, choice = read_choice(arguments, "infogoal train")
    if not task and choice.resume in (None, "", AUTO):
        return all_tasks(train, HELP, arguments, choice)
    of_run = choice.resume not in (None, "", AUTO)
    config = config_of_run(choice.resume, task, choice) if of_run else preset_of(task, choice)
    return of_task(train, config, choice, arguments if task else [config.task, *arguments])
