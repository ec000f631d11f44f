"""m, c and noise of galaxies on several epochs, against one stamp of their summed S/N.

Galaxies and PSFs are sums of two Gaussians, which are sheared and convolved without error, so that many are drawn in a short time. Galaxies
come in fours, turned by 45 degrees each, under shears of (γ, γ) and (−γ, −γ) on the sky, γ = 0.02. Each epoch has a WCS, dither, PSF and
depth of its own (EPOCHS); `one` has the first alone. `epochs` measures them with `shearq.measure(epochs=…)`, and `--averaged` each by
itself, with the mean of e and of R. Both shears have the same noise, added and taken away.
`python3 tests/stress/epochs.py` needs numpy and the Python package of shearq.
"""

import argparse
import warnings

import numpy as np
import shearq

from sky import SCALE, SHEAR, SIDE, TURNS, estimates, turned

# Position angle in degrees, parity, pixel shear, mean square of the PSF in px², its distortion on the sky, and noise in units of
# the first.
EPOCHS = (
    (0, False, 0.0, 2.2, (0.06, -0.04), 1.0),
    (37, False, 0.01, 2.7, (-0.08, 0.02), 1.3),
    (-64, True, 0.0, 1.9, (0.04, 0.10), 0.8),
    (110, False, -0.02, 2.4, (0.0, -0.06), 1.6),
)
# Shares of the light, and mean squares, of the Gaussians of a galaxy and of a PSF: an exponential disc and a Moffat profile, roughly.
GALAXY = ((0.5, 0.5), (0.5, 2.0))
PSF = ((0.7, 0.8), (0.3, 1.8))


def moments(square, distortion):
    """The matrix of second moments."""
    e1, e2 = distortion
    return square * np.array([[1 + e1, e2], [e2, 1 - e1]])


def drawn(parts, matrix, place, side=SIDE):
    """An image of Gaussians (light, moments) on pixels of a Jacobian."""
    rows, columns = np.indices((side, side)) - (side - 1) / 2
    u, v = np.einsum("ij,jyx->iyx", matrix, np.array([columns - place[0], rows - place[1]]))
    image = 0.0
    for light, ((xx, xy), (_, yy)) in parts:
        area = xx * yy - xy * xy
        image = image + light * np.exp(-0.5 * (yy * u * u - 2 * xy * u * v + xx * v * v) / area) / (2 * np.pi * np.sqrt(area))
    return image * abs(np.linalg.det(matrix))


def scenes(epochs, count, snr, rng):
    """For each epoch stamps [sign, galaxy, y, x], offsets, PSF, Jacobian and noise; all together have this S/N."""
    parts = []
    # The same galaxies for any number of epochs.
    shapes = np.random.default_rng(rng.integers(1 << 32))
    for angle, mirrored, g1, square, distortion, noise in epochs:
        matrix = turned(angle, mirrored, g1)
        psf = [(light, moments(share * square * SCALE**2, distortion)) for light, share in PSF]
        image = drawn(psf, matrix, (0.0, 0.0), 40)
        parts.append((np.empty((2, count, SIDE, SIDE), np.float32), rng.uniform(-0.5, 0.5, (count, 2)), psf, image, matrix, noise))
    for first in range(0, count, TURNS):
        square, modulus, direction = shapes.uniform(4, 12) * SCALE**2, shapes.uniform(0.1, 0.6), shapes.uniform(0, 2 * np.pi)
        power = 0.0
        for turn in range(TURNS):
            angle = direction + np.pi / 2 * turn
            galaxy = [(light, moments(share * square, (modulus * np.cos(angle), modulus * np.sin(angle)))) for light, share in GALAXY]
            for sign in range(2):
                g = SHEAR * (1 - 2 * sign)
                shear = np.array([[1 + g, g], [g, 1 - g]]) / np.sqrt(1 - 2 * g * g)
                sheared = [(light, shear @ own @ shear) for light, own in galaxy]
                for stamps, places, psf, _, matrix, noise in parts:
                    both = [(a * b, own + star) for a, own in sheared for b, star in psf]
                    stamps[sign, first + turn] = image = drawn(both, matrix, places[first + turn])
                    power += (image**2).sum() / noise**2 / 2 / TURNS
        for stamps, *_ in parts:
            stamps[:, first : first + TURNS] *= snr / np.sqrt(power)
    return parts


def columns(catalogue):
    e = [catalogue[f"e{k}"] for k in "12"]
    return np.array([*e, *(np.where(catalogue.good, catalogue[f"R{k}"], np.nan) for k in ("11", "12", "21", "22"))])


def measured(parts, noises, sign, add, together):
    epochs = [
        {"stamps": stamps[sign] + add * noise, "psf": psf, "noise": level, "wcs": matrix, "offsets": places}
        for (stamps, places, _, psf, matrix, level), noise in zip(parts, noises)
    ]
    if together:
        return columns(shearq.measure(epochs=epochs))
    return np.mean([columns(shearq.measure(epochs=[epoch])) for epoch in epochs], axis=0)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--galaxies", type=int, default=2000, help="a multiple of four")
    parser.add_argument("--fields", type=int, default=4, help="fields of noise on each, an even number")
    parser.add_argument("--snr", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--averaged", action="store_true", help="also average single epochs")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    for name, epochs in (("one", EPOCHS[:1]), ("epochs", EPOCHS)):
        rng = np.random.default_rng(options.seed)
        parts = scenes(epochs, options.galaxies, options.snr, rng)
        ways = {"": True, " averaged": False} if options.averaged and len(epochs) > 1 else {"": True}
        sums, squares = dict.fromkeys(ways, 0.0), dict.fromkeys(ways, 0.0)
        for _ in range(options.fields // 2):
            noises = [part[-1] * rng.standard_normal(part[0].shape[1:], dtype=np.float32) for part in parts]
            for way, together in ways.items():
                found = [np.array([measured(parts, noises, sign, add, together) for sign in range(2)]) for add in (1, -1)]
                sums[way] = sums[way] + found[0] + found[1]
                squares[way] = squares[way] + ((found[0] - found[1])[:, :2] / 2) ** 2
        for way, total in sums.items():
            values, errors = estimates(total)
            response = np.nanmean(total[:, [2, 5]]) / options.fields
            noise = np.sqrt(np.nanmean(squares[way]) / (options.fields // 2)) / response
            text = [f"{1e3 * value:+7.2f} ± {1e3 * error:.2f}" for value, error in zip(values, errors)]
            print(f"{name + way:16s} noise {noise:.4f}  m1, m2, c1, c2 (1e-3): {'  '.join(text)}", flush=True)


if __name__ == "__main__":
    main()
