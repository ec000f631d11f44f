"""Shears of galaxies over the mean response of a survey, in Python, on the command line, and in TreeCorr."""

import importlib.util

import numpy as np
import pytest
import shearq

SIDE, SPACING, SCALE = 12, 64, 0.2


def test_shears_are_ellipticities_over_one_mean_response(image):
    measured = shearq.measure(image.stamps, image.psf)
    g1, g2 = measured.shear()
    mean = measured.mean_shear()
    assert [np.nanmean(g1), np.nanmean(g2)] == pytest.approx(list(mean), rel=1e-9)
    assert np.allclose(measured.shear(np.eye(2)), [measured["e1"], measured["e2"]], equal_nan=True)
    with pytest.raises(ValueError, match="expected a 2 × 2 matrix"):
        measured.shear([0.5, 0.5])


def test_one_response_serves_a_survey_of_small_images(command, tmp_path):
    command("simulate", "--sets", "2", "--images", "3", "--grid", "8", "--seed", "3", "--out", tmp_path / "data")
    command("measure", "--submission", "48/linear/star", "--data", tmp_path / "data", "--out", tmp_path / "out")
    written = tmp_path / "shears.parquet"
    command("shear", "--measured", tmp_path / "out", "--out", written)
    parquet = pytest.importorskip("pyarrow.parquet", reason="the table is read with it")
    table = parquet.read_table(written)
    catalogues = shearq.concatenate(shearq.read_all(tmp_path / "out"))
    for name, shear in zip(("g1", "g2"), catalogues.shear()):
        assert np.allclose(table[name].to_numpy(), shear, rtol=1e-9, equal_nan=True)
    assert table["image"].to_pylist() == [1] * 64 + [2] * 64 + [3] * 64
    stated = table.schema.metadata[b"response"].decode().split("survey: ")[1].split(" ")
    assert float(stated[0]) == pytest.approx(catalogues["R11"][catalogues.good].mean(), rel=1e-5)
    command("shear", "--measured", tmp_path / "out", "--response", "image", "--out", tmp_path / "images.fits")
    refused = command("shear", "--measured", tmp_path / "out", "--treecorr", "--out", tmp_path / "t.fits", status=1, stream="stderr")
    assert "no WCS states" in refused
    command("shear", "--measured", tmp_path / "out", "--treecorr", "x,y", "--out", tmp_path / "t.parquet")
    assert parquet.read_table(tmp_path / "t.parquet").column_names == ["x", "y", "g1", "g2", "w"]


def test_treecorr_finds_the_tangential_shear_of_a_halo(command, tmp_path):
    treecorr = pytest.importorskip("treecorr", reason="its signs are tested")
    pytest.importorskip("pyarrow", reason="TreeCorr reads the table with it")
    pytest.importorskip("pandas", reason="TreeCorr reads the table with it")
    galsim = pytest.importorskip("galsim", reason="the galaxies are drawn with it")
    fits = pytest.importorskip("astropy.io.fits", reason="the exposure is written with it")
    wcs = pytest.importorskip("astropy.wcs", reason="places are transformed with it")
    side = SIDE * SPACING
    cos, sin = np.cos(np.radians(37)), np.sin(np.radians(37))
    header = fits.Header()
    # x is turned, and east is to its left.
    matrix = SCALE / 3600 * np.array([[-cos, sin], [sin, cos]])
    middle = side / 2 + 0.5
    header.update(CTYPE1="RA---TAN", CTYPE2="DEC--TAN", CRVAL1=150.0, CRVAL2=2.0, CRPIX1=middle, CRPIX2=middle)
    header.update(CD1_1=matrix[0, 0], CD1_2=matrix[0, 1], CD2_1=matrix[1, 0], CD2_2=matrix[1, 1])
    sky, own = galsim.FitsWCS(header=header), wcs.WCS(header)
    rng, psf = np.random.default_rng(5), galsim.Moffat(beta=3, fwhm=3.4 * SCALE)
    exposure = rng.normal(size=(side, side)).astype(np.float32)
    places = [(SPACING * i + 32.5, SPACING * j + 32.5) for j in range(SIDE) for i in range(SIDE)]
    for x, y in places:
        ra, dec = own.all_pix2world(x, y, 1)
        u, v = -(ra - 150.0) * np.cos(np.radians(2)), dec - 2.0
        shear = -0.1 * np.exp(2j * np.arctan2(v, u))
        galaxy = galsim.Exponential(half_light_radius=3 * SCALE).shear(g1=shear.real, g2=shear.imag)
        local = sky.local(galsim.PositionD(x, y))
        stamp = galsim.Convolve(galaxy, psf).drawImage(nx=48, ny=48, wcs=local).array
        exposure[int(y) - 24 : int(y) + 24, int(x) - 24 : int(x) + 24] += stamp * 100 / np.sqrt((stamp**2).sum())
    fits.writeto(tmp_path / "field.fits", exposure, header)
    star = psf.drawImage(nx=48, ny=48, wcs=sky.local(galsim.PositionD(side / 2, side / 2)))
    fits.writeto(tmp_path / "psf.fits", star.array)
    np.savetxt(tmp_path / "places.csv", places, delimiter=",", header="x,y", comments="")
    exposures = ["--exposure", tmp_path / "field.fits", "--positions", tmp_path / "places.csv", "--psf", tmp_path / "psf.fits"]
    command("gather", *exposures, "--out", tmp_path / "data")
    command("measure", "--submission", "48/linear/star", "--data", tmp_path / "data", "--out", tmp_path / "out")
    columns = {f"{name}_col": name for name in ("ra", "dec", "g1", "g2", "w")}
    lens = treecorr.Catalog(ra=[150.0], dec=[2.0], ra_units="deg", dec_units="deg")
    # TreeCorr reads FITS with fitsio.
    files = ["sources.parquet", *(["sources.fits"] if importlib.util.find_spec("fitsio") else [])]
    for file in files:
        command("shear", "--measured", tmp_path / "out", "--treecorr", "--out", tmp_path / file)
        sources = treecorr.Catalog(str(tmp_path / file), ra_units="deg", dec_units="deg", **columns)
        assert sources.ntot > 100
        found = treecorr.NGCorrelation(min_sep=1, max_sep=120, nbins=1, sep_units="arcsec")
        found.process(lens, sources)
        # 140 galaxies of S/N 100 that are round but for the shear, whose square has an effect of 1 %.
        assert found.xi[0] == pytest.approx(0.1, abs=0.006) and abs(found.xi_im[0]) < 0.006
