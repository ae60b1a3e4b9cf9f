"""Files of Python that a user names, whose tasks and parts a command then knows: `--import my_task.py`.

A file runs only because whoever types the command names it. A run keeps a copy of what it was made with, and its
checksum; that alone never runs anything.
"""

import atexit
import functools
import hashlib
import importlib.metadata
import importlib.util
import shutil
import sys
import tempfile
import traceback
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any, NamedTuple

from infogoal_jax.errors import UserError, reason, require, typed
from infogoal_jax.files import read_bytes

FLAG = "--import"
MOST = 2**24
"""Bytes of a file of Python."""
GROUP = "infogoal.plugins"
"""Entry points of installed packages, modules that register tasks and parts when they are imported."""


COPIES = "imports"
"""The folder of a run that holds a copy of each file that it was made with."""


class OtherImportsError(UserError):
    """What a run was made with is not imported, or is another file now."""


class Imported(NamedTuple):
    """A file that ran, as it was then. checksum: SHA-256 of its content."""

    path: Path
    content: bytes
    checksum: str


imported: dict[str, Imported] = {}
"""The files of this process, by their names without folders."""


def import_file(file: str | Path) -> None:
    """Run a file of Python once. Raises `UserError` if it is not there, is no Python file, has the name of another one,
    or fails."""
    path = Path(file)
    given = f"import = {str(file)!r}"
    require(path.suffix == ".py", "import", str(file), "give a file that ends in .py")
    try:
        content = read_bytes(path, MOST)
    except OSError as error:
        raise UserError(f"{given}: {error.strerror or error}; give the file that registers the task") from error
    checksum, before = hashlib.sha256(content).hexdigest(), imported.get(path.name)
    if before is not None:
        require(before.checksum == checksum, "import", str(file), "another file of this name is imported already")
        return
    name = path.stem
    require(name not in sys.modules, "import", str(file), f"Python has a module {name!r} already; rename the file")
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        exec(compile(content, str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:  # A script that ends its process would end the command, without a word.
        del sys.modules[name]
        frames = traceback.walk_tb(error.__traceback__)
        lines = [line for frame, line in frames if frame.f_code.co_filename == str(path)]
        line = lines[-1] if lines else getattr(error, "lineno", None)
        where = f", line {line}" if line else ""
        raise UserError(f"{given}{where}: {reason(error)}; mend the file") from error
    imported[path.name] = Imported(path, content, checksum)


@functools.cache
def entry_points(group: str) -> EntryPoints:
    """Those of installed packages, looked for once in a process: every file of every package is asked."""
    return importlib.metadata.entry_points(group=group)


def import_installed() -> None:
    """Import what installed packages register. Raises `UserError`, naming the entry point, for one that fails."""
    for point in entry_points(GROUP):
        load(point)


def load(point: EntryPoint) -> Any:
    """What an entry point of an installed package names. Raises `UserError`, naming it, where its import fails."""
    try:
        return point.load()
    except (Exception, SystemExit) as error:
        said = f"{point.group}: {point.name} = {point.value!r}: {reason(error)}"
        raise UserError(f"{said}; mend or uninstall the package") from error


def take_imports(arguments: list[str]) -> list[str]:
    """Import the files that `--import FILE` names, wherever it stands. Returns the other words. Raises `UserError` as
    `import_file` does, and for a flag without a file."""
    words, rest = iter(arguments), []
    for word in words:
        flag, sign, file = word.partition("=")
        if flag != FLAG:
            rest.append(word)
            continue
        file = file if sign else next(words, "")
        require(bool(file), "import", file, "give the file that registers the task")
        import_file(file)
    return rest


def import_flags() -> list[str]:
    """The words that make another process import the same files."""
    return [word for file in imported.values() for word in (FLAG, str(file.path))]


def typed_command(*words: object) -> str:
    """A command of infogoal as it is typed into a shell, with the files that are imported here."""
    return " ".join(["infogoal", *(typed(word) for word in (*words, *import_flags()))])


def contents() -> dict[str, bytes]:
    """What a process on another machine needs to import the same files: {name: content}."""
    return {name: file.content for name, file in imported.items()}


def import_contents(files: dict[str, bytes]) -> None:
    """Import files that another process sent, {name: content}. They stay on the disk until this process ends, so that
    errors show their lines. Raises `UserError` as `import_file` does."""
    if not files:
        return
    folder = Path(tempfile.mkdtemp(prefix="infogoal-import-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for name, content in files.items():
        path = folder / Path(name).name
        path.write_bytes(content)
        import_file(path)


def checksums() -> dict[str, str]:
    """What a run remembers: the checksum of each file, by its name."""
    return {name: file.checksum for name, file in sorted(imported.items())}


def check_unchanged(wanted: dict[str, str], path: Path) -> None:
    """Raise `OtherImportsError` if a file that a run was made with is imported with another content, or other files in
    its place. path: of the run's description."""
    for name, checksum in wanted.items():
        file = imported.get(name)
        if file is not None and file.checksum != checksum:
            raise OtherImportsError(
                f"{path}: the run was made with another {name!r} (SHA-256 {checksum[:12]}) than {file.path} "
                f"({file.checksum[:12]}); two versions need two commands; give the file as it was: "
                f"{flags_of([name], path)}"
            )
    if imported and not set(wanted.values()) <= {file.checksum for file in imported.values()}:
        raise OtherImportsError(f"{path}: {missing(wanted, path)}")  # Others may register a task of the same name.


def missing(wanted: dict[str, str], path: Path) -> str:
    """What helps where a run was made with files that are not imported, in words; empty if all are. path: of the run's
    description."""
    names = [name for name in wanted if name not in imported]
    made_with = f"the run was made with {', '.join(names)}; if you trust what is in it, give {flags_of(names, path)}"
    return made_with if names else ""


def flags_of(names: list[str], path: Path) -> str:
    """The words that import these files: the copies beside this description of a run, where it has them."""
    copies = {name: path.parent / COPIES / name for name in names}
    return " ".join(f"{FLAG} {typed(copy if copy.exists() else name)}" for name, copy in copies.items())
