"""The command `infogoal`: train, tune, final, methods, pretrain; those about runs stand in run_commands.py, those about data in data_commands.py.

A command is a dataclass; its fields are the flags (tyro).
"""

import dataclasses
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import tyro

from infogoal_jax import presets
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import UserError, nearest
from infogoal_jax.train.compilation import use_compilation_cache
from infogoal_jax.train.data_commands import DATA_COMMANDS
from infogoal_jax.train.run_commands import RUN_COMMANDS

USAGE = """infogoal: goal-conditioned reinforcement learning with InfoGoal, in JAX

  infogoal train object_search                   train; progress, table, figures and checkpoint under runs/
  infogoal train fetch_push                      the same for a Fetch task, whose goals are images; also fetch_reach, fetch_pick_and_place
  infogoal train object_manipulation             an arm turns a cube to the pose of an image; --agent dqn, --relabelling her
  infogoal train embodied_qa                     offline: a drone learns from recorded flights to find what a question asks about
  infogoal train object_search --method none     the bare agent, without goal-representation learning
  infogoal train object_search --seeds 16        sixteen seeds in one program
  infogoal train object_search --resume RUN      go on from the last checkpoint of a run
  infogoal methods                               what each method is, and which tasks and agents it goes together with
  infogoal methods fetch_push her                whether one combination works and why not; --learner, --agent, --relabelling, --explorer
  infogoal tune object_search --method vae       look for hyperparameters on validation goals; --trials 16 --seeds 2, all in one program
  infogoal final SEARCH                          run the best of such a search again with other seeds; --trials 4 --seeds 8
  infogoal pretrain fetch_push --seeds 4         train the low level that drives the robot to target states, keep the best of four seeds
  infogoal evaluate RUN                          evaluate a run's last parameters again, with other starts or another epsilon
  infogoal evaluate RUN --corruption 0.4         the same with backgrounds of another weight over the images of corrupted goals
  infogoal report RUN                            draw the figures and print the table of a run
  infogoal compare RUN RUN --out FILE.png        draw the success of several runs of one task in one figure
  infogoal pretrain object_manipulation          the same for an arm that moves its joints by steps
  infogoal data check PATH                       list everything that is wrong with a dataset: a folder of scenes, or an image dataset's npz
  infogoal data import FOLDER CSV --out FILE.npz make an image dataset of your own images (--size 64 64, --wrap JOINT)
  infogoal data export-minari FILE.npz --out FOLDER/NAME-v0   write the trajectories of an image dataset for Minari
  infogoal data build cube FILE.npz --seed 1     draw the stand-in for object manipulation (--physical-limits: within the arm's joints' limits)
  infogoal data build shelf FILE.npz --seed 1    draw the stand-in for embodied question answering (--hovering)
  infogoal data build house PATH --seed 1        build a synthetic house in the format of the Active Vision Dataset
  infogoal data build backgrounds PATH           cut background images out of photographs of installed packages
  infogoal data build fetch PATH --seed 1        draw banks of goal images of Fetch tasks (needs gymnasium-robotics and OpenGL)
  infogoal data download cifar10 [PATH]          download CIFAR-10 as background images (170 MB)
  infogoal data embed "a red mug" --out FILE     embed the text of new goals (needs the sentence encoder's weights)
  infogoal video RUN --out FILE.mp4              watch the policy of a run of a Fetch task on test goals (--corruption 0.4: on corrupted ones)
  infogoal video fetch_reach --out FILE.mp4      watch a random policy
  infogoal check-fetch FILE.npz                  replay recorded episodes of the reference Fetch tasks, print how far ours are from them

Add --help to a command for its flags; every field of the configuration is one.
"""


