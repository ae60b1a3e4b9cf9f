"""Where commands write: new folders under runs/, and folders that must be empty."""

import time
from pathlib import Path

from infogoal_jax.errors import UserError


def new_folder(*words: str) -> Path:
    """A folder under runs/ that says what it holds, and since when."""
    return Path("runs") / "-".join([*words, time.strftime("%Y%m%d-%H%M%S")])


def empty_folder(path: str | Path, flag: str) -> Path:
    """The folder of this path. Raises `UserError`, naming the flag that it was given by, if it holds anything."""
    folder = Path(path)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{flag} = {str(path)!r}: is there already and not empty; give a new folder")
    return folder
