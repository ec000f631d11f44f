"""The scripts of the gallery run and draw their plots."""

import pathlib
import subprocess
import sys

import pytest

EXAMPLES = sorted((pathlib.Path(__file__).parents[1] / "examples").glob("*.py"))
NEEDED = {"galsim_stamps": ["galsim"], "dask_images": ["distributed"], "score_catalogue": []}


@pytest.mark.parametrize("script", EXAMPLES, ids=lambda script: script.stem)
def test_the_script_draws_its_plot(script, tmp_path):
    for library in ["matplotlib", *NEEDED[script.stem]]:
        pytest.importorskip(library, reason=f"{script.name} needs {library}")
    plot = tmp_path / "plot.png"
    done = subprocess.run(
        [sys.executable, script, "--quick", "--out", plot], capture_output=True, text=True, check=False, timeout=600
    )
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr, done.stderr
    assert plot.read_bytes().startswith(b"\x89PNG")
