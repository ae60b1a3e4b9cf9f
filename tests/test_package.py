"""Who may import whom, as docs/reference/architecture.md says it: no file of the package imports from a layer above its
own; and what benchmarks import of the package is there. And the wheel, installed where the repository is not:
everything a user does first works."""

import ast
import functools
import importlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from places import ROOT, TINY

import infogoal_jax
from infogoal_jax import presets

PACKAGE = ROOT / "infogoal_jax"
BESIDE = ("infogoal_paper", "infogoal_drone")
"""Packages that use the library, in the same distribution."""
LAYERS = (
    {
        "errors",
        "stopping",
        "imports",
        "files",
        "field_types",
        "config",
        "checked_dict",
        "registry",
        "hyperparameters",
        "goals",
        "goal_uses",
        "policy_file",
        "pairs",
        "networks",
        "replay",
        "angles",
        "keys",
        "checks",
        "rows",
        "shapes",
    },
    {"learners", "relabelling", "agents", "exploration", "data"},
    {"stand_ins", "envs"},
    {"presets"},
    {"runs"},
    {"train"},
    {"loading", "runner"},
    {"report", "bridges"},
    {"cli"},
)
EVERYTHING = {"__init__", "__main__"}  # The package's own face.
NOT_OF_LEARNING = {
    "data": {"checks", "goals", "goal_uses", "errors", "stopping", "files"},
    "envs": {
        *("goals", "goal_uses", "errors", "field_types", "files"),
        *("replay", "registry", "angles", "keys", "checks", "shapes"),
    },
}
"""What data and environments may know of the lowest layer."""


def layer_of(name: str) -> int:
    """The number of the layer that a module or folder of the package belongs to."""
    (found,) = (number for number, names in enumerate(LAYERS) if name in names)
    return found


@functools.cache
def imports_in(path: Path) -> list[ast.Import | ast.ImportFrom]:
    """The statements of a file that import, inside of functions too."""
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Import | ast.ImportFrom)]


def nodes_of_files_with(words: set[str], *folders: Path) -> Iterator[tuple[str, ast.AST]]:
    """What the files in which one of these words stands are made of, each with the file's name: parsing takes long."""
    for path in (path for folder in folders for path in folder.rglob("*.py")):
        text = path.read_text()
        if any(word in text for word in words):
            yield from ((path.relative_to(ROOT).as_posix(), node) for node in ast.walk(ast.parse(text)))


def imported_by(path: Path) -> set[str]:
    """Modules and folders of the package that a file imports, inside of functions too."""
    found = set()
    for node in imports_in(path):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == PACKAGE.name:
            below = node.module.split(".")[1:]
            found |= {below[0]} if below else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name.split(".")[1] for alias in node.names if alias.name.startswith(f"{PACKAGE.name}.")}
    return {name for name in found if (PACKAGE / name).is_dir() or (PACKAGE / f"{name}.py").is_file()}


def files() -> dict[Path, str]:
    """Every file of the package and the module or folder that it belongs to."""
    own = {path: path.relative_to(PACKAGE).parts[0].removesuffix(".py") for path in PACKAGE.rglob("*.py")}
    return {path: name for path, name in own.items() if name not in EVERYTHING}


def test_no_layer_imports_from_above():
    upwards = {
        f"{path.relative_to(PACKAGE)} imports {other}"
        for path, own in files().items()
        for other in imported_by(path)
        if layer_of(other) > layer_of(own)
    }
    assert not upwards


def test_data_and_environments_know_nothing_of_learning():
    learning = LAYERS[0] | {"learners", "relabelling", "agents", "exploration"}
    known = {
        f"{path.relative_to(PACKAGE)} imports {other}"
        for path, own in files().items()
        if own in NOT_OF_LEARNING
        for other in imported_by(path) & learning - NOT_OF_LEARNING[own]
    }
    assert not known


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("*/*.py")), ids=lambda path: path.name)
def test_what_benchmarks_import_of_the_package_is_there(path):
    for node in imports_in(path):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == PACKAGE.name:
            module = importlib.import_module(node.module)
            for alias in node.names:
                if not hasattr(module, alias.name):
                    importlib.import_module(f"{node.module}.{alias.name}")  # Raises what is missing.


def test_a_home_is_looked_up_in_one_way():
    """`files.expanded`: what pathlib has fails for a user who is not there."""
    everywhere = *BESIDE, "tools", "benchmarks"
    found = {
        name
        for name, node in nodes_of_files_with({"expanduser"}, PACKAGE, *(ROOT / each for each in everywhere))
        if isinstance(node, ast.Attribute) and node.attr == "expanduser"
    }
    assert found == {"infogoal_jax/files.py"}


def test_there_is_one_loop_over_chunks():
    """Nothing but runner/sweep.py makes the programs of epochs and evaluation, or calls them."""
    found = {
        name
        for name, node in nodes_of_files_with(LOOPS, PACKAGE, *(ROOT / each for each in BESIDE))
        if isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", "")) in LOOPS
    }
    assert found == {"infogoal_jax/runner/sweep.py", "infogoal_jax/train/program.py"}


LOOPS = {"chunk_of", "chunk"}
"""What makes a program of epochs and evaluation, and what runs it."""
KNOWN_TO_THE_PROGRAM = {"environment", "target_states"}
"""Of environments: their contract. The rest of them, and presets and data, read files."""
READS_FILES = {"runs", "runner", "loading", "data", "stand_ins", "presets", "files"}
HOST = {"pathlib", "io", "tempfile", "shutil", "subprocess", "threading", "signal", "zipfile", "socket", "cv2"}
HARMLESS = {"fspath", "fsencode", "PathLike", "register_at_fork"}
"""Of `os`: what looks at the name of a file, and what marks a process as a copy."""


