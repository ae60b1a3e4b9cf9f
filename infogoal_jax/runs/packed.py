"""One seed of a run in one file, small enough to be sent or shipped: configuration, parameters, evaluations.

The file is a zip of a run's folder. A command or a function that looks at the folder of a run takes such a file too,
and `shipped/NAME` for those that come with the package. They are unpacked into the user's cache and are runs like any
other there, save that they hold no checkpoint to go on from.
"""

import dataclasses
import hashlib
import io
import os
import shutil
import tempfile
import zipfile
import zlib
from pathlib import Path

import flax.serialization
import jax

from infogoal_jax.data import archives
from infogoal_jax.errors import UserError, nearest, require
from infogoal_jax.runs import checkpoint, configuration, disk, tables

SHIPPED = Path(__file__).parent.parent / "data" / "files" / "policies"
PREFIX = "shipped/"
SUFFIX = ".zip"
NAMES = ("config.json", "policy", *(name for table in tables.TABLES for name in tables.file_names(table)))
LARGEST = 2**28
"""Bytes of an unpacked file."""
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Of compression that are read: others unpack a few bytes to any size at once."""
DATE = (1980, 1, 1, 0, 0, 0)
"""Of all files in a zip, so that the same run makes the same file."""


def shipped() -> list[str]:
    """The names of the policies that come with the package."""
    return sorted(PREFIX + path.stem for path in SHIPPED.glob(f"*{SUFFIX}"))


def pack(folder: Path, out: Path, seed: int) -> None:
    """Write one seed of the run in this folder as a file, with the epochs that were evaluated.

    Raises `UserError` for a folder without a run, a seed that the run does not have or that was never evaluated, a file
    of somebody else in the way, or a disk that refuses.
    """
    about = configuration.read(folder)
    require(out.suffix == SUFFIX, "out", str(out), f"give a file that ends in {SUFFIX}")
    require(may_be_replaced(out), "out", str(out), "is there already and is no packed run; give a new file")
    require(seed in about.seeds, "seed", seed, f"the run has the seeds {', '.join(map(str, about.seeds))}")
    evaluations = [row for row in tables.read_table(folder, "evaluations") if row["seed"] == seed]
    epochs = [row for row in tables.read_table(folder, "epochs") if row["seed"] == seed]
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
        checkpoint.save(one / "policy", {"epoch": header["epoch"], **about.values()}, params)
        for table, rows in (("epochs", epochs), ("evaluations", evaluations)):
            tables.append_rows(one, table, rows)
        disk.make_folder(out.parent)
        disk.write_atomically(out, lambda file: write_zip(file, one))


def may_be_replaced(out: Path) -> bool:
    """Whether nothing but an earlier packed run is lost where a run is packed."""
    if not out.exists():
        return True
    try:
        with zipfile.ZipFile(out) as archive:
            return set(archive.namelist()) == set(NAMES)
    except (zipfile.BadZipFile, OSError):
        return False


def write_zip(file, folder: Path) -> None:
    """Write the files of a packed run, in their order and without dates."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name in NAMES:
            archive.writestr(zipfile.ZipInfo(name, DATE), (folder / name).read_bytes(), zipfile.ZIP_DEFLATED)


def find_run(run: str | Path) -> Path:
    """The folder of a run that is named by its folder, by a packed file, or as `shipped/NAME`. Raises `UserError` for a
    name that is not shipped, or a file that is no packed run."""
    path, name = Path(run), Path(run).as_posix()
    if name.startswith(PREFIX) and not path.exists():
        known = shipped()
        require(name in known, "run", name, f"no such policy.{nearest(name, known)} Known: {', '.join(known)}")
        path = SHIPPED / f"{name.removeprefix(PREFIX)}{SUFFIX}"
    return unpacked(path) if path.suffix == SUFFIX and path.is_file() else path


def unpacked(path: Path) -> Path:
    """The folder in the user's cache that holds this packed run. It is unpacked once; another file of the same name has
    another folder."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise disk.disk_error(path, error) from error
    folder = archives.user_cache() / "runs" / f"{path.stem}-{hashlib.sha256(content).hexdigest()[:12]}"
    if folder.is_dir():
        return folder
    wrong = UserError(f"run = {str(path)!r}: is no file of `infogoal pack`; give one, or the folder of a run")
    disk.make_folder(folder.parent)
    beside = Path(tempfile.mkdtemp(dir=folder.parent, prefix=".unpacking-"))
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = {info.filename: info for info in archive.infolist()}
            if set(infos) != set(NAMES) or any(info.compress_type not in METHODS for info in infos.values()):
                raise wrong
            for name in NAMES:
                with archive.open(name) as member:
                    found = member.read(LARGEST + 1)  # What it says of its size need not be so.
                if len(found) > LARGEST:
                    raise wrong
                (beside / name).write_bytes(found)
        if not folder.is_dir():  # Another process may have been faster.
            os.replace(beside, folder)
    except (zipfile.BadZipFile, EOFError, RuntimeError, NotImplementedError, zlib.error) as error:
        raise wrong from error  # Damaged, or encrypted, or packed in a way that `pack` does not know.
    except OSError as error:
        if not folder.is_dir():
            raise disk.disk_error(folder, error) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return folder
