#!/usr/bin/env python3
"""Measures m and c of a submission on galaxies that GalSim rendered.

    pip install galsim astropy pyarrow
    python3 tests/galsim-shear.py --submission 48/linear/star [--kinds fiducial,small] [--fields 40]

Every galaxy is drawn four times: with intrinsic ellipticity +e and -e (a ring of two, whose mean is the
shear), each under +g and -g, all with the same noise, so that shape noise cancels exactly and noise to first
order. Each rendered stamp is used with several fields of noise. Nothing of shearq's simulator is used; its
binary is run on FITS images in the layout that `measure` reads.

m is half the difference between +g and -g over g, less the response that the submission measured, over that
response; c the mean of all four over it. Errors are the scatter over galaxies over the root of their number.
"""

import argparse
import subprocess
import tempfile
from pathlib import Path

import galsim
import numpy as np
import pyarrow.parquet as pq
from astropy.io import fits

STAMP, GRID, SHEAR = 48, 32, 0.02
# Half-light radii of bulge and disc in pixels, S/N, PSF, and whether bulges are off the disc's centre.
KINDS = {
    "fiducial": (2.3, 4.8, 20, "moffat", False),
    "low-snr": (2.3, 4.8, 10, "moffat", False),
    "high-snr": (2.3, 4.8, 40, "moffat", False),
    "small": (1.8, 2.6, 20, "moffat", False),
    "large": (3.4, 10.0, 20, "moffat", False),
    "kolmogorov": (2.3, 4.8, 20, "kolmogorov", False),
    "offset-bulge": (2.3, 4.8, 20, "moffat", True),
}
VERSIONS = [(1, 1), (1, -1), (-1, 1), (-1, -1)]


def psf_of(kind):
    profile = galsim.Kolmogorov(fwhm=3.4) if kind == "kolmogorov" else galsim.Moffat(beta=3, fwhm=3.4)
    return profile.shear(g1=0.03, g2=-0.02)


def render(kind, count, rng):
    """Noise-free stamps of the four versions of `count` galaxies, scaled to the kind's S/N for noise of 1."""
    bulge, disc, snr, profile, offset = KINDS[kind]
    psf = psf_of(profile)
    stamps = np.empty((4, count, STAMP, STAMP), np.float32)
    for k in range(count):
        e = np.minimum(rng.rayleigh(0.14), 0.6)
        angle = rng.uniform(0, np.pi)
        place = rng.uniform(-0.5, 0.5, 2)
        away = rng.normal(size=2) if offset else np.zeros(2)
        for v, (sign, shear) in enumerate(VERSIONS):
            shape = dict(g1=sign * e * np.cos(2 * angle), g2=sign * e * np.sin(2 * angle))
            inner = galsim.DeVaucouleurs(half_light_radius=bulge).shear(**shape).shift(*away)
            outer = galsim.Exponential(half_light_radius=disc).shear(**shape)
            galaxy = (0.5 * inner + 0.5 * outer).shear(g1=shear * SHEAR, g2=shear * SHEAR)
            image = galsim.Convolve(galaxy.shift(*place), psf).drawImage(nx=STAMP, ny=STAMP, scale=1)
            stamps[v, k] = image.array
        # One factor for all versions: a shear keeps the flux.
        stamps[:, k] *= snr / np.sqrt((stamps[:, k] ** 2).sum((1, 2)).mean())
    return stamps, psf.drawImage(nx=STAMP, ny=STAMP, scale=1).array


def write(path, stamps, psf, image, noise):
    """One image of GRID x GRID stamps in the layout of `measure`."""
    rows = (stamps + noise).reshape(GRID, GRID, STAMP, STAMP).transpose(0, 2, 1, 3)
    galaxies = fits.PrimaryHDU(rows.reshape(GRID * STAMP, GRID * STAMP).astype(np.float32))
    for key, value in dict(SET=1, IMAGE=image, STAMP=STAMP, NGRID=GRID, NOISESIG=1.0).items():
        galaxies.header[key] = value
    galaxies.writeto(path / f"galaxies-{image:03}.fits")
    star = fits.PrimaryHDU(psf.astype(np.float32))
    star.header["STAMP"] = STAMP
    star.writeto(path / f"psf-{image:03}.fits")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--binary", default="target/release/shearq")
    parser.add_argument("--submission", default="48/linear/star")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--fields", type=int, default=40, help="fields of noise for each galaxy")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    cells = GRID * GRID
    print(f"{options.submission}, {cells} galaxies x 4 versions x {options.fields} fields of noise, seed {options.seed}")
    print("kind            m1, m2 (1e-3)                   c1, c2 (1e-4)                   flagged")
    for number, kind in enumerate(options.kinds.split(",")):
        rng = np.random.default_rng([options.seed, number])
        stamps, psf = render(kind, cells, rng)
        with tempfile.TemporaryDirectory() as folder:
            data, out = Path(folder) / "data", Path(folder) / "out"
            (data / "set01").mkdir(parents=True)
            for field in range(options.fields):
                noise = rng.normal(size=stamps[0].shape)
                for version in range(4):
                    write(data / "set01", stamps[version], psf, 4 * field + version + 1, noise)
            command = [options.binary, "measure", "--submission", options.submission]
            subprocess.run(command + ["--data", str(data), "--out", str(out)], check=True, capture_output=True)
            tables = [pq.read_table(out / f"set01/catalogue-{image + 1:03}.parquet") for image in range(4 * options.fields)]
        column = lambda name: np.array([t[name].to_numpy() for t in tables]).reshape(options.fields, 4, cells)
        line, flagged = f"{kind:14}", column("flag") != 0
        good = ~flagged.any(1)
        slopes, offsets = [], []
        for k in "12":
            response = np.where(flagged, np.nan, column(f"response{k}"))
            # Undo each image's own calibration and take the mean response of all.
            e = column(f"e{k}") * np.nanmean(response, 2, keepdims=True)
            mean = np.nanmean(response)
            e = np.where(good[:, None], e, np.nan)
            slope = (e[:, 0] - e[:, 1] + e[:, 2] - e[:, 3]) / (4 * SHEAR)
            surplus = (slope - response.mean(1)) / mean

            def figure(values, scale):
                # A galaxy's fields share its shape: their mean is one sample.
                own = np.nanmean(values, 0)
                return f"{scale * own.mean():7.2f} +- {scale * own.std() / np.sqrt(cells):.2f}"

            slopes.append(figure(surplus, 1e3))
            offsets.append(figure(e.mean(1) / mean, 1e4))
        print(f"{line}{slopes[0]}, {slopes[1]}  {offsets[0]}, {offsets[1]}  {flagged.sum()}", flush=True)


if __name__ == "__main__":
    main()
