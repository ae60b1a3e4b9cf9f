"""What several commands ask for: new folders under runs/, folders that must be empty, seeds."""

import time
from pathlib import Path

from infogoal_jax.errors import UserError, require


def new_folder(*words: str) -> Path:
    """A folder under runs/ that says what it holds, and since when."""
    return Path("runs") / "-".join([*words, time.strftime("%Y%m%d-%H%M%S")])


def empty_folder(path: str | Path, flag: str) -> Path:
    """The folder of this path. Raises `UserError`, naming the flag that it was given by, if it holds anything or cannot
    be looked into."""
    folder = Path(path)
    try:
        holds_something = not folder.is_dir() or any(folder.iterdir())
        there = folder.exists()
    except OSError as error:
        raise UserError(f"{flag} = {str(path)!r}: {error.strerror or error}; give a new folder") from error
    if there and holds_something:
        raise UserError(f"{flag} = {str(path)!r}: is there already and not empty; give a new folder")
    return folder


def check_resumed_in_place(resume: str, out: str) -> None:
    """Raise `UserError` if what is gone on with was to be written somewhere else."""
    require(
        not (resume and out) or Path(resume).resolve() == Path(out).resolve(),
        "out",
        out,
        f"what is gone on with stays in its folder, {resume}; leave the flag out, or copy the folder first",
    )


def check_seed(seed: int, flag: str = "seed") -> None:
    """Raise `UserError`, naming the flag, for what is no seed."""
    require(0 <= seed < 2**32, flag, seed, "give a seed from 0 to below 2^32")


def seeds_from(first: int, count: int) -> range:
    """`count` seeds from the first on. Raises `UserError` for none, or seeds that are no seeds."""
    require(count > 0, "seeds", count, "give at least 1")
    require(
        first >= 0 and first + count <= 2**32,
        "seeds",
        f"{first} to {first + count - 1}",
        "give seeds from 0 to below 2^32 (--seeds, --first-seed)",
    )
    return range(first, first + count)
