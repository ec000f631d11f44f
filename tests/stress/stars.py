"""m and leakage that the noise of stars adds, with one star per galaxy (docs/limitations.md, The PSF).

Galaxies of S/N 40 come in fours, turned by 45 degrees each, under shears of +0.02 and −0.02, with noise and with the same
noise of the other sign. Each is measured behind its noisy star and behind the same star without noise; the difference of m
and its error are printed. `python3 tests/stress/stars.py [CASE ...]` needs galsim and the Python package of shearq.
"""

import argparse
import warnings

import galsim
import numpy as np
import shearq

from scenes import ACCURACY, mixture

SHEAR = 0.02
SIDE = 48
GALAXY_SNR = 40.0


def kolmogorov(fwhm=3.4, shape=(0.03, -0.02)):
    return galsim.Kolmogorov(fwhm=fwhm).shear(g1=shape[0], g2=shape[1])


def moffat(fwhm=3.4, shape=(0.03, -0.02)):
    return galsim.Moffat(beta=3, fwhm=fwhm).shear(g1=shape[0], g2=shape[1])


def airy(shape=(0.03, -0.02)):
    return galsim.Airy(lam_over_diam=2.4, obscuration=0.3).shear(g1=shape[0], g2=shape[1])


def spikes(angles):
    """A Kolmogorov profile with 3 % of its light in arms at these angles."""
    arm = galsim.Gaussian(sigma=2.2).shear(g1=0.85)
    share = 0.03 / len(angles)
    return 0.97 * kolmogorov() + galsim.Add([share * arm.rotate(angle * galsim.degrees) for angle in angles])


def halo():
    core = galsim.Kolmogorov(fwhm=3.2).shear(g1=0.06, g2=-0.04)
    return 0.88 * core + 0.12 * galsim.Moffat(beta=2.0, fwhm=9.0)


def coma():
    core = galsim.Kolmogorov(fwhm=3.0)
    return 0.7 * core + 0.2 * core.dilate(1.3).shift(0.9, 0.4) + 0.1 * core.dilate(1.6).shift(2.0, 0.9)


# PSF, its ellipticity, pairs per field, fields, images per field.
CASES = {
    "kolmogorov": (kolmogorov(), (0.03, -0.02), 2500, 8, 1),
    "kolmogorov-12": (kolmogorov(), (0.03, -0.02), 2496, 8, 208),
    "kolmogorov-64": (kolmogorov(), (0.03, -0.02), 2496, 4, 39),
    "kolmogorov-2.2": (kolmogorov(2.2), (0.03, -0.02), 1600, 6, 1),
    "kolmogorov-5": (kolmogorov(5.0), (0.03, -0.02), 1600, 6, 1),
    "moffat": (moffat(), (0.03, -0.02), 2500, 8, 1),
    "moffat-2.2": (moffat(2.2), (0.03, -0.02), 1600, 6, 1),
    "moffat-5": (moffat(5.0), (0.03, -0.02), 1600, 6, 1),
    "spikes-4": (spikes([20, 110]), (0.03, -0.02), 1600, 6, 1),
    "spikes-2": (spikes([20]), (0.03, -0.02), 1600, 6, 1),
    "halo": (halo(), (0.06, -0.04), 1600, 6, 1),
    "coma": (coma(), (0.04, 0.04), 1600, 6, 1),
    "airy": (airy(), (0.03, -0.02), 1200, 6, 1),
}


def scene(psf, count, rng):
    """Stamps [sign, galaxy, y, x] without noise, of S/N 40 in noise of one, and the star of each galaxy."""
    stamps = np.empty((2, count, SIDE, SIDE), np.float32)
    stars = np.empty((count, SIDE, SIDE))
    for first in range(0, count, 4):
        galaxy = mixture("mixed", rng)
        for turn in range(4):
            place, offset = rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.5, 0.5, 2)
            turned = galaxy.rotate(45 * turn * galsim.degrees)
            for sign in range(2):
                shear = SHEAR * (1 - 2 * sign)
                sheared = turned.shear(g1=shear, g2=shear).shift(*place)
                image = galsim.Convolve(sheared, psf, gsparams=ACCURACY).drawImage(nx=SIDE, ny=SIDE, scale=1)
                stamps[sign, first + turn] = image.array
            stars[first + turn] = psf.shift(*offset).drawImage(nx=SIDE, ny=SIDE, scale=1).array
        four = stamps[:, first : first + 4].astype(float)
        stamps[:, first : first + 4] *= GALAXY_SNR / np.sqrt((four**2).sum((2, 3)).mean())
    return stamps, stars


