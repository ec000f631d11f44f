"""Models of PSFs that vary over an image."""

import io
import logging
import sys
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import same_bits

import shearq

galsim = pytest.importorskip("galsim", reason="PSFs are drawn by GalSim")

SIDE, SCALE, FIELD = 48, 0.2, 1600


def exact(x, y):
    """A Moffat whose size and ellipticity change over the field."""
    u, v = x / FIELD - 0.5, y / FIELD - 0.5
    return galsim.Moffat(beta=3.0, fwhm=0.75 * (1 + 0.06 * u)).shear(g1=0.03 + 0.02 * v, g2=-0.02 + 0.03 * u)


def galaxies(places, seed=1, shear=(0.02, -0.01)):
    """Round and elliptical galaxies in pairs at right angles, on stamps of the exact PSF."""
    rng = np.random.default_rng(seed)
    stamps = []
    for k, (x, y) in enumerate(places):
        if k % 2 == 0:
            e, angle = rng.uniform(0, 0.3), rng.uniform(0, np.pi)
        turn = angle + (k % 2) * np.pi / 2
        galaxy = galsim.Exponential(half_light_radius=0.7, flux=1e4).shear(g1=e * np.cos(2 * turn), g2=e * np.sin(2 * turn))
        galaxy = galaxy.shear(g1=shear[0], g2=shear[1])
        drawn = galsim.Convolve(galaxy, exact(x, y)).drawImage(nx=SIDE, ny=SIDE, scale=SCALE)
        stamps.append(drawn.array + rng.normal(0, 1.0, (SIDE, SIDE)))
    return np.array(stamps)


@pytest.fixture(scope="module")
def field():
    rng = np.random.default_rng(5)
    places = np.repeat(rng.uniform(50, FIELD - 50, (60, 2)), 2, axis=0)
    return places, galaxies(places)


def exact_catalogue(places, stamps):
    drawn = [exact(x, y).drawImage(nx=SIDE, ny=SIDE, scale=SCALE, dtype=float).array for x, y in places]
    return shearq.measure(stamps, np.array(drawn), noise=1.0)


def test_functions_are_drawn_with_the_pixel_of_the_stamps(field):
    places, stamps = field
    x, y = places.T
    wcs = np.diag([SCALE, SCALE])
    expected = exact_catalogue(places, stamps)
    found = shearq.measure(stamps, exact, noise=1.0, x=x, y=y, wcs=wcs)
    for name in ("e1", "e2", "R11", "R22"):
        # On the sky, by a Jacobian.
        assert np.allclose(found[name], expected[name], atol=1e-5), name
    images = shearq.measure(stamps, lambda x, y: exact(x, y).drawImage(nx=SIDE, ny=SIDE, scale=SCALE), noise=1.0, x=x, y=y)
    assert np.allclose(images["e1"], expected["e1"], atol=1e-5)
    blocks = list(shearq.measure_blocks(stamps, exact, noise=1.0, x=x, y=y, wcs=wcs, block=60))
    alone = shearq.measure(stamps[60:], exact, noise=1.0, x=x[60:], y=y[60:], wcs=wcs)
    assert len(blocks) == 2 and same_bits(blocks[1], alone)
    one = {"stamps": stamps, "psf": exact, "noise": 1.0, "x": x, "y": y, "wcs": wcs}
    assert np.array_equal(shearq.measure(epochs=[one])["e1"], found["e1"])


