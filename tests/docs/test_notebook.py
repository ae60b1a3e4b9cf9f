"""The notebook of the README runs from top to bottom, at toy size, and draws its figures."""

import pytest
from places import ROOT

nbclient = pytest.importorskip("nbclient")
nbformat = pytest.importorskip("nbformat")

NOTEBOOK = ROOT / "notebooks" / "quickstart.ipynb"
DRAWS = ("env", "curves", "codes", "path", "sweep")  # Cells that end in a figure.


@pytest.fixture(scope="module")
def written():
    """The notebook as it is in the repository."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    return notebook


def test_no_outputs_are_stored(written):
    code = [cell for cell in written.cells if cell.cell_type == "code"]
    assert code and all(not cell.outputs and cell.execution_count is None for cell in code)


def test_runs_without_error_or_warning_and_draws_its_figures(written, monkeypatch, tmp_path):
    for name in (
        "IPYTHONDIR",
        "JUPYTER_CONFIG_DIR",
        "JUPYTER_DATA_DIR",
        "JUPYTER_RUNTIME_DIR",
    ):  # The user's own Jupyter is left alone.
        monkeypatch.setenv(name, str(tmp_path / name))
    monkeypatch.setenv("INFOGOAL_TOY", "1")
    notebook = nbclient.NotebookClient(
        written, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    outputs = {cell.id: cell.outputs for cell in notebook.cells if cell.cell_type == "code"}
    printed = "".join(
        output.text for of_cell in outputs.values() for output in of_cell if output.output_type == "stream"
    )
    assert "stand-in" in printed and "Warning" not in printed
    for name in DRAWS:
        images = [output.data["image/png"] for output in outputs[name] if "image/png" in output.get("data", {})]
        assert len(images) == 1 and len(images[0]) > 5000, name
