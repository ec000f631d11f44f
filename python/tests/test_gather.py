"""Models of PSFs and cameras on the command line."""

import logging

import numpy as np
import pytest
from shearq.__main__ import main
from test_psf_models import FIELD, SCALE, SIDE, exact, exact_catalogue, galaxies, write_psfex

import shearq

galsim = pytest.importorskip("galsim", reason="PSFs are drawn by GalSim")
pytest.importorskip("galsim.des")
fits = pytest.importorskip("astropy.io.fits")
polars = pytest.importorskip("polars")


@pytest.fixture
def command(monkeypatch, tmp_path):
    """Runs a command in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(line):
        monkeypatch.setattr("sys.argv", ["shearq", *line.split()])
        return main()

    return run


def drawn_psfs(path, side=SIDE):
    mosaic = fits.getdata(path)
    rows, columns = (length // side for length in mosaic.shape)
    return mosaic.reshape(rows, side, columns, side).swapaxes(1, 2).reshape(-1, side, side)


def write_positions(path, places, names="xy"):
    np.savetxt(path, places, delimiter=",", header=",".join(names), comments="")


@pytest.mark.parametrize("axis", ["X_IMAGE", "POLZERO1"])
def test_models_of_psfex_are_drawn_as_galsim_draws_them(command, tmp_path, axis):
    write_psfex("model.psf")
    with fits.open("model.psf", "update") as hdus:
        if axis == "POLZERO1":
            hdus[1].header["POLNAME1"] = "XWIN_IMAGE"
            hdus[1].header["POLZERO1"] = 470.5
    rng = np.random.default_rng(5)
    places = rng.uniform(30, 970, (9, 2))
    write_positions("places.csv", places)
    fits.writeto("field.fits", rng.normal(0, 1, (1000, 1000)).astype("f4"))
    assert command("gather --exposure field.fits --positions places.csv --psf model.psf --out data") == 0
    found = drawn_psfs("data/set01/psf-001.fits")[:9]
    psf = galsim.des.DES_PSFEx("model.psf")
    for one, (x, y) in zip(found, places):
        expected = psf.getPSF(galsim.PositionD(x, y)).drawImage(nx=SIDE, ny=SIDE, scale=1.0, method="no_pixel", dtype=float).array
        # Of the light of the PSF; GalSim tabulates its kernel to this.
        assert np.abs(one - expected).max() < 1e-6
    # The same of stamps in a file, whose places are in a table.
    fits.writeto("stamps.fits", rng.normal(0, 1, (9, 48, 48)).astype("f4"))
    assert command("gather --stamps stamps.fits --positions places.csv --psf model.psf --out stamps") == 0
    assert np.array_equal(drawn_psfs("stamps/set01/psf-001.fits")[:9], found)


def fitted(tmp_path, chips=1):
    """A model that Piff fits to stars on each chip."""
    piff = pytest.importorskip("piff", reason="Piff is not installed")
    rng = np.random.default_rng(9)
    images, stars = [], []
    for chip in range(chips):
        image = galsim.Image(FIELD, FIELD)
        # Chips side by side on the sky.
        image.wcs = galsim.TanWCS(galsim.AffineTransform(-SCALE, 0, 0, SCALE, galsim.PositionD(FIELD / 2, FIELD / 2), galsim.PositionD(chip * FIELD * SCALE * -1.1, 0)), galsim.CelestialCoord(40 * galsim.degrees, 5 * galsim.degrees))
        rows = np.array([(x, y) for x in np.linspace(60, FIELD - 60, 5) for y in np.linspace(60, FIELD - 60, 5)])
        rows += rng.uniform(-0.5, 0.5, rows.shape)
        for x, y in rows:
            stamp = exact(x, y).dilate(1 + 0.1 * chip).withFlux(1e6).drawImage(nx=64, ny=64, scale=SCALE, center=galsim.PositionD(x, y))
            stamp.wcs = None
            image[stamp.bounds] += stamp
        image.addNoise(galsim.GaussianNoise(galsim.BaseDeviate(3 + chip), sigma=1.0))
        image.write(str(tmp_path / f"image{chip}.fits"))
        columns = [fits.Column(name=name, format="D", array=column) for name, column in zip("xy", rows.T)]
        fits.BinTableHDU.from_columns(columns).writeto(tmp_path / f"stars{chip}.fits")
        images.append(str(tmp_path / f"image{chip}.fits"))
        stars.append(str(tmp_path / f"stars{chip}.fits"))
    model = {"type": "Moffat", "beta": 3.0}
    kind = {"type": "Simple", "model": model, "interp": {"type": "Polynomial", "order": 1}}
    config = {
        "input": {"image_file_name": images, "cat_file_name": stars, "x_col": "x", "y_col": "y", "stamp_size": 32, "noise": 1.0},
        "psf": kind if chips == 1 else {"type": "SingleChip", "model": model, "interp": {"type": "Polynomial", "order": 1}},
    }
    psf = piff.process(config, logging.getLogger("piff"))
    psf.write(str(tmp_path / "model.piff"))
    return psf


def test_a_model_that_piff_fitted_is_drawn_at_the_galaxies(command, tmp_path):
    psf = fitted(tmp_path)
    rng = np.random.default_rng(5)
    places = np.repeat(rng.uniform(60, FIELD - 60, (60, 2)), 2, axis=0)
    stamps = galaxies(places)
    fits.writeto("stamps.fits", stamps.astype("f4"))
    write_positions("places.csv", places)
    assert command("gather --stamps stamps.fits --positions places.csv --psf model.piff --noise 1 --out data") == 0
    found = drawn_psfs("data/set01/psf-001.fits")
    x, y = places[7]
    expected = psf.draw(x=x, y=y, stamp_size=SIDE, center=True).array
    # In single precision.
    assert np.allclose(found[7], expected, atol=1e-7)
    assert command("measure --submission 48/linear/star --data data --out out") == 0
    shear = shearq.read("out/set01/catalogue-001.parquet").mean_shear()
    exactly = exact_catalogue(places, stamps).mean_shear()
    # The fitted PSF is exact to 10⁻³ of its size.
    assert abs(shear.g1 / exactly.g1 - 1) < 1e-3 + 1e-4 / abs(exactly.g1)


def test_a_model_on_other_pixels_is_refused(command, tmp_path, capfd):
    fitted(tmp_path)
    header = fits.getheader("image0.fits")
    for key in ("CD1_1", "CD2_2"):
        header[key] *= 1.5
    fits.writeto("coarse.fits", fits.getdata("image0.fits"), header)
    assert command("detect --exposure image0.fits --psf model.piff --noise 1 --threshold 5 --out detected") == 0
    capfd.readouterr()
    assert command("detect --exposure coarse.fits --psf model.piff --noise 1 --out other") != 0
    assert f"the model has pixels of {SCALE:.4g} arcsec, and the image of the galaxies of {1.5 * SCALE:.4g} arcsec; expected the same" in capfd.readouterr().err


def test_chips_have_their_galaxies_psf_and_wcs(command, tmp_path, capfd):
    psf = fitted(tmp_path, chips=2)
    images = [galsim.fits.read(f"image{chip}.fits") for chip in range(2)]
    hdus = [fits.PrimaryHDU()]
    for chip, image in enumerate(images):
        header = fits.getheader(f"image{chip}.fits")
        hdus.append(fits.ImageHDU(image.array, header, name="SCI", ver=chip + 1))
        mask = np.zeros(image.array.shape, "i4")
        mask[:, : FIELD // 2] = chip
        hdus.append(fits.ImageHDU(mask, name="DQ", ver=chip + 1))
    fits.HDUList(hdus).writeto("camera.fits")
    rng = np.random.default_rng(1)
    places = [rng.uniform(60, FIELD - 60, (20 + 5 * chip, 2)) for chip in range(2)]
    sky = []
    for image, own in zip(images, places):
        for x, y in own:
            at = image.wcs.toWorld(galsim.PositionD(x, y))
            sky.append((at.ra.deg, at.dec.deg))
    order = rng.permutation(len(sky))
    write_positions("places.csv", np.c_[np.array(sky)[order], order], ["ra", "dec", "id"])
    line = "gather --exposure camera.fits --extension SCI,* --mask-extension DQ,* --positions places.csv --psf model.piff --out data"
    assert command(line) == 0, capfd.readouterr()
    for chip, own in enumerate(places):
        table = polars.read_parquet(f"data/set01/stamps-{chip + 1:03}.parquet")
        of_chip = order[(order >= 20) == bool(chip)]
        assert list(table["id"]) == list(of_chip)
        assert np.allclose(np.c_[table["x"], table["y"]], own[of_chip - 20 * chip], atol=1e-3)
        found = drawn_psfs(f"data/set01/psf-{chip + 1:03}.fits")[0]
        x, y = own[of_chip[0] - 20 * chip]
        expected = psf.draw(x=x, y=y, chipnum=chip, stamp_size=SIDE, center=True).array
        assert np.allclose(found, expected, atol=1e-6)
    # The mask of the second chip has no galaxy of the first.
    missing = [np.isnan(fits.getdata(f"data/set01/galaxies-{chip:03}.fits")).any() for chip in (1, 2)]
    assert missing == [False, True]
    capfd.readouterr()
    write_positions("pixels.csv", places[0])
    for wrong, message in [
        ("--extension SCI,* --positions pixels.csv", "x and y are pixels of one chip"),
        ("--extension XX,* --positions places.csv", "no image is called `XX,*`"),
        ("--extension SCI,1 --mask-extension DQ,* --positions places.csv", "expected `*` in --extension"),
    ]:
        assert command(f"gather --exposure camera.fits {wrong} --psf model.piff --out wrong") == 1
        assert message in capfd.readouterr().err
    # Stars of the first chip alone.
    write_positions("first.csv", np.array(sky)[:20], ["ra", "dec"])
    assert command("gather --exposure camera.fits --extension SCI,* --positions first.csv --psf model.piff --out one") == 0
    assert "no galaxy is on this chip" in capfd.readouterr().err






def test_models_that_cannot_be_drawn_say_why(command, tmp_path, capfd):
    write_psfex("model.psf")
    fits.writeto("stamps.fits", np.ones((2, 48, 48), "f4"))
    assert command("gather --stamps stamps.fits --psf model.psf --out data") == 1
    assert "whose places are not known" in capfd.readouterr().err
    write_positions("places.csv", [(1, 2), (3, 4)])
    for key, value, message in [
        ("POLNAME1", "MAG_AUTO", "POLNAME1 of table 1 is `MAG_AUTO`; expected X_IMAGE"),
        ("POLNAXIS", 3, "POLNAXIS of table 1 is `3`"),
        ("POLDEG1", 2, "expected sides of 6 masks with 11907 numbers"),
        ("PSF_SAMP", 0.0, "PSF_SAMP of table 1"),
        ("PSFAXIS1", 62, "PSFAXIS1 of table 1"),
    ]:
        with fits.open("model.psf") as hdus:
            hdus[1].header[key] = value
            hdus.writeto("wrong.psf", overwrite=True)
        assert command("gather --stamps stamps.fits --positions places.csv --psf wrong.psf --out data") == 1
        assert message in capfd.readouterr().err