@dataclasses.dataclass(frozen=True)
class Selection:
    """What the configuration starts from: the preset of a task and a method, or the configuration of a run."""

    task: tyro.conf.Positional[str] = ""
    """Name of the task."""
    method: str | None = None
    """Name of a method, see `infogoal methods`; none: infogoal."""
    learner: str | None = None
    """Name of another goal-representation learner than the method's own."""
    agent: str | None = None
    """Name of another reinforcement-learning agent than the task's own."""
    relabelling: str | None = None
    """Name of another relabelling of goals than the method's own."""
    explorer: str | None = None
    """Name of another explorer than the method's own."""
    resume: str = ""
    """Folder of a run to go on with, from its last checkpoint."""

    def parts(self) -> dict[str, str]:
        """The parts that were asked for by name."""
        return {kind: name for kind in presets.REGISTRIES if (name := getattr(self, kind)) is not None}

    def config(self) -> TrainConfig:
        """The configuration of this choice. Raises `UserError` for an unknown name, or one that is not that of the run to resume."""
        if not self.resume:
            return presets.load(self.task or "object_search", self.method or "infogoal", **self.parts())
        from infogoal_jax.report.runs import read_run

        config = read_run(Path(self.resume)).config
        if self.task not in ("", config.task):
            raise UserError(f"task = {self.task!r}: the run to resume is of task {config.task!r}")
        if self.method is not None and not is_of_method(config, self.method):
            raise UserError(f"method = {self.method!r}: the run to resume is of method {presets.name_of(config)!r}; leave the flag out")
        for kind, name in self.parts().items():
            if name != presets.names_of(config)[kind]:
                raise UserError(f"{kind} = {name!r}: the run to resume has {presets.names_of(config)[kind]!r}; leave the flag out")
        return config


def selected(arguments: list[str], prog: str) -> tuple[Selection, list[str]]:
    """What the arguments choose, and all of them with the task, which may be left out, in front."""
    if not arguments or arguments[0].startswith("-"):
        arguments = ["", *arguments]
    return tyro.cli(Selection, prog=prog, args=arguments, return_unknown_args=True, add_help=False)[0], arguments


@dataclasses.dataclass(frozen=True)
class TrainCommand:
    """Train on a task, all seeds in one program, and leave metrics, figures and a checkpoint in a folder."""

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    start: Annotated[Selection, tyro.conf.arg(name="")] = Selection()
    seeds: int = 1
    """How many seeds to train side by side: 0, 1, 2, ..."""
    first_seed: int = 0
    """Number of the first seed."""
    out: str = ""
    """Folder of the run; empty: a new one under runs/."""
    figures: bool = True
    """Draw the figures at the end."""
    tensorboard: bool = False
    """Write the metrics for TensorBoard too, into the run's folder."""
    wandb: str = ""
    """Name of a Weights & Biases project to log to (needs `pip install wandb`)."""


def is_of_method(config: TrainConfig, method: str) -> bool:
    """Whether a configuration is made of the parts that this method names; a relabelling or an explorer may have been added to it."""
    named = presets.method_named(method)
    names = presets.names_of(config)
    parts = ((named.learner, names["learner"]), (named.relabelling, names["relabelling"]))
    return all(asked in (None, own) for asked, own in parts) and named.explorer in ("none", names["explorer"])


def train(arguments: list[str]) -> int:
    """`infogoal train TASK ...`: 0 when it finished, 130 when it was stopped by Ctrl-C (with a checkpoint)."""
    start, arguments = selected(arguments, "infogoal train TASK")
    default = TrainCommand(start=start, config=start.config())
    command = tyro.cli(TrainCommand, prog="infogoal train", args=arguments, default=default)
    if command.seeds <= 0:
        raise UserError(f"seeds = {command.seeds}: give at least 1")
    use_compilation_cache()
    from infogoal_jax.train import host
    from infogoal_jax.train.combinations import check_combination
    from infogoal_jax.train.listeners import make_listeners

    check_combination(command.config)
    config, resuming = command.config, bool(command.start.resume)
    seeds = list(range(command.first_seed, command.first_seed + command.seeds))
    if resuming:
        from infogoal_jax.report.runs import read_run

        if (command.seeds, command.first_seed) == (default.seeds, default.first_seed):
            seeds = read_run(Path(command.start.resume)).seeds
    folder = Path(command.start.resume or command.out or f"runs/{config.task}-{presets.name_of(config)}-{time.strftime('%Y%m%d-%H%M%S')}")
    with make_listeners(folder, config, len(seeds), tensorboard=command.tensorboard, wandb=command.wandb) as listeners:
        sweep = host.run(config, seeds, folder, resume=resuming, listeners=listeners)
    from infogoal_jax.report.summary import print_summary

    print_summary(sweep)
    if command.figures and not sweep.stopped:
        from infogoal_jax.report.figures import draw_figures

        for path in draw_figures(folder):
            print(f"figure      {path}")
    if sweep.stopped:
        print(f"Stopped. Go on with: infogoal train {config.task} --resume {folder}")
        return 130
    return 0


