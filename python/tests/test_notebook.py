"""The notebook runs from its first cell to its last, and says what it promises."""

import pathlib
import re

import pytest

NOTEBOOK = pathlib.Path(__file__).parents[1] / "examples/shear-and-spectrum.ipynb"


def test_the_notebook_runs_and_finds_small_biases(monkeypatch):
    for library in ("galsim", "matplotlib", "ipykernel"):
        pytest.importorskip(library, reason=f"the notebook needs {library}")
    nbformat = pytest.importorskip("nbformat", reason="running a notebook needs nbformat")
    client = pytest.importorskip("nbclient", reason="running a notebook needs nbclient")
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    client.NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    text = "".join(output.get("text", "") for output in outputs)
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    biases = re.findall(r"m[12] = (\S+) ± (\S+), c[12] = (\S+) ± (\S+)$", text, re.MULTILINE)
    assert len(biases) == 2
    for m, m_error, _, _ in biases:
        assert abs(float(m)) < 3 * float(m_error) + 0.01
    assert re.search(r"^q +\d", text, re.MULTILINE)
