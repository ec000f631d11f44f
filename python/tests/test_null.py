"""Null tests of a survey by TreeCorr."""

import numpy as np
import pytest
import shearq

SEPARATIONS = {"min_sep": 1, "max_sep": 20, "nbins": 6}


def _field(rng, n=4000):
    """Places within half a degree, and shears of a plane E wave in noise."""
    ra, dec = 150 + rng.uniform(-0.25, 0.25, n), 2 + rng.uniform(-0.25, 0.25, n)
    # A wave along the declination: g1 > 0 is along east–west, so that g1 has no B modes.
    g1 = 0.05 * np.cos(2 * np.pi * dec / 0.25) + rng.normal(0, 0.01, n)
    return {"ra": ra, "dec": dec, "g1": g1, "g2": rng.normal(0, 0.01, n), "x": rng.uniform(0, 1000, n)}


def test_faults_are_found_where_they_are():
    pytest.importorskip("treecorr")
    rng = np.random.default_rng(5)
    field = _field(rng)
    points = {"ra": 150 + rng.uniform(-0.2, 0.2, 50), "dec": 2 + rng.uniform(-0.2, 0.2, 50)}
    # Coarse bins mix modes, too.
    separations = {"min_sep": 0.5, "max_sep": 20, "nbins": 12}
    found = shearq.null_tests(field, points=points, against=("x",), **separations)
    modes = found["modes"]
    # Small and large apertures would mix modes, because pairs are missing.
    assert np.array_equal(np.isfinite(modes["map2"]), (modes["r"] > 2.5) & (modes["r"] < 10)), modes
    at = np.nanargmax(modes["map2"])
    assert modes["map2"][at] > 5 * abs(modes["mx2"][at])
    assert np.all(np.abs(found["points"]["gx"]) < 0.02)
    assert np.all(np.abs(found["x"]["g2"]) < 4 * found["x"]["g2_error"]) and np.all(np.diff(found["x"]["at"]) > 0)
    # Turned by 45 degrees, E modes are B modes; a fault of the left half is seen against x.
    turned = {**field, "g1": -field["g2"], "g2": field["g1"] + 0.02 * (field["x"] < 500)}
    found = shearq.null_tests(turned, against=("x",), bins=2, **separations)
    assert found["modes"]["mx2"][at] > 5 * abs(found["modes"]["map2"][at])
    assert found["x"]["g2"][0] - found["x"]["g2"][1] > 0.015


def test_separations_without_pairs_are_missing():
    pytest.importorskip("treecorr")
    modes = shearq.null_tests(_field(np.random.default_rng(5)), min_sep=1, max_sep=400, nbins=8)["modes"]
    # The field is 42 arcmin across.
    for name in ("xip", "xim", "error"):
        assert np.array_equal(np.isfinite(modes[name]), np.arange(8) < 5), (name, modes)
    assert not np.isfinite(modes["map2"][5:]).any()


def test_few_galaxies_are_refused():
    pytest.importorskip("treecorr")
    few = {name: column[:3] for name, column in _field(np.random.default_rng(5)).items()}
    with pytest.raises(ValueError, match="shears: found 3 galaxies with a shear; expected 5 or more"):
        shearq.null_tests(few, against=("x",))


def test_tables_are_read_from_files(tmp_path):
    pytest.importorskip("treecorr")
    table = pytest.importorskip("astropy.table")
    field = _field(np.random.default_rng(5))
    expected = shearq.null_tests(field, **SEPARATIONS)
    table.Table(field).write(tmp_path / "shears.fits")
    found = shearq.null_tests(tmp_path / "shears.fits", points=tmp_path / "shears.fits", **SEPARATIONS)
    assert np.allclose(found["modes"]["xip"], expected["modes"]["xip"]) and "points" in found
    with pytest.raises(ValueError, match="shears: found the path shears.csv; expected a Parquet or FITS file"):
        shearq.null_tests("shears.csv")
    with pytest.raises(FileNotFoundError, match="stars: there is no file none.fits"):
        shearq.null_tests(field, stars="none.fits")


def test_leakage_and_the_psf_are_tested_by_default():
    pytest.importorskip("treecorr")
    rng = np.random.default_rng(9)
    field = _field(rng)
    field |= {"psf_e1": rng.normal(0, 0.03, 4000), "psf_e2": rng.normal(0, 0.03, 4000), "psf_sigma": rng.normal(2, 0.1, 4000)}
    field["g1"] = rng.normal(0, 0.1, 4000) + 0.3 * field["psf_e1"]
    field["g2"] = rng.normal(0, 0.1, 4000)
    # Galaxies without a shear, as `shear` writes them.
    field["w"] = np.ones(4000)
    field["w"][:50], field["g1"][:50] = 0, np.nan
    found = shearq.null_tests(field, **SEPARATIONS)
    alpha, error = found["leakage"]["alpha"], found["leakage"]["error"]
    assert np.all(np.abs(alpha - [0.3, 0.0]) < 4 * error) and np.all(error < 0.07)
    assert found["psf_e1"]["g1"][-1] > found["psf_e1"]["g1"][0] + 0.01 and "psf_sigma" in found
    one = {**field, "psf_e1": np.full(4000, 0.03)}
    assert np.isnan(shearq.null_tests(one, **SEPARATIONS)["leakage"]["alpha"][0])


def test_rho_statistics_are_those_of_residuals():
    pytest.importorskip("treecorr")
    rng = np.random.default_rng(6)
    field = _field(rng)
    stars = {"ra": field["ra"], "dec": field["dec"], "e1": np.full(4000, 0.05), "e2": np.zeros(4000), "T": np.ones(4000)}
    stars |= {"model_e1": np.full(4000, 0.04), "model_e2": np.zeros(4000), "model_T": np.full(4000, 0.9)}
    rho = shearq.null_tests(field, stars=stars, **SEPARATIONS)["rho"]
    # Residuals of 0.01 in shape and 0.1 in size, and a shape of 0.05.
    for number, expected in enumerate([1e-4, 5e-4, 2.5e-5, 5e-5, 2.5e-4], 1):
        assert np.allclose(rho[f"rho{number}"], expected, rtol=1e-3), number
    with pytest.raises(ValueError, match="stars: no column T, model_T"):
        shearq.null_tests(field, stars={k: v for k, v in stars.items() if "T" not in k})
