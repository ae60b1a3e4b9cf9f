"""The folder of a run: new where none of its files is there yet, and written by one process at a time. And one seed of
a run in one file, small enough to be sent or shipped: configuration, parameters, evaluations.

The file is a zip of a run's folder. A command or a function that looks at the folder of a run takes such a file too,
and `shipped/NAME` for those that come with the package. They are unpacked into the user's cache and are runs like any
other there, save that they hold no checkpoint to go on from.
"""

import contextlib
import dataclasses
import hashlib
import os
import platform
import re
import stat
import sys
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import flax.serialization
import jax

from infogoal_jax import checks, files
from infogoal_jax.config import TrainConfig
from infogoal_jax.data import archives
from infogoal_jax.errors import UserError, require, require_known, typed
from infogoal_jax.files import has_no_locks, open_lock, try_lock
from infogoal_jax.imports import COPIES, OtherImportsError
from infogoal_jax.runs import checkpoint, configuration, disk, tables
from infogoal_jax.runs.configuration import to_dict
from infogoal_jax.runs.disk import disk_error, make_folder
from infogoal_jax.stopping import temporary

LOCK = ".lock"
RUN = (
    "config.json",
    "checkpoint",
    "policy",
    "timing.json",
    *(name for table in tables.TABLES for name in tables.file_names(table)),
    "evaluation.json",
    "figures",
    "low_level.npz",
    COPIES,
)
"""What `infogoal train` and `pretrain`, and what looks at its run, writes."""
SEARCH = ("config.json", "checkpoint", "trials.jsonl", "best.json", COPIES)
"""What `infogoal tune` and `infogoal final` write."""
APPENDED = {LOCK, *(name for table in tables.TABLES for name in tables.file_names(table))}
"""What is changed in place, so that a second name of such a file would show the change too."""


class BeingWrittenError(UserError):
    """Another process holds the lock."""


def check_new(folder: Path, names: Sequence[str]) -> None:
    """Raise `UserError` if the folder holds any of these, or cannot be looked into."""
    try:
        there = {path.name for path in folder.iterdir()} & {*names}
    except FileNotFoundError:
        return
    except OSError as error:
        raise disk_error(folder, error) from error
    if there:
        kind = "sweep" if configuration.SWEEP in there else "run"
        on_with_it = f", or go on with the {kind} by --resume {typed(folder)}"
        raise UserError(
            f"out = {str(folder)!r}: holds a run already, or other files of its names ({', '.join(sorted(there))}); "
            f"give another folder{on_with_it if there & {configuration.NAME, configuration.SWEEP} else ''}"
        )


def newest_run(parent: Path, config: TrainConfig, seeds: Sequence[int]) -> Path | None:
    """The folder below `parent` whose run of this configuration and these seeds was started last, however many epochs
    it was to have; None where there is none. Folders that hold something else are passed over."""
    wanted = to_dict(configuration.located(config)) | {"num_epochs": None}
    found = []
    for path in parent.glob(f"*/{configuration.NAME}"):
        try:
            about = configuration.read(path.parent)
        except UserError:
            continue
        if to_dict(about.config) | {"num_epochs": None} == wanted and about.seeds == list(seeds):
            found.append((path.stat().st_mtime_ns, path.parent))
    return max(found)[1] if found else None


def check_own(folder: Path, names: Iterable[str]) -> None:
    """Raise `UserError` if what is written to these files, and into folders of these names, would reach what lies
    outside of `folder`: for a link, or a file that is changed in place and has a second name. Whoever made the folder
    may have been somebody else."""
    for name in names:
        path = folder / name
        for found in (path, *(path.iterdir() if path.is_dir() and not path.is_symlink() else ())):
            try:
                about = found.lstat()
            except OSError:
                continue  # It is not there, or what is tried with it will say why not.
            kind = stat.S_IFMT(about.st_mode)
            if kind not in (stat.S_IFREG, stat.S_IFDIR):
                raise UserError(
                    f"{found}: is {'a link' if kind == stat.S_IFLNK else 'no regular file'}, through which nothing is "
                    f"written; put the file itself there, or go on with a copy: cp -rL {typed(folder)} COPY"
                )
            if kind == stat.S_IFREG and about.st_nlink > 1 and found.name in APPENDED:
                raise UserError(
                    f"{found}: has a second name elsewhere (a hard link), which would change with it; go on with a "
                    f"copy: cp -r {typed(folder)} COPY"
                )


