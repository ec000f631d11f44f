"""Arrays, files, HDUs, GalSim, ngmix and ``gather`` give one answer for the same data."""

from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

import shearq
from conftest import same_bits
from shearq import adapters

fits = pytest.importorskip("astropy.io.fits", reason="files are written by astropy")

SIDE, COUNT, SIGMA = 48, 36, 0.02
# Difference of shears with stated noise and with noise and sizes measured on all stamps: of 36 galaxies of scatter 0.17, the change of
# their weights.
MODES = 0.005
# Pixels of 0.2″, turned by 0.5 rad, mirrored and sheared, u to the west and v to the north.
MATRIX = 0.2 * np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]]) @ np.array([[-1.02, 0.01], [0.01, 0.98]])


def gaussian(side, sigma, shear, offset):
    y, x = np.indices((side, side)) - (side - 1) / 2
    x, y = x - offset[0], y - offset[1]
    found = np.exp(-((1 - shear[0]) * x**2 + (1 + shear[0]) * y**2 - 2 * shear[1] * x * y) / (2 * sigma**2))
    return found / found.sum()


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    rng = np.random.default_rng(4)
    shapes, places = rng.uniform(-0.3, 0.3, (COUNT, 2)), rng.uniform(-0.5, 0.5, (COUNT, 2))
    stamps = np.array([100 * gaussian(SIDE, 3.0, shape, place) for shape, place in zip(shapes, places)])
    stamps = (stamps + rng.normal(0, SIGMA, stamps.shape)).astype("f4")
    psf = gaussian(SIDE, 1.6, (0.05, 0.02), (0, 0)).astype("f4")
    folder = tmp_path_factory.mktemp("same")
    cards = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 30.0, "CRVAL2": 2.0, "CRPIX1": 24.5, "CRPIX2": 24.5}
    cd = np.array([-MATRIX[0], MATRIX[1]]) / 3600
    cards.update({f"CD{i + 1}_{j + 1}": cd[i, j] for i in (0, 1) for j in (0, 1)})
    header = fits.Header(cards)
    for name, pixels in {"field": stamps, "star": psf}.items():
        fits.writeto(folder / f"{name}.fits", pixels, header)
    return SimpleNamespace(stamps=stamps, psf=psf, folder=folder, noise=np.full(COUNT, SIGMA))


def arrays(data, noise):
    return shearq.measure(data.stamps, data.psf, noise=noise, wcs=MATRIX)


def files(data, noise):
    return shearq.measure(data.folder / "field.fits", str(data.folder / "star.fits"), noise=noise)


def hdus(data, noise):
    with fits.open(data.folder / "field.fits") as field, fits.open(data.folder / "star.fits") as star:
        return shearq.measure(field[0], star[0], noise=noise)


def astropy_wcs(data, noise):
    wcs = pytest.importorskip("astropy.wcs", reason="a WCS of astropy").WCS(fits.getheader(data.folder / "field.fits"), naxis=2)
    return shearq.measure(data.stamps, data.psf, noise=noise, wcs=wcs)


def galsim(data, noise):
    galsim = pytest.importorskip("galsim", reason="images of GalSim")
    wcs = galsim.JacobianWCS(*MATRIX.ravel())
    images = [galsim.Image(stamp, wcs=wcs) for stamp in data.stamps]
    star = galsim.Image(data.psf, wcs=wcs)
    return shearq.measure(**shearq.from_galsim(images, star, wcs="sky"), noise=noise)


class ObsList(list):
    """As that of ngmix."""


def ngmix(data, noise):
    names = ("get_dudcol", "get_dudrow", "get_dvdcol", "get_dvdrow")
    ways = {name: (lambda value=value: value) for name, value in zip(names, MATRIX.ravel())}
    jacobian = SimpleNamespace(get_cen=lambda: (23.5, 23.5), **ways)
    star = SimpleNamespace(image=data.psf, jacobian=jacobian)
    weight = np.full((SIDE, SIDE), SIGMA**-2.0)
    each = [ObsList([SimpleNamespace(image=stamp, weight=weight, psf=star, jacobian=jacobian)]) for stamp in data.stamps]
    return shearq.measure(**adapters.from_ngmix(each))


def gather(data, noise):
    out = data.folder / "data"
    if not out.exists():
        at = {name: str(data.folder / f"{name}.fits") for name in ("field", "star")}
        words = ["gather", "--stamps", at["field"], "--psf", at["star"], "--out", str(out)]
        assert shearq._shearq.run_command(["shearq", *words]) == 0
        words = ["measure", "--submission", "48/linear/star", "--data", str(out), "--out", str(data.folder / "out")]
        assert shearq._shearq.run_command(["shearq", *words]) == 0
    return shearq.read(data.folder / "out" / "set01" / "catalogue-001.parquet")


WAYS = (arrays, files, hdus, astropy_wcs, galsim, ngmix, gather)


