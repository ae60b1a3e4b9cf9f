"""Files of arrays (npz): read without pickles and within limits, written whole; and the user's cache folder.

A reader wraps its work in `naming`, so that whatever is wrong with a file is one `UserError` that names it and says
what to do.
"""

import contextlib
import dataclasses
import hashlib
import io
import os
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from infogoal_jax import checks, files
from infogoal_jax.errors import UserError, require
from infogoal_jax.stopping import temporary


@dataclasses.dataclass(frozen=True)
class Archive:
    """An npz in memory. sizes: bytes of each member when unpacked, by its name (without .npy), in the order of the
    file."""

    content: bytes
    sizes: dict[str, int]


MOST_PACKED = 2**36
"""Bytes of an archive: what is written here may be as large as a machine's memory."""
MOST_UNPACKED, MOST_RATIO = 2**30, 100
"""Bytes that an archive may unpack to however small it is, and times its own size beyond that."""
MOST_MEMBERS, LONGEST_NAME = 2**16, 200
"""Members of an archive, and letters of a member's name."""
MOST_FILES, METHODS = 100, (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Files of a zip that is unpacked whole, and the ways in which they are packed."""
HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
"""What reads the header of an array, by the version of its format."""
FORMAT = "format_version"
"""The member that says which version of its format an archive has; one without it has the first."""


@contextlib.contextmanager
def naming(what: str, path: str | os.PathLike, remedy: str) -> Iterator[None]:
    """Turn an error of the disk or a `UserError` in the block into a `UserError` that names the file: `what = 'path':
    ...`."""
    name = f"{what} = {str(path)!r}"
    checks.path(path, what, remedy)
    try:
        yield
    except FileNotFoundError:
        raise UserError(f"{name}: no such file; {remedy}") from None
    except OSError as error:
        raise UserError(f"{name}: cannot be read ({error.strerror or error}); {remedy}") from error
    except UserError as error:
        raise UserError(f"{name}: {error}") from error


def read(path: str | os.PathLike, remedy: str, version: int | None = 1) -> Archive:
    """The npz at `path`, its members still packed. version: of its format that the caller reads; None: the caller looks
    at it.

    Raises `OSError` if it cannot be read, `UserError` if it is no npz, cut short, of another version, or larger than
    any that was meant to be read.
    """
    content = files.read_bytes(path, MOST_PACKED)  # From memory: numpy leaves a damaged file open.
    require(
        zipfile.is_zipfile(io.BytesIO(content)),
        "format",
        "not an npz",
        f"the file is cut short, damaged or something else; {remedy}",
    )
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as members:
            infos = members.infolist()
            sizes = {info.filename.removesuffix(".npy"): info.file_size for info in infos}
    except Exception as error:  # zipfile raises half a dozen types on a damaged list of members
        raise UserError(f"format = a damaged npz ({error}); {remedy}") from error
    longest = max((len(name) for name in sizes), default=0)
    usual = len(sizes) == len(infos) <= MOST_MEMBERS and longest <= LONGEST_NAME
    require(usual, "members", len(infos), f"too many, equal names, or one of {longest} letters; {remedy}")
    unpacked = sum(sizes.values())
    require(
        unpacked <= max(MOST_UNPACKED, MOST_RATIO * len(content)),
        "size",
        f"{len(content):,} bytes that unpack to {unpacked:,}",
        f"no dataset is like this; {remedy}",
    )
    archive = Archive(content, sizes)
    if version is not None and FORMAT in sizes:
        found = member(archive, FORMAT, remedy)
        same = found.shape == () and found.dtype.kind in "iu" and found == version
        require(same, FORMAT, found.tolist(), f"this program reads {version}: use the one that wrote it, or {remedy}")
    return archive


def member(archive: Archive, name: str, remedy: str) -> np.ndarray:
    """One member, unpacked. Raises `UserError` if it is damaged or holds pickled objects."""
    try:
        with np.load(io.BytesIO(archive.content), allow_pickle=False) as members:
            array = members[name]
        if not isinstance(array, np.ndarray):
            raise ValueError("no array")  # NumPy returns the bytes of a member that is something else.
        if array.size > archive.sizes[name]:
            raise ValueError(f"{array.size:,} elements of no size")  # Whoever looks at each would never end.
        return array
    except Exception as error:  # numpy, zipfile and lzma raise a dozen types between them on a damaged file
        raise UserError(
            f"{name} = unreadable ({error}); the file is damaged, or holds pickled objects, which run code; {remedy}"
        ) from error


def header(path: str | os.PathLike, name: str) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type of one member of the npz at `path`, of which nothing else is read. Raises `OSError` if it cannot
    be read, `UserError` if it is damaged or has no such member."""
    try:
        with files.open_to_read(path) as file, zipfile.ZipFile(file) as members, members.open(f"{name}.npy") as array:
            read_header = HEADERS[np.lib.format.read_magic(array)]
            shape, _, dtype = read_header(array)
    except OSError:
        raise
    except Exception as error:  # As in `member`.
        raise UserError(f"{name} = unreadable ({error})") from error
    return shape, dtype


def unzipped(content: bytes, largest: int) -> dict[str, bytes]:
    """The members of a zip by name. largest: bytes that one may unpack to.

    Raises `UserError` for what is no zip, damaged, encrypted, packed in other ways than this package packs, or larger:
    other ways unpack a few bytes to any size at once, and what a zip says of its sizes need not be so.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos, found = archive.infolist(), {}
            names = {info.filename[: LONGEST_NAME + 1] for info in infos}
            usual = len(names) == len(infos) <= MOST_FILES and all(len(name) <= LONGEST_NAME for name in names)
            if not usual or any(info.compress_type not in METHODS for info in infos):
                raise UserError("it is no zip of `infogoal pack`")
            for info in infos:
                with archive.open(info) as member:
                    found[info.filename] = member.read(largest + 1)
                if len(found[info.filename]) > largest:
                    raise UserError(f"{info.filename} has more than {largest:,} bytes")
            return found
    except UserError:
        raise
    except Exception as error:  # zipfile and zlib raise half a dozen types between them on a damaged file
        raise UserError(f"it is damaged, or no zip ({error})") from error


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
    files.replace_file(path, write_members)


def save(
    path: str | os.PathLike,
    members: Mapping[str, Any],
    what: str,
    compression: int = zipfile.ZIP_STORED,
    level: int | None = None,
) -> None:
    """`write`, for a file that the user asked for: what the disk refuses is a `UserError` that names it."""
    checks.path(path, what, "give the path of a file")
    try:
        write(path, members, compression, level)
    except OSError as error:
        raise UserError(
            f"{what} = {str(path)!r}: cannot be written ({error.strerror or error}); give another place"
        ) from error


@contextlib.contextmanager
def new_folder(path: str | os.PathLike, what: str) -> Iterator[Path]:
    """Give a folder to write into, which becomes `path` (empty or not there) at the end of the block; after an error
    nothing is left of it. An error of the disk is a `UserError` that names the path."""
    path = Path(path)
    there = path.is_dir()
    beside = files.beside(path / "new" if there else path.absolute())
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


def checksum(*parts: np.ndarray) -> str:
    """A checksum of these arrays, eight letters, for the words that say which data a run saw."""
    return hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()[:8]


def user_cache() -> Path:
    """The user's cache folder of this package, where downloads and generated datasets are kept."""
    return Path(platformdirs.user_cache_dir("infogoal", appauthor=False))
