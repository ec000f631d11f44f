"""The survey of the documentation, from exposures to a tangential shear."""

import pathlib
import runpy
import shlex

import numpy as np
import pytest

DOCS = pathlib.Path(__file__).parents[2] / "docs"


def blocks(page, language):
    return [part.split("```")[0] for part in page.split(f"```{language}\n")[1:]]


def test_three_exposures_give_the_shear_of_a_halo(command, tmp_path, monkeypatch):
    for library in ("galsim", "sep", "treecorr", "astropy", "pandas", "pyarrow"):
        pytest.importorskip(library, reason=f"the survey needs {library}")
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(DOCS / "survey.py"))
    page = (DOCS / "survey.md").read_text()
    lines = [line for block in blocks(page, "sh") for line in block.splitlines() if line.startswith("shearq ")]
    assert len(lines) == 4
    printed = [command(*shlex.split(line)[1:]) for line in lines]
    assert "Frame: sky" in printed[2]
    found = {}
    exec(blocks(page, "python")[0], found)
    correlation, true = found["tangential"], found["true"]
    error = np.sqrt(correlation.varxi)
    assert np.all(true > 5 * error)
    assert np.all(np.abs(correlation.xi - true) < 3 * error + 0.01 * true)
    assert np.all(np.abs(correlation.xi_im) < 3 * error)
