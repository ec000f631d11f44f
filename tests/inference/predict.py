"""What the leaderboard would have said: Q, M/2 and √A of a set from the response to shear and the scatter of
one galaxy. docs/scoring.md has the arithmetic; `check` holds it against known figures.
"""

from math import erf, exp, pi, sqrt

import numpy as np

SIDE = np.deg2rad(10.0)  # of a field
GRID = 100  # galaxies a side
IMAGES = 200  # of a set
BINS = 20
SCORED = slice(1, 9)  # bins 2 to 9

# ℓ²C_ℓ/2π of the fiducial shear (crates/simulate/src/field.rs).
FIDUCIAL = [
    (36, 3.56e-6), (60, 5.80e-6), (100, 8.65e-6), (180, 1.22e-5), (300, 1.63e-5), (500, 2.27e-5),
    (800, 3.19e-5), (1200, 4.27e-5), (1800, 5.53e-5), (2600, 6.62e-5), (3600, 7.35e-5), (5000, 7.71e-5),
]  # fmt: skip


def mean_modulus(mean, sigma):
    """Mean of |x| for a Gaussian x."""
    if sigma == 0:
        return abs(mean)
    z = mean / sigma
    return sigma * sqrt(2 / pi) * exp(-z * z / 2) + mean * erf(z / sqrt(2))


class Leaderboard:
    """Bins of the original scoring, and the fiducial shear in them."""

    def __init__(self):
        n, base = GRID, 2 * np.pi / SIDE
        width = base * (n - 1) / (BINS - 1)
        wave = base * (np.arange(n) - n // 2) + 1e-10
        l1, l2 = np.meshgrid(wave, wave, indexing="ij")
        modulus = np.hypot(l1, l2).ravel()
        seen = (modulus >= base) & (modulus <= base * n)
        # Rounded half away from zero.
        of = np.floor((modulus + 1 - base) / width + 0.5).astype(int)
        of = np.where(seen & (of < BINS), of, BINS)
        # Of each bin, the multipole of the mode visited last.
        last = np.zeros(BINS)
        for b in range(BINS):
            inside = np.flatnonzero(of == b)
            last[b] = modulus[inside[-1]] if len(inside) else 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            self.dln = np.append(np.log(last[1:] / last[:-1]), 0.0)[SCORED]
        counted = of < BINS
        self.weight = np.bincount(of[counted], modulus[counted], BINS)[SCORED] / width
        # Modes of equal weight that would scatter as much; a mode and its opposite count as two.
        squares = np.bincount(of[counted], modulus[counted] ** 2, BINS)[SCORED] / width**2
        self.modes = self.weight**2 / squares
        # Modes that a simulated field has: up to Nyquist, without the rows that have no opposite.
        row = np.arange(n) == 0
        edge = (row[:, None] | row[None, :]).ravel()
        drawn = counted & ~edge & (modulus <= base * n / 2)
        nodes = np.array(FIDUCIAL)
        power = np.exp(np.interp(np.log(modulus[drawn]), np.log(nodes[:, 0]), np.log(nodes[:, 1])))
        c_l = power * 2 * np.pi / modulus[drawn] ** 2
        self.truth = np.bincount(of[drawn], c_l * modulus[drawn], BINS)[SCORED] / (SIDE**2 * width)

    def figures(self, response, variance, amplitude=1.0, images=IMAGES):
        """Mean Q, M/2 and √A (10⁻⁴) of a set whose galaxies answer a shear with `response` (per component) and
        scatter by `variance` (mean of the components), for `amplitude` times the fiducial spectrum.

        With unequal responses R₁ and R₂ a mode keeps R₁cos² + R₂sin² of itself, the angle being twice its
        own; in the mean over directions its power is ((R₁ + R₂)² + (R₁ − R₂)²/2)/4 times as large. Noise of power N
        beside a signal of power S scatters the power of m modes by √(2(N² + 2SN)/m), without which Q would have no
        bound where what is lost of the signal and what noise brings are equal.
        """
        first, second = response
        gain = ((first + second) ** 2 + (first - second) ** 2 / 2) / 4
        truth = amplitude * self.truth
        noise = self.weight * variance / (images * GRID**2)
        apart = (gain - 1) * truth + noise
        q = 5e-3 / self.deviation(apart, gain * truth, noise)
        to_c_l = SIDE**2 / self.weight
        # Least squares, unweighted.
        x, y = truth * to_c_l, apart * to_c_l
        slope = np.dot(x - x.mean(), y) / np.dot(x - x.mean(), x - x.mean())
        intercept = y.mean() - slope * x.mean()
        return q, slope / 2, np.sign(intercept) * np.sqrt(abs(intercept)) * 1e4

    def deviation(self, apart, signal, noise):
        """Mean σ_sys."""
        scatter = np.sqrt(2 * (noise**2 + 2 * signal * noise) / self.modes)
        return float(np.dot([mean_modulus(a, s) for a, s in zip(apart, scatter)], self.dln))

    def check(self):
        """The bins' Δln ℓ as the organisers' program has them, and the Q of noise alone."""
        known = [0.488699, 0.316020, 0.241805, 0.196500, 0.158864, 0.143010, 0.120470, 0.110345]
        assert np.allclose(self.dln, known, atol=1e-6), self.dln
        for sigma, q in [(0.1, 184.4), (0.2, 46.1)]:
            assert abs(self.figures((1, 1), sigma**2, amplitude=1e-9)[0] / q - 1) < 0.01
        # A response of R moves M/2 by (R² − 1)/2, and noise moves it not at all.
        q, m_half, sqrt_a = self.figures((0.9, 0.9), 0.01)
        assert abs(m_half - (0.81 - 1) / 2) < 1e-9 and sqrt_a > 0, (m_half, sqrt_a)
