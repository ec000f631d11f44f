"""Shapes by estimators that others made, of the stamps that a submission is measured on.

Each takes stamps `[version, galaxy, y, x]` (with both shears and one field of noise, and with the first and another),
their PSF, and a function that draws noise like that of a version. It returns ellipticities `[version, galaxy, component]`,
not a number where it failed, and its own mean response per component.
"""

import galsim
import numpy as np

try:
    import anacal
except ImportError:
    anacal = None

#: Kernel of FPFS in pixels, by which its noise is least among 2.6, 3.2 and 4 px, and what is added to its divisor in
#: units of a galaxy's.
KERNEL, OFFSET = 4.0, 1.0
#: Pixels a side of FPFS's stamps, and arcseconds a pixel, which it is told lengths in.
SIDE, SCALE = 64, 0.2


def regauss(stamps, psf, _noise):
    """Re-Gaussianization (Hirata & Seljak 2003) of GalSim's HSM; shears are half of its distortions."""
    side = stamps.shape[-1]
    image = psf.drawImage(nx=side, ny=side, scale=1, dtype=float)
    e = np.full((*stamps.shape[:2], 2), np.nan)
    for version, galaxies in enumerate(stamps):
        for k, stamp in enumerate(galaxies):
            found = galsim.hsm.EstimateShear(
                galsim.Image(np.ascontiguousarray(stamp, dtype=float)), image, sky_var=1.0, strict=False
            )
            if not found.error_message:
                e[version, k] = found.corrected_e1 / 2, found.corrected_e2 / 2
    # A distortion of modulus 2 is none.
    e[np.abs(e) > 1.0] = np.nan
    # The response of distortions to shear is 2 (1 − χ²) with the intrinsic χ² per component: what noise does not add.
    change = np.nanvar(e[0] - e[2], 0) / 2
    return e, 1.0 - 4.0 * (np.nanvar(e[0], 0) - change)


def fpfs(stamps, psf, noise):
    """FPFS (Li et al. 2022) of AnaCal at the stamps' middles, without detection, with its doubled noise."""
    versions, count, side, _ = stamps.shape
    full = max(SIDE, side)
    grid = int(np.sqrt(count))
    edge = (full - side) // 2

    def mosaic(galaxies):
        image = np.zeros((count, full, full))
        image[:, edge : edge + side, edge : edge + side] = galaxies
        image = image.reshape(grid, grid, full, full).transpose(0, 2, 1, 3)
        return np.ascontiguousarray(image.reshape(grid * full, grid * full))

    # Its PSF has the middle of a pixel for its own, at half of the side.
    drawn = psf.shift(0.5, 0.5).drawImage(nx=full, ny=full, scale=1, dtype=float).array
    task = anacal.fpfs.FpfsTask(
        npix=full, pixel_scale=SCALE, sigma_shapelets=KERNEL * SCALE, psf_array=drawn, kmax_thres=1e-12
    )
    places = np.empty(count, dtype=[("y", np.int32), ("x", np.int32)])
    y, x = np.mgrid[0:grid, 0:grid] * full + full // 2
    places["y"], places["x"] = y.ravel(), x.ravel()
    e, responses, offset = [], [], None
    for version in range(versions):
        # The version with another field of noise has another of these, too.
        added = mosaic(noise(version))
        found = task.run(
            gal_array=mosaic(stamps[version]) + added, psf=drawn, noise_array=added, det=places
        )
        if offset is None:
            offset = OFFSET * float(np.median(found["data"]["m00"]))
        shapes = anacal.fpfs.measure_fpfs(C0=offset, x_array=found["data"], y_array=found["noise"])
        e.append(np.stack([shapes["e1"], shapes["e2"]], 1))
        responses.append([shapes["de1_dg1"].mean(), shapes["de2_dg2"].mean()])
    return np.array(e), np.mean(responses[:2], 0)


#: What can be asked for.
PEERS = {"REGAUSS": regauss} | ({"FPFS": fpfs} if anacal else {})
