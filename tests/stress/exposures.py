"""Exposures by the command line: noise that differs over the image, Poisson noise of the galaxies, and a halo on the sky.

Galaxies of the case `mixed` come in fours, turned by 45 degrees each, under shears of (γ, γ) and (−γ, −γ), γ = 0.02; both get the same
noise, added and taken away. m is the mean difference of e before calibration over 2γ and the mean response matrix, less 1.

* `depths`: the left half has half of the noise of the right one. `--variance` is the map, `image` measures one noise for all.
* `poisson1000`, `poisson100`, `poisson10`: S/N 30 with so many electrons of sky per pixel, with and without `--gain`.
* `halo`: shears of an isothermal sphere through a WCS (TAN, turned by 37 degrees and mirrored), and TreeCorr's tangential shear from ra, dec,
  e1 and e2 of the catalogue.

`python3 tests/stress/exposures.py --shearq target/release/shearq [CASE ...]` needs galsim, astropy, pyarrow, pandas and treecorr.
"""

import argparse
import pathlib
import subprocess
import tempfile

import galsim
import numpy as np
import pyarrow.parquet
from astropy.io import fits
from astropy.wcs import WCS

from scenes import ACCURACY, PSF_SHAPE, SHEAR, TURNS, Galaxies

SIDE = 48
SPACING = 56
PSF = galsim.Moffat(beta=3, fwhm=3.4).shear(**PSF_SHAPE)
CASES = ("depths", "poisson1000", "poisson100", "poisson10", "halo")


