"""The command `infogoal`: train, pretrain, evaluate, report, data, check-fetch, video. A command is a dataclass; its fields are the flags (tyro)."""

import dataclasses
import os
import sys
import time
from pathlib import Path
from typing import Annotated

import tyro

from infogoal_jax import presets
from infogoal_jax.config import TrainConfig
from infogoal_jax.errors import UserError, nearest

USAGE = """infogoal: goal-conditioned reinforcement learning with InfoGoal, in JAX

  infogoal train object_search                   train; progress, table, figures and checkpoint under runs/
  infogoal train object_search --method none     the bare agent, without goal-representation learning
  infogoal train object_search --seeds 16        sixteen seeds in one program
  infogoal train object_search --resume RUN      go on from the last checkpoint of a run
  infogoal pretrain fetch_push --seeds 4         train the low level that drives the robot to target states, keep the best of four seeds
  infogoal evaluate RUN                          evaluate a run's last parameters again, with other starts or another epsilon
  infogoal report RUN                            draw the figures and print the table of a run
  infogoal data check PATH                       list everything that is wrong with a dataset
  infogoal data build house PATH --seed 1        build a synthetic house in the format of the Active Vision Dataset
  infogoal data build backgrounds PATH           cut background images out of photographs of installed packages
  infogoal data build fetch PATH --seed 1        draw banks of goal images of Fetch tasks (needs gymnasium-robotics and OpenGL)
  infogoal data download cifar10 [PATH]          download CIFAR-10 as background images (170 MB)
  infogoal data embed "a red mug" --out FILE     embed the text of new goals (needs the sentence encoder's weights)
  infogoal video fetch_reach --out FILE.mp4      watch a random policy
  infogoal check-fetch FILE.npz                  replay recorded episodes of the reference Fetch tasks, print how far ours are from them

Add --help to a command for its flags; every field of the configuration is one.
"""


@dataclasses.dataclass(frozen=True)
class TrainCommand:
    """Train on a task, all seeds in one program, and leave metrics, figures and a checkpoint in a folder."""

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    seeds: int = 1
    """How many seeds to train side by side: 0, 1, 2, ..."""
    first_seed: int = 0
    """Number of the first seed."""
    out: str = ""
    """Folder of the run; empty: a new one under runs/."""
    resume: str = ""
    """Folder of a run to go on with, from its last checkpoint."""
    figures: bool = True
    """Draw the figures at the end."""
    tensorboard: bool = False
    """Write the metrics for TensorBoard too, into the run's folder."""
    wandb: str = ""
    """Name of a Weights & Biases project to log to (needs `pip install wandb`)."""


def flag(arguments: list[str], name: str) -> str | None:
    """The value of `--name VALUE` or `--name=VALUE` among the arguments; None if it is not there."""
    for position, argument in enumerate(arguments):
        if argument == f"--{name}" and position + 1 < len(arguments):
            return arguments[position + 1]
        if argument.startswith(f"--{name}="):
            return argument.split("=", 1)[1]
    return None


def default_config(arguments: list[str]) -> TrainConfig:
    """The configuration that the flags start from: the preset of the task and method named, or that of the run to resume."""
    from infogoal_jax.report.runs import read_run

    resumed = flag(arguments, "resume")
    if resumed:
        return read_run(Path(resumed)).config
    task = arguments[0] if arguments and not arguments[0].startswith("-") else "object_search"
    return presets.load(task, flag(arguments, "method") or "infogoal")


def train(arguments: list[str]) -> int:
    """`infogoal train TASK ...`: 0 when it finished, 130 when it was stopped by Ctrl-C (with a checkpoint)."""
    default = default_config(arguments)
    if arguments and not arguments[0].startswith("-"):
        if arguments[0] != default.task:
            raise UserError(f"task = {arguments[0]!r}: the run to resume is of task {default.task!r}")
        arguments = arguments[1:]
    command = tyro.cli(TrainCommand, prog="infogoal train TASK", args=arguments, default=TrainCommand(config=default))
    if command.seeds <= 0:
        raise UserError(f"seeds = {command.seeds}: give at least 1")
    use_compilation_cache()
    from infogoal_jax.train import host
    from infogoal_jax.train.listeners import make_listeners

    config, resuming = command.config, bool(command.resume)
    seeds = list(range(command.first_seed, command.first_seed + command.seeds))
    if resuming:
        from infogoal_jax.report.runs import read_run

        if flag(arguments, "seeds") is None and flag(arguments, "first-seed") is None:
            seeds = read_run(Path(command.resume)).seeds
    folder = Path(command.resume or command.out or f"runs/{config.task}-{config.method}-{time.strftime('%Y%m%d-%H%M%S')}")
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


