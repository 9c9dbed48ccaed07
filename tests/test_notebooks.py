"""Notebooks: they run from top to bottom, and what is stored is the evidence of such a run."""

import os
import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
MACHINE_PATH = re.compile(r"/(?:home|root|Users|tmp|private|var)/|[A-Za-z]:\\+Users")

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def outputs(notebook):
    return [output for cell in code_cells(notebook) for output in cell.outputs]


def complaints(notebook):
    """Return errors, and what was written to standard error, where warnings go."""
    return [
        output.get("text", output.get("ename"))
        for output in outputs(notebook)
        if output.output_type == "error" or output.get("name") == "stderr"
    ]


def kernel_environment(folder):
    """Return an environment in which the kernel finds the clone, and the user's own stays out."""
    kept = {name: os.environ[name] for name in os.environ if name not in ("MESH", "MPLBACKEND")}
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return kept | {
        "SMOKE": "1",
        "PYTHONPATH": os.pathsep.join(paths),  # so the packages need not be installed
        "IPYTHONDIR": str(folder / "ipython"),
        "JAX_PLATFORMS": "cpu",
    }


def test_there_are_notebooks():
    assert NOTEBOOKS


@each_notebook
def test_runs(path, tmp_path):
    """At small sizes, in another folder; an exception or a failed assertion in a cell fails."""
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}
    client = NotebookClient(notebook, kernel_name="python3", timeout=600, resources=resources)
    client.execute(env=kernel_environment(tmp_path))
    assert not complaints(notebook)


@each_notebook
def test_stored_run_is_whole(path):
    """Every cell was executed once, in order, without complaint, and there are pictures to see."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    assert not complaints(notebook)
    assert any("image/png" in output.get("data", {}) for output in outputs(notebook))


@each_notebook
def test_stored_file_is_small_and_names_no_machine(path):
    assert path.stat().st_size <= 2**20
    notebook = nbformat.read(path, as_version=4)
    assert set(notebook.metadata) <= {"kernelspec", "language_info"}
    assert notebook.metadata.kernelspec.name == "python3"
    texts = [cell.source for cell in notebook.cells]
    for output in outputs(notebook):
        texts += [output.get("text", ""), output.get("data", {}).get("text/plain", "")]
    assert not [found.group() for text in texts if (found := MACHINE_PATH.search(text))]
