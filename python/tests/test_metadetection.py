"""Metadetection of scenes, as the documents have it."""

import json
import pathlib
import runpy
import sys

import numpy as np
import pytest

SCRIPT = pathlib.Path(__file__).parents[2] / "docs" / "metadetection.py"


@pytest.fixture
def script(monkeypatch, tmp_path):
    for library in ("sep", "scipy", "astropy", "polars"):
        pytest.importorskip(library, reason=f"metadetection needs {library}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["metadetection.py", "scenes", "found"])
    return lambda: runpy.run_path(str(SCRIPT))


def test_the_noise_of_metadetection_is_isotropic(script):
    shearer = script()["Shearer"]
    x = np.arange(48) - 23.5
    psf = np.exp(-0.5 * (x**2 / 2.5 + x[:, None] ** 2 / 1.8))
    white = np.random.default_rng(4).normal(size=(300, 300))

    def quadrupole(image):
        along, across = ((image * np.roll(image, 2, axis)).mean() for axis in (1, 0))
        return (along - across) / image.var()

    for g in ((0, 0), (0.05, 0)):
        sheared = shearer(psf, 300)
        own, added = sheared.image(white, g), sheared.noise(white, g)
        # 90,000 pixels, of which about ten are one independent number.
        assert abs(quadrupole(own)) > 0.05 and abs(quadrupole(own) + quadrupole(added)) < 0.02
        assert own.std() == pytest.approx(added.std(), rel=0.01)


def test_metadetection_of_scenes_is_recognised(script, command):
    size = ["--scenes", "1", "--side", "600", "--border", "40"]
    command("simulate", *size, "--constant-shear", "0.08,0", "--opposite", "--rotated", "--out", "scenes")
    script()
    found = sorted(pathlib.Path("found").glob("*/*/*.parquet"))
    assert len(found) == 4
    given = ["bias", *map(str, found), "--truth", "scenes/shears.csv", "--units", "catalogues"]
    assert "Columns: metadetect" in command(*given)
    row = json.loads(command(*given, "--format", "json"))["rows"][0]
    # 270 galaxies. Shapes cancel with those turned by 90°, and noise does not: 0.3/0.08/√270 is 0.2, if all are faint.
    assert 0.2 < row["r1"] < 0.6 and abs(row["m1"]) < 0.3
