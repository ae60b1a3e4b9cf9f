"""`infogoal train TASK`; `infogoal methods`, which says what can be trained; and `infogoal pretrain TASK`, which trains
the low levels that drive a robot to target states."""

import sys
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional

from infogoal_jax.cli.choice import (
    AUTO,
    Name,
    Parts,
    Synonyms,
    Where,
    all_tasks,
    check_left_out,
    check_same_parts,
    of_task,
    preset_of,
    read_choice,
)
from infogoal_jax.cli.commands import (
    Command,
    Group,
    TaskCommands,
    Words,
    check_resumed_in_place,
    draw,
    named,
    new_folder,
    seeds_from,
    tell,
)
from infogoal_jax.errors import UserError, counted, require
from infogoal_jax.imports import typed_command
from infogoal_jax.stopping import STATUS, stop_on_signal

BY_SIGNAL = 128
"""What a shell adds to the number of the signal that ended a process, for its exit status."""
OF_CODE = Annotated[tuple[str, ...], tyro.conf.Suppress, tyro.conf.Fixed]
"""Of an argument that is no flag."""
HELP = """Train on a task. `infogoal train TASK --help` shows the flags of one, and
`infogoal train --resume RUN` goes on with a run from its last checkpoint."""


def train(
    parts: Annotated[object, tyro.conf.arg(name="")] = None,
    config: Annotated[object, tyro.conf.arg(name="")] = None,
    resume: str = "",
    small: FlagCreatePairsOff[bool] = False,
    seeds: int = 1,
    first_seed: int = 0,
    out: str = "",
    figures: bool = True,
    tensorboard: FlagCreatePairsOff[bool] = False,
    wandb: str = "",
    sweep: Words = (),
    vmap_size: int = 0,
    synonyms: Annotated[Synonyms, OmitArgPrefixes] = Synonyms(),  # noqa: B008 (frozen)
    where: Annotated[Where, OmitArgPrefixes] = Where(),  # noqa: B008 (frozen)
    help_all: FlagCreatePairsOff[bool] = False,
    command: OF_CODE = ("train",),
) -> int:
    """Train on a task, all seeds in one program.

    Args:
        parts: Their names, which are in the configuration already.
        config: That of the task and the parts.
        resume: Folder of a run to go on with; auto: the one in --out, the newest like this, or a new one.
        small: Begin with the preset for first trials, which object_search has.
        seeds: Seeds that are trained side by side: 0, 1, 2, ...
        first_seed: Number of the first seed.
        out: Folder of the run; empty: a new one under runs/.
        figures: Draw the figures at the end.
        tensorboard: Write the metrics for TensorBoard too, into the folder of the run.
        wandb: Project of Weights & Biases to log to, a run for each seed, in a group (needs `pip install wandb`).
        sweep: Values of floats, such as learning_rate=1e-4,3e-4 discount=0.9,0.99: a run for each combination.
        vmap_size: Seeds that one program trains side by side at most; 0: all.
        synonyms: Flags of other libraries.
        where: The programs run.
        help_all: Show all flags, of each part and the hyperparameters too.
        command: What a user types to go on, before --resume.

    Returns:
        0 when it finished, 130 when it was stopped by a signal (with a checkpoint).
    """
    numbers = seeds_from(first_seed, seeds)
    if resume != AUTO:
        check_resumed_in_place(resume, out)
    from infogoal_jax import presets
    from infogoal_jax.loading import check_combination
    from infogoal_jax.runner import distributed as several
    from infogoal_jax.runner import training
    from infogoal_jax.runner.compilation import use_compilation_cache
    from infogoal_jax.runner.listeners import make_listeners
    from infogoal_jax.runs.configuration import SWEEP
    from infogoal_jax.runs.folder import check_new

    check_where(where, resume)
    if where.distributed:
        several.join(where.distributed, where.num_processes, where.process)
    use_compilation_cache()
    config = with_synonyms(config, synonyms.lr, synonyms.total_steps)
    check_combination(config)
    in_parts = bool(sweep or vmap_size or where.processes or where.engine == "ray")
    if in_parts or is_sweep(resume):
        require(
            not where.distributed,
            "distributed",
            where.distributed,
            "goes with neither --sweep, --vmap-size nor an engine",
        )
        require(resume != AUTO, "resume", resume, "name the folder of the sweep")
        for name, value in (("tensorboard", tensorboard), ("wandb", wandb)):
            require(not value, name, value, "goes with neither --sweep, --vmap-size nor an engine")
        folder = Path(resume or out or new_folder(config.task, presets.name_of(config)))
        settings = [] if resume else read_settings(sweep)
        swept = synonyms.lr is not None and any("learning_rate" in setting for setting in settings)
        require(not swept, "lr", synonyms.lr, "--sweep says the learning rates; leave one of both out")
        return train_parts(config, settings, numbers, vmap_size, folder, bool(resume), where, figures)
    if resume == AUTO:
        resume = run_to_go_on_with(config, numbers, out)
    elif resume:
        from infogoal_jax.runs import configuration

        before = configuration.read(Path(resume), "resume").seeds
        numbers = before if (seeds, first_seed) == (len(before), before[0]) else numbers
    folder = Path(resume or out or several.agreed(str(new_folder(config.task, presets.name_of(config)))))
    if not resume:
        check_new(folder, (SWEEP,))  # Whose runs stand in it.
    onward = typed_command(*command, "--resume", folder)
    if not several.is_writer():
        sweep = training.run(config, numbers, folder, bool(resume), onward=onward)
        several.part()
        return STATUS if sweep.stopped else 0
    with make_listeners(folder, config, len(numbers), tensorboard=tensorboard, wandb=wandb) as listeners:
        told = {"phase": listeners.phase, "onward": onward}
        sweep = training.run(config, numbers, folder, bool(resume), listeners.progress, **told)
        several.part()  # Figures may take longer than the others would wait.
        listeners.end_progress()
        from infogoal_jax.report.summary import print_run

        with stop_on_signal() as stop:
            stop.advice = f"the run in {folder} is whole; draw its figures with: {typed_command('report', folder)}"
            if not where.quiet:
                print_run(folder)
            if sweep.stopped:
                print(f"Stopped. Go on with: {onward}")
                return STATUS
            if figures:
                from infogoal_jax.report.figures import draw_figures

                paths = draw(draw_figures, folder, sweep.train.env)
                video = [draw_video(folder, sweep.train.env)] if tensorboard or wandb else []
                listeners.pictures([*paths, *filter(None, video)])
            return 0


