#!/usr/bin/env python3
"""Measures the data of docs/compare-your-code.md by GalSim's HSM: python3 hsm.py DATA OUT (pip install galsim astropy).

Writes OUT/CODE/SN/VERSION.csv for the codes regauss and ksb, with one row per galaxy. A code of your own needs this loop, and its
own lines in place of `EstimateShear`.
"""

import csv
import sys
from pathlib import Path

import galsim
import numpy as np
from astropy.io import fits


def stamps(mosaic, size):
    for top, left in np.ndindex(mosaic.shape[0] // size, mosaic.shape[1] // size):
        # HSM needs native byte order and its own memory.
        yield mosaic[top * size : (top + 1) * size, left * size : (left + 1) * size].astype(float)


# Largest modulus of an ellipticity: distortions above 2 are cut, as HSC does, and shears above 1. A few of them would determine
# all scatter.
MAX_MODULUS = {"regauss": 2.0, "ksb": 1.0}


def shape(found, code):
    e1, e2 = (found.corrected_e1, found.corrected_e2) if code == "regauss" else (found.corrected_g1, found.corrected_g2)
    if found.correction_status != 0 or not np.hypot(e1, e2) <= MAX_MODULUS[code]:
        return ["nan", "nan", 1]
    return [f"{e1:.7f}", f"{e2:.7f}", 0]


def measure(version, out):
    """Measures the galaxies under one shear: VERSION/setNN/galaxies-001.fits with the PSF beside it."""
    (path,) = version.glob("set*/galaxies-001.fits")
    mosaic, header = fits.getdata(path), fits.getheader(path)
    psf = galsim.Image(fits.getdata(path.with_name("psf-001.fits")).astype(float))
    g1, g2 = (float(part) for part in version.name.removesuffix("_rotated").removeprefix("g1_").split("_g2_"))
    # REGAUSS gives distortions, whose mean is divided by the responsivity of the intrinsic shapes. A survey knows their scatter
    # from deep fields, this comparison from the simulation.
    intrinsic = np.genfromtxt(path.with_name("intrinsic-001.csv"), delimiter=",", names=True)
    modulus = np.hypot(intrinsic["e1"], intrinsic["e2"])
    rms_e = np.sqrt(np.mean((2 * modulus / (1 + modulus**2)) ** 2) / 2)
    names = {"regauss": ("corrected_e1", "corrected_e2", "rms_e"), "ksb": ("corrected_g1", "corrected_g2")}
    tables = {}
    for code in names:
        target = out / code / version.parent.name / f"{version.name}.csv"
        target.parent.mkdir(parents=True, exist_ok=True)
        tables[code] = (target.open("w", newline=""), [rms_e][: len(names[code]) - 2])
    writers = {code: csv.writer(file) for code, (file, _) in tables.items()}
    for code, writer in writers.items():
        writer.writerow(["id", "g1", "g2", *names[code][:2], "flag", *names[code][2:]])
    for number, stamp in enumerate(stamps(mosaic, header["STAMP"])):
        for code, writer in writers.items():
            found = galsim.hsm.EstimateShear(
                galsim.Image(stamp), psf, sky_var=header["NOISESIG"] ** 2, shear_est=code.upper(), strict=False
            )
            writer.writerow([number, g1, g2, *shape(found, code), *(f"{own:.5f}" for own in tables[code][1])])
    for file, _ in tables.values():
        file.close()


if __name__ == "__main__":
    data, out = map(Path, sys.argv[1:3])
    for version in sorted(data.glob("sn*/g1_*")):
        measure(version, out)
        print(version)