def scenes(n, rng):
    """Exposures [sign, y, x] of n × n galaxies of mean square light one on their stamps, and their places, from 1."""
    side = n * SPACING
    exposures = np.zeros((2, side, side), np.float32)
    galaxies, places = Galaxies("mixed", None), []
    for four in range(n * n // TURNS):
        galaxy, stamps = galaxies(rng), np.empty((2, TURNS, SIDE, SIDE), np.float32)
        for turn in range(TURNS):
            offset, own = rng.uniform(-0.5, 0.5, 2), galaxy.rotate(45 * turn * galsim.degrees)
            x, y = (SPACING * k + SPACING // 2 for k in ((four * TURNS + turn) % n, (four * TURNS + turn) // n))
            places.append((x + 0.5 + offset[0], y + 0.5 + offset[1]))
            for sign in range(2):
                shear = SHEAR * (1 - 2 * sign)
                image = galsim.Convolve(own.shear(g1=shear, g2=shear), PSF, gsparams=ACCURACY)
                stamps[sign, turn] = image.drawImage(nx=SIDE, ny=SIDE, scale=1.0, offset=offset).array
        stamps /= np.sqrt((stamps.astype(float) ** 2).sum((2, 3)).mean())
        for turn in range(TURNS):
            k = four * TURNS + turn
            x, y = (SPACING * i + SPACING // 2 - SIDE // 2 for i in (k % n, k // n))
            exposures[:, y : y + SIDE, x : x + SIDE] = stamps[:, turn]
    return exposures, np.array(places)


class Folder:
    """A folder for the files of a case."""

    def __init__(self, shearq):
        self.shearq = shearq
        self.made = tempfile.TemporaryDirectory()
        self.path = pathlib.Path(self.made.name)
        fits.writeto(self.path / "psf.fits", PSF.drawImage(nx=SIDE, ny=SIDE, scale=1.0).array.astype(np.float32))

    def run(self, *arguments):
        done = subprocess.run([self.shearq, *map(str, arguments)], cwd=self.path, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(done.stderr)
        return done.stderr

    def measure(self, name, exposures, places, *options, header=None):
        """The catalogues of exposures."""
        lines = "".join(f"{k},{x},{y}\n" for k, (x, y) in enumerate(places))
        (self.path / "places.csv").write_text("id,x,y\n" + lines)
        for image, exposure in enumerate(exposures, 1):
            fits.writeto(self.path / "exposure.fits", exposure.astype(np.float32), header, overwrite=True)
            self.run("gather", "--exposure", "exposure.fits", "--positions", "places.csv", "--psf", "psf.fits",
                     "--size", SIDE, "--image", image, "--out", name, *options)
        self.run("measure", "--submission", "48/linear/star", "--data", name, "--out", name + "-out")
        paths = sorted((self.path / f"{name}-out/set01").glob("catalogue-*.parquet"))
        return [pyarrow.parquet.read_table(path).to_pandas() for path in paths]


def bias(catalogues, chosen):
    """m1 and m2 with errors, of catalogues (+γ, +n), (−γ, +n), (+γ, −n), (−γ, −n), from whole fours."""
    good = chosen & np.all([c["flags"] == 0 for c in catalogues], axis=0)
    whole = good.reshape(-1, TURNS).all(1).repeat(TURNS)
    e = [np.stack([c["e1"], c["e2"]], 1)[whole] for c in catalogues]
    response = np.mean([c[["R11", "R12", "R21", "R22"]].to_numpy()[whole].mean(0) for c in catalogues], 0).reshape(2, 2)
    own = np.mean([c[["R11", "R12", "R21", "R22"]].to_numpy()[whole] for c in catalogues], 0).reshape(-1, 2, 2)
    difference = ((e[0] - e[1]) + (e[2] - e[3])) / 4 / SHEAR
    left = np.linalg.solve(response, (difference - own.sum(2)).T).T.reshape(-1, TURNS, 2).mean(1)
    return left.mean(0), left.std(0) / np.sqrt(len(left)), 1 - whole.sum() / chosen.sum()


def shown(name, found):
    m, error, flagged = found
    print(f"{name:28} m = {1e3 * m[0]:+7.1f}, {1e3 * m[1]:+7.1f} ± {1e3 * error.max():.1f} (10⁻³), {100 * flagged:.1f} % left out", flush=True)


def depths(folder, n, rng):
    scene, places = scenes(n, rng)
    side = n * SPACING
    sigma = np.where(np.arange(side) < side // 2, 0.5, 1.0) * np.ones((side, 1))
    noise = rng.normal(size=(side, side)) * sigma
    light = 15.0
    exposures = [light * scene[sign] + add * noise for add in (1, -1) for sign in (0, 1)]
    fits.writeto(folder.path / "map.fits", (sigma**2).astype(np.float32))
    for name, options in (("image", ()), ("variance", ("--variance", "map.fits"))):
        found = folder.measure(name, exposures, places, *options)
        for half, chosen in (("deep", places[:, 0] < side // 2), ("shallow", places[:, 0] >= side // 2)):
            shown(f"depths {name} {half}", bias(found, chosen))


def poisson(folder, n, rng, sky):
    scene, places = scenes(n, rng)
    # The S/N of the sky alone is 30.
    scene *= 30.0 * np.sqrt(sky)
    field = rng.normal(size=scene[0].shape)
    noise = [field * np.sqrt(sky + np.maximum(light, 0)) for light in scene]
    exposures = [scene[sign] + add * noise[sign] for add in (1, -1) for sign in (0, 1)]
    for name, options in (("sky", ()), ("gain", ("--gain", 1))):
        found = folder.measure(f"{name}{sky}", exposures, places, *options)
        shown(f"poisson {sky} {name}", bias(found, np.ones(len(places), bool)))


def halo(folder, n, rng):
    import treecorr

    side, scale = n * SPACING, 0.2
    cos, sin = np.cos(np.radians(37)), np.sin(np.radians(37))
    header = fits.Header()
    header.update(CTYPE1="RA---TAN", CTYPE2="DEC--TAN", CRVAL1=150.0, CRVAL2=2.0, CRPIX1=side / 2 + 0.5, CRPIX2=side / 2 + 0.5)
    matrix = scale / 3600 * np.array([[cos, sin], [-sin, cos]])
    header.update(CD1_1=matrix[0, 0], CD1_2=matrix[0, 1], CD2_1=matrix[1, 0], CD2_2=matrix[1, 1])
    wcs, sky = WCS(header), galsim.FitsWCS(header=header)
    galaxies, exposure, places = Galaxies("mixed", None), np.zeros((side, side), np.float32), []
    psf = PSF.dilate(scale)
    einstein = 0.05 * side * scale
    for k in range(n * n):
        x, y = (SPACING * i + SPACING // 2 + 0.5 for i in (k % n, k // n))
        places.append((x, y))
        ra, dec = wcs.all_pix2world(x, y, 1)
        u, v = -(ra - 150.0) * np.cos(np.radians(2)) * 3600, (dec - 2.0) * 3600
        radius, angle = np.hypot(u, v), np.arctan2(v, u)
        gamma = -einstein / (2 * max(radius, 3 * einstein)) * np.exp(2j * angle)
        own = galaxies(rng).dilate(scale).rotate(rng.uniform(0, 180) * galsim.degrees).shear(g1=gamma.real, g2=gamma.imag)
        local = sky.local(galsim.PositionD(x, y))
        stamp = galsim.Convolve(own, psf, gsparams=ACCURACY).drawImage(nx=SIDE, ny=SIDE, wcs=local).array
        exposure[int(y) - 24 : int(y) + 24, int(x) - 24 : int(x) + 24] = stamp * 30 / np.sqrt((stamp**2).sum())
    fits.writeto(folder.path / "psf.fits", psf.drawImage(nx=SIDE, ny=SIDE, wcs=sky.local(galsim.PositionD(side / 2, side / 2))).array, overwrite=True)
    exposure += rng.normal(size=exposure.shape)
    [found] = folder.measure("halo", [exposure], places, header=header)
    found = found[found["flags"] == 0].copy()
    response = found[["R11", "R12", "R21", "R22"]].to_numpy().mean(0).reshape(2, 2)
    found[["e1", "e2"]] = np.linalg.solve(response, found[["e1", "e2"]].to_numpy().T).T
    lens = treecorr.Catalog(ra=[150.0], dec=[2.0], ra_units="deg", dec_units="deg")
    source = treecorr.Catalog(ra=found["ra"], dec=found["dec"], g1=found["e1"], g2=found["e2"], ra_units="deg", dec_units="deg")
    correlation = treecorr.NGCorrelation(min_sep=3 * einstein, max_sep=side * scale / 2, nbins=4, sep_units="arcsec")
    correlation.process(lens, source)
    error = np.hypot(found["e1"].std(), found["e2"].std()) / np.sqrt(2 * correlation.npairs)
    truth = einstein / (2 * correlation.meanr)
    for row in zip(correlation.meanr, truth, correlation.xi, error, correlation.xi_im):
        print("halo at {:6.1f} arcsec: truth {:+.4f}, γt {:+.4f} ± {:.4f}, γx {:+.4f}".format(*row))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=CASES)
    parser.add_argument("--shearq", type=pathlib.Path, required=True)
    parser.add_argument("--side", type=int, default=100, help="galaxies per side of an exposure, a multiple of 4")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    for case in options.cases:
        folder, rng = Folder(options.shearq.resolve()), np.random.default_rng(options.seed)
        if case.startswith("poisson"):
            poisson(folder, options.side, rng, int(case.removeprefix("poisson")))
        else:
            {"depths": depths, "halo": halo}[case](folder, options.side, rng)


if __name__ == "__main__":
    main()