@pytest.mark.filterwarnings("ignore::shearq.DataWarning")
@pytest.mark.parametrize(("one", "other"), list(combinations(WAYS, 2)), ids=lambda way: way.__name__)
def test_the_same_data_have_one_answer(data, one, other):
    # Observations of ngmix state the noise, with which galaxies are measured one by one; a folder has none.
    noise = data.noise if ngmix in (one, other) else None
    first, second = one(data, noise), other(data, noise)
    assert not first["flags"].any()
    if (one, other) == (ngmix, gather):
        assert np.allclose(tuple(first.mean_shear()), tuple(second.mean_shear()), atol=MODES)
    else:
        for name in ("e1", "e2", "R11", "psf_e1", "psf_e2", "snr"):
            # Jacobians from astropy are differences over a pixel.
            assert np.allclose(first[name], second[name], rtol=1e-4, atol=2e-6), name
    assert first.attrs["frame"] == second.attrs["frame"] == "sky"


def test_headers_whose_pixels_are_those_of_the_sky_need_no_wcs(data, tmp_path):
    # The scale of star.fits, so that the orientation alone differs.
    scale = 0.19997 / 3600
    plain = fits.Header({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CD1_1": -scale, "CD2_2": scale})
    fits.writeto(tmp_path / "plain.fits", data.stamps, plain)
    found = shearq.measure(tmp_path / "plain.fits", data.psf, noise=data.noise)
    assert found.attrs["frame"] == "pixel" and str(found.mean_shear()).endswith(" flagged, pixel frame)")
    assert str(arrays(data, data.noise).mean_shear()).endswith(" flagged, sky frame)")
    with pytest.raises(ValueError, match="catalogues: found ellipticities in the frames of pixels and of the sky"):
        shearq.mean_shear([found, arrays(data, data.noise)])
    with pytest.raises(ValueError, match="psf: the PSF image and the galaxy image have pixel axes of different orientation"):
        shearq.measure(tmp_path / "plain.fits", data.folder / "star.fits")


def test_headers_that_cannot_be_used_are_refused_or_named(data):
    def hdu(**cards):
        base = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CD1_1": -5e-5, "CD2_2": 5e-5}
        return fits.PrimaryHDU(data.stamps, fits.Header({**base, **cards}))

    with pytest.raises(ValueError, match="stamps: found asinh magnitudes"):
        shearq.measure(hdu(BSOFTEN=30.0), data.psf)
    with pytest.raises(ValueError, match="the projection RA---ZPN is not read"):
        shearq.measure(hdu(CTYPE1="RA---ZPN", CTYPE2="DEC--ZPN"), data.psf)
    with pytest.warns(shearq.DataWarning, match="stamps: the WCS has CPDIS1, whose distortion"):
        shearq.measure(hdu(CPDIS1="Lookup"), data.psf)


def test_one_psf_for_stamps_of_several_orientations_is_named(data):
    turned = np.array([MATRIX, MATRIX @ np.array([[0.0, -1.0], [1.0, 0.0]])])[np.arange(COUNT) % 2]
    with pytest.warns(shearq.DataWarning, match="one PSF is for all stamps, whose pixels differ on the sky"):
        shearq.measure(data.stamps, data.psf, noise=data.noise, wcs=turned)


def test_maps_of_noise_are_those_of_gather(data, tmp_path):
    rng = np.random.default_rng(9)
    sigmas = SIGMA * rng.uniform(0.9, 1.1, data.stamps.shape)
    sigmas[::5, 3:6, 40:44] = np.inf
    sigmas[:, 20:28, 20:28] *= 3
    fits.writeto(tmp_path / "variance.fits", (sigmas**2).astype("f8"))
    at = {name: str(data.folder / f"{name}.fits") for name in ("field", "star")}
    words = ["gather", "--stamps", at["field"], "--psf", at["star"], "--variance", str(tmp_path / "variance.fits"), "--out", str(tmp_path / "data")]
    assert shearq._shearq.run_command(["shearq", *words]) == 0
    words = ["measure", "--submission", "48/linear/star", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")]
    assert shearq._shearq.run_command(["shearq", *words]) == 0
    gathered = shearq.read(tmp_path / "out" / "set01" / "catalogue-001.parquet")
    found = shearq.measure(data.stamps, data.psf, noise=sigmas, wcs=MATRIX)
    for name in ("e1", "e2", "R11", "noise", "snr"):
        assert np.allclose(found[name], gathered[name], rtol=1e-4, atol=2e-6), name
    marked = np.where(np.isinf(sigmas), 1e15, sigmas)
    assert same_bits(shearq.measure(data.stamps, data.psf, noise=marked, wcs=MATRIX), found)
    with pytest.raises(ValueError, match="noise: found -1 on stamp 0; expected positive"):
        shearq.measure(data.stamps, data.psf, noise=-np.ones_like(sigmas))
    with pytest.raises(ValueError, match="noise: found maps of shape"):
        shearq.measure(data.stamps, data.psf, noise=sigmas[:, :10])


def test_pixels_that_differ_from_their_checksum_are_noted(data, tmp_path, capfd):
    for name, pixels in (("good", data.stamps), ("changed", data.stamps + 1)):
        hdu = fits.PrimaryHDU(data.stamps)
        hdu.add_datasum()
        fits.PrimaryHDU(pixels, hdu.header).writeto(tmp_path / f"{name}.fits")
        words = ["gather", "--stamps", str(tmp_path / f"{name}.fits"), "--psf", str(data.folder / "star.fits"), "--frame", "pixel"]
        assert shearq._shearq.run_command(["shearq", *words, "--out", str(tmp_path / name)]) == 0
        assert ("differ from the checksum DATASUM" in capfd.readouterr().err) == (name == "changed")