def test_profiles_are_drawn_on_the_pixels_of_the_wcs(field):
    places, stamps = field
    turn = np.radians(25.0)
    wcs = SCALE * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    profiles = [exact(x, y) for x, y in places]
    local = galsim.JacobianWCS(*wcs.ravel())
    images = np.array([one.drawImage(nx=SIDE, ny=SIDE, wcs=local, dtype=float).array for one in profiles])
    expected = shearq.measure(stamps, images, noise=1.0, wcs=wcs)
    for pixels in (stamps, [galsim.Image(stamp) for stamp in stamps]):
        assert same_bits(shearq.measure(pixels, profiles, noise=1.0, wcs=wcs), expected)
    blocks = list(shearq.measure_blocks(stamps, profiles, noise=1.0, wcs=wcs, block=60))
    assert same_bits(blocks[1]["e1"], shearq.measure(stamps[60:], images[60:], noise=1.0, wcs=wcs)["e1"])
    one = shearq.measure(stamps, profiles[0], noise=1.0, wcs=wcs)
    assert same_bits(one, shearq.measure(stamps, images[0], noise=1.0, wcs=wcs))
    # A Jacobian for each stamp.
    each = shearq.measure(stamps, profiles[0], noise=1.0, wcs=np.repeat(wcs[np.newaxis], len(stamps), axis=0))
    assert np.allclose(each["e1"], one["e1"], atol=1e-5)
    wrong = [
        ({"psf": profiles[:5], "wcs": wcs}, ValueError, "psf: found 5 profiles; expected one, or 120"),
        ({"psf": [*profiles[:-1], 3.0], "wcs": wcs}, TypeError, "psf: number 119 is of type float"),
        ({"psf": profiles}, TypeError, "stamps that have no WCS.* Try: wcs="),
        ({"psf": profiles, "wcs": wcs, "psf_oversampling": 2}, ValueError, "psf_oversampling: found with profiles"),
        ({"psf": exact, "wcs": wcs, "psf_oversampling": 2, "x": places[:, 0], "y": places[:, 1]}, ValueError, "psf_oversampling: found with profiles"),
        ({"psf": np.ones((145, 145)), "psf_oversampling": 3}, ValueError, r"psf: found an oversampled PSF of shape \(145, 145\) .* Try: draw the PSF on 144 × 144 or 147 × 147"),
    ]
    for arguments, kind, message in wrong:
        with pytest.raises(kind, match=message):
            shearq.measure(stamps, noise=1.0, **arguments)


def test_a_psf_that_piff_fitted_has_the_exact_shear(field, tmp_path):
    piff = pytest.importorskip("piff", reason="Piff is not installed")
    fits = pytest.importorskip("astropy.io.fits")
    rng = np.random.default_rng(9)
    image = galsim.Image(FIELD, FIELD, scale=SCALE)
    rows = [(x, y) for x in np.linspace(60, FIELD - 60, 5) for y in np.linspace(60, FIELD - 60, 5)]
    rows = np.array(rows) + rng.uniform(-0.5, 0.5, (len(rows), 2))
    for x, y in rows:
        stamp = exact(x, y).withFlux(1e6).drawImage(nx=64, ny=64, scale=SCALE, center=galsim.PositionD(x, y))
        image[stamp.bounds] += stamp
    image.addNoise(galsim.GaussianNoise(galsim.BaseDeviate(3), sigma=1.0))
    image.write(str(tmp_path / "image.fits"))
    columns = [fits.Column(name=name, format="D", array=column) for name, column in zip("xy", rows.T)]
    fits.BinTableHDU.from_columns(columns).writeto(tmp_path / "stars.fits")
    config = {
        "input": {"image_file_name": str(tmp_path / "image.fits"), "cat_file_name": str(tmp_path / "stars.fits"), "x_col": "x", "y_col": "y", "stamp_size": 32, "noise": 1.0},
        "psf": {"model": {"type": "Moffat", "beta": 3.0}, "interp": {"type": "Polynomial", "order": 1}},
    }
    psf = piff.process(config, logging.getLogger("piff"))
    places, stamps = field
    x, y = places.T
    found = shearq.measure(stamps, psf, noise=1.0, x=x, y=y).mean_shear()
    expected = exact_catalogue(places, stamps).mean_shear()
    # The PSF is exact to 10⁻³ of its size; a missing or repeated pixel would change g by 1.6 %.
    assert abs(found.g1 / expected.g1 - 1) < 1e-3 + 1e-4 / abs(expected.g1)
    assert found.g1 == pytest.approx(0.02, abs=0.001) and found.g2 == pytest.approx(-0.01, abs=0.001)