def with_synonyms(config: Any, lr: float | None, total_steps: int) -> Any:
    """The configuration with what the flags of other libraries say, rounded to whole evaluations, which is printed.
    Raises `UserError` for a task that takes no steps, and for fewer than 0 or more than a run can have."""
    import dataclasses

    from infogoal_jax.field_types import LARGEST_WHOLE
    from infogoal_jax.loading import traits_declared

    if lr is not None:
        config = dataclasses.replace(config, hyper=config.hyper.replace(learning_rate=lr))
    require(total_steps >= 0, "total_steps", total_steps, "give 0 or more environment steps")
    if not total_steps:
        return config
    traits = traits_declared(config)
    recorded = traits is not None and traits.recorded
    require(not recorded, "total_steps", total_steps, f"{config.task} learns from recorded steps; give --num-epochs")
    chunk = config.num_envs * config.rollout_steps * config.epochs_per_evaluation
    most = LARGEST_WHOLE // config.epochs_per_evaluation * chunk
    require(total_steps <= most, "total_steps", total_steps, f"give at most {most}: {LARGEST_WHOLE} epochs")
    count = max(round(total_steps / chunk), 1)
    epochs = count * config.epochs_per_evaluation
    length = f"{counted(epochs, 'epoch')}, {counted(count, 'evaluation')}"
    tell(f"total_steps {count * chunk:,} environment steps at most: {length}")
    return dataclasses.replace(config, num_epochs=epochs)


OTHER_NAMES = {"--lr": "--hyper.learning-rate", "--total-steps": "--num-epochs"}
"""The flags that say the same as `Synonyms` do."""


def check_said_once(arguments: list[str]) -> None:
    """Raise `UserError` where a field has two values: one by a flag of this library and one by that of others."""
    given = {word.partition("=")[0].replace("_", "-") for word in arguments}
    for name, other in OTHER_NAMES.items():
        if {name, other} <= given:
            raise UserError(f"{name}: says the same as {other}; give one of both")


def check_where(where: Where, resume: str) -> None:
    """Raise `UserError` for flags of where programs run that do not go together."""
    from infogoal_jax.runner.executors import check_flags

    several = bool(where.distributed)
    require(several or not where.num_processes, "num_processes", where.num_processes, "goes with --distributed")
    require(several or not where.process, "process", where.process, "goes with --distributed")
    for name in ("num_processes", "process") if where.distributed == AUTO else ():
        require(not (number := getattr(where, name)), name, number, "auto finds it out; leave it out")
    require(not (several and resume == AUTO), "resume", resume, "name the run: several processes go on with it")
    check_flags(where.engine, where.processes, where.gpus, where.ray_address)


def is_sweep(folder: str) -> bool:
    """Whether a folder to go on with is that of a sweep."""
    from infogoal_jax.runner.jobs import NAME

    return bool(folder) and (Path(folder) / NAME).exists()


