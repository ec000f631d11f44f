#!/usr/bin/env python3
"""Images as one might have them, rendered by GalSim (pip install galsim astropy): a field of one shear as a cube of
stamps. docs/own-images.md goes on from here."""

import galsim
import numpy as np
from astropy.io import fits

STAMP, SNR = 48, 30.0
rng = np.random.default_rng(1)
psf = galsim.Moffat(beta=3, fwhm=3.4).shear(g1=0.02, g2=-0.015)


def drawn(profile):
    return profile.drawImage(nx=STAMP, ny=STAMP, scale=1.0).array


# All galaxies have the flux that gives a round one this S/N. Scaled after lensing, their flux would depend on shear (m of 4e-3).
light = galsim.DeVaucouleurs(half_light_radius=2.3) + galsim.Exponential(half_light_radius=4.8)
round_galaxy = light * (SNR / np.sqrt(np.sum(drawn(galsim.Convolve(psf, light)) ** 2)))


def stamp(shear, intrinsic, noise):
    """A galaxy under a shear (g1, g2), in noise of one a pixel."""
    galaxy = round_galaxy.shear(g1=intrinsic[0], g2=intrinsic[1]).shear(g1=shear[0], g2=shear[1])
    image = drawn(galsim.Convolve(psf, galaxy.shift(*rng.uniform(-0.5, 0.5, 2))))
    return (image + noise).astype(np.float32)


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
