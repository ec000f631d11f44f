//! E and B modes of a complex ellipticity field on a grid.
//!
//! Fourier scaling: `FFT` is the plain sum Σ f·e^{−2πi(jk/n)} without a factor,
//! `IFFT` carries 1/n². A mode's power per steradian is |FFT|²·L²/n⁴.

use ndarray::Array2;
use shearq_quantities::fourier::{Complex64, Plan64, Planner64};

use crate::error::ScoringError;
use crate::grid::{Grid, check_shape};

/// E and B modes in FFT order, first index along ℓ₁ (x), second along ℓ₂ (y).
#[derive(Debug, Clone)]
pub struct Modes {
    /// FFT of the real part of κ: the gradient-like, lensing signal.
    pub e: Array2<Complex64>,
    /// FFT of the imaginary part of κ: the curl-like part, zero for shear alone.
    pub b: Array2<Complex64>,
}

/// Two-dimensional FFT of a grid, with its E/B kernel.
#[derive(Clone)]
pub struct Decomposer {
    grid: Grid,
    forward: Plan64,
    inverse: Plan64,
    kernel: Array2<Complex64>,
}

impl std::fmt::Debug for Decomposer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Decomposer")
            .field("grid", &self.grid)
            .finish_non_exhaustive()
    }
}

impl Decomposer {
    /// Plans the transforms of `grid`.
    pub fn new(grid: Grid) -> Self {
        let mut planner = Planner64::new();
        let mut kernel = Array2::zeros((grid.n, grid.n));
        for i in 0..grid.n {
            for j in 0..grid.n {
                kernel[(grid.fft_index(i), grid.fft_index(j))] = kernel_value(&grid, i, j);
            }
        }
        Decomposer {
            grid,
            forward: planner.forward(grid.n),
            inverse: planner.inverse(grid.n),
            kernel,
        }
    }

    /// The grid.
    pub fn grid(&self) -> Grid {
        self.grid
    }

    /// κ = IFFT(K·FFT(field)) with K = conj(z)²/|z|², z = ℓ₁ + iℓ₂; E = FFT(Re κ), B = FFT(Im κ)
    /// (Kaiser & Squires 1993; Kitching et al. 2011, eqs 17–19).
    ///
    /// `field` is `[ix, iy]`. The detour through κ matters for even grids, whose Nyquist rows have no
    /// opposite frequency.
    ///
    /// # Errors
    /// If the shape of `field` differs from the grid.
    pub fn decompose(&self, field: Array2<Complex64>) -> Result<Modes, ScoringError> {
        check_shape("the field", &field, self.grid.n)?;
        Ok(self.modes_of(field))
    }

    pub(crate) fn modes_of(&self, mut field: Array2<Complex64>) -> Modes {
        self.transform(&mut field, &self.forward);
        field *= &self.kernel;
        self.transform(&mut field, &self.inverse);
        let scale = 1.0 / (self.grid.cells() as f64);
        let mut e = field.mapv(|kappa| Complex64::new(kappa.re * scale, 0.0));
        let mut b = field.mapv(|kappa| Complex64::new(kappa.im * scale, 0.0));
        self.transform(&mut e, &self.forward);
        self.transform(&mut b, &self.forward);
        Modes { e, b }
    }

    /// The ellipticity field with the E and B modes `modes`: the inverse of [`Decomposer::decompose`],
    /// except for the zero mode and, on even grids, the Nyquist rows.
    ///
    /// # Errors
    /// If the shape of the modes differs from the grid.
    pub fn compose(&self, modes: &Modes) -> Result<Array2<Complex64>, ScoringError> {
        check_shape("the E modes", &modes.e, self.grid.n)?;
        check_shape("the B modes", &modes.b, self.grid.n)?;
        let i = Complex64::new(0.0, 1.0);
        let mut field = Array2::from_shape_fn(modes.e.dim(), |at| {
            (modes.e[at] + i * modes.b[at]) * self.kernel[at].conj()
        });
        self.transform(&mut field, &self.inverse);
        field /= Complex64::new(self.grid.cells() as f64, 0.0);
        Ok(field)
    }

    pub(crate) fn fft(&self, mut field: Array2<Complex64>) -> Array2<Complex64> {
        self.transform(&mut field, &self.forward);
        field
    }

    // K = exp(−2iφ) of a mode in FFT order; zero at the zero mode.
    pub(crate) fn kernel(&self, mode: (usize, usize)) -> Complex64 {
        self.kernel[mode]
    }

    // One-dimensional transforms along both axes, unscaled.
    fn transform(&self, field: &mut Array2<Complex64>, fft: &Plan64) {
        for _ in 0..2 {
            let mut turned = field.t().as_standard_layout().into_owned();
            if let Some(rows) = turned.as_slice_mut() {
                fft.process(rows);
            }
            *field = turned;
        }
    }
}