def pretrain(arguments: list[str]) -> int:
    """`infogoal pretrain TASK ...`: 0 when it finished, 130 when it was stopped by Ctrl-C (with what was learned until then)."""
    from infogoal_jax.train import pretrain_host
    from infogoal_jax.train.pretrain import PRESETS, preset

    if not arguments or (arguments[0].startswith("-") and not {"-h", "--help"} & set(arguments)):
        raise UserError(f"task = {' '.join(arguments[:1])!r}: name the task first: infogoal pretrain {' | '.join(PRESETS)}")
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
    words = " ".join(["infogoal pretrain", *arguments])
    result = pretrain_host.pretrain(command.config, seeds, folder, command.evaluation_episodes, words)
    pretrain_host.print_result(result)
    return 130 if result.stopped else 0


@dataclasses.dataclass(frozen=True)
class EvaluateCommand:
    """Evaluate the last parameters of a run: every goal from several starts."""

    run: tyro.conf.Positional[str]
    """Folder of the run."""
    starts: int = 50
    """Start states for each goal."""
    start_seed: int = 1
    """Seed of the start states; training's own evaluations use others."""
    test_epsilon: float = -1.0
    """Share of random actions; negative: the run's own."""


def evaluate(arguments: list[str]) -> int:
    """`infogoal evaluate RUN`: prints success, SPL and episode length of each group of goals over the run's seeds."""
    command = tyro.cli(EvaluateCommand, prog="infogoal evaluate", args=arguments)
    use_compilation_cache()
    from infogoal_jax.report.summary import evaluate_run

    evaluate_run(Path(command.run), command.starts, command.start_seed, command.test_epsilon)
    return 0


@dataclasses.dataclass(frozen=True)
class ReportCommand:
    """Draw the figures of a run and print its table."""

    run: tyro.conf.Positional[str]
    """Folder of the run."""


def report(arguments: list[str]) -> int:
    """`infogoal report RUN`."""
    command = tyro.cli(ReportCommand, prog="infogoal report", args=arguments)
    from infogoal_jax.report.figures import draw_figures
    from infogoal_jax.report.summary import print_run

    print_run(Path(command.run))
    for path in draw_figures(Path(command.run)):
        print(f"figure      {path}")
    return 0


@dataclasses.dataclass(frozen=True)
class CheckCommand:
    """List everything that is wrong with a dataset in the format of the Active Vision Dataset."""

    path: tyro.conf.Positional[str]
    """Folder that holds the scenes."""


@dataclasses.dataclass(frozen=True)
class BuildHouseCommand:
    """Build a synthetic house, a stand-in in the format of the Active Vision Dataset."""

    path: tyro.conf.Positional[str]
    """Folder to write to; must not exist yet, or be empty."""
    seed: int = 0
    """Seed of the generator: rooms, furniture, objects and textures."""


@dataclasses.dataclass(frozen=True)
class BuildBackgroundsCommand:
    """Cut the shipped background images out of photographs again (needs `pip install 'infogoal-jax[backgrounds]'`)."""

    path: tyro.conf.Positional[str]
    """Folder to write to; must not exist yet, or be empty."""
    seed: int = 0
    """Seed of the crops' places and sizes; 0: the shipped ones."""
    crops_of_each: int = 84
    """Crops of each photograph."""


@dataclasses.dataclass(frozen=True)
class BuildFetchCommand:
    """Draw banks of goal images of Fetch tasks (needs `pip install 'infogoal-jax[goal-images]'` and OpenGL; docs/goal_images.md)."""

    path: tyro.conf.Positional[str]
    """Folder to write to, one file a task; files that are there already are never overwritten."""
    seed: int = 0
    """Seed of the goals for training, validation and tests; 0: the shipped ones."""
    tasks: tuple[str, ...] = ("fetch_reach", "fetch_push", "fetch_pick_and_place")
    """The tasks."""


@dataclasses.dataclass(frozen=True)
class DownloadCifar10Command:
    """Download CIFAR-10's binary version, 170 MB, as background images (docs/backgrounds.md)."""

    path: tyro.conf.Positional[str] = ""
    """Folder to unpack into; empty: the user's cache, where `cifar10` as the path of the backgrounds finds it."""
    url: str = "https://www.cs.toronto.edu/~kriz/cifar-10-binary.tar.gz"
    """Where the archive is; a mirror must have the same file, by its checksum."""