def write_psfex(path):
    """A PSFEx file of a Gaussian that grows along x, sampled at half a pixel, the pixel included."""
    fits = pytest.importorskip("astropy.io.fits")
    side, step = 63, 0.5
    rows, columns = (np.indices((side, side)) - (side - 1) / 2) * step

    def gaussian(sigma):
        drawn = np.exp(-(rows**2 + columns**2) / (2 * sigma**2))
        return drawn / drawn.sum()

    slope = (gaussian(2.2) - gaussian(1.8)) / 2
    masks = np.array([gaussian(1.8) + slope, slope, 0 * slope], dtype="f4")
    column = fits.Column("PSF_MASK", f"{masks.size}E", dim=f"({side},{side},3)", array=masks[np.newaxis])
    table = fits.BinTableHDU.from_columns([column], name="PSF_DATA")
    keys = {"POLNAXIS": 2, "POLNGRP": 1, "POLGRP1": 1, "POLGRP2": 1, "POLNAME1": "X_IMAGE", "POLNAME2": "Y_IMAGE", "POLZERO1": 500.0, "POLZERO2": 500.0}
    keys |= {"POLSCAL1": 500.0, "POLSCAL2": 1000.0, "POLDEG1": 1, "PSFNAXIS": 3, "PSFAXIS1": side, "PSFAXIS2": side, "PSFAXIS3": 3, "PSF_SAMP": step}
    table.header.update(keys)
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(path)


def test_psfex_files_are_drawn_without_another_pixel(tmp_path):
    des = pytest.importorskip("galsim.des")
    write_psfex(tmp_path / "model.psf")
    psf = des.DES_PSFEx(str(tmp_path / "model.psf"))
    rng = np.random.default_rng(3)
    y, x = np.indices((SIDE, SIDE)) - (SIDE - 1) / 2
    stamps = 1000 * np.exp(-(x**2 + y**2) / 18) + rng.normal(0, 1, (20, SIDE, SIDE))
    at = np.where(np.arange(20) < 10, 0.0, 1000.0)
    found = shearq.measure(stamps, psf, noise=1.0, x=at, y=np.full(20, 500.0))
    # Another pixel would make the first wider by 2 %.
    assert found["psf_sigma"][0] == pytest.approx(1.8, rel=5e-3) and found["psf_sigma"][-1] == pytest.approx(2.2, rel=5e-3)