def read_settings(words: tuple[str, ...]) -> list[dict[str, float]]:
    """The settings that these words ask for, such as learning_rate=1e-4,3e-4. Raises `UserError` for other words."""
    from infogoal_jax.runner.jobs import combinations

    values: dict[str, list[float]] = {}
    for word in words:
        name, sign, listed = word.partition("=")
        name = name.removeprefix("hyper.").replace("-", "_")
        remedy = "give FIELD=NUMBER,NUMBER,..., such as learning_rate=1e-4,3e-4"
        require(bool(sign) and bool(name), "sweep", word, remedy)
        require(name not in values, "sweep", word, f"{name} is given already; list all of its values there")
        try:
            values[name] = [float(value) for value in listed.split(",")]
        except ValueError:
            raise UserError(f"sweep = {word!r}: {remedy}") from None
    return combinations(values)


def train_parts(
    config: Any,
    settings: list[dict[str, float]],
    seeds: Any,
    vmap_size: int,
    folder: Path,
    resume: bool,
    where: Where,
    figures: bool,
) -> int:
    """Train settings and seeds as jobs, where the engine says, and show what came of them. Returns the exit status."""
    import functools

    from infogoal_jax.report.sweeps import draw_sweep, print_sweep
    from infogoal_jax.runner.executors import run_on_ray
    from infogoal_jax.runner.jobs import Plan, jobs_of, read_plan, run_plan, start, take_up

    plan = read_plan(folder)[1] if resume else Plan(settings, list(seeds), vmap_size)
    if where.engine == "ray":
        execute = functools.partial(run_on_ray, workers=where.processes, address=where.ray_address)
        status = STATUS if run_plan(config, plan, folder, resume, execute).stopped else 0
    elif where.processes > 1:
        (take_up if resume else start)(config, plan, folder)
        status = train_in_processes(folder, where)
    else:
        status = STATUS if run_plan(config, plan, folder, resume).stopped else 0
    is_done = all(job.is_done(folder) for job in jobs_of(config, plan))
    if where.quiet:  # As one of several, which train the rest.
        return 0 if is_done else status
    if not is_done:
        if status in (0, STATUS):
            print(f"Stopped. Go on with: {typed_command('train', '--resume', folder)}")
        return status or STATUS
    print_sweep(folder, plan)
    if figures:
        draw(draw_sweep, folder, plan)
    return 0


def train_in_processes(folder: Path, where: Where) -> int:
    """Go on with a sweep in several processes. Returns the exit status: that of the first process that failed, which is
    named, since what it said stands above."""
    from infogoal_jax.runner.executors import run_in_processes

    with stop_on_signal() as stop:
        statuses = run_in_processes(["train", "--resume", str(folder), "--quiet"], where.processes, where.gpus)
    failed = {number: status for number, status in enumerate(statuses) if status not in (0, STATUS)}
    if stop.requested or not failed:
        return STATUS if stop.requested else max(statuses)
    number, status = next(iter(failed.items()))
    words = f"with status {status}; what it said stands above" if status > 0 else f"by signal {-status}"
    print(f"infogoal: process {number} ended {words}", file=sys.stderr)
    return status if status > 0 else BY_SIGNAL - status


def draw_video(folder: Path, env: Any) -> Path | None:
    """A GIF of one episode of the trained policy under RUN/figures; None for tasks whose goals are not images."""
    from infogoal_jax.envs.environment import has_image_goals
    from infogoal_jax.report.figures import read_subject
    from infogoal_jax.report.video import policy_video

    subject, path = read_subject(folder, env), folder / "figures" / "episode.gif"
    if not has_image_goals(env) or subject.params is None or "test" not in env.goals.groups:
        return None
    policy_video(subject, path, height=180)
    return path


def run_to_go_on_with(config: Any, seeds: range, out: str) -> str:
    """The folder of the run that `--resume auto` means, or nothing where a new run is to be started."""
    from infogoal_jax.runs.folder import newest_run

    if out:
        return out if (Path(out) / "config.json").exists() else ""
    newest = newest_run(Path("runs"), config, seeds)
    return str(newest) if newest else ""