@dataclasses.dataclass(frozen=True)
class EmbedCommand:
    """Embed the text of goals with the real weights of all-MiniLM-L6-v2 (docs/text_goals.md)."""

    texts: tyro.conf.Positional[tuple[str, ...]]
    """The texts."""
    out: str
    """File to write, or to add to: an npz for --env.text-embeddings."""
    weights: str = ""
    """Folder with model.safetensors, tokenizer.json and config.json; empty: the installed package."""
    allow_other_weights: bool = False
    """Take weights with another checksum than the official one; the checksum is recorded."""


def data_check(arguments: list[str]) -> int:
    """`infogoal data check PATH`: 1 if anything is an error."""
    command = tyro.cli(CheckCommand, prog="infogoal data check", args=arguments)
    from infogoal_jax.data.check import check_active_vision

    findings = check_active_vision(command.path)
    for finding in findings:
        print(f"{finding.severity:8s} {finding.where}: {finding.problem}")
    errors = sum(finding.severity == "error" for finding in findings)
    print(f"{command.path}: {errors} errors, {len(findings) - errors} warnings")
    return 1 if errors else 0


def data_build(arguments: list[str]) -> int:
    """`infogoal data build house PATH`, `infogoal data build backgrounds PATH`, `infogoal data build fetch PATH`."""
    if arguments and arguments[0] == "backgrounds":
        return data_build_backgrounds(arguments[1:])
    if arguments and arguments[0] == "fetch":
        return data_build_fetch(arguments[1:])
    if not arguments or arguments[0] != "house":
        raise UserError(f"data build {arguments[0] if arguments else ''!r}: no such dataset. Known: house, backgrounds, fetch")
    command = tyro.cli(BuildHouseCommand, prog="infogoal data build house", args=arguments[1:])
    from infogoal_jax.data.house import build_house

    target = new_folder(command.path)
    build_house(target, seed=command.seed)
    print(f"{target}: built from seed {command.seed}")
    return 0


def new_folder(path: str) -> Path:
    """The path of a folder that does not exist yet, or is empty."""
    target = Path(path)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise UserError(f"path = {path!r}: is there already and not empty; give a new folder")
    return target


def data_build_backgrounds(arguments: list[str]) -> int:
    """`infogoal data build backgrounds PATH`."""
    command = tyro.cli(BuildBackgroundsCommand, prog="infogoal data build backgrounds", args=arguments)
    from infogoal_jax.data.photographs import build_backgrounds

    target = new_folder(command.path)
    build_backgrounds(target, command.seed, command.crops_of_each)
    print(f"{target}: built from seed {command.seed}")
    return 0


def data_build_fetch(arguments: list[str]) -> int:
    """`infogoal data build fetch PATH`: a file a task, and what is in it."""
    command = tyro.cli(BuildFetchCommand, prog="infogoal data build fetch", args=arguments)
    from rich.progress import track

    from infogoal_jax.data import fetch_goal_images, goal_images

    paths = {name: Path(command.path) / f"{name}.npz" for name in command.tasks}
    for path in paths.values():
        if path.exists():
            raise UserError(f"path = {str(path)!r}: is there already; give a new folder")
    fetch_goal_images.check(tuple(paths), command.seed)
    for name, path in paths.items():
        start = time.perf_counter()
        bank = fetch_goal_images.build(name, command.seed, lambda goals, name: track(goals, name, disable=not sys.stdout.isatty()))
        goal_images.save(path, bank)
        seconds = time.perf_counter() - start
        print(f"{path}: {len(bank.images)} images, {path.stat().st_size / 1e6:.2f} MB, built in {seconds:.0f} s")
        for field, words in bank.about.items():
            print(f"  {field}: {words}")
    return 0


def data_download(arguments: list[str]) -> int:
    """`infogoal data download cifar10 [PATH]`."""
    if not arguments or arguments[0] != "cifar10":
        raise UserError(f"data download {arguments[0] if arguments else ''!r}: no such dataset. Known: cifar10")
    command = tyro.cli(DownloadCifar10Command, prog="infogoal data download cifar10", args=arguments[1:])
    from infogoal_jax.data.backgrounds import download_cifar10

    print(f"{download_cifar10(command.path, command.url)}: CIFAR-10, complete")
    return 0


