"""Stages of ceci, as its own program runs them."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from test_survey import DOCS, blocks

import shearq

pytest.importorskip("ceci", reason="ceci is not installed")
pytest.importorskip("h5py", reason="HDF5 files are read by h5py")
fits = pytest.importorskip("astropy.io.fits")

PAGE = (DOCS / "from-your-pipeline.md").read_text()


def test_a_pipeline_measures_and_finds_the_bias(tmp_path):
    image = shearq.simulate(set=8, grid=16)[0]
    fits.writeto(tmp_path / "stamps.fits", np.asarray(image.stamps))
    fits.writeto(tmp_path / "psf.fits", np.asarray(image.psf))
    for name, text in zip(("pipeline.yml", "config.yml"), blocks(PAGE, "yaml")):
        (tmp_path / name).write_text(text)
    # ceci starts `python3`, which is that of the environment.
    path = os.pathsep.join([os.path.dirname(sys.executable), os.environ["PATH"]])
    done = subprocess.run([os.path.join(os.path.dirname(sys.executable), "ceci"), "pipeline.yml"], cwd=tmp_path, env={**os.environ, "PATH": path}, capture_output=True, text=True)
    logs = "".join(log.read_text() for log in (tmp_path / "logs").glob("*")) if (tmp_path / "logs").exists() else ""
    assert done.returncode == 0, done.stdout + done.stderr + logs
    found = json.loads((tmp_path / "out" / "shear_bias.json").read_text())
    expected = shearq.bias(shearq.measure(image.stamps, image.psf), g1=0.02, g2=0.0)
    assert found["rows"][0]["m1"] == pytest.approx(expected["m1"], abs=1e-12) and found["version"] == shearq.__version__
