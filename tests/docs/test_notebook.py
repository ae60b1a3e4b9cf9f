"""The notebooks: saved with their pictures, and run from top to bottom at toy size."""

import base64
import re

import pytest
from pages import block_of
from places import ROOT

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")

DRAWS = {
    "quickstart": ("env", "curves", "codes", "path", "sweep"),
    "fetch_image_goals": ("curves", "goals", "corrupt", "video"),
    "seed_sweeps": ("curves", "enough", "pairs"),
    "your_own": ("task-figure", "compare", "dataset", "dataset-train"),
}
"""The cells of each notebook that end in a picture."""
PICTURES = ("image/png", "image/gif")
LARGEST = 600_000
"""Bytes of a saved notebook."""
each_notebook = pytest.mark.parametrize("name", DRAWS)


def read(name: str):
    """A notebook as it is in the repository."""
    notebook = nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4)
    nbformat.validate(notebook)
    return notebook


def code_cells(notebook) -> dict:
    """The cells with code, by their names."""
    return {cell.id: cell for cell in notebook.cells if cell.cell_type == "code"}


def pictures(cell) -> list[str]:
    """The pictures that a cell shows, in base64."""
    data = [output.data for output in cell.outputs if "data" in output]
    return [one[kind] for one in data for kind in PICTURES if kind in one]


def printed(notebook) -> str:
    """What all cells print."""
    return "".join(output.text for cell in code_cells(notebook).values() for output in cell.outputs if "text" in output)


def test_every_notebook_is_tested():
    assert {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")} == set(DRAWS)


@each_notebook
def test_saved_as_it_ran_with_its_pictures(name):
    """From top to bottom in one session, at full size, without warnings or anybody's paths; small enough for git."""
    notebook = read(name)
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells.values()] == list(range(1, len(cells) + 1))
    assert [cell for cell, own in cells.items() if pictures(own)] == list(DRAWS[name])
    assert (ROOT / "notebooks" / f"{name}.ipynb").stat().st_size < LARGEST
    assert not [output for cell in cells.values() for output in cell.outputs if output.get("name") == "stderr"]
    assert not re.search(r"/home/|/root/|/tmp/|/work/|Warning", printed(notebook))


@each_notebook
def test_begins_by_installing_and_says_what_it_is_sized_for(name):
    notebook = read(name)
    title, install = notebook.cells[:2]
    assert "Sized for two CPU cores" in title.source and "GPU" in title.source
    assert "%pip install" in install.source and "RESTART" in install.source
    assert install.source == read("quickstart").cells[1].source


def test_the_task_and_the_learner_are_those_of_the_docs():
    cells = code_cells(read("your_own"))
    for page, cell in (("own_task.md", "task"), ("own_learner.md", "learner")):
        lines = [line.rstrip() for line in block_of(page).splitlines()]
        assert set(cells[cell].source.splitlines()) <= set(lines), page


@pytest.mark.long
@pytest.mark.parametrize("name", DRAWS)
def test_runs_without_error_or_warning_and_draws_its_figures(name, monkeypatch, tmp_path):
    folders = ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR")
    for folder in folders:  # The user's own Jupyter is left alone.
        monkeypatch.setenv(folder, str(tmp_path / folder))
    monkeypatch.setenv("INFOGOAL_TOY", "1")
    resources = {"metadata": {"path": str(tmp_path)}}
    notebook = nbclient.NotebookClient(read(name), timeout=600, kernel_name="python3", resources=resources).execute()
    assert "Warning" not in printed(notebook)
    for cell in DRAWS[name]:
        shown = pictures(code_cells(notebook)[cell])
        assert len(shown) == 1 and len(base64.b64decode(shown[0])) > 3000, cell