def tasks(arguments: list[str], command: Command = train) -> TaskCommands:
    """`train` for each task; for one that is named, or known from a run to resume, with the configuration that is
    chosen as its defaults. command: `train`, or what is called in its place."""
    task, choice = read_choice(arguments, f"infogoal {command.__name__}")
    check_said_once(arguments)
    if not task and choice.resume in (None, "", AUTO):
        return all_tasks(command, HELP, arguments, choice)
    if choice.resume in (None, "", AUTO):
        return of_task(command, preset_of(task, choice), choice, arguments)
    from infogoal_jax.runs import configuration
    from infogoal_jax.runs.folder import PREFIX, SUFFIX

    packed = choice.resume.endswith(SUFFIX) or choice.resume.startswith(PREFIX)
    remedy = "is a packed run, which has no checkpoint to go on from; give the folder that it was packed of"
    require(not packed or Path(choice.resume).is_dir(), "resume", choice.resume, remedy)
    if is_sweep(choice.resume):
        from infogoal_jax.runner.jobs import read_plan

        config, plan = read_plan(Path(choice.resume))
        check_same_parts(config, task, choice)
        check_left_out(arguments, ("--small", "--sweep", "--vmap-size", "--seeds", "--first-seed"), "sweep")
        return of_task(train, config, choice, arguments if task else [config.task, *arguments], seeds=len(plan.seeds))
    about = configuration.read(Path(choice.resume), "resume")
    check_same_parts(about.config, task, choice)
    check_left_out(arguments, ("--small",), "run")
    arguments = arguments if task else [about.config.task, *arguments]
    return of_task(command, about.config, choice, arguments, seeds=len(about.seeds), first_seed=about.seeds[0])


def methods(
    task: Positional[str] = "",
    method: Positional[str] = "",
    learner: Name = None,
    agent: Name = None,
    relabelling: Name = None,
    explorer: Name = None,
) -> int:
    """Say which methods and tasks go together, and why others do not.

    Args:
        task: Name of a task; empty: all.
        method: Name of a method on that task; empty: all.
        learner: Name of another learner than the method's own.
        agent: Name of another agent than the task's own.
        relabelling: Name of another relabelling than the method's own.
        explorer: Name of another explorer than the method's own.

    Returns:
        0; with a task and a method 1 where they do not work together.
    """
    from infogoal_jax import presets
    from infogoal_jax.report import methods as table

    parts = Parts(None, learner, agent, relabelling, explorer).names()
    if method:
        return 0 if table.print_combination(task, method, **parts) else 1
    if task in presets.METHODS:
        raise UserError(f"task = {task!r}: is a method; name a task before it: infogoal methods TASK {task}")
    if parts:
        raise UserError(f"method = {method!r}: name a task and a method: infogoal methods TASK METHOD --agent ...")
    if task:
        presets.load(task)  # Refuses a name that does not exist.
    table.print_methods((task,) if task else tuple(presets.registry))
    return 0


TARGETS = "_targets"
"""What the name of a task's target states ends in."""


def pretrain(
    parts: Annotated[object, tyro.conf.arg(name="")] = None,
    config: Annotated[object, tyro.conf.arg(name="")] = None,
    resume: str = "",
    seeds: int = 4,
    first_seed: int = 0,
    out: str = "",
    help_all: FlagCreatePairsOff[bool] = False,
) -> int:
    """Train the low level that drives a robot to target states.

    Args:
        parts: Their names, which are in the configuration already.
        config: That of the task and the parts.
        resume: Folder of a run to go on with, from its last checkpoint.
        seeds: Seeds that are trained side by side: 0, 1, 2, ...
        first_seed: Number of the first seed.
        out: Folder of the run; empty: a new one under runs/.
        help_all: Show all flags, of each part and the hyperparameters too.

    Returns:
        As `train`. When it finished, the folder has the policy of the seed that reached most target states.
    """
    require(resume != AUTO, "resume", resume, "name the folder of the run")
    task = config.task.removesuffix(TARGETS)
    out, command = out or resume or str(new_folder(task, "low-level")), ("pretrain", task)
    status = train(parts, config, resume, seeds=seeds, first_seed=first_seed, out=out, command=command)
    if status:
        return status
    from infogoal_jax.report.export import export
    from infogoal_jax.report.runs import diverged_seeds, load_run, table_of
    from infogoal_jax.runs.low_level import NAME

    table = table_of(Path(out), "evaluations", diverged_seeds(Path(out)))
    require(bool(table.seeds), "seeds", seeds, "every one diverged, and none is kept; give others")
    best = int(table.last()["train_goal/success_rate"].argmax())
    export(load_run(out), Path(out) / NAME, table.seeds[best])
    print(f"low level   {Path(out) / NAME}, seed {table.seeds[best]}")
    return 0


def pretraining_tasks(arguments: list[str]) -> TaskCommands:
    """`pretrain` for each task that has target states: `train` on these, without a goal representation where nothing
    else is asked for."""
    from infogoal_jax import presets

    known = {name.removesuffix(TARGETS): preset for name, preset in presets.registry.items() if name.endswith(TARGETS)}
    task, *flags = arguments or [""]
    if task not in known:
        help = "Train the low level of a task. `infogoal pretrain TASK --help` shows the flags of one."
        commands = {name: named(pretrain, preset.description) for name, preset in known.items()}
        return TaskCommands(Group(help, commands), arguments)
    chosen = any(flag.partition("=")[0] in ("--method", "--resume") for flag in flags)
    return tasks([task + TARGETS, *([] if chosen else ["--method", "none"]), *flags], pretrain)