// K = conj(z)²/|z|² at centred position `(i, j)`; zero at the zero mode.
fn kernel_value(grid: &Grid, i: usize, j: usize) -> Complex64 {
    if grid.frequency(i) == 0 && grid.frequency(j) == 0 {
        return Complex64::ZERO;
    }
    let z = Complex64::new(grid.wave(i), grid.wave(j));
    z.conj() * z.conj() / z.norm_sqr()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The same modes by direct sums over all cells.
    fn decompose_naive(grid: &Grid, field: &Array2<Complex64>) -> Modes {
        let n = grid.n;
        let phase = |product: usize, sign: f64| {
            let angle = sign * 2.0 * std::f64::consts::PI * (product % n) as f64 / n as f64;
            Complex64::from_polar(1.0, angle)
        };
        let sum = |input: &Array2<Complex64>, sign: f64| {
            Array2::from_shape_fn((n, n), |(k1, k2)| {
                let mut total = Complex64::ZERO;
                for ((j1, j2), value) in input.indexed_iter() {
                    total += value * phase(j1 * k1, sign) * phase(j2 * k2, sign);
                }
                total
            })
        };
        let mut kappa = sum(field, -1.0);
        for i in 0..n {
            for j in 0..n {
                kappa[(grid.fft_index(i), grid.fft_index(j))] *= kernel_value(grid, i, j);
            }
        }
        let kappa = sum(&kappa, 1.0) / Complex64::new((n * n) as f64, 0.0);
        Modes {
            e: sum(&kappa.mapv(|k| Complex64::new(k.re, 0.0)), -1.0),
            b: sum(&kappa.mapv(|k| Complex64::new(k.im, 0.0)), -1.0),
        }
    }

    /// A reproducible field without a random-number crate: a linear congruential generator.
    fn field(n: usize, seed: u64) -> Array2<Complex64> {
        let mut state = seed;
        let mut next = || {
            state = state
                .wrapping_mul(6364136223846793005)
                .wrapping_add(1442695040888963407);
            (state >> 11) as f64 / (1u64 << 53) as f64 - 0.5
        };
        Array2::from_shape_fn((n, n), |_| Complex64::new(next(), next()))
    }

    /// Whether all values are the same but for rounding; none is that are no numbers.
    fn alike(a: &Array2<Complex64>, b: &Array2<Complex64>) -> bool {
        // Sums of n² values of order 0.5 in f64: 1e-16 · n² · a few.
        a.iter().zip(b).all(|(x, y)| (x - y).norm() < 1e-12)
    }

    #[test]
    fn fast_modes_equal_direct_sums_on_even_and_odd_grids() {
        for n in [8, 9, 11, 12] {
            let grid = Grid::great10(n).unwrap();
            let input = field(n, n as u64);
            let fast = Decomposer::new(grid).modes_of(input.clone());
            let plain = decompose_naive(&grid, &input);
            assert!(alike(&fast.e, &plain.e), "n {n}");
            assert!(alike(&fast.b, &plain.b), "n {n}");
        }
    }

    #[test]
    fn tangential_waves_are_pure_e_and_at_45_degrees_pure_b() {
        // κ = cos(k·x) along x gives γ1 = κ, γ2 = 0 for a wave along ℓ1; along the diagonal
        // the shear is all γ2. A swapped axis or a flipped sign of e2 breaks one of the two.
        let n = 16;
        let grid = Grid::great10(n).unwrap();
        let decomposer = Decomposer::new(grid);
        let angle = |i: usize, j: usize, k: (usize, usize)| {
            2.0 * std::f64::consts::PI * (k.0 * i + k.1 * j) as f64 / n as f64
        };
        for (wave, e1, e2) in [((3, 0), 1.0, 0.0), ((0, 3), -1.0, 0.0), ((2, 2), 0.0, 1.0)] {
            let shear = Array2::from_shape_fn((n, n), |(i, j)| {
                Complex64::new(e1, e2) * angle(i, j, wave).cos()
            });
            let turned = shear.mapv(|g| g * Complex64::new(0.0, 1.0));
            let power = |m: &Array2<Complex64>| m.iter().map(|v| v.norm_sqr()).sum::<f64>();
            let modes = decomposer.modes_of(shear);
            assert!(power(&modes.b) < 1e-12 * power(&modes.e), "wave {wave:?}");
            // κ keeps the sign of the wave: E is +n²/2 at the wave vector.
            assert!((modes.e[wave].re - (n * n) as f64 / 2.0).abs() < 1e-6);
            let modes = decomposer.modes_of(turned);
            assert!(power(&modes.e) < 1e-12 * power(&modes.b));
        }
    }

    #[test]
    fn composing_modes_and_decomposing_them_is_a_round_trip() {
        let n = 15;
        let grid = Grid::great10(n).unwrap();
        let decomposer = Decomposer::new(grid);
        let mut modes = decomposer.modes_of(field(n, 9));
        let again = decomposer.modes_of(decomposer.compose(&modes).unwrap());
        modes.e[(0, 0)] = Complex64::ZERO;
        modes.b[(0, 0)] = Complex64::ZERO;
        assert!(alike(&modes.e, &again.e));
        assert!(alike(&modes.b, &again.b));
    }
}
