#!/usr/bin/env python3
"""Images as one might have them, rendered by GalSim (pip install galsim astropy): a field of one shear as a cube of
stamps, and a small challenge of one set in shearq's layout. docs/own-images.md goes on from here."""

from pathlib import Path

import galsim
import numpy as np
from astropy.io import fits

STAMP, SNR = 48, 30.0
rng = np.random.default_rng(1)
psf = galsim.Moffat(beta=3, fwhm=3.4).shear(g1=0.02, g2=-0.015)


def drawn(profile):
    return profile.drawImage(nx=STAMP, ny=STAMP, scale=1.0).array


def stamp(shear, intrinsic, noise):
    """A galaxy of S/N 30 under a shear (g1, g2), in noise of one a pixel."""
    bulge, disc = galsim.DeVaucouleurs(half_light_radius=2.3), galsim.Exponential(half_light_radius=4.8)
    galaxy = (bulge + disc).shear(g1=intrinsic[0], g2=intrinsic[1]).shear(g1=shear[0], g2=shear[1])
    image = drawn(galsim.Convolve(psf, galaxy.shift(*rng.uniform(-0.5, 0.5, 2))))
    return (image * SNR / np.sqrt(np.sum(image**2)) + noise).astype(np.float32)


def ellipticity():
    size = min(abs(rng.normal(0, 0.2)), 0.7)
    angle = rng.uniform(0, 2 * np.pi)
    return size * np.cos(angle), size * np.sin(angle)


# A field of one shear. Every galaxy comes again turned by 90 degrees, so that the shapes cancel in the mean.
stamps = []
for _ in range(200):
    e = ellipticity()
    for sign in (1, -1):
        noise = rng.normal(0, 1, (STAMP, STAMP))
        stamps.append(stamp((0.02, -0.01), (sign * e[0], sign * e[1]), noise))
fits.writeto("field.fits", np.array(stamps), overwrite=True)
fits.writeto("star.fits", drawn(psf).astype(np.float32), overwrite=True)

# A challenge: two images of 16 x 16 galaxies under one field of shear, plane waves of E modes.
N = 16
place = np.arange(N)
x, y = np.meshgrid(place, place)
g1, g2 = np.zeros((N, N)), np.zeros((N, N))
for kx in range(-5, 6):
    for ky in range(0, 6):
        if kx or ky:
            wave = 0.05 / np.hypot(kx, ky) * np.cos(2 * np.pi * (kx * x + ky * y) / N + rng.uniform(0, 2 * np.pi))
            angle = 2 * np.arctan2(ky, kx)
            g1 += wave * np.cos(angle)
            g2 += wave * np.sin(angle)
folder = Path("challenge/set01")
folder.mkdir(parents=True, exist_ok=True)
for image in (1, 2):
    mosaic = np.zeros((N * STAMP, N * STAMP), np.float32)
    for iy in range(N):
        for ix in range(N):
            noise = rng.normal(0, 1, (STAMP, STAMP))
            part = stamp((g1[iy, ix], g2[iy, ix]), ellipticity(), noise)
            mosaic[iy * STAMP : (iy + 1) * STAMP, ix * STAMP : (ix + 1) * STAMP] = part
    fits.writeto(folder / f"galaxies-{image:03}.fits", mosaic, overwrite=True)
    fits.writeto(folder / f"psf-{image:03}.fits", drawn(psf).astype(np.float32), overwrite=True)
with open(folder / "truth.csv", "w") as truth:
    truth.write("x,y,g1,g2\n")
    for iy in range(N):
        for ix in range(N):
            truth.write(f"{ix * STAMP + 24.5},{iy * STAMP + 24.5},{g1[iy, ix]},{g2[iy, ix]}\n")
