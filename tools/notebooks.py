"""Run notebooks from top to bottom, each in an empty folder, and write them with what they show.

    python tools/notebooks.py                               # all of them: an hour on two cores
    python tools/notebooks.py notebooks/quickstart.ipynb

Saved are the outputs of a cell, its lines as one, without the messages on stderr and the times of execution: what
changes from run to run is then what a reader sees.
"""

import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

import nbclient
import nbformat

ROOT = Path(__file__).resolve().parent.parent


def execute(path: Path) -> nbformat.NotebookNode:
    """A notebook with all that it shows."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        return nbclient.NotebookClient(notebook, timeout=None, kernel_name="python3", resources=resources).execute()


def tidy(notebook: nbformat.NotebookNode) -> None:
    """Leave what is saved."""
    notebook.metadata["language_info"] = {"name": "python"}
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = lines_as_one(output for output in cell.outputs if output.get("name") != "stderr")


def lines_as_one(outputs: Iterable) -> list:
    """Outputs, in which what is printed line after line is one."""
    kept = []
    for output in outputs:
        output.pop("transient", None)
        if kept and kept[-1].output_type == output.output_type == "stream":
            kept[-1].text += output.text
        else:
            kept.append(output)
    return kept


if __name__ == "__main__":
    for path in map(Path, sys.argv[1:]) if len(sys.argv) > 1 else sorted((ROOT / "notebooks").glob("*.ipynb")):
        print(path, flush=True)
        notebook = execute(path)
        tidy(notebook)
        nbformat.write(notebook, path)
