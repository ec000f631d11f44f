"""Exposures with the attributes of Rubin's."""

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import same_bits

import shearq

galsim = pytest.importorskip("galsim", reason="exposures are drawn by GalSim")

SIDE, SCALE, X0, Y0 = 900, 0.2, 3000, 7000
PLANES = {"BAD": 0, "SAT": 1, "CR": 3, "DETECTED": 5, "NO_DATA": 8}


class Mask:
    def __init__(self):
        self.array = np.zeros((SIDE, SIDE), np.int32)

    def getMaskPlaneDict(self):
        return PLANES

    def getPlaneBitMask(self, names):
        return sum(1 << PLANES[name] for name in names)


class Wcs:
    """A tangent plane, rotated by an angle, whose first pixel is 0."""

    def __init__(self, angle):
        turn = np.radians(angle)
        matrix = SCALE * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        self.galsim = self.tangent(matrix, X0, Y0)
        self.matrix = matrix

    def tangent(self, matrix, x0, y0):
        plane = galsim.AffineTransform(*matrix.ravel(), origin=galsim.PositionD(x0 + SIDE / 2, y0 + SIDE / 2))
        return galsim.TanWCS(plane, galsim.CelestialCoord(1 * galsim.radians, 0.3 * galsim.radians))

    def of_file(self):
        return self.tangent(self.matrix, 1, 1)

    def pixelToSkyArray(self, x, y, degrees):
        assert degrees
        return self.galsim.xyToradec(x, y, units="deg")


class Psf:
    def __init__(self, wcs):
        self.wcs = wcs

    def profile(self):
        return galsim.Moffat(beta=3, fwhm=0.7).shear(g1=0.03, g2=-0.02)

    def computeKernelImage(self, point):
        local = self.wcs.local(galsim.PositionD(point.x, point.y))
        return self.profile().drawImage(nx=41, ny=41, wcs=local, dtype=float)


def exposure(angle, shear=(0.03, -0.02), noise=0.5):
    rng = np.random.default_rng(4)
    wcs = Wcs(angle)
    psf = Psf(wcs.galsim)
    image = galsim.Image(galsim.BoundsI(X0, X0 + SIDE - 1, Y0, Y0 + SIDE - 1), wcs=wcs.galsim, dtype=float)
    places = []
    for row in range(14):
        for column in range(14):
            x, y = X0 + 60 + 60 * column + rng.uniform(-2, 2), Y0 + 60 + 60 * row + rng.uniform(-2, 2)
            center = galsim.PositionD(x, y)
            galaxy = galsim.Exponential(half_light_radius=0.6, flux=2000).shear(g1=shear[0], g2=shear[1])
            stamp = galsim.Convolve(galaxy, psf.profile()).drawImage(nx=54, ny=54, wcs=wcs.galsim.local(center), center=center)
            image[stamp.bounds] += stamp
            places.append((x, y))
    image.array[:] += rng.normal(0, noise, image.array.shape)
    plain = SimpleNamespace
    found = plain(
        image=plain(array=image.array),
        mask=Mask(),
        variance=plain(array=np.full((SIDE, SIDE), noise**2)),
        psf=psf,
        wcs=wcs,
        getXY0=lambda: (X0, Y0),
    )
    return found, np.array(places).T


@pytest.mark.parametrize("angle", [0, 130])
def test_galaxies_are_measured_on_the_sky(angle):
    found, (x, y) = exposure(angle)
    shear = shearq.measure(**shearq.from_exposure(found, x, y, ids=np.arange(len(x)))).mean_shear()
    # Errors of 196 round galaxies at S/N 60.
    assert shear.g1 == pytest.approx(0.03, abs=0.004) and shear.g2 == pytest.approx(-0.02, abs=0.004)
    assert shear.flagged == 0


def test_planes_are_missing_pixels_by_name():
    found, (x, y) = exposure(0)
    clean = shearq.measure(**shearq.from_exposure(found, x, y))
    row, column = int(y[5] - Y0), int(x[5] - X0)
    found.image.array[row - 2 : row + 2, column + 4 : column + 8] = 1e4
    found.mask.array[row - 2 : row + 2, column + 4 : column + 8] = 1 << PLANES["CR"]
    found.mask.array[row - 20 : row + 20, column - 20 : column + 20] |= 1 << PLANES["DETECTED"]
    masked = shearq.measure(**shearq.from_exposure(found, x, y))
    assert abs(masked["e1"][5] - clean["e1"][5]) < 0.2 and masked["flags"][5] in (0, 1)
    with pytest.raises(ValueError, match="planes: the mask has no plane SUSPECT; expected some of BAD, CR"):
        shearq.from_exposure(found, x, y, planes=["SUSPECT"])
    # Outside the exposure.
    x[7] = X0 - 200.0
    assert shearq.measure(**shearq.from_exposure(found, x, y))["flags"][7] == 1
    found.psf = None
    with pytest.raises(ValueError, match="exposure: has no PSF"):
        shearq.from_exposure(found, x, y)