def test_places_off_the_chip_and_forgotten_wcs_are_warned_of(field, tmp_path):
    des = pytest.importorskip("galsim.des")
    write_psfex(tmp_path / "model.psf")
    places, stamps = field
    # On the chip of the model of PSFEx.
    stamps, (x, y) = stamps[:40], places[:40].T / 2
    turned = galsim.AffineTransform(0.0, SCALE, -SCALE, 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        right = galsim.PixelScale(SCALE)
        expected = shearq.measure(stamps, des.DES_PSFEx(str(tmp_path / "model.psf"), wcs=right), noise=1.0, x=x, y=y)
    with pytest.warns(shearq.DataWarning, match=r"none is given, .* Try: wcs=psf.wcs for shapes on the sky, or wcs=np.eye\(2\)"):
        found = shearq.measure(stamps, des.DES_PSFEx(str(tmp_path / "model.psf"), wcs=turned), noise=1.0, x=x, y=y)
    # This PSF is round.
    assert np.allclose(found["e1"], expected["e1"], atol=1e-4)

    class Fitted:
        """The attributes of a model of Piff."""

        interp_property_names = ("u", "v")
        stars = [SimpleNamespace(image_pos=galsim.PositionD(*place)) for place in places]
        wcs = {3: turned}

        def draw(self, x, y, stamp_size, center, chipnum):
            return galsim.Image(exact(0, 0).drawImage(nx=stamp_size, ny=stamp_size, scale=SCALE).array)

    far = np.where(np.arange(40) == 7, 1e5, x)
    with pytest.warns(shearq.DataWarning, match=r"1 of 40 galaxies are far .* galaxy 7 is at x = 100000"):
        shearq.measure(stamps, Fitted(), noise=1.0, x=far, y=y, wcs=turned, properties={"chipnum": 3})
    with pytest.warns(shearq.DataWarning, match=r"Try: wcs=psf.wcs\[3\]"):
        shearq.measure(stamps, Fitted(), noise=1.0, x=x, y=y, properties={"chipnum": 3})


class RubinPsf:
    """The methods of a PSF of Rubin that are called."""

    def computeKernelImage(self, point):
        return exact(point.x, point.y).drawImage(nx=41, ny=41, scale=SCALE, dtype=float)


def test_psfs_of_rubin_are_on_pixels_of_their_own(field):
    places, stamps = field
    x, y = places.T
    found = shearq.measure(stamps, RubinPsf(), noise=1.0, x=x, y=y)
    expected = exact_catalogue(places, stamps)
    # Light beyond 41 px.
    assert np.allclose(found["e1"], expected["e1"], atol=2e-3)


def test_models_depend_on_properties(field):
    places, stamps = field
    x, y = places.T
    colour = np.linspace(0, 1, len(x))

    def chromatic(x, y, colour, band):
        assert band == "r"
        return exact(x, y).dilate(1 + 0.1 * colour).drawImage(nx=SIDE, ny=SIDE, scale=SCALE)

    found = shearq.measure(stamps, chromatic, noise=1.0, x=x, y=y, properties={"colour": colour, "band": "r"})
    neutral = exact_catalogue(places, stamps)
    growth = found["psf_sigma"] / neutral["psf_sigma"]
    # The pixel does not grow.
    assert 1.0 == pytest.approx(growth[0], abs=1e-3) and 1.07 < growth[-1] < 1.1
    wrong = [
        ({"x": x, "y": y, "properties": {"colour": colour[:-1], "band": "r"}}, ValueError, "properties: colour has 119 values; expected one, or 120"),
        ({"properties": {"colour": 0.1, "band": "r"}}, ValueError, "psf: found a model, and no places"),
        ({"x": x[1:], "y": y, "properties": {"colour": 0.1, "band": "r"}}, ValueError, "x: found an array of shape"),
        ({"x": x, "y": y}, ValueError, "psf: the model has no PSF at x = .*galaxy 0"),
    ]
    for arguments, kind, message in wrong:
        with pytest.raises(kind, match=message):
            shearq.measure(stamps, chromatic, noise=1.0, **arguments)
    with pytest.raises(ValueError, match="returned a profile of GalSim, and the pixels have no WCS"):
        shearq.measure(stamps, exact, noise=1.0, x=x, y=y)
    with pytest.raises(TypeError, match="properties: found with a PSF of type ndarray"):
        shearq.measure(stamps, np.ones((48, 48)), properties={"a": 1})


def test_a_package_that_a_model_needs_is_named(monkeypatch, capsys):
    from shearq import _drawn_psfs

    def read(_):
        raise ModuleNotFoundError("No module named 'pixmappy'", name="pixmappy")

    monkeypatch.setitem(sys.modules, "piff", SimpleNamespace(PSF=SimpleNamespace(read=read)))
    monkeypatch.setattr(sys, "argv", ["_drawn_psfs", "model.piff", "0", "1", "48"])
    monkeypatch.setattr(sys, "stdin", io.StringIO("1 1\n"))
    assert _drawn_psfs.main() == 1
    assert "pip install git+https://github.com/gbernstein/pixmappy" in capsys.readouterr().err
