#!/usr/bin/env python3
"""A small survey, rendered by GalSim (pip install galsim sep astropy): three dithered exposures of different orientation behind
a halo, with variance maps, and the galaxies that sep detects. docs/survey.md goes on from here."""

import galsim
import numpy as np
import sep
from astropy.io import fits
from astropy.wcs import WCS

SIDE, STAMP, SCALE = 1500, 64, 0.2  # px, px, arcsec
EINSTEIN, CORE, RADIUS = 12.0, 30.0, 130.0  # arcsec: of the halo, and of the field
HALO = galsim.CelestialCoord(150.0 * galsim.degrees, 2.0 * galsim.degrees)
EXPOSURES = [  # position angle in degrees, parity, FWHM in arcsec, dither in px
    (37, 1, 0.70, (0, 0)),
    (-64, -1, 0.80, (17.3, -9.6)),
    (110, 1, 0.75, (-12.1, 21.4)),
]
rng = np.random.default_rng(1)

# Galaxies on a coarse grid, so that stamps contain one, with the shear of an isothermal sphere.
galaxies = []
for place in np.ndindex(25, 25):
    u, v = 11.0 * (np.array(place) - 12) + rng.uniform(-1, 1, 2)
    radius, angle = np.hypot(u, v), np.arctan2(v, u)
    if CORE < radius < RADIUS:
        gamma = EINSTEIN / (2 * radius)
        g = -gamma / (1 - gamma) * np.exp(2j * angle)  # tangential, with κ = γ
        e = min(abs(rng.normal(0, 0.15)), 0.6) * np.exp(1j * rng.uniform(0, 2 * np.pi))
        profile = galsim.Exponential(half_light_radius=rng.uniform(0.5, 0.8), flux=rng.uniform(300, 1000))
        profile = profile.shear(g1=e.real, g2=e.imag).shear(g1=g.real, g2=g.imag)
        galaxies.append((HALO.deproject(u * galsim.arcsec, v * galsim.arcsec), profile))

for number, (angle, parity, fwhm, dither) in enumerate(EXPOSURES, 1):
    # From pixels to (u, v), +u west and +v north.
    turn = np.radians(angle)
    matrix = SCALE * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ np.diag([parity, 1])
    origin = galsim.PositionD(SIDE / 2 + 0.5 + dither[0], SIDE / 2 + 0.5 + dither[1])
    wcs = galsim.TanWCS(galsim.AffineTransform(*matrix.ravel(), origin=origin), HALO)
    psf = galsim.Moffat(beta=3, fwhm=fwhm).shear(g1=0.03, g2=-0.02)
    image = galsim.ImageF(SIDE, SIDE, wcs=wcs)
    for position, profile in galaxies:
        center = wcs.toImage(position)
        stamp = galsim.Convolve(profile, psf).drawImage(nx=STAMP, ny=STAMP, wcs=wcs.local(center), center=center)
        overlap = stamp.bounds & image.bounds
        image[overlap] += stamp[overlap]
    # One amplifier is noisier than the other.
    variance = np.ones((SIDE, SIDE), np.float32)
    variance[:, SIDE // 2 :] = 2.0
    image.array[:] += rng.normal(size=variance.shape) * np.sqrt(variance)
    header = fits.Header()
    wcs.writeToFitsHeader(header, image.bounds)
    fits.writeto(f"exposure-{number}.fits", image.array, header, overwrite=True)
    fits.writeto(f"variance-{number}.fits", variance, header, overwrite=True)
    star = psf.drawImage(nx=STAMP, ny=STAMP, wcs=wcs.local(origin))
    fits.writeto(f"star-{number}.fits", star.array, overwrite=True)
    if number == 1:
        pixels = image.array.astype(float)
        found = sep.extract(pixels, 2.0, var=variance.astype(float), minarea=5)
        ra, dec = WCS(header).all_pix2world(found["x"], found["y"], 0)
        bright = found["flux"] > 100
        rows = zip(np.arange(len(found))[bright], ra[bright], dec[bright], found["flux"][bright])
        with open("objects.csv", "w") as table:
            table.write("id,ra,dec,sep_flux\n")
            table.writelines(f"{id},{ra:.8f},{dec:.8f},{flux:.1f}\n" for id, ra, dec, flux in rows)
        print(f"{bright.sum()} objects of {len(galaxies)} galaxies")
