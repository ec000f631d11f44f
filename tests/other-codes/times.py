"""CPU time per galaxy of shearq, FPFS and REGAUSS on the same stamps, in one process.

    pip install ./python galsim anacal
    python3 tests/other-codes/times.py

Stamps are shearq's simulated ones of set 2 (S/N 20). All programs get arrays in memory and use one thread. Passes alternate, so
that a change of the processor's clock affects all.
"""

import statistics
import time

import anacal
import galsim
import numpy as np
import shearq

#: Galaxies along a side of the mosaic, pixels a side of FPFS's stamps, as of all others, and arcseconds a pixel.
GRID, SIDE, SCALE = 100, 48, 0.2
#: σ of the shapelets of FPFS in pixels. It does not change the time.
KERNEL = 4.0
#: REGAUSS measures every so many galaxies, because it takes long.
STRIDE = 10
PASSES = 5


def mosaic(stamps):
    """Stamps side by side, each with zeros around it."""
    edge = (SIDE - stamps.shape[1]) // 2
    image = np.pad(stamps.astype(float), ((0, 0), (edge, edge), (edge, edge)))
    image = image.reshape(GRID, GRID, SIDE, SIDE).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(image.reshape(GRID * SIDE, GRID * SIDE))


def fpfs(image, psf, places):
    """FPFS at known places, without added noise: its fastest form."""
    task = anacal.fpfs.FpfsTask(
        npix=SIDE, pixel_scale=SCALE, sigma_shapelets=KERNEL * SCALE, psf_array=psf, kmax_thres=1e-12
    )
    found = task.run(gal_array=image, psf=psf, noise_array=None, det=places)
    anacal.fpfs.measure_fpfs(C0=1.0, x_array=found["data"], y_array=None)


def regauss(stamps, psf):
    """Re-Gaussianization of GalSim's HSM."""
    for stamp in stamps:
        galsim.hsm.EstimateShear(galsim.Image(stamp.astype(float)), psf, sky_var=1.0, strict=False)


def main():
    image = shearq.simulate(set=2, grid=GRID, seed=3)[0]
    stamps, psf = np.ascontiguousarray(image.stamps), np.asarray(image.psf, dtype=float)
    count, edge = len(stamps), (SIDE - psf.shape[0]) // 2
    places = np.empty(count, dtype=[("y", np.int32), ("x", np.int32)])
    y, x = np.mgrid[0:GRID, 0:GRID] * SIDE + SIDE // 2
    places["y"], places["x"] = y.ravel(), x.ravel()
    joined, padded, drawn = mosaic(stamps), np.pad(psf, edge), galsim.Image(psf)
    codes = {
        "48/linear/star": (1, lambda: shearq.measure(stamps, psf, threads=1)),
        "48/linear/star, noise given": (1, lambda: shearq.measure(stamps, psf, noise=image.noise, threads=1)),
        "FPFS, centred, not renoised": (1, lambda: fpfs(joined, padded, places)),
        "REGAUSS": (STRIDE, lambda: regauss(stamps[::STRIDE], drawn)),
    }
    times = {name: [] for name in codes}
    for _ in range(PASSES):
        for name, (stride, run) in codes.items():
            start = time.process_time()
            run()
            times[name].append((time.process_time() - start) * stride / count * 1e6)
    first = statistics.median(times["48/linear/star"])
    print(f"{'code':30} {'µs per galaxy':>14} {'range':>14} {'ratio':>6}")
    for name, values in times.items():
        middle = statistics.median(values)
        print(f"{name:30} {middle:14.1f} {min(values):6.1f} to {max(values):5.1f} {middle / first:6.1f}")


if __name__ == "__main__":
    main()