def test_places_and_masks_that_leave_no_galaxy_are_named():
    found, (x, y) = exposure(0)
    x[3] = np.nan
    with pytest.raises(ValueError, match=r"x: found nan in row 3 \(from 0\), and 1 such rows; expected finite places. Try: rows"):
        shearq.from_exposure(found, x, y)
    found.mask.array[:] = 1 << PLANES["SAT"]
    found.mask.array[:90] |= 1 << PLANES["BAD"]
    with pytest.raises(ValueError, match="exposure: all pixels are masked .by BAD 10%, SAT 100%.*Try: planes="):
        shearq.from_exposure(found, y, y)


def as_images(found):
    """The same as lsst.images has it."""
    plain = SimpleNamespace
    names = {"BAD": "BAD", "SAT": "SATURATED", "CR": "COSMIC_RAY", "DETECTED": "DETECTED", "NO_DATA": "NO_DATA"}

    def pixel_to_sky(*, x, y):
        ra, dec = found.wcs.pixelToSkyArray(x, y, degrees=True)
        return plain(ra=plain(deg=ra), dec=plain(deg=dec))

    planes = {new: (found.mask.array >> PLANES[old] & 1).astype(bool) for old, new in names.items()}
    return plain(
        image=found.image,
        variance=found.variance,
        mask=plain(schema=plain(names=planes.keys()), get=planes.__getitem__),
        psf=plain(compute_kernel_image=lambda *, x, y: found.psf.computeKernelImage(plain(x=x, y=y))),
        sky_projection=plain(pixel_to_sky=pixel_to_sky),
        bbox=plain(start=plain(xy=(X0, Y0))),
    )


def write_coadd(path, found, cards):
    """The images of a coadd as afw and lsst.images write them."""
    fits = pytest.importorskip("astropy.io.fits")
    header = fits.Header()
    # Column and row of the first pixel of the file are 1.
    found.wcs.of_file().writeToFitsHeader(header, galsim.BoundsI(1, SIDE, 1, SIDE))
    header.update({"LTV1": -X0, "LTV2": -Y0})
    images = [("IMAGE", found.image.array, header), ("MASK", found.mask.array, fits.Header(cards)), ("VARIANCE", found.variance.array, None)]
    fits.HDUList([fits.PrimaryHDU(), *(fits.ImageHDU(array, own, name=name) for name, array, own in images)]).writeto(path)


def test_images_of_lsst_images_and_of_files_are_those_of_afw(tmp_path):
    found, (x, y) = exposure(25)
    found.mask.array[300:340, 300:330] = 1 << PLANES["SAT"]
    expected = shearq.measure(**shearq.from_exposure(found, x, y))
    assert (expected["flags"] == 1).any()
    of_images = shearq.measure(**shearq.from_exposure(as_images(found), x, y))
    assert same_bits(of_images, expected)
    with pytest.raises(ValueError, match="the mask has no plane SAT; expected some of BAD, COSMIC_RAY"):
        shearq.from_exposure(as_images(found), x, y, planes=["SAT"])
    afw = {f"MP_{name}": bit for name, bit in PLANES.items()}
    new = {"MSKN0000": "BAD", "MSKM0000": 1, "MSKN0001": "SATURATED", "MSKM0001": 2}
    for number, cards in enumerate((afw, new)):
        write_coadd(tmp_path / f"{number}.fits", found, cards)
        of_file = shearq.measure(**shearq.from_exposure(tmp_path / f"{number}.fits", x, y, psf=found.psf))
        for name in ("e1", "e2", "flags"):
            # The header has fewer digits.
            assert np.allclose(of_file[name], expected[name], atol=1e-6, equal_nan=True), name
    with pytest.raises(ValueError, match="exposure: has no PSF; expected one. Try: psf="):
        shearq.from_exposure(tmp_path / "0.fits", x, y)
