#!/usr/bin/env python3
"""Metadetection (Sheldon et al. 2020, ApJ 902, 138) of simulated scenes, to compare with `shearq detect` (pip install sep astropy
polars scipy): python metadetection.py SCENES OUT. Exposures have one PSF, square pixels and a noise of one."""

import sys
from pathlib import Path

import numpy as np
import polars as pl
import sep
from astropy.io import fits
from scipy import fft, ndimage

SCENES, OUT = Path(sys.argv[1]), Path(sys.argv[2])
STEPS = {"noshear": (0, 0), "1p": (0.01, 0), "1m": (-0.01, 0), "2p": (0, 0.01), "2m": (0, -0.01)}
THRESHOLD = 1.4  # of the detection, in σ of a pixel
WEIGHT_SIGMA = 2.5  # of the moments, in px: a FWHM of 1.2″ in the default scenes
# Between these the weight grows from 0 to 1; the size is xx + yy over that of the PSF. Cuts instead would make the response so noisy
# that m of 10⁵ galaxies has an error of 0.01.
SNR, SIZE = (8, 20), (1.1, 1.5)
EDGE = 30  # px without galaxies


class Shearer:
    """Deconvolves images from their PSF, shears them and convolves them with a round Gaussian, chosen as in ngmix."""

    def __init__(self, psf, side):
        self.side = side
        self.k = 2 * np.pi * np.stack(np.meshgrid(fft.fftfreq(side), fft.rfftfreq(side), indexing="ij"))  # (k_y, k_x)
        star = np.zeros((side, side))
        half = psf.shape[0] // 2
        star[: 2 * half, : 2 * half] = psf / psf.sum()
        # The PSF of `simulate` has its centre between the pixels half - 1 and half.
        self.transfer = fft.rfft2(star) * np.exp(1j * self.k.sum(0) * (half - 0.5))
        self.modulus = np.abs(fft.fftshift(fft.fft2(star)))
        square = (self.k**2).sum(0)
        self.variance = -2 * np.log(3e-3) / square[np.abs(self.transfer) < 0.01].min() * 1.02**2

    def image(self, image, g):
        # Where the PSF's transform is below 10⁻⁴, the Gaussian's is a thousandth of it.
        known = np.abs(self.transfer) > 1e-4
        return self.sheared(np.divide(fft.rfft2(image), self.transfer, out=np.zeros_like(self.transfer), where=known), g)

    def noise(self, noise, g):
        """Noise with the power that `image` gives to white noise, turned by 90 degrees: the sum of both is isotropic. It moves with the
        galaxies; otherwise they would lie on other noise in each image, which makes the response noisy."""
        matrix = shear_matrix(g)
        turned = matrix @ [[0, 1], [-1, 0]] @ np.linalg.inv(matrix)
        places = np.tensordot(turned, self.k, 1) * self.side / (2 * np.pi) + self.side // 2
        modulus = ndimage.map_coordinates(self.modulus, places, order=1, mode="nearest")
        return self.sheared(np.divide(fft.rfft2(noise), modulus, out=np.zeros_like(self.transfer), where=modulus > 1e-4), g)

    def sheared(self, deconvolved, g):
        inverse = np.linalg.inv(shear_matrix(g))
        # The Gaussian is round after the shear: it is that of S⁻¹k before it.
        square = (np.tensordot(inverse, self.k, 1) ** 2).sum(0)
        smooth = fft.irfft2(deconvolved * np.exp(-0.5 * self.variance * square), s=(self.side, self.side))
        centre = np.full(2, (self.side - 1) / 2)
        return ndimage.affine_transform(smooth, inverse, centre - inverse @ centre, order=5, mode="grid-wrap")


def shear_matrix(g):
    """Of vectors (y, x)."""
    return np.array([[1 - g[0], g[1]], [g[1], 1 + g[0]]]) / np.sqrt(1 - g[0] ** 2 - g[1] ** 2)


def moments(image, x, y):
    """e1, e2, xx + yy and flux in a Gaussian weight about the positions."""
    offsets = np.arange(-10, 11)
    column, row = np.rint(x).astype(int), np.rint(y).astype(int)
    stamps = image[row[:, None, None] + offsets[:, None], column[:, None, None] + offsets]
    dx, dy = offsets - (x - column)[:, None, None], offsets[:, None] - (y - row)[:, None, None]
    light = stamps * np.exp(-0.5 * (dx**2 + dy**2) / WEIGHT_SIGMA**2)
    flux, xx, yy, xy = (np.sum(light * factor, axis=(1, 2)) for factor in (1, dx**2, dy**2, dx * dy))
    return (xx - yy) / (xx + yy), 2 * xy / (xx + yy), (xx + yy) / flux, flux


def smooth_step(value, ends):
    x = np.clip((value - ends[0]) / (ends[1] - ends[0]), 0, 1)
    return x**2 * (3 - 2 * x)


def catalogue(image, noise, variance):
    """Rows of the galaxies on an image whose noise is known from an image of noise alone."""
    objects = sep.extract(image, THRESHOLD, err=noise.std())
    x, y = objects["x"], objects["y"]
    inner = (np.minimum(x, y) > EDGE) & (np.maximum(x, y) < len(image) - 1 - EDGE)
    x, y = x[inner], y[inner]
    e1, e2, size, flux = moments(image, x, y)
    grid = np.arange(EDGE, len(image) - EDGE, 12.0)
    snr = flux / moments(noise, *map(np.ravel, np.meshgrid(grid, grid)))[3].std()
    psf_size = 2 / (1 / variance + 1 / WEIGHT_SIGMA**2)
    weight = smooth_step(snr, SNR) * smooth_step(size / psf_size, SIZE)
    return pl.DataFrame({"e1": e1, "e2": e2, "w": weight, "snr": snr, "x": x + 1, "y": y + 1}).filter(pl.col("w") > 0)


for path in sorted(SCENES.glob("**/scene-*.fits"), key=lambda path: (path.name, path)):
    # plus/scene-001, as in shears.csv.
    out = OUT / path.relative_to(SCENES).with_suffix("") / "metadetection.parquet"
    if out.exists():
        continue
    image, psf = (fits.getdata(name).astype(float) for name in (path, path.with_name("psf.fits")))
    # The same noise for all versions of a scene, and its opposite where the exposure has the opposite noise.
    noise = np.random.default_rng(int(path.stem.split("-")[1])).normal(size=image.shape)
    noise *= -1 if "noise" in path.parent.name else 1
    shearer, rows = Shearer(psf, len(image)), []
    for name, g in STEPS.items():
        added = shearer.noise(noise, g)
        found = catalogue(shearer.image(image, g) + added, np.sqrt(2) * added, shearer.variance)
        rows.append(found.with_columns(mdet_step=pl.lit(name)))
    out.parent.mkdir(parents=True, exist_ok=True)
    pl.concat(rows).write_parquet(out)
    print(f"{out}: {len(rows[0])} galaxies", flush=True)
