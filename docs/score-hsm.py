#!/usr/bin/env python3
"""Measures the set in `data` with GalSim's REGAUSS (pip install galsim astropy). docs/tutorial-score.md goes on from here."""

import csv
from pathlib import Path

import galsim
import numpy as np
from astropy.io import fits

STAMP = 48
folder = Path("hsm/set02")
folder.mkdir(parents=True, exist_ok=True)
for mosaic in sorted(Path("data/set02").glob("galaxies-*.fits")):
    number = mosaic.stem.split("-")[1]
    pixels, header = fits.getdata(mosaic).astype(float), fits.getheader(mosaic)
    psf = galsim.Image(fits.getdata(f"data/set02/psf-{number}.fits").astype(float))
    rows = []
    for top, left in np.ndindex(pixels.shape[0] // STAMP, pixels.shape[1] // STAMP):
        stamp = pixels[top * STAMP : (top + 1) * STAMP, left * STAMP : (left + 1) * STAMP].copy()
        found = galsim.hsm.EstimateShear(
            galsim.Image(stamp), psf, sky_var=header["NOISESIG"] ** 2, shear_est="REGAUSS", strict=False
        )
        failed = found.correction_status != 0
        # FITS pixels of the centre of the stamp. REGAUSS gives distortions.
        center = (left * STAMP + (STAMP + 1) / 2, top * STAMP + (STAMP + 1) / 2)
        rows.append([*center, found.corrected_e1, found.corrected_e2, int(failed)])
    with open(folder / f"hsm-{number}.csv", "w", newline="") as table:
        writer = csv.writer(table)
        writer.writerow(["x", "y", "e1", "e2", "flag"])
        writer.writerows(rows)
    print(f"image {number}: {sum(row[4] for row in rows)} of {len(rows)} galaxies failed")
