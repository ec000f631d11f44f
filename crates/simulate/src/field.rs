//! Gaussian random ellipticity fields on a grid, from E- and B-mode power spectra.

use std::f64::consts::TAU;

use ndarray::Array2;
use rand::{Rng, RngExt};
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};
use shearq_quantities::fourier::Complex64;
use shearq_scoring::modes::{Decomposer, Modes};
use shearq_scoring::{BINS, Grid};

// ℓ and ℓ²C_ℓ/2π of the fiducial ΛCDM shear, sources at z ≈ 1: the table that GREAT3 used.
const FIDUCIAL: [(f64, f64); 12] = [
    (36.0, 3.56e-6),
    (60.0, 5.80e-6),
    (100.0, 8.65e-6),
    (180.0, 1.22e-5),
    (300.0, 1.63e-5),
    (500.0, 2.27e-5),
    (800.0, 3.19e-5),
    (1200.0, 4.27e-5),
    (1800.0, 5.53e-5),
    (2600.0, 6.62e-5),
    (3600.0, 7.35e-5),
    (5000.0, 7.71e-5),
];

// Moduli of constant shears in GREAT3.
const SHEARS: (f64, f64) = (0.01, MAX_RANDOM_SHEAR);
pub(super) const MAX_RANDOM_SHEAR: f64 = 0.05;

// Multipole whose power a tilt leaves unchanged. Chosen by hand.
const PIVOT: f64 = 1000.0;

/// A shear for all galaxies, uniform over the ring of GREAT3.
pub fn random_shear(rng: &mut impl Rng) -> Complex64 {
    let (low, high) = SHEARS;
    let modulus = rng.random_range(low * low..high * high).sqrt();
    Complex64::from_polar(modulus, rng.random_range(0.0..TAU))
}

/// The shear power spectrum of a set: the fiducial one times amplitude·(ℓ/1000)^tilt, and in each bandpower of the scoring
/// times a random factor.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ShearSpectrum {
    pub amplitude: f64,
    pub tilt: f64,
    /// Largest factor s on a bandpower. Each set and bandpower has its own factor, log-uniform between 1/s and s, so
    /// that neither other sets nor other simulations predict it. 1 for the same smooth spectrum in all sets.
    #[serde(default = "unscattered", skip_serializing_if = "is_unscattered")]
    pub scatter: f64,
}

fn unscattered() -> f64 {
    1.0
}

fn is_unscattered(scatter: &f64) -> bool {
    *scatter == 1.0
}

impl Default for ShearSpectrum {
    fn default() -> Self {
        ShearSpectrum {
            amplitude: 1.0,
            tilt: 0.0,
            scatter: 1.0,
        }
    }
}

impl ShearSpectrum {
    /// C_ℓ in steradian at multipole `l` > 0, interpolated in log–log, beyond the table by its last
    /// slopes.
    pub fn c_l(&self, l: f64) -> f64 {
        let after = FIDUCIAL
            .iter()
            .position(|&(node, _)| node > l)
            .unwrap_or(FIDUCIAL.len())
            .clamp(1, FIDUCIAL.len() - 1);
        let ((l0, p0), (l1, p1)) = (FIDUCIAL[after - 1], FIDUCIAL[after]);
        let slope = (p1 / p0).ln() / (l1 / l0).ln();
        let power = p0 * (l / l0).powf(slope);
        power * self.amplitude * (l / PIVOT).powf(self.tilt) * 2.0 * std::f64::consts::PI / (l * l)
    }

