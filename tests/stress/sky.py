"""m and c of shears on the sky behind pixels that are turned, mirrored and sheared there.

Galaxies of the case `mixed` come in fours, turned by 45 degrees each, under shears of (γ, γ) and (−γ, −γ) on the sky, γ = 0.02,
drawn through the WCS with a PSF of shape (0.03, −0.02) on the sky. Both shears have the same noise, added and taken away.
Estimates divide by the mean response matrix; errors are from the scatter between fours. `ignored` measures without the WCS.
`python3 tests/stress/sky.py [CASE ...]` needs galsim and the Python package of shearq.
"""

import argparse
import warnings

import galsim
import numpy as np
import shearq

from scenes import ACCURACY, PSF_SHAPE, SHEAR, TURNS, Galaxies

SIDE = 48
SCALE = 0.2
FWHM = 3.4


def turned(angle, mirrored=False, g1=0.0, g2=0.0):
    """A Jacobian: pixels that are sheared on the sky by (g1, g2), then mirrored, and turned by an angle in degrees."""
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turn = np.array([[cos, -sin], [sin, cos]]) @ np.diag([-1 if mirrored else 1, 1])
    shear = np.array([[1 + g1, g2], [g2, 1 - g1]]) / np.sqrt(1 - g1**2 - g2**2)
    return SCALE * turn @ shear


CASES = {
    "square": turned(0),
    "turned37": turned(37),
    "mirrored37": turned(37, mirrored=True),
    "jacobian": np.array([[0.02, 0.16], [0.157, -0.01]]),
    "sheared0.03": turned(0, g1=0.03),
    "sheared0.03-37": turned(37, g2=-0.03),
    "sheared0.05": turned(0, g1=-0.03, g2=0.04),
    "sheared0.05-m": turned(80, mirrored=True, g1=0.04, g2=0.03),
}


def scene(jacobian, count, snr, rng):
    """Stamps [sign, galaxy, y, x] of an S/N in noise of one, and their PSF."""
    wcs = galsim.JacobianWCS(*jacobian.ravel())
    scale = wcs.pixelArea() ** 0.5
    psf = galsim.Moffat(beta=3, fwhm=FWHM * scale).shear(**PSF_SHAPE)
    galaxies = Galaxies("mixed", None)
    stamps = np.empty((2, count, SIDE, SIDE), np.float32)
    for first in range(0, count, TURNS):
        galaxy = galaxies(rng).dilate(scale)
        for turn in range(TURNS):
            place = rng.uniform(-0.5, 0.5, 2)
            own = galaxy.rotate(45 * turn * galsim.degrees)
            for sign in range(2):
                shear = SHEAR * (1 - 2 * sign)
                image = galsim.Convolve(own.shear(g1=shear, g2=shear), psf, gsparams=ACCURACY)
                stamps[sign, first + turn] = image.drawImage(nx=SIDE, ny=SIDE, wcs=wcs, offset=place).array
        four = stamps[:, first : first + TURNS].astype(float)
        stamps[:, first : first + TURNS] *= snr / np.sqrt((four**2).sum((2, 3)).mean())
    return stamps, psf.drawImage(nx=SIDE, ny=SIDE, wcs=wcs, dtype=float).array


def measured(stamps, psf, wcs):
    """Ellipticities and responses before calibration, [e1, e2, R11, R12, R21, R22][galaxy]; NaN if flagged."""
    catalogue = shearq.measure(stamps, psf, noise=1.0, wcs=wcs)
    e = [catalogue[f"e{k}"] for k in "12"]
    return np.array([*e, *(np.where(catalogue.good, catalogue[f"R{k}"], np.nan) for k in ("11", "12", "21", "22"))])


def estimates(found):
    """m1, m2, c1 and c2, and their errors, of [sign, column, galaxy]."""
    good = np.isfinite(found).all((0, 1)).reshape(-1, TURNS).all(1)
    fours = found.reshape(*found.shape[:2], -1, TURNS)[:, :, good].sum(-1)
    response = np.array([fours[:, 2:4], fours[:, 4:6]]).mean(1)
    inverse = np.linalg.inv(response.mean(-1))
    half = (fours[0, :2] - fours[1, :2]) / (2 * SHEAR) - response.sum(1)
    both = (fours[0, :2] + fours[1, :2]) / 2
    shares = np.concatenate([inverse @ half, inverse @ both])
    values = shares.mean(1)
    # What a four adds beyond its own response.
    own = np.concatenate([np.einsum("ij,jkn,k->in", inverse, response, part) for part in (values[:2], values[2:])])
    return values, (shares - own).std(1) / np.sqrt(shares.shape[1])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=list(CASES), metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--galaxies", type=int, default=4000, help="rendered galaxies of each case, a multiple of four")
    parser.add_argument("--fields", type=int, default=8, help="fields of noise on each, an even number")
    parser.add_argument("--snr", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--ignored", action="store_true", help="measure without the WCS as well")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    for case in options.cases:
        # The same galaxies in all cases.
        rng = np.random.default_rng(options.seed)
        stamps, psf = scene(CASES[case], options.galaxies, options.snr, rng)
        ways = {"": CASES[case], " ignored": None} if options.ignored else {"": CASES[case]}
        sums = dict.fromkeys(ways, 0.0)
        for _ in range(options.fields // 2):
            noise = rng.standard_normal(stamps.shape[1:], dtype=np.float32)
            for way, wcs in ways.items():
                for sign in (1, -1):
                    sums[way] = sums[way] + np.array([measured(own + sign * noise, psf, wcs) for own in stamps])
        for way, total in sums.items():
            values, errors = estimates(total)
            text = [f"{1e3 * value:+8.2f} ± {1e3 * error:.2f}" for value, error in zip(values, errors)]
            print(f"{case + way:22s} m1, m2, c1, c2 (1e-3): {'  '.join(text)}", flush=True)


if __name__ == "__main__":
    main()
