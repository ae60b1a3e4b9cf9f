"""The commands `infogoal data ...`: check, build, download and embed. A command is a dataclass; its fields are the flags (tyro)."""

import dataclasses
import sys
import time
from pathlib import Path

import tyro

from infogoal_jax.errors import UserError


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
