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
h5py = pytest.importorskip("h5py", reason="HDF5 files are read by h5py")
fits = pytest.importorskip("astropy.io.fits")

from shearq.ceci import ShearBias, ShearMeasure  # noqa: E402 (needs the packages above)

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
    assert found["rows"][0]["m1"] == pytest.approx(expected["m1"], abs=1e-12) and found["made_by"]["version"].split()[0] == shearq.__version__
    assert list(found["made_by"]["inputs"]) == ["out/shear_catalog.hdf5:shear"]


def stage(kind, tmp_path, text, **inputs):
    """A stage with a configuration, and its output."""
    (tmp_path / "config.yml").write_text(text)
    (tag,) = kind.output_tags()
    output = tmp_path / f"{tag}.out"
    return kind({"config": str(tmp_path / "config.yml"), tag: str(output), **{name: str(path) for name, path in inputs.items()}}), output


def run(kind, tmp_path, text, **inputs):
    made, output = stage(kind, tmp_path, text, **inputs)
    made.run()
    made.finalize()
    return output


@pytest.fixture
def catalogue(tmp_path):
    """Metacalibration with a step of 0.02, and a binned column."""
    rng = np.random.default_rng(2)
    e1, e2 = rng.normal(0, 0.1, (2, 2000))
    table = {"e1": e1 + 0.02, "e2": e2, "size": rng.uniform(1, 2, 2000), "flag": np.arange(2000) % 10 == 0}
    steps = {"e1_1p": (e1, 0.01), "e1_1m": (e1, -0.01), "e2_2p": (e2, 0.01), "e2_2m": (e2, -0.01)}
    table.update({name: e + step for name, (e, step) in steps.items()})
    with h5py.File(tmp_path / "shear.hdf5", "w") as file:
        for name, column in table.items():
            file.create_dataset(f"shear/{name}", data=column)
    return tmp_path / "shear.hdf5"


def test_keys_are_arguments_of_bias(catalogue, tmp_path):
    text = """
ShearBias:
  g1: 2.0e-2
  g2: 0
  step: 2e-2
  bins: [[size, 2], flag]
  where: size < 1.9
  columns: {flag: none}
  against: AGAINST
""".replace("AGAINST", f"{catalogue}:shear")
    output = run(ShearBias, tmp_path, text, shear_catalog=catalogue)
    path = f"{catalogue}:shear"
    expected = shearq.bias(path, g1=0.02, g2=0, step=0.02, bins=[("size", 2), "flag"], where="size < 1.9", columns={"flag": "none"}, against=path)
    found = json.loads(output.read_text())
    assert found["rows"] == json.loads(expected.to_json())["rows"] and len(found["rows"]) > 5
    assert found["made_by"]["inputs"] == {path: expected.made_by["inputs"][path]} and found["made_by"]["settings"]["step"] == 0.02


def test_keys_are_arguments_of_measure_and_headers_state_the_wcs(tmp_path):
    image = shearq.simulate(set=8, grid=10)[0]
    header = fits.Header()
    turn = np.radians(25.0)
    header.update(CTYPE1="RA---TAN", CTYPE2="DEC--TAN", CRVAL1=30.0, CRVAL2=-10.0, CRPIX1=24.5, CRPIX2=24.5)
    for (row, column), value in np.ndenumerate(0.2 / 3600 * np.array([[-np.cos(turn), np.sin(turn)], [np.sin(turn), np.cos(turn)]])):
        header[f"CD{row + 1}_{column + 1}"] = value
    paths = {"stamps": tmp_path / "stamps.fits", "psf": tmp_path / "psf.fits"}
    for name, path in paths.items():
        fits.writeto(path, np.asarray(getattr(image, name)), header)
    text = "ShearMeasure: {submission: {extends: 48/linear/star}, noise: 1e+0, threads: 1, x: X}".replace("X", str(list(range(100))))
    output = run(ShearMeasure, tmp_path, text, **paths)
    expected = shearq.measure(*paths.values(), noise=1.0, x=np.arange(100))
    with h5py.File(output) as file:
        found = file["shear"]
        assert found.attrs["frame"] == "sky" and np.array_equal(found["e1"], expected["e1"]) and np.array_equal(found["x"], np.arange(100))
    assert not np.allclose(expected["e1"], shearq.measure(image.stamps, image.psf)["e1"], atol=0.05)


@pytest.mark.parametrize(
    "kind, text, message",
    [
        (ShearMeasure, "ShearMeasure: {submision: 48/linear/star}", "found the key submision; .* Try: submission"),
        (ShearBias, "ShearBias: {wher: size > 1}", "found the key wher; .* Try: where"),
        (ShearBias, "ShearBias: {stamps: 1}", "found the key stamps"),
    ],
)
def test_unknown_keys_are_refused(kind, text, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        stage(kind, tmp_path, text, **{tag: tmp_path / tag for tag in kind.input_tags()})


def test_keys_of_all_stages_may_be_unknown(tmp_path):
    made, _ = stage(ShearMeasure, tmp_path, "global: {chunk_rows: 5, threads: 2}", stamps="stamps.fits", psf="psf.fits")
    assert made.config["threads"] == 2


def test_options_are_set_on_the_command_line(catalogue, tmp_path):
    (tmp_path / "config.yml").write_text("{}")
    output = tmp_path / "bias.json"
    arguments = ["ShearBias", f"--shear_catalog={catalogue}", f"--shear_bias={output}", f"--config={tmp_path / 'config.yml'}"]
    arguments += ["--g1=0.02", "--g2=0", "--step=0.02", "--columns=e1=e1, e2=e2", "--drop_missing"]
    made = ShearBias(ShearBias.parse_command_line(arguments))
    made.run()
    made.finalize()
    assert json.loads(output.read_text())["made_by"]["settings"]["columns"] == {"e1": "e1", "e2": "e2"}


def test_columns_are_roles_with_names(catalogue, tmp_path):
    made, _ = stage(ShearBias, tmp_path, "ShearBias: {g1: 0.02, g2: 0, columns: e1}", shear_catalog=catalogue)
    with pytest.raises(ValueError, match="columns: found 'e1'; expected ROLE=COLUMN"):
        made.run()
