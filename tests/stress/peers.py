"""Shapes by estimators that others made, of the stamps that a submission is measured on.

Each takes stamps `[field, ±shear, galaxy, y, x]` under fields of noise, their PSF, and a function that draws further noise for a
field. Every second field is the one before with the other sign. It returns ellipticities `[field, ±shear, galaxy, component]`,
not a number where it failed, and its own response `[galaxy, component]`.
"""

import galsim
import numpy as np

#: Kernel of FPFS in pixels, and C of its e = M22 / (M00 + C) in units of the median M00: see README.md.
KERNEL, OFFSET = 4.0, 1.0
#: Pixels a side of FPFS's stamps, and arcseconds a pixel: it takes lengths in arcseconds.
SIDE, SCALE = 64, 0.2


def regauss(stamps, psf, _noise):
    """Re-Gaussianization (Hirata & Seljak 2003) of GalSim's HSM; ellipticities are half of its distortions χ.

    Distortions respond to shear by 2 (1 − χ²) with the intrinsic χ² of the component, which is the covariance of two
    measurements with noise of their own. Moduli of χ above 2 count as failed: they would rule all scatter.
    """
    side = stamps.shape[-1]
    image = psf.drawImage(nx=side, ny=side, scale=1, dtype=float)
    e = np.full((*stamps.shape[:3], 2), np.nan)
    for at in np.ndindex(e.shape[:3]):
        stamp = galsim.Image(np.ascontiguousarray(stamps[at], dtype=float))
        found = galsim.hsm.EstimateShear(stamp, image, sky_var=1.0, strict=False)
        if not found.error_message:
            e[at] = found.corrected_e1 / 2, found.corrected_e2 / 2
    e[np.hypot(e[..., 0], e[..., 1]) > 1.0] = np.nan
    e[:, :, np.isnan(e).any((0, 1, 3))] = np.nan
    off = e - np.nanmean(e, 2, keepdims=True)
    # Fields 0 and 2 are independent.
    return e, 1.0 - 4.0 * off[0, 0] * off[2, 0]


class Fpfs:
    """FPFS (Li et al. 2022) of AnaCal at the middles of stamps, without detection; its kernel is in pixels."""

    def __init__(self, count, side, psf, kernel):
        try:
            import anacal
        except ImportError:
            raise SystemExit("FPFS needs AnaCal: pip install anacal") from None
        self.code, self.count, self.side, self.full = anacal.fpfs, count, side, max(SIDE, side)
        self.grid = int(np.sqrt(count))
        # The PSF is half a pixel off the place that is told as its middle, as the galaxies are.
        self.psf = psf.drawImage(nx=self.full, ny=self.full, scale=1, dtype=float).array
        self.task = self.code.FpfsTask(
            npix=self.full, pixel_scale=SCALE, sigma_shapelets=kernel * SCALE, psf_array=self.psf, kmax_thres=1e-12
        )
        self.places = np.empty(count, dtype=[("y", np.int32), ("x", np.int32)])
        y, x = np.mgrid[0 : self.grid, 0 : self.grid] * self.full + self.full // 2
        self.places["y"], self.places["x"] = y.ravel(), x.ravel()

    def mosaic(self, stamps):
        edge, grid, full = (self.full - self.side) // 2, self.grid, self.full
        image = np.zeros((self.count, full, full))
        image[:, edge : edge + self.side, edge : edge + self.side] = stamps
        image = image.reshape(grid, grid, full, full).transpose(0, 2, 1, 3)
        return np.ascontiguousarray(image.reshape(grid * full, grid * full))

    def run(self, stamps, added=None):
        """Moments of the stamps, under `data`, and of the noise that it adds itself, under `noise`."""
        added = None if added is None else self.mosaic(added)
        return self.task.run(gal_array=self.mosaic(stamps), psf=self.psf, noise_array=added, det=self.places)

    def shapes(self, offset, found, added=None):
        """Ellipticities and responses from moments, with this C."""
        return self.code.measure_fpfs(C0=offset, x_array=found, y_array=added)


def fpfs(stamps, psf, noise, renoise=True):
    """FPFS. With `renoise`, it adds noise like that of the stamps, which removes the noise bias of its response."""
    count, side = stamps.shape[2:4]
    code = Fpfs(count, side, psf, KERNEL)
    e = np.empty((*stamps.shape[:3], 2))
    responses, offset = np.zeros((count, 2)), None
    for field, sign in np.ndindex(e.shape[:2]):
        found = code.run(stamps[field, sign], noise(field) if renoise else None)
        if offset is None:
            offset = OFFSET * float(np.median(found["data"]["m00"]))
        shapes = code.shapes(offset, found["data"], found["noise"] if renoise else None)
        e[field, sign] = np.stack([shapes["e1"], shapes["e2"]], 1)
        responses += np.stack([shapes["de1_dg1"], shapes["de2_dg2"]], 1)
    return e, responses / (len(stamps) * 2)


def fpfs_plain(stamps, psf, noise):
    """FPFS without added noise: less noise, and some noise bias at low S/N."""
    return fpfs(stamps, psf, noise, renoise=False)


#: Those that get the stamps as they are.
PEERS = {"REGAUSS": regauss}
#: Those whose authors use them on galaxies whose middle is known: stamps without dither.
CENTRED = {"FPFS": fpfs, "FPFS-plain": fpfs_plain}