@dataclasses.dataclass(frozen=True)
class TuneCommand:
    """Look for hyperparameters by random search: all trials with all seeds in one program, scored on validation goals."""

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    start: Annotated[Selection, tyro.conf.arg(name="")] = Selection()
    trials: int = 16
    """Settings that are tried; the first is the preset."""
    seeds: int = 2
    """Seeds of each setting."""
    first_seed: int = 1000
    """Number of the first seed: 1000 or more, because reported runs have the seeds 0, 1, 2, ..."""
    space_seed: int = 0
    """Seed of the draws from the space; methods that are to be compared have the same."""
    fields: tuple[str, ...] = ()
    """Hyperparameters to search, such as learning_rate discount; empty: all that matter to the method."""
    out: str = ""
    """Folder of the search; empty: a new one under runs/."""


def tune(arguments: list[str]) -> int:
    """`infogoal tune TASK ...`: 0 when it finished, 130 when it was stopped by Ctrl-C (with the scores until then)."""
    from infogoal_jax.train import tune as search

    start, arguments = selected(arguments, "infogoal tune TASK")
    default = TuneCommand(start=start, config=search.same_budget(start.config()))
    command = tyro.cli(TuneCommand, prog="infogoal tune", args=arguments, default=default)
    seeds = range(command.first_seed, command.first_seed + command.seeds)
    fields = tuple(field.replace("-", "_") for field in command.fields)
    use_compilation_cache()
    import jax

    key = jax.random.key(command.space_seed)
    return watch_search(command.config, command.trials, command.seeds, command.out or new_folder(command.config, "tuning"),
                        lambda watch: search.tune(command.config, command.trials, seeds, key, fields, watch=watch))


@dataclasses.dataclass(frozen=True)
class FinalCommand:
    """Run the preset and the best trials of a search again, with other seeds: the best of many owes something to luck."""

    search: tyro.conf.Positional[str]
    """Folder of an `infogoal tune` that came to its end. Its task, method and configuration are those of the final."""
    trials: int = 4
    """How many, the preset among them."""
    seeds: int = 8
    """Seeds of each."""
    first_seed: int | None = None
    """Number of the first seed; none: the one after the search's last."""
    out: str = ""
    """Folder of the final; empty: a new one under runs/."""


def final(arguments: list[str]) -> int:
    """`infogoal final SEARCH`: 0 when it finished, 130 when it was stopped by Ctrl-C (with the scores until then)."""
    command = tyro.cli(FinalCommand, prog="infogoal final", args=arguments)
    from infogoal_jax.report import tuning
    from infogoal_jax.train import tune as search

    run, trials = tuning.read(Path(command.search))
    finalists = search.finalists(trials, command.trials)
    first = max(run.seeds) + 1 if command.first_seed is None else command.first_seed
    seeds = range(first, first + command.seeds)
    if set(seeds) & set(run.seeds):
        raise UserError(f"first_seed = {first}: the search had the seeds {run.seeds}; give others, or leave the flag out")
    use_compilation_cache()
    return watch_search(run.config, command.trials, command.seeds, command.out or new_folder(run.config, "final"),
                        lambda watch: search.final(run.config, finalists, seeds, watch=watch))


def new_folder(config: TrainConfig, kind: str) -> str:
    """A folder under runs/ that says what it holds, and since when."""
    return f"runs/{config.task}-{presets.name_of(config)}-{kind}-{time.strftime('%Y%m%d-%H%M%S')}"


def watch_search(config: TrainConfig, trials: int, seeds: int, out: str, run: Callable[[Callable], Any]) -> int:
    """Run a search or a final, given what watches it, into the folder `out`. Returns the exit status."""
    from infogoal_jax.report import tuning

    folder = Path(out)
    if any((folder / name).exists() for name in ("config.json", "trials.jsonl", "checkpoint")):
        raise UserError(f"out = {out!r}: holds a search or a run already; give another folder")
    try:
        with tuning.watching(config, trials, seeds, folder) as watch:
            result = run(watch)
    except KeyboardInterrupt:
        print(f"Stopped. The scores until then, if there are any, are in {folder}")
        return 130
    tuning.print_result(result)
    return 0


