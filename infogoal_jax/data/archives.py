"""Files of arrays (npz) that are read without pickles and are always whole: the old one or the new one. Locks on open
files, and the user's cache folder.

A reader wraps its work in `naming`, so that whatever is wrong with a file is one `UserError` that names it and says
what to do. A lock is of one process at a time, and gone with it, however it ends.
"""

import contextlib
import dataclasses
import errno
import hashlib
import io
import os
import stat
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from infogoal_jax.errors import UserError, require
from infogoal_jax.stopping import temporary

try:
    import fcntl
except ImportError:  # Windows.
    fcntl = None

NOT_SUPPORTED = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL}


@dataclasses.dataclass(frozen=True)
class Archive:
    """An npz in memory. sizes: bytes of each member when unpacked, by its name (without .npy), in the order of the
    file."""

    content: bytes
    sizes: dict[str, int]


MOST_UNPACKED, MOST_RATIO = 2**30, 100
"""Bytes that an archive may unpack to however small it is, and times its own size beyond that."""


def regular(path: str | os.PathLike) -> Path:
    """The path of a file that can be read to its end. Raises `OSError` for a folder, or a pipe, which would wait for a
    writer for ever."""
    path = Path(path)
    kind = path.stat().st_mode
    if stat.S_ISDIR(kind):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(kind):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return path


@contextlib.contextmanager
def naming(what: str, path: str | os.PathLike, remedy: str) -> Iterator[None]:
    """Turn an error of the disk or a `UserError` in the block into a `UserError` that names the file: `what = 'path':
    ...`."""
    name = f"{what} = {str(path)!r}"
    try:
        yield
    except FileNotFoundError:
        raise UserError(f"{name}: no such file; {remedy}") from None
    except OSError as error:
        raise UserError(f"{name}: cannot be read ({error.strerror or error}); {remedy}") from error
    except UserError as error:
        raise UserError(f"{name}: {error}") from error


def read(path: str | os.PathLike, remedy: str) -> Archive:
    """The npz at `path`, its members still packed. Raises `OSError` if it cannot be read, `UserError` if it is no npz
    or cut short."""
    content = regular(path).read_bytes()  # From memory: numpy leaves a file open when it finds it damaged.
    require(
        zipfile.is_zipfile(io.BytesIO(content)),
        "format",
        "not an npz",
        f"the file is cut short, damaged or something else; {remedy}",
    )
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as members:
            sizes = {info.filename.removesuffix(".npy"): info.file_size for info in members.infolist()}
    except Exception as error:  # zipfile raises half a dozen types on a damaged list of members
        raise UserError(f"format = a damaged npz ({error}); {remedy}") from error
    unpacked = sum(sizes.values())
    require(
        unpacked <= max(MOST_UNPACKED, MOST_RATIO * len(content)),
        "size",
        f"{len(content):,} bytes that unpack to {unpacked:,}",
        f"no dataset is like this; {remedy}",
    )
    return Archive(content, sizes)


def member(archive: Archive, name: str, remedy: str) -> np.ndarray:
    """One member, unpacked. Raises `UserError` if it is damaged or holds pickled objects."""
    try:
        with np.load(io.BytesIO(archive.content), allow_pickle=False) as members:
            return members[name]
    except Exception as error:  # numpy, zipfile and lzma raise a dozen types between them on a damaged file
        raise UserError(
            f"{name} = unreadable ({error}); the file is damaged or holds pickled objects; {remedy}"
        ) from error


def write(
    path: str | os.PathLike, members: Mapping[str, Any], compression: int = zipfile.ZIP_STORED, level: int | None = None
) -> None:
    """Write an npz as `replace_file` does, its folder too. The same members give the same bytes. Raises `OSError` if
    the disk refuses.

    members: arrays, numbers or texts by name. compression and level: of each member, as zipfile takes them;
    `numpy.savez` cannot choose.
    """

    def write_members(file) -> None:
        with zipfile.ZipFile(file, "w", compression, compresslevel=level) as archive:
            for name, value in members.items():
                array = np.asarray(value)
                with archive.open(f"{name}.npy", "w", force_zip64=array.nbytes > 1 << 30) as stream:
                    np.lib.format.write_array(stream, array, allow_pickle=False)

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, write_members)


def save(
    path: str | os.PathLike,
    members: Mapping[str, Any],
    what: str,
    compression: int = zipfile.ZIP_STORED,
    level: int | None = None,
) -> None:
    """`write`, for a file that the user asked for: what the disk refuses is a `UserError` that names it."""
    try:
        write(path, members, compression, level)
    except OSError as error:
        raise UserError(
            f"{what} = {str(path)!r}: cannot be written ({error.strerror or error}); give another place"
        ) from error


def replace_file(path: str | os.PathLike, write_content: Callable[[object], None]) -> None:
    """Write a file beside, sync and rename it, so that `path` holds either its old or its whole new content. Raises
    `OSError`."""
    path = Path(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}.partial")
    with temporary(beside):
        with open(beside, "wb") as file:
            with contextlib.suppress(OSError):  # A file system without locks.
                try_lock(file)  # It says that the writer lives: what killed ones leave is deleted.
            write_content(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)


@contextlib.contextmanager
def new_folder(path: str | os.PathLike, what: str) -> Iterator[Path]:
    """Give a folder to write into, which becomes `path` (empty or not there) at the end of the block; after an error
    nothing is left of it. An error of the disk is a `UserError` that names the path."""
    path = Path(path)
    there = path.is_dir()
    beside = (
        path / f".{os.getpid()}.partial" if there else path.absolute().with_name(f".{path.name}.{os.getpid()}.partial")
    )
    with temporary(beside):
        try:
            beside.mkdir(parents=True)
            yield beside
            if there:  # Somebody may be in that folder: it stays.
                for child in beside.iterdir():
                    child.rename(path / child.name)
            else:
                beside.rename(path)
        except OSError as error:
            raise UserError(
                f"{what} = {str(path)!r}: cannot be written ({error.strerror or error}); give another place"
            ) from error


def content_of(*parts: np.ndarray) -> str:
    """A checksum of these arrays, eight letters, for the words that say which data a run saw."""
    return hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()[:8]


def user_cache() -> Path:
    """The user's cache folder of this package, where downloads and generated datasets are kept."""
    return Path(platformdirs.user_cache_dir("infogoal", appauthor=False))


def try_lock(file) -> bool:
    """Take the lock of an open file. False if another process has it. Raises `OSError` where there are no locks."""
    if fcntl is None:
        raise OSError(errno.ENOSYS, "no locks on this platform")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def has_no_locks(error: OSError) -> bool:
    """Whether an error of `try_lock` says that the platform or the file system knows no locks."""
    return error.errno in NOT_SUPPORTED
