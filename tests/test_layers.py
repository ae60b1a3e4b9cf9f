"""Who may import whom, as docs/architecture.md says it: no file of the package imports from a layer above its own; and
what benchmarks import of the package is there."""

import ast
import importlib
from pathlib import Path

import pytest
from places import ROOT

PACKAGE = ROOT / "infogoal_jax"
LAYERS = (
    {
        "errors",
        "stopping",
        "field_types",
        "config",
        "registry",
        "hyperparameters",
        "goals",
        "goal_uses",
        "policy_file",
        "pairs",
        "networks",
        "replay",
        "angles",
        "threefry",
    },
    {"learners", "relabelling", "agents", "exploration", "data"},
    {"stand_ins", "envs"},
    {"presets"},
    {"runs"},
    {"train"},
    {"report", "bridges", "drone"},
    {"reproduce"},
    {"cli"},
)
EVERYTHING = {"__init__", "__main__"}  # The package's own face.
NOT_OF_LEARNING = {
    "data": {"goals", "goal_uses", "errors", "stopping"},
    "envs": {"goals", "goal_uses", "errors", "replay", "registry", "angles"},
}
"""What data and environments may know of the lowest layer."""


def layer_of(name: str) -> int:
    """The number of the layer that a module or folder of the package belongs to."""
    (found,) = (number for number, names in enumerate(LAYERS) if name in names)
    return found


def imported_by(path: Path) -> set[str]:
    """Modules and folders of the package that a file imports, inside of functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
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
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == PACKAGE.name:
            module = importlib.import_module(node.module)
            for alias in node.names:
                if not hasattr(module, alias.name):
                    importlib.import_module(f"{node.module}.{alias.name}")  # Raises what is missing.