@contextlib.contextmanager
def only_writer(folder: Path, new: Sequence[str] = ()) -> Iterator[None]:
    """Inside, no other process writes the run in this folder, which is made if it is not there.

    new: names of the files that must not be there yet. Raises `UserError` if another process writes there, or for one
    of these files. The lock goes with the process, so that a killed one leaves none behind.
    """
    make_folder(folder)
    check_own(folder, {LOCK, *RUN, *SEARCH})
    with locked(folder / LOCK, folder):
        check_new(folder, new)
        remove_abandoned(folder)
        yield


@contextlib.contextmanager
def locked(path: Path, folder: Path) -> Iterator[None]:
    """Hold the lock of this file, which is there as long as it is held."""
    while True:
        try:
            file = open_lock(path)
        except OSError as error:
            raise disk_error(path, error) from error
        with file:
            try:
                mine = try_lock(file)
            except OSError as error:
                if not has_no_locks(error):
                    raise disk_error(path, error) from error
                print(
                    f"infogoal: {folder} is on a file system without locks ({error.strerror}): let no two processes "
                    "write there",
                    file=sys.stderr,
                )
                mine = True
            if not mine:
                file.seek(0)
                by = file.read(200).decode(errors="replace").strip()
                raise BeingWrittenError(
                    f"{folder}: is being written by another process ({by or 'just started'}); wait for its end, or "
                    "give another folder"
                )
            if not is_at(file, path):
                continue  # The process that had it deleted it between our two steps.
            with temporary(path):
                try:
                    file.truncate(0)
                    file.write(f"process {os.getpid()} on {platform.node()}".encode())
                except OSError as error:
                    raise disk_error(path, error) from error
                yield
            return


def is_at(file, path: Path) -> bool:
    """Whether the open file is the one at this path."""
    try:
        there, own = path.stat(), os.fstat(file.fileno())
    except OSError:
        return False
    return (there.st_dev, there.st_ino) == (own.st_dev, own.st_ino)


def remove_abandoned(folder: Path) -> None:
    """Delete what killed processes were writing beside a file. Whoever is still writing holds the lock of its file."""
    for path in (*folder.glob(".*.partial"), *folder.glob("figures/.*.partial")):
        with contextlib.suppress(OSError), open_lock(path, make=False) as file:
            if try_lock(file):
                path.unlink(missing_ok=True)


SHIPPED = Path(__file__).parent.parent / "data" / "files" / "policies"
PREFIX = "shipped/"
SUFFIX = ".zip"
NAMES = ("config.json", "policy", *(name for table in tables.TABLES for name in tables.file_names(table)))
LARGEST = 2**28
"""Bytes of an unpacked file."""
DATE = (1980, 1, 1, 0, 0, 0)
"""Of all files in a zip, so that the same run makes the same file."""


def shipped() -> list[str]:
    """The names of the policies that come with the package."""
    return sorted(PREFIX + path.stem for path in SHIPPED.glob(f"*{SUFFIX}"))


def pack(folder: Path, out: Path, seed: int | None = None) -> list[tables.Row]:
    """Write one seed of the run in this folder as a file, with the epochs that were evaluated, and return the rows of
    its evaluations. seed: None: the first of the run.

    Raises `UserError` for a folder without a run, a seed that the run does not have, that diverged or was never
    evaluated, a file of somebody else in the way, or a disk that refuses.
    """
    about = configuration.read(folder)
    seed = about.seeds[0] if seed is None else checks.whole(seed, "seed")
    require(out.suffix == SUFFIX, "out", str(out), f"give a file that ends in {SUFFIX}")
    disk.check_out(out)
    require(may_be_replaced(out), "out", str(out), "is there already and is no packed run; give a new file")
    require(seed in about.seeds, "seed", seed, f"the run has the seeds {', '.join(map(str, about.seeds))}")
    evaluations = [row for row in tables.read_table(folder, "evaluations") if row["seed"] == seed]
    epochs = [row for row in tables.read_table(folder, "epochs") if row["seed"] == seed]
    require(not tables.diverged_seeds(epochs), "seed", seed, "diverged in training: give another one")
    require(bool(evaluations), "run", str(folder), f"seed {seed} was never evaluated: train it to its first evaluation")
    place = about.seeds.index(seed)
    about = dataclasses.replace(about, seeds=[seed])
    header, payload = checkpoint.read_header(folder / "policy")
    params = jax.tree.map(lambda leaf: leaf[place : place + 1], flax.serialization.msgpack_restore(payload))
    known = {row["epoch"] for row in evaluations}
    epochs = [row for row in epochs if row["epoch"] in known]
    with tempfile.TemporaryDirectory() as beside:
        one = Path(beside)
        configuration.write(one, about)
        keep_copies(folder, one, about.imports)
        checkpoint.save(one / "policy", {"epoch": header["epoch"], **about.values()}, params)
        for table, rows in (("epochs", epochs), ("evaluations", evaluations)):
            tables.append_rows(one, table, rows)
        disk.make_folder(out.parent)
        disk.write_atomically(out, lambda file: write_zip(file, one))
    return evaluations


