"""m and c of galaxies that are measured with another PSF than the one they were drawn with, less those of the first case.

A bulge with half of the light (Sérsic n = 2, half-light radius 0.6 of the disc's) and an exponential disc of 2.2 to 4 px, S/N 60, behind a Moffat PSF of β = 3 and
FWHM 3.4 px with e = (0.03, −0.02). Galaxies come in fours, turned by 45 degrees each, under (γ, γ) and (−γ, −γ), γ = 0.02, with the same noise.

`python3 tests/stress/psf_errors.py --shearq target/release/shearq [--galaxies N] [CASE ...]` needs galsim, astropy and pyarrow.
"""

import argparse
import pathlib
import subprocess
import tempfile

import galsim
import numpy as np
import pyarrow.parquet
from astropy.io import fits

from scenes import ACCURACY, PSF_SHAPE, SHEAR, TURNS

SIDE = 48
FWHM = 3.4


def moffat(fwhm=FWHM, beta=3.0, **shape):
    return galsim.Moffat(beta=beta, fwhm=fwhm).shear(**(shape or PSF_SHAPE))


TRUE = moffat()
# The width of a PSF from the ground follows the wavelength to the power −0.2; a redder star by 0.1 in ln λ has 2 % less.
RED, BLUE = moffat(FWHM * 0.99), moffat(FWHM * 1.01)

def image_of(psf):
    return psf.drawImage(nx=SIDE, ny=SIDE, scale=1.0).array


# (PSFs of bulge and disc, image of the PSF that is used)
CASES = {
    "none": (TRUE, TRUE, image_of(TRUE)),
    "size +1 %": (TRUE, TRUE, image_of(moffat(1.01 * FWHM))),
    "size -1 %": (TRUE, TRUE, image_of(moffat(0.99 * FWHM))),
    "ellipticity +0.005, 0": (TRUE, TRUE, image_of(moffat(g1=0.035, g2=-0.02))),
    "Kolmogorov of the same FWHM": (TRUE, TRUE, image_of(galsim.Kolmogorov(fwhm=FWHM).shear(**PSF_SHAPE))),
    "without the pixel": (TRUE, TRUE, TRUE.drawImage(nx=SIDE, ny=SIDE, scale=1.0, method="no_pixel").array),
    "stars redder by 0.1 in ln λ": (TRUE, TRUE, image_of(moffat(0.98 * FWHM))),
    "stars bluer by 0.1 in ln λ": (TRUE, TRUE, image_of(moffat(1.02 * FWHM))),
    "bulge redder than the disc by 0.1 in ln λ": (RED, BLUE, 0.5 * (image_of(RED) + image_of(BLUE))),
    "stars broader by charge: σ² + 1 %": (TRUE, TRUE, image_of(moffat(1.005 * FWHM))),
}


def scene(psfs, galaxies, seed):
    """Stamps under ±γ of the same galaxies, and their noise."""
    rng = np.random.default_rng(seed)
    stamps = np.empty((2, galaxies, SIDE, SIDE), np.float32)
    for four in range(galaxies // TURNS):
        radius, e = rng.uniform(2.2, 4.0), min(rng.rayleigh(0.2), 0.6)
        for turn in range(TURNS):
            place = rng.uniform(-0.5, 0.5, 2)
            for sign in range(2):
                shear = SHEAR * (1 - 2 * sign)
                light = 0
                parts = (galsim.Sersic(2.0, half_light_radius=0.6 * radius), galsim.Exponential(half_light_radius=radius))
                for part, psf in zip(parts, psfs):
                    part = part.shear(g1=e).rotate((45 * turn + 7 * four) * galsim.degrees).shear(g1=shear, g2=shear)
                    image = galsim.Convolve(0.5 * part, psf, gsparams=ACCURACY)
                    light += image.drawImage(nx=SIDE, ny=SIDE, scale=1.0, offset=tuple(place)).array
                stamps[sign, TURNS * four + turn] = light
    sigma = np.median(np.sqrt((stamps[0] ** 2).sum((1, 2)))) / 60
    return stamps + sigma * rng.normal(size=stamps.shape[1:]).astype(np.float32)


def measured(shearq, folder, stamps, psf):
    def run(*arguments):
        subprocess.run([shearq, *map(str, arguments)], cwd=folder, check=True, capture_output=True)

    fits.writeto(folder / "psf.fits", psf.astype(np.float32), overwrite=True)
    found = []
    for name, of_sign in zip(("plus", "minus"), stamps):
        fits.writeto(folder / f"{name}.fits", of_sign, overwrite=True)
        run("gather", "--stamps", f"{name}.fits", "--psf", "psf.fits", "--out", name)
        run("measure", "--submission", "48/linear/star", "--data", name, "--out", f"{name}-out")
        found.append(pyarrow.parquet.read_table(folder / f"{name}-out/set01/catalogue-001.parquet").to_pandas())
    return found


def biases(catalogues):
    """m and c of both components: of all galaxies, and without each of 20 blocks of fours in turn."""
    good = np.all([c["flags"] == 0 for c in catalogues], axis=0).reshape(-1, TURNS).all(1)
    sums = [c[["e1", "e2", "R11", "R12", "R21", "R22"]].to_numpy().reshape(-1, TURNS, 6).sum(1) for c in catalogues]
    block = np.arange(len(good)) % 20

    def of(keep):
        plus, minus = (np.linalg.solve(s[keep, 2:].sum(0).reshape(2, 2), s[keep, :2].sum(0)) for s in sums)
        return np.concatenate([(plus - minus) / (2 * SHEAR) - 1, (plus + minus) / 2])

    return np.array([of(good)] + [of(good & (block != b)) for b in range(20)])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=list(CASES))
    parser.add_argument("--shearq", type=pathlib.Path, required=True)
    parser.add_argument("--galaxies", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=7717)
    options = parser.parse_args()
    key = first = None
    for case in options.cases:
        *psfs, used = CASES[case]
        if key != tuple(map(repr, psfs)):
            key, stamps = tuple(map(repr, psfs)), scene(psfs, options.galaxies, options.seed)
        with tempfile.TemporaryDirectory() as folder:
            found = biases(measured(options.shearq.resolve(), pathlib.Path(folder), stamps, used))
        # With the right PSF, the same galaxies and noise have the m of the first case.
        first = found.copy() if first is None else first
        found -= first
        error = np.sqrt(19 * found[1:].var(0))
        m = "m = {:+.1f}, {:+.1f} ± {:.1f}".format(*1e3 * found[0, :2], 1e3 * error[:2].max())
        c = "c = {:+.2f}, {:+.2f} ± {:.2f} (10⁻³)".format(*1e3 * found[0, 2:], 1e3 * error[2:].max())
        print(f"{case:44} {m}, {c}", flush=True)


if __name__ == "__main__":
    main()