def measured(stamps, stars, images):
    """Ellipticities before calibration and responses [e1, R11, e2, R22][galaxy]; NaN if flagged."""
    parts = []
    for own, psfs in zip(np.split(stamps, images), np.split(stars, images)):
        catalogue = shearq.measure(own, psfs.astype(np.float32))
        columns = []
        for k in "12":
            response = np.where(catalogue.good, catalogue[f"R{k}{k}"], np.nan)
            columns += [catalogue[f"e{k}"], response]
        parts.append(columns)
    return np.concatenate(parts, axis=1)


def estimates(found, shape):
    """m1, m2 and the leakage, with what each four contributes; of [field, sign, column, galaxy]."""
    sums = found.reshape(*found.shape[:3], -1, 4).sum(-1)
    values, shares, leaks = [], [], 0.0
    for k, own in enumerate(shape):
        e, response = sums[:, :, 2 * k], sums[:, :, 2 * k + 1]
        moved = ((e[:, 0] - e[:, 1]) / (2 * SHEAR) - response.mean(1)).mean(0)
        mean, total = response.mean((0, 1)), response.mean((0, 1)).sum()
        m = moved.sum() / total
        values.append(m)
        shares.append((moved - m * mean) / total)
        leaks = leaks + own * e.mean((0, 1)) / total
    leaks = leaks / (shape[0] ** 2 + shape[1] ** 2)
    return np.array([*values, leaks.sum()]), np.array([*shares, leaks - leaks.mean()])


def added(case, between, seed):
    """What noise of stars with S/N between two values adds to m1, m2 and the leakage, and the errors."""
    psf, shape, count, fields, images = CASES[case]
    rng = np.random.default_rng([seed, list(CASES).index(case)])
    stamps, stars = scene(psf, count, rng)
    snr = np.exp(rng.uniform(*np.log(between), count))
    sigma = (np.sqrt((stars**2).sum((1, 2))) / snr)[:, None, None]
    noisy, clean = [], []
    for _ in range(fields // 2):
        noise = rng.standard_normal((count, SIDE, SIDE), dtype=np.float32)
        of_stars = sigma * rng.standard_normal((count, SIDE, SIDE))
        for half in (1, -1):
            noisy.append([measured(own + half * noise, stars + half * of_stars, images) for own in stamps])
            clean.append([measured(own + half * noise, stars, images) for own in stamps])
    noisy, clean = np.array(noisy), np.array(clean)
    good = np.isfinite(noisy).all((0, 1, 2)) & np.isfinite(clean).all((0, 1, 2))
    good = good.reshape(-1, 4).all(1).repeat(4)
    (values, shares), (exact, own) = (estimates(found[..., good], shape) for found in (noisy, clean))
    return values - exact, np.sqrt(((shares - own) ** 2).sum(1))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", default=list(CASES), metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--snr", type=float, nargs="+", default=[50.0, 100.0], help="S/N of the stars")
    parser.add_argument("--between", type=float, nargs=2, metavar=("LOW", "HIGH"), help="S/N between these instead")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    for case in options.cases:
        for low, high in [options.between] if options.between else [(snr, snr) for snr in options.snr]:
            (m1, m2, leak), (error1, error2, error) = added(case, (low, high), options.seed)
            m = f"{1e3 * m1:+6.2f} {1e3 * m2:+6.2f} ± {1e3 * max(error1, error2):.2f}"
            print(f"{case:15s} S/N {low:.0f} to {high:.0f}   m1, m2 (1e-3) {m}   leakage {leak:+.4f} ± {error:.4f}", flush=True)


if __name__ == "__main__":
    main()