def keep_copies(folder: Path, one: Path, names: Iterable[str]) -> None:
    """Put the copies that this run keeps of its files of `--import` beside those of this process, whose files may have
    other names now."""
    for name in names:
        copy, own = folder / COPIES / name, one / COPIES / name
        if copy.is_file() and not own.exists():
            disk.make_folder(own.parent)
            own.write_bytes(files.read_bytes(copy))


def may_be_replaced(out: Path) -> bool:
    """Whether nothing but an earlier packed run is lost where a run is packed."""
    try:
        return is_packed(archives.unzipped(files.read_bytes(out), LARGEST))
    except FileNotFoundError:
        return not out.is_symlink()
    except NotADirectoryError:
        return True  # What is written will say so.
    except (OSError, UserError):
        return False


def is_packed(names: Iterable[str]) -> bool:
    """Whether a zip of files of these names is a packed run."""
    return {name for name in names if not re.fullmatch(rf"{COPIES}/[^./][^/]*\.py", name)} == set(NAMES)


def write_zip(file, folder: Path) -> None:
    """Write the files of a packed run, in their order and without dates."""
    copies = sorted(path.relative_to(folder).as_posix() for path in folder.glob(f"{COPIES}/*.py"))
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name in (*NAMES, *copies):
            archive.writestr(zipfile.ZipInfo(name, DATE), files.read_bytes(folder / name), zipfile.ZIP_DEFLATED)


def find_run(run: str | Path) -> Path:
    """The folder of a run that is named by its folder, by a packed file, or as `shipped/NAME`. Raises `UserError` for a
    name that is not shipped, or a file that is no packed run."""
    path = files.expanded(run)
    name = path.as_posix()
    if name.startswith(PREFIX) and not path.exists():
        require_known("run", name, shipped(), "no such policy")
        path = SHIPPED / f"{name.removeprefix(PREFIX)}{SUFFIX}"
    return unpacked(path) if path.suffix == SUFFIX and path.is_file() else path


def unpacked(path: Path) -> Path:
    """The folder in the user's cache that holds this packed run. It is unpacked once; another file of the same name has
    another folder."""
    content = disk.read_bytes(
        disk.Place(path), f"run = {str(path)!r}: there is no such file; give one of `infogoal pack`"
    )
    folder = archives.user_cache() / "runs" / f"{path.stem}-{hashlib.sha256(content).hexdigest()[:12]}"
    if folder.is_dir():
        return folder
    with archives.naming("run", path, "give a file of `infogoal pack`, or the folder of a run"):
        found = archives.unzipped(content, LARGEST)
        require(is_packed(found), "files", sorted(found), "it is no file of `infogoal pack`; pack the run again")
    try:
        with archives.new_folder(folder, "run") as beside:
            for name, member in found.items():
                (beside / name).parent.mkdir(exist_ok=True)
                (beside / name).write_bytes(member)
            check_packed(beside, path)
    except UserError:
        if not folder.is_dir():  # Another process may have been faster.
            raise
    return folder


def check_packed(folder: Path, path: Path) -> None:
    """Raise `UserError`, which names the packed file, if what was unpacked is damaged: nothing of it stays then. It
    stays where it only needs a file of `--import`, of which it has a copy."""
    try:
        checkpoint.read_header(folder / "policy")
        for table in tables.TABLES:
            tables.read_table(folder, table)
        with contextlib.suppress(OtherImportsError):
            about = configuration.read(folder)
            require(len(about.seeds) == 1, "seeds", about.seeds, "a packed run has one")
    except UserError as error:
        reason = str(error).replace(f"{folder}{os.sep}", "").replace(str(folder), "its folder")
        raise UserError(f"run = {str(path)!r}: {reason}") from error
