#!/usr/bin/env python3
"""Measures m and c of a submission on galaxies that GalSim rendered.

    pip install galsim astropy pyarrow
    python3 tests/galsim-shear.py --submission 48/linear/star [--kinds fiducial,small] [--grid 64] [--fields 40]

Every galaxy is drawn four times: with intrinsic ellipticity e under shears of (g, g) and (-g, -g), and with -e
under (g, -g) and (-g, g), all with the same noise, so that shape noise cancels exactly, noise to first order,
and so does what one component of shear does to the other. Every other galaxy is the one before, turned by 45 degrees. Each rendered stamp is used with several fields of
noise, every other the negative of the one before. Nothing of shearq's simulator is used; its binary is run on
FITS images in the layout that `measure` reads.

m is half the difference between +g and -g over g, less the response that the submission measured, over that
response; c the mean of all four over it. Errors are the scatter over pairs of galaxies over the root of their number.
"""

import argparse
import subprocess
import tempfile
from pathlib import Path

import galsim
import numpy as np
import pyarrow.parquet as pq
from astropy.io import fits

STAMP, SHEAR = 48, 0.02
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
# Signs of the intrinsic ellipticity and of both components of shear.
VERSIONS = [(1, (1, 1)), (1, (-1, -1)), (-1, (1, -1)), (-1, (-1, 1))]
# Of the catalogue.
COLUMNS = ["e1", "e2", "R11", "R22", "flags"]
# Light that may be folded back into the image: GalSim's default of 5e-3 is no better than the biases sought.
ACCURACY = galsim.GSParams(folding_threshold=1e-3, maximum_fft_size=16384)


def psf_of(kind):
    profile = galsim.Kolmogorov(fwhm=3.4) if kind == "kolmogorov" else galsim.Moffat(beta=3, fwhm=3.4)
    return profile.shear(g1=0.03, g2=-0.02)


def render(kind, count, rng):
    """Noise-free stamps of the four versions of `count` galaxies, scaled to the kind's S/N for noise of 1."""
    bulge, disc, snr, profile, offset = KINDS[kind]
    psf = psf_of(profile)
    stamps = np.empty((4, count, STAMP, STAMP), np.float32)
    for k in range(count):
        if k % 2 == 0:
            e, angle = np.minimum(rng.rayleigh(0.14), 0.6), rng.uniform(0, np.pi)
            place = rng.uniform(-0.5, 0.5, 2)
            away = rng.normal(size=2) if offset else np.zeros(2)
        else:
            # The galaxy before, turned by 45 degrees: the part of the response that has spin 4 cancels.
            angle += np.pi / 4
            away = np.array([away[0] - away[1], away[0] + away[1]]) / np.sqrt(2)
        for v, (sign, (first, second)) in enumerate(VERSIONS):
            shape = dict(g1=sign * e * np.cos(2 * angle), g2=sign * e * np.sin(2 * angle))
            inner = galsim.DeVaucouleurs(half_light_radius=bulge).shear(**shape).shift(*away)
            outer = galsim.Exponential(half_light_radius=disc).shear(**shape)
            galaxy = (0.5 * inner + 0.5 * outer).shear(g1=first * SHEAR, g2=second * SHEAR)
            image = galsim.Convolve(galaxy.shift(*place), psf, gsparams=ACCURACY).drawImage(nx=STAMP, ny=STAMP, scale=1)
            stamps[v, k] = image.array
        # One factor for all versions: a shear keeps the flux.
        stamps[:, k] *= snr / np.sqrt((stamps[:, k] ** 2).sum((1, 2)).mean())
    return stamps, psf.drawImage(nx=STAMP, ny=STAMP, scale=1).array


def write(path, stamps, psf, image, noise):
    """One image of a square grid of stamps in the layout of `measure`."""
    grid = round(len(stamps) ** 0.5)
    rows = (stamps + noise).reshape(grid, grid, STAMP, STAMP).transpose(0, 2, 1, 3)
    galaxies = fits.PrimaryHDU(rows.reshape(grid * STAMP, grid * STAMP).astype(np.float32))
    for key, value in dict(SET=1, IMAGE=image, STAMP=STAMP, NGRID=grid, NOISESIG=1.0).items():
        galaxies.header[key] = value
    galaxies.writeto(path / f"galaxies-{image:03}.fits")
    star = fits.PrimaryHDU(psf.astype(np.float32))
    star.header["STAMP"] = STAMP
    star.writeto(path / f"psf-{image:03}.fits")


def measure(command, stamps, psf, noise):
    """Tables of the four versions with one field of noise."""
    with tempfile.TemporaryDirectory() as folder:
        data, out = Path(folder) / "data", Path(folder) / "out"
        (data / "set01").mkdir(parents=True)
        for version in range(4):
            write(data / "set01", stamps[version], psf, version + 1, noise)
        subprocess.run(command + ["--data", str(data), "--out", str(out)], check=True, capture_output=True)
        tables = [pq.read_table(out / f"set01/catalogue-{version + 1:03}.parquet") for version in range(4)]
    return {name: np.array([t[name].to_numpy() for t in tables]) for name in COLUMNS}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--binary", default="target/release/shearq")
    parser.add_argument("--submission", default="48/linear/star")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--grid", type=int, default=64, help="galaxies a side of an image, an even number")
    parser.add_argument("--fields", type=int, default=40, help="fields of noise for each galaxy")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    cells = options.grid**2
    command = [options.binary, "measure", "--submission", options.submission]
    print(f"{options.submission}, {cells} galaxies x 4 versions x {options.fields} fields of noise, seed {options.seed}")
    print("kind            m1, m2 (1e-3)                   c1, c2 (1e-4)                   flagged", flush=True)
    for kind in options.kinds.split(","):
        rng = np.random.default_rng([options.seed, list(KINDS).index(kind)])
        stamps, psf = render(kind, cells, rng)
        fields = []
        for field in range(options.fields):
            noise = -noise if field % 2 else rng.standard_normal(size=stamps[0].shape, dtype=np.float32)
            fields.append(measure(command, stamps, psf, noise))
        column = lambda name: np.array([field[name] for field in fields])
        line, flagged = f"{kind:14}", column("flags") != 0
        good = ~flagged.any(1)
        slopes, offsets = [], []
        for k in range(2):
            response = np.where(flagged, np.nan, column(f"R{k + 1}{k + 1}"))
            mean = np.nanmean(response)
            e = np.where(good[:, None], column(f"e{k + 1}"), np.nan)
            signs = np.array([shear[k] for _, shear in VERSIONS])
            slope = (e * signs[:, None]).sum(1) / (4 * SHEAR)
            surplus = (slope - response.mean(1)) / mean

            def figure(values, scale):
                # The fields of two galaxies that differ by a turn share a shape: their mean is one sample.
                own = np.nanmean(values, 0).reshape(-1, 2).mean(1)
                return f"{scale * own.mean():7.2f} +- {scale * own.std() / np.sqrt(len(own)):.2f}"

            slopes.append(figure(surplus, 1e3))
            offsets.append(figure(e.mean(1) / mean, 1e4))
        print(f"{line}{slopes[0]}, {slopes[1]}  {offsets[0]}, {offsets[1]}  {flagged.sum()}", flush=True)


if __name__ == "__main__":
    main()
