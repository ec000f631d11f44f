"""Exposures with the attributes of Rubin's."""

from types import SimpleNamespace

import numpy as np
import pytest

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
        origin = galsim.PositionD(X0 + SIDE / 2, Y0 + SIDE / 2)
        self.galsim = galsim.TanWCS(galsim.AffineTransform(*matrix.ravel(), origin=origin), galsim.CelestialCoord(1 * galsim.radians, 0.3 * galsim.radians))

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