@dataclasses.dataclass(frozen=True)
class MethodsCommand:
    """Say what each method is and which tasks it goes together with; or whether one combination works."""

    task: tyro.conf.Positional[str] = ""
    """Name of a task; empty: all."""
    method: tyro.conf.Positional[str] = ""
    """Name of a method on that task; empty: all."""
    learner: str | None = None
    """Name of another learner than the method's own."""
    agent: str | None = None
    """Name of another agent than the task's own."""
    relabelling: str | None = None
    """Name of another relabelling than the method's own."""
    explorer: str | None = None
    """Name of another explorer than the method's own."""


def methods(arguments: list[str]) -> int:
    """`infogoal methods`; with a task and a method it is 0 where they work together and 1 where they do not."""
    command = tyro.cli(MethodsCommand, prog="infogoal methods", args=arguments)
    from infogoal_jax.report import methods as table

    parts = {kind: name for kind in presets.REGISTRIES if (name := getattr(command, kind)) is not None}
    if command.method:
        return 0 if table.print_combination(command.task, command.method, **parts) else 1
    if parts:
        raise UserError(f"method = {command.method!r}: name a task and a method: infogoal methods TASK METHOD --agent ...")
    if command.task:
        presets.load(command.task)  # Refuses a name that does not exist.
    table.print_methods((command.task,) if command.task else presets.TASKS)
    return 0


def pretrain(arguments: list[str]) -> int:
    """`infogoal pretrain TASK ...`: 0 when it finished, 130 when it was stopped by Ctrl-C (with what was learned until then)."""
    from infogoal_jax.train import pretrain_host, pretrain_joints
    from infogoal_jax.train.pretrain import PRESETS, preset

    if not arguments or (arguments[0].startswith("-") and not {"-h", "--help"} & set(arguments)):
        raise UserError(f"task = {' '.join(arguments[:1])!r}: name the task first: infogoal pretrain {' | '.join([*PRESETS, pretrain_joints.TASK])}")
    words = " ".join(["infogoal pretrain", *arguments])
    if arguments[0] == pretrain_joints.TASK:
        config = tyro.cli(pretrain_joints.JointPretrainConfig, prog=f"infogoal pretrain {pretrain_joints.TASK}", args=arguments[1:])
        use_compilation_cache()
        pretrain_joints.print_result(pretrain_joints.pretrain(config, words))
        return 0
    named = not arguments[0].startswith("-")
    default = pretrain_host.PretrainCommand(config=preset(arguments[0] if named else "fetch_push"))
    command = tyro.cli(pretrain_host.PretrainCommand, prog="infogoal pretrain TASK", args=arguments[named:], default=default)
    if command.config.task != default.config.task:
        raise UserError(f"task = {command.config.task!r}: the task named first is {default.config.task!r}; name one")
    if command.seeds <= 0:
        raise UserError(f"seeds = {command.seeds}: give at least 1")
    use_compilation_cache()
    folder = Path(command.out or f"runs/{command.config.task}-low-level-{time.strftime('%Y%m%d-%H%M%S')}")
    seeds = list(range(command.first_seed, command.first_seed + command.seeds))
    result = pretrain_host.pretrain(command.config, seeds, folder, command.evaluation_episodes, words)
    pretrain_host.print_result(result)
    return 130 if result.stopped else 0


def data(arguments: list[str]) -> int:
    """`infogoal data COMMAND ...`."""
    return dispatch(DATA_COMMANDS, arguments, "data ")


COMMANDS = {"train": train, "tune": tune, "final": final, "methods": methods, "pretrain": pretrain, "data": data, **RUN_COMMANDS}


def dispatch(commands: dict, arguments: list[str], prefix: str = "") -> int:
    """Run the command that the first argument names."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE, end="")
        return 0
    if arguments[0] not in commands:
        raise UserError(f"{prefix}{arguments[0]!r}: no such command.{nearest(arguments[0], list(commands))} Known: {', '.join(commands)}")
    return commands[arguments[0]](arguments[1:])


def main(arguments: list[str] | None = None) -> int:
    """Entry point. A `UserError` is printed without a traceback; the exit status is then 2."""
    try:
        return dispatch(COMMANDS, sys.argv[1:] if arguments is None else arguments)
    except UserError as error:
        print(f"infogoal: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("infogoal: stopped at once; a run that has a checkpoint goes on from it with --resume", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
