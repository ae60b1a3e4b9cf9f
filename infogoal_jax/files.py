"""How files are opened, in one way each for reading, writing, appending and locking.

What is read is a regular file: a pipe would wait for a writer for ever, a device has no end. What is written is never
reached through a link, and a file that is appended to has no second name: so whoever prepared a folder cannot make a
program that writes there change anything outside of it. A file is whole at any moment, the old one or the new one.
"""

import contextlib
import errno
import fcntl
import json
import os
import secrets
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from infogoal_jax.stopping import temporary

NO_LINK = os.O_NOFOLLOW | os.O_CLOEXEC
AT_ONCE = os.O_NONBLOCK
"""A pipe that takes a file's place after it was looked at is opened without waiting for its other end."""
MOST = 2**31
"""Bytes of a file that is read into memory, where its kind is not known to be larger."""
NOT_SUPPORTED = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL}


def expanded(path: str | os.PathLike) -> Path:
    """The path with the folder of a user in place of `~`. It stays as it is for a user who is not there, for whom
    pathlib's own `expanduser` raises a `RuntimeError`."""
    return Path(os.path.expanduser(path))


def regular(path: str | os.PathLike) -> Path:
    """The path of a file that can be read to its end. Raises `OSError` for a folder, a pipe or a device."""
    path = Path(path)
    check_kind(path.stat().st_mode, path)
    return path


def check_kind(mode: int, path: Path) -> None:
    """Raise `OSError` unless this is the mode of a regular file."""
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if stat.S_ISLNK(mode):
        raise OSError(errno.ELOOP, "it is a link, which is not followed where something is written", str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "it is no regular file", str(path))


def open_to_read(path: str | os.PathLike) -> BinaryIO:
    """A regular file, opened for reading. Raises `OSError`."""
    path = regular(path)
    descriptor = os.open(path, os.O_RDONLY | AT_ONCE | os.O_CLOEXEC)
    file = open(descriptor, "rb")  # noqa: SIM115 (the caller closes it)
    try:
        check_kind(os.fstat(file.fileno()).st_mode, path)
    except OSError:
        file.close()
        raise
    return file


def read_bytes(path: str | os.PathLike, most: int = MOST) -> bytes:
    """The content of a regular file. most: bytes that it may have. Raises `OSError`, for a larger one too."""
    with open_to_read(path) as file:
        size = os.fstat(file.fileno()).st_size
        content = file.read(min(size, most) + 1)
        while size < len(content) <= most and (more := file.read(2**20)):  # It grows, or has no size, as in /proc.
            content += more
    if max(len(content), size) > most:
        raise OSError(errno.EFBIG, f"it has more than {most:,} bytes, which no file of its kind has", str(path))
    return content


def read_text(path: str | os.PathLike, encoding: str = "utf-8", errors: str = "strict") -> str:
    """The text of a regular file. Raises `OSError`, and `UnicodeDecodeError` (a `ValueError`)."""
    return read_bytes(path).decode(encoding, errors)


def from_json(text: str | bytes, **options: Any) -> Any:
    """The value of a JSON text; options: those of `json.loads`. Raises `ValueError` for anything else."""
    try:
        return json.loads(text, **options)
    except RecursionError:
        raise ValueError("it is nested thousands of levels deep") from None


def check_writable(path: Path) -> None:
    """Raise `OSError` where what is there at this path is a link, a pipe, a device or a folder: none of them is
    replaced by a file."""
    with contextlib.suppress(FileNotFoundError):
        check_kind(path.lstat().st_mode, path)


def create(path: Path) -> BinaryIO:
    """A new file, opened for writing. Raises `OSError`, also for a link, whether or not it leads somewhere."""
    return open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | NO_LINK, 0o666), "wb")


def beside(path: Path, ending: str = "") -> Path:
    """Where a file or a folder is written before it is renamed: a new name, which nobody can have prepared."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial{ending}")


def replace_file(path: str | os.PathLike, write_content: Callable[[Any], None]) -> None:
    """Write a file beside, sync and rename it, so that `path` holds either its old or its whole new content. Raises
    `OSError`."""
    path = Path(path)
    check_writable(path)
    partial = beside(path)
    with temporary(partial):
        with create(partial) as file:
            with contextlib.suppress(OSError):  # A file system without locks.
                try_lock(file)  # It says that the writer lives: what killed ones leave is deleted.
            write_content(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)


def own(descriptor: int, path: Path) -> None:
    """Raise `OSError` unless this open file is a regular one without a second name: what is changed in place would
    change under the other name too."""
    about = os.fstat(descriptor)
    check_kind(about.st_mode, path)
    if about.st_nlink > 1:
        raise OSError(errno.EMLINK, "it has a second name elsewhere (a hard link), which would change too", str(path))


def append(path: str | os.PathLike, content: bytes, first: bytes = b"") -> None:
    """Add to the end of a file and sync it; first: what comes before the content in a file that is new or empty.

    Raises `OSError`; then the file is as long as it was before.
    """
    path = Path(path)
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | AT_ONCE | NO_LINK, 0o666)
    try:
        own(descriptor, path)
        before = os.fstat(descriptor).st_size
        left = memoryview(content if before else first + content)
        try:
            while left:
                left = left[os.write(descriptor, left) :]
            os.fsync(descriptor)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(descriptor, before)
            raise
    finally:
        os.close(descriptor)


def open_lock(path: Path, make: bool = True) -> BinaryIO:
    """A file of its own whose lock can be taken, opened for reading and writing. make: if it is not there. Raises
    `OSError`."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT * make | AT_ONCE | NO_LINK, 0o666)
    try:
        own(descriptor, path)
    except OSError:
        os.close(descriptor)
        raise
    return open(descriptor, "r+b", buffering=0)


def try_lock(file: Any) -> bool:
    """Take the lock of an open file. False if another process has it. Raises `OSError` where there are no locks."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def has_no_locks(error: OSError) -> bool:
    """Whether an error of `try_lock` says that the file system knows no locks."""
    return error.errno in NOT_SUPPORTED
