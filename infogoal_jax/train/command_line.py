"""The command `infogoal`: train, evaluate, report, data, check-fetch, video. Each command is a dataclass whose fields are its flags (tyro)."""

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
  infogoal evaluate RUN                          evaluate a run's last parameters again, with other starts or another epsilon
  infogoal report RUN                            draw the figures and print the table of a run
  infogoal data check PATH                       list everything that is wrong with a dataset
  infogoal data build house PATH --seed 1        build a synthetic house in the format of the Active Vision Dataset
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
    """`infogoal data build house PATH`."""
    if not arguments or arguments[0] != "house":
        raise UserError(f"data build {arguments[0] if arguments else ''!r}: no such dataset. Known: house")
    command = tyro.cli(BuildHouseCommand, prog="infogoal data build house", args=arguments[1:])
    from infogoal_jax.data.house import build_house

    target = Path(command.path)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise UserError(f"path = {command.path!r}: is there already and not empty; give a new folder")
    build_house(target, seed=command.seed)
    print(f"{target}: built from seed {command.seed}")
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


DATA_COMMANDS = {"check": data_check, "build": data_build, "embed": data_embed}


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


COMMANDS = {"train": train, "evaluate": evaluate, "report": report, "data": data, "check-fetch": check_fetch, "video": video}


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