def data_embed(arguments: list[str]) -> int:
    """`infogoal data embed TEXT ... --out FILE`."""
    command = tyro.cli(EmbedCommand, prog="infogoal data embed", args=arguments)
    if not command.texts:
        raise UserError("texts = (): give at least one text to embed")
    from infogoal_jax.data.sentence_encoder import embed_file

    embeddings = embed_file(command.texts, command.out, command.weights or None, command.allow_other_weights)
    print(f"{command.out}: {len(embeddings.texts)} texts")
    return 0


DATA_COMMANDS = {"check": data_check, "build": data_build, "download": data_download, "embed": data_embed}


def data(arguments: list[str]) -> int:
    """`infogoal data COMMAND ...`."""
    return dispatch(DATA_COMMANDS, arguments, "data ")


@dataclasses.dataclass(frozen=True)
class CheckFetchCommand:
    """Replay recorded episodes of the reference Fetch tasks here, and print how far grip and object are from where they were recorded."""

    file: tyro.conf.Positional[str]
    """The episodes: an npz as benchmarks/record_fetch_reference.py writes it."""
    faithful: bool = False
    """Simulate as finely as the reference does, 20 steps of 2 ms and the whole body; otherwise the fast default."""
    kinds: str = ""
    """Kinds of the first, second, ... episode of each task, repeated over the episodes, to print them apart: random,held,scripted."""
    out: str = ""
    """File to write the numbers to, those of each episode too (json)."""


def check_fetch(arguments: list[str]) -> int:
    """`infogoal check-fetch FILE`: measures and passes no judgement, so it is 0 whatever the numbers."""
    command = tyro.cli(CheckFetchCommand, prog="infogoal check-fetch", args=arguments)
    from infogoal_jax.envs.fetch.recordings import load_recordings
    from infogoal_jax.report.fetch_parity import check_recordings, read_kinds

    kinds, recordings = read_kinds(command.kinds), load_recordings(command.file)
    use_compilation_cache()
    check_recordings(recordings, command.faithful, kinds, Path(command.out) if command.out else None)
    return 0


@dataclasses.dataclass(frozen=True)
class VideoCommand:
    """Draw episodes of a Fetch task under a random policy as an mp4."""

    task: tyro.conf.Positional[str]
    """fetch_reach, fetch_push, fetch_pick_and_place or fetch_slide."""
    out: str
    """File to write; must end in .mp4."""
    episodes: int = 1
    """Episodes, one after the other."""
    seed: int = 0
    """Seed of starts, goals and actions."""
    height: int = 480
    """Pixels; the width is 4/3 of it."""


def video(arguments: list[str]) -> int:
    """`infogoal video TASK --out FILE`."""
    command = tyro.cli(VideoCommand, prog="infogoal video", args=arguments)
    import jax

    from infogoal_jax.envs.fetch.environment import make
    from infogoal_jax.envs.fetch.tasks import FetchConfig
    from infogoal_jax.report.video import episode_video, random_policy

    env, size = make(command.task, FetchConfig(ends_at_goal=False)), (command.height, command.height * 4 // 3)
    use_compilation_cache()
    last = episode_video(env, random_policy, jax.random.key(command.seed), command.out, command.episodes, size)
    at_goal = sum(bool(env.reached(env.achieved(state), state.goal)) for state in last)
    print(f"{command.out}: {command.episodes} episodes of a random policy, {at_goal} end at the goal")
    return 0


COMMANDS = {"train": train, "pretrain": pretrain, "evaluate": evaluate, "report": report, "data": data, "check-fetch": check_fetch, "video": video}


def dispatch(commands: dict, arguments: list[str], prefix: str = "") -> int:
    """Run the command that the first argument names."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE, end="")
        return 0
    if arguments[0] not in commands:
        raise UserError(f"{prefix}{arguments[0]!r}: no such command.{nearest(arguments[0], list(commands))} Known: {', '.join(commands)}")
    return commands[arguments[0]](arguments[1:])


def use_compilation_cache() -> None:
    """Keep compiled programs on disk between runs, under $XDG_CACHE_HOME or ~/.cache. Only the command line does this, never an import."""
    import jax

    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "infogoal" / "jax"
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        return  # A home that cannot be written to costs the cache, nothing else.
    jax.config.update("jax_compilation_cache_dir", str(cache))


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