    pub(crate) fn factors(&self, rng: &mut impl RngExt) -> [f64; BINS] {
        let range = self.scatter.ln();
        std::array::from_fn(|_| (range * (2.0 * rng.random::<f64>() - 1.0)).exp())
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Content {
    EOnly,
    BOnly,
    Both,
}

const SAME_GRID: &str = "a field on the grid of the decomposer";

/// A Gaussian random field with power C_ℓ = `spectrum(ℓ)` in steradian in each of the modes of
/// `content`; index `[ix, iy]`, e₁ + i e₂.
///
/// The zero mode and, for even grids, the Nyquist rows are left out, and so are all modes beyond the
/// Nyquist multipole of the axes.
pub fn random_field(
    decomposer: &Decomposer,
    rng: &mut impl Rng,
    content: Content,
    spectrum: impl Fn(f64) -> f64,
) -> Array2<Complex64> {
    let grid = decomposer.grid();
    let n = grid.n;
    let mut draw = || -> f64 { StandardNormal.sample(rng) };
    // White noise of unit variance has |E|² = |B|² = n² in every mode, with the symmetry that makes
    // the field's κ real.
    let mut white = Array2::<Complex64>::zeros((n, n));
    for value in &mut white {
        *value = Complex64::new(draw(), draw());
    }
    let Modes { mut e, mut b } = decomposer.decompose(white).expect(SAME_GRID);
    let nyquist = grid.l_min().0 * n as f64 / 2.0;
    for i in 0..n {
        for j in 0..n {
            let l = multipole(&grid, i, j);
            let edge = n.is_multiple_of(2) && (i == n / 2 || j == n / 2);
            // |mode|² = C_ℓ n⁴/L² (see `shearq_scoring::modes`).
            let scale = if l == 0.0 || edge || l > nyquist {
                0.0
            } else {
                spectrum(l).sqrt() * n as f64 / grid.side().0
            };
            let on = |wanted: bool| if wanted { scale } else { 0.0 };
            e[(i, j)] *= on(content != Content::BOnly);
            b[(i, j)] *= on(content != Content::EOnly);
        }
    }
    decomposer.compose(&Modes { e, b }).expect(SAME_GRID)
}

/// |ℓ| of the mode at `(i, j)` in FFT order.
fn multipole(grid: &Grid, i: usize, j: usize) -> f64 {
    let frequency = |k: usize| {
        let k = k as f64;
        let n = grid.n as f64;
        if k > n / 2.0 { k - n } else { k }
    };
    grid.l_min().0 * frequency(i).hypot(frequency(j))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use shearq_scoring::{Bins, Definition, SCORED};

    #[test]
    fn spectra_pass_their_table_and_tilt_about_their_pivot() {
        let fiducial = ShearSpectrum::default();
        let power = |s: &ShearSpectrum, l: f64| s.c_l(l) * l * l / (2.0 * std::f64::consts::PI);
        for (l, expected) in FIDUCIAL {
            assert!((power(&fiducial, l) / expected - 1.0).abs() < 1e-12);
        }
        let tilted = ShearSpectrum {
            amplitude: 2.0,
            tilt: 0.5,
            ..fiducial
        };
        assert!((power(&tilted, 1000.0) / power(&fiducial, 1000.0) - 2.0).abs() < 1e-12);
        assert!(
            (power(&tilted, 2000.0) / power(&fiducial, 2000.0) / 2.0f64.powf(1.5) - 1.0).abs()
                < 1e-12
        );
    }

    #[test]
    fn factors_of_bandpowers_are_log_uniform() {
        let spectrum = ShearSpectrum {
            scatter: 4.0,
            ..ShearSpectrum::default()
        };
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let logs: Vec<f64> = (0..1000)
            .flat_map(|_| spectrum.factors(&mut rng).map(f64::ln))
            .collect();
        let (count, range) = (logs.len() as f64, 4f64.ln());
        let mean = logs.iter().sum::<f64>() / count;
        let square = logs.iter().map(|log| log * log).sum::<f64>() / count;
        // A uniform number between ±r has the variance r²/3; four standard errors of 20,000 numbers are 3 %.
        assert!(mean.abs() < 0.03 * range && (3.0 * square / range.powi(2) - 1.0).abs() < 0.03);
        assert!(logs.iter().all(|log| log.abs() <= range));
        assert_eq!(ShearSpectrum::default().factors(&mut rng), [1.0; BINS]);
    }

    #[test]
    fn fields_have_the_power_and_the_modes_asked_for() {
        let grid = Grid::great10(64).unwrap();
        let decomposer = Decomposer::new(grid);
        let bins = Bins::new(&grid, Definition::Corrected);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let spectrum = ShearSpectrum::default();
        let mut mean = [0.0; 20];
        let fields = 40;
        for _ in 0..fields {
            let field = random_field(&decomposer, &mut rng, Content::EOnly, |l| spectrum.c_l(l));
            let modes = decomposer.decompose(field).unwrap();
            let e = bins.power(&modes.e, &modes.e).unwrap();
            let b = bins.power(&modes.b, &modes.b).unwrap();
            for k in SCORED {
                mean[k] += e[k] / f64::from(fields);
                assert!(b[k] < 1e-20, "leaked into B");
            }
        }
        for k in SCORED {
            // Modes beyond Nyquist are missing from the last scored bin.
            if bins.l[k] * 1.1 > grid.l_min().0 * 32.0 {
                continue;
            }
            let l = bins.l[k];
            let expected = spectrum.c_l(l) * l * l / (2.0 * std::f64::consts::PI);
            let independent = bins.modes[k] as f64 / 2.0 * f64::from(fields);
            // Scatter of a mean of squared Gaussians, plus 2 % for the curvature inside a bin.
            let tolerance = 4.0 / independent.sqrt() + 0.02;
            assert!((mean[k] / expected - 1.0).abs() < tolerance, "bin {k}");
        }
        let field = random_field(&decomposer, &mut rng, Content::BOnly, |_| 1e-9);
        let modes = decomposer.decompose(field).unwrap();
        assert!(modes.e.iter().all(|v| v.norm() < 1e-8));
        assert!(modes.b.iter().any(|v| v.norm() > 1e-3));
    }
}
