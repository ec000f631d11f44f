#!/usr/bin/env python3
"""Make the images in this folder.

    python3 tests/data/galsim/make.py SETS COSMOS OUT

SETS: the four sets of 16 × 16 galaxies that GalSim rendered (tests compare with all of them if they are in
`../shared/galsim-sets`). The first 6 × 6 galaxies of each image go to OUT: a tenth of the bytes.
COSMOS: the folder of `real_galaxy_catalog_23.5_example.fits`, which GalSim distributes. 256 of its galaxies go to
OUT/cosmos.

Galaxies are stored as 16-bit integers in units of 1/64 of the noise, which adds 2e-5 to the variance of a pixel.
PSFs keep their 32 bits. Needs numpy, astropy and galsim.
"""

import argparse
import csv
from pathlib import Path

import galsim
import numpy as np
from astropy.io import fits

STAMP = 48
#: Galaxies per axis that are kept.
KEPT = 6
#: Galaxies per axis of the COSMOS image.
COSMOS_GRID = 16
CATALOGUE = "real_galaxy_catalog_23.5_example.fits"
#: Arcseconds per pixel of the COSMOS image.
PIXEL = 0.2
#: Steps per noise of the stored integers.
STEPS = 64


def write_galaxies(path, pixels, header):
    """Store an image of noise 1 as integers."""
    pixels = np.rint(pixels * STEPS)
    assert np.abs(pixels).max() < 2**15
    image = fits.PrimaryHDU(pixels.astype(np.int16))
    image.header.update(header)
    # After the pixels are set, so that they are not scaled again.
    image.header["BSCALE"] = 1 / STEPS
    image.header["BZERO"] = 0.0
    image.writeto(path, overwrite=True)


def write_psf(path, pixels, header):
    image = fits.PrimaryHDU(pixels.astype(np.float32))
    image.header.update(header)
    image.writeto(path, overwrite=True)


def kept(header):
    """The header of an image with fewer galaxies."""
    header = {key: header[key] for key in ("SET", "IMAGE", "STAMP", "NGRID", "NOISESIG") if key in header}
    if "NGRID" in header:
        header["NGRID"] = KEPT
    return header


def cut(source, target):
    """Keep the first galaxies of a set."""
    target.mkdir(parents=True, exist_ok=True)
    side = KEPT * STAMP
    for path in sorted(source.iterdir()):
        if path.suffix == ".fits":
            pixels, header = fits.getdata(path)[:side, :side], kept(fits.getheader(path))
            write = write_psf if path.name.startswith("psf") else write_galaxies
            write(target / path.name, pixels, header)
            continue
        with path.open(newline="") as lines:
            head, *rows = csv.reader(lines)
        rows = [row for row in rows if float(row[0]) < side and float(row[1]) < side]
        with (target / path.name).open("w", newline="") as lines:
            csv.writer(lines, lineterminator="\n").writerows([head, *rows])


def cosmos(folder, target):
    """Galaxies of the COSMOS catalogue with their fitted profiles and fluxes; a quarter is below S/N 12."""
    target.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(23)
    catalogue = galsim.COSMOSCatalog(CATALOGUE, dir=str(folder), use_real=False, exclusion_level="none")
    psf = galsim.Moffat(beta=3, fwhm=3.4).shear(g1=0.03, g2=-0.02)
    stamps = np.empty((COSMOS_GRID**2, STAMP, STAMP))
    for stamp in stamps:
        galaxy = catalogue.makeGalaxy(int(random.integers(catalogue.nobjects)), gal_type="parametric")
        galaxy = galaxy.rotate(random.uniform(0, 360) * galsim.degrees).dilate(1 / PIXEL)
        galaxy = galaxy.shift(*random.uniform(-0.5, 0.5, 2))
        stamp[:] = galsim.Convolve(galaxy, psf).drawImage(nx=STAMP, ny=STAMP, scale=1).array
    stamps *= 12 / np.percentile(np.sqrt((stamps**2).sum((1, 2))), 25)
    stamps += random.standard_normal(stamps.shape)
    mosaic = stamps.reshape(COSMOS_GRID, COSMOS_GRID, STAMP, STAMP).transpose(0, 2, 1, 3)
    side = COSMOS_GRID * STAMP
    header = {"SET": 1, "IMAGE": 1, "STAMP": STAMP, "NGRID": COSMOS_GRID, "NOISESIG": 1.0}
    write_galaxies(target / "galaxies-001.fits", mosaic.reshape(side, side), header)
    write_psf(target / "psf-001.fits", psf.drawImage(nx=STAMP, ny=STAMP, scale=1).array, {"STAMP": STAMP})


def main():
    parser = argparse.ArgumentParser()
    for name in ("sets", "cosmos", "out"):
        parser.add_argument(name, type=Path)
    options = parser.parse_args()
    for source in sorted(options.sets.glob("set??")):
        cut(source, options.out / "sets" / source.name)
    cosmos(options.cosmos, options.out / "cosmos" / "set01")


if __name__ == "__main__":
    main()