def test_the_program_touches_no_disk_and_knows_no_host():
    """No file of train/, and none that it imports, or that these import, opens a file or imports what does; not inside
    of functions either."""
    found, todo, seen = set(), sorted((PACKAGE / "train").glob("*.py")), set()
    while todo:
        path = todo.pop()
        if path in seen:
            continue
        seen.add(path)
        name, own = path.relative_to(PACKAGE).as_posix(), path.relative_to(PACKAGE).parts
        if own[0].removesuffix(".py") in READS_FILES:
            found.add(f"{name} is imported")
        if own[0] == "envs" and own[-1].removesuffix(".py") not in KNOWN_TO_THE_PROGRAM:
            found.add(f"{name} is imported")
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", "")) == "open":
                found.add(f"{name} opens a file")
            if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "os" and node.attr not in HARMLESS:
                found.add(f"{name} uses os.{node.attr}")
            for module in modules_of(node):
                if module.split(".")[0] in HOST or (module == "os" and isinstance(node, ast.ImportFrom)):
                    found.add(f"{name} imports {module}")
            todo += modules_in_the_package(node)
    assert {"train/program.py", "pairs.py", "learners/infogoal.py"} <= {
        path.relative_to(PACKAGE).as_posix() for path in seen
    }
    assert not found


def modules_in_the_package(node: ast.AST) -> list[Path]:
    """The files of the package that a statement imports, without the faces of the folders above them."""
    found = []
    for module in modules_of(node):
        names = [alias.name for alias in node.names] if isinstance(node, ast.ImportFrom) else []
        parts = module.split(".")
        if parts[0] != PACKAGE.name:
            continue
        place = PACKAGE.joinpath(*parts[1:])
        below = [file for name in names for file in files_of(place / name)]
        found += below if len(below) == len(names) and names else [*below, *files_of(place)]
    return found


def files_of(place: Path) -> list[Path]:
    """The file of a module, or the face of a folder."""
    return [file for file in (place.with_suffix(".py"), place / "__init__.py") if file.is_file()][:1]


def test_the_library_imports_nothing_of_the_packages_beside_it():
    found = {
        f"{path.relative_to(ROOT)} imports {name}"
        for path in PACKAGE.rglob("*.py")
        for node in imports_in(path)
        for name in modules_of(node)
        if name.partition(".")[0] in BESIDE
    }
    assert not found


def modules_of(node: ast.AST) -> list[str]:
    """The modules that a statement imports."""
    if isinstance(node, ast.ImportFrom):
        return [node.module or ""]
    return [alias.name for alias in node.names] if isinstance(node, ast.Import) else []


FROM_PYTHON = """
import sys
import jax, numpy as np
import infogoal_jax
from infogoal_jax import presets
assert infogoal_jax.__file__.startswith(sys.prefix), infogoal_jax.__file__
assert not {"tensorboardX", "wandb", "gymnasium"} & {*sys.modules}
run = infogoal_jax.load_run("run")
action = run.policy(1)(np.zeros(1, np.int32), np.zeros(1, np.int32), jax.random.key(0))
assert action.shape == (1,)
for task in presets.TASKS:  # Goal images, backgrounds, low levels, questions and texts are in the wheel or are built.
    env = infogoal_jax.make_train(presets.load(task)).env
    print(task, env.goals.evaluated.shape[0])
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with an environment `env` in which the wheel is installed."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    shutil.copytree(ROOT / "infogoal_jax", source / "infogoal_jax", ignore=shutil.ignore_patterns("__pycache__"))
    for package in BESIDE:
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    with_network(folder, sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", ".", "./source")
    shutil.rmtree(source)
    run(folder, sys.executable, "-m", "venv", "env")
    (wheel,) = folder.glob(f"infogoal_jax-{infogoal_jax.__version__}-*.whl")
    with_network(folder, python(folder), "-m", "pip", "install", "--quiet", "-c", ROOT / "constraints.txt", wheel)
    return folder


def python(folder: Path) -> Path:
    """The interpreter of the new environment."""
    return folder / "env" / "bin" / "python"


def with_network(folder: Path, *command: str | Path) -> None:
    """Run what pip does. Where it reaches no index, the test is skipped."""
    try:
        run(folder, *command)
    except AssertionError as error:
        if "connection broken by" in str(error):
            pytest.skip("pip reaches no package index here")
        raise


def run(folder: Path, *command: str | Path) -> str:
    """What a command prints in this folder, without the repository on its path."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}: {done.stdout[-2000:]} {done.stderr[-2000:]}"
    return done.stdout


@pytest.mark.long  # It installs everything anew, for which pip needs a network or its cache.
def test_the_first_things_that_a_user_does(folder):
    """The console command trains, evaluates and draws; `python -m infogoal_jax` is the same; shipped data load."""
    infogoal = folder / "env" / "bin" / "infogoal"
    assert "train" in run(folder, infogoal)
    assert "object_search" in run(folder, python(folder), "-m", "infogoal_jax", "methods")
    assert "success rate" in run(folder, infogoal, *f"train object_search --seeds 2 --out run {TINY}".split())
    assert "success rate" in run(folder, infogoal, *"evaluate run --starts 1".split())
    assert "learning_curves.pdf" in run(folder, infogoal, *"report run --format pdf".split())
    assert (folder / "run" / "figures" / "learning_curves.png").stat().st_size > 10_000
    lines = run(folder, python(folder), "-I", "-c", FROM_PYTHON).splitlines()
    assert [line.split()[0] for line in lines] == list(presets.TASKS)
    assert all(int(line.split()[1]) > 1 for line in lines)  # Goals to be evaluated on.
