#!/usr/bin/env python3
"""Fisher bound of the total scatter of the COSMOS fits, for S/N that are uniform in the logarithm.

    python3 tests/stress/bound.py FOLDER [LEAST LARGEST]

The total scatter is that of the shear of one galaxy per component, with its shape. FOLDER has GalSim's example catalogues.
"""

import sys

import numpy as np
from cases import CASES
from scenes import PIXEL, SHEAR, Galaxies, drawn, psf_of

#: Places of ellipticities along an axis, twice as far as they go so that noise does not wrap around.
PLACES = np.linspace(-2.0, 2.0, 401)


def galaxies(folder):
    """Moduli of ellipticity of the fits, and Cramér–Rao errors of the shear of each at S/N 1, per component."""
    case = next(case for case in CASES if case.name == "cosmos20")
    psf, catalogue = psf_of(case, None), Galaxies("cosmos", folder).catalogue
    moduli, errors = [], []
    for index in range(catalogue.nobjects):
        ratio = catalogue.getParametricRecord(index)["sersicfit"][3]
        moduli.append((1 - ratio) / (1 + ratio))
        galaxy = catalogue.makeGalaxy(index, gal_type="parametric").dilate(1.0 / PIXEL)
        plus, minus = (drawn(galaxy.shear(g1=g, g2=g), psf, case.stamp) for g in (SHEAR, -SHEAR))
        slope = (plus - minus) / (2 * SHEAR * np.sqrt(((plus + minus) ** 2).sum() / 4))
        # Both components change together, each by half of the sum.
        errors.append(np.sqrt(2 / (slope**2).sum()))
    return np.array(moduli), np.array(errors)


def most_likely(moduli):
    """a and b of the most likely density exp(−(|ε|/a)^b) of ellipticities, |ε| < 1.

    Of a smoothed histogram of a hundred galaxies the bound depends on the smoothing: 0.218 to 0.269 for 0.05 to 0.12.
    """
    radii = np.linspace(0, 1, 2001)

    def likelihood(a, b):
        norm = 2 * np.pi * (radii * np.exp(-((radii / a) ** b))).sum() * radii[1]
        return -((moduli / a) ** b).sum() - len(moduli) * np.log(norm)

    grid = [(a, b) for a in np.linspace(0.05, 0.9, 86) for b in np.linspace(0.6, 4.0, 35)]
    return max(grid, key=lambda at: likelihood(*at))


def information(a, b, levels):
    """What a galaxy with an error of its shear of each of `levels` tells of g1 on average.

    A shear g moves an ellipticity ε by v = g − g* ε². The density p of noisy ellipticities changes by q, the convolution of
    −∇·(p v) with the noise, and tells ∫ q²/p.
    """
    e1, e2 = np.meshgrid(PLACES, PLACES)
    step, radius = PLACES[1] - PLACES[0], np.hypot(e1, e2)
    # Falls to zero at 1 without a step, whose gradient would tell of the shear.
    p = np.exp(-((radius / a) ** b)) * np.clip(10 * (1 - radius), 0, 1)
    p /= p.sum()
    q = -np.gradient(p * (1 - e1**2 + e2**2), step, axis=1) - np.gradient(-2 * p * e1 * e2, step, axis=0)
    k = 2 * np.pi * np.fft.fftfreq(len(PLACES), step)
    square = k[:, None] ** 2 + k**2
    told = []
    for level in levels:
        blur = np.exp(-0.5 * level**2 * square)
        there, change = (np.fft.ifft2(np.fft.fft2(part) * blur).real for part in (p, q))
        seen = there > 1e-9 * there.max()
        told.append((change[seen] ** 2 / there[seen]).sum())
    return told


def main():
    folder, least, largest = sys.argv[1], *map(float, sys.argv[2:4] or (10, 200))
    moduli, errors = galaxies(folder)
    a, b = most_likely(moduli)
    snr = np.geomspace(least, largest, 25)
    levels = np.geomspace(errors.min() / largest, 0.6, 16)
    noise = np.clip(errors[:, None] / snr, levels[0], levels[-1])
    told = np.interp(np.log(noise), np.log(levels), information(a, b, levels)).mean()
    print(f"{len(moduli)} galaxies, density exp(-(|e|/{a:.2f})^{b:.1f}), error of the shear {np.median(errors):.2f} over S/N")
    print(f"S/N {least:g} to {largest:g}: total scatter at least {1 / np.sqrt(told):.4f}")


if __name__ == "__main__":
    main()
