"""The notebook runs from its first cell to its last, and says what it promises."""

import pathlib
import re

import pytest

EXAMPLES = pathlib.Path(__file__).parents[1] / "examples"


def executed(name, monkeypatch):
    """The outputs of a notebook."""
    for library in ("galsim", "matplotlib", "ipykernel"):
        pytest.importorskip(library, reason=f"the notebook needs {library}")
    nbformat = pytest.importorskip("nbformat", reason="running a notebook needs nbformat")
    client = pytest.importorskip("nbclient", reason="running a notebook needs nbclient")
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    notebook = nbformat.read(EXAMPLES / name, as_version=4)
    client.NotebookClient(notebook, timeout=600, kernel_name="python3").execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return outputs, "".join(output.get("text", "") for output in outputs)


def test_the_notebook_runs_and_finds_small_biases(monkeypatch):
    outputs, text = executed("shear-and-spectrum.ipynb", monkeypatch)
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    biases = re.findall(r"m[12] = (\S+) ± (\S+), c[12] = (\S+) ± (\S+)$", text, re.MULTILINE)
    assert len(biases) == 2
    for m, m_error, _, _ in biases:
        assert abs(float(m)) < 3 * float(m_error) + 0.01
    assert re.search(r"^q +\d", text, re.MULTILINE)


def test_another_program_is_validated(monkeypatch):
    pytest.importorskip("pandas")
    outputs, text = executed("validate-regauss.ipynb", monkeypatch)
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 1
    assert "Columns: HSM" in text and "pairs" in text and len(re.findall("^snr ", text, re.MULTILINE)) == 3
