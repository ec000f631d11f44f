//! Autocorrelation of a stamp by zero-padded FFT.

use std::sync::Arc;

use ndarray::Array2;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use rustfft::num_complex::Complex32;
use rustfft::{Fft, FftPlanner};

/// Autocorrelation of n×n stamps: A(dx, dy) = Σ v(x, y)·v(x + dx, y + dy), zero outside the stamp.
///
/// Lags are kept for dy = 0…n−1 and dx = −(n−1)…n−1; the other half follows from
/// A(−dx, −dy) = A(dx, dy).
pub struct Autocorrelation {
    n: usize,
    /// FFT side, at least 2n − 1 so that no lag wraps onto another.
    size: usize,
    forward: Arc<dyn RealToComplex<f32>>,
    backward: Arc<dyn ComplexToReal<f32>>,
    column: Arc<dyn Fft<f32>>,
    column_back: Arc<dyn Fft<f32>>,
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub struct AcfScratch {
    line: Vec<f32>,
    half: Vec<Complex32>,
    /// Half spectrum, column by column: `size` values along y for each of `size/2 + 1` frequencies.
    columns: Vec<Complex32>,
    fft: Vec<Complex32>,
}

impl Autocorrelation {
    /// Plans for n×n stamps.
    pub fn new(n: usize) -> Self {
        let size = transform_size(2 * n - 1);
        let mut real = RealFftPlanner::new();
        let mut complex = FftPlanner::new();
        Autocorrelation {
            n,
            size,
            forward: real.plan_fft_forward(size),
            backward: real.plan_fft_inverse(size),
            column: complex.plan_fft_forward(size),
            column_back: complex.plan_fft_inverse(size),
        }
    }

    /// Buffers that fit this plan.
    pub fn scratch(&self) -> AcfScratch {
        let zero = Complex32::ZERO;
        let half = self.size / 2 + 1;
        let fft = [
            self.forward.get_scratch_len(),
            self.backward.get_scratch_len(),
            self.column.get_inplace_scratch_len(),
            self.column_back.get_inplace_scratch_len(),
        ];
        AcfScratch {
            line: vec![0.0; self.size],
            half: vec![zero; half],
            columns: vec![zero; half * self.size],
            fft: vec![zero; fft.into_iter().max().unwrap_or(0)],
        }
    }

    /// Number of values [`Autocorrelation::compute`] writes: n rows (dy) of 2n − 1 lags (dx).
    pub fn len(&self) -> usize {
        self.n * (2 * self.n - 1)
    }

    /// Whether there are no lags; never, but expected beside `len`.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Writes A(dx, dy) of the row-major `stamp` to `out[dy·(2n−1) + dx + n−1]`.
    ///
    /// # Panics
    /// Where a length is not that of the plan.
    pub fn compute(&self, stamp: &[f32], scratch: &mut AcfScratch, out: &mut [f32]) {
        let (n, size) = (self.n, self.size);
        let half = size / 2 + 1;
        assert_eq!(out.len(), self.len(), "lags of a stamp of {n} × {n} pixels");
        let AcfScratch {
            line,
            half: spectrum,
            columns,
            fft,
        } = scratch;
        for (y, row) in stamp.chunks_exact(n).enumerate() {
            line[..n].copy_from_slice(row);
            line[n..].fill(0.0);
            // Lengths are the plan's own, which is all that these calls can object to.
            let done = self.forward.process_with_scratch(line, spectrum, fft);
            debug_assert!(done.is_ok());
            for (k, value) in spectrum.iter().enumerate() {
                columns[k * size + y] = *value;
            }
        }
        // Power spectrum of each column, back along y; only lags dy < n are needed after that.
        for column in columns.chunks_exact_mut(size) {
            column[n..].fill(Complex32::ZERO);
            self.column.process_with_scratch(column, fft);
            for value in column.iter_mut() {
                *value = Complex32::new(value.norm_sqr(), 0.0);
            }
            self.column_back.process_with_scratch(column, fft);
        }
        let scale = 1.0 / (size * size) as f32;
        for (dy, lags) in out.chunks_exact_mut(2 * n - 1).enumerate() {
            for (k, value) in spectrum.iter_mut().enumerate() {
                *value = columns[k * size + dy];
            }
            // The first and, for even sizes, the last value are real but for rounding.
            spectrum[0].im = 0.0;
            if size % 2 == 0 {
                spectrum[half - 1].im = 0.0;
            }
            let done = self.backward.process_with_scratch(spectrum, line, fft);
            debug_assert!(done.is_ok());
            for (lag, value) in lags.iter_mut().enumerate() {
                // lag = dx + n − 1; negative dx lie at the end of the line.
                *value = line[(lag + size + 1 - n) % size] * scale;
            }
        }
    }
}

/// The smallest even length of at least `least` with no prime factor above 5.
fn transform_size(least: usize) -> usize {
    (least..)
        .find(|&size| {
            let mut rest = size;
            for prime in [2, 3, 5] {
                while rest % prime == 0 {
                    rest /= prime;
                }
            }
            rest == 1 && size % 2 == 0
        })
        .unwrap_or(least)
}

/// The same lags by the plain definition in f64.
pub fn autocorrelation_naive(stamp: &Array2<f64>) -> Array2<f64> {
    let n = stamp.nrows();
    Array2::from_shape_fn((n, 2 * n - 1), |(dy, lag)| {
        let mut sum = 0.0;
        for ((y, x), value) in stamp.indexed_iter() {
            let (y2, x2) = (y + dy, (x + lag + 1).wrapping_sub(n));
            if y2 < n && x2 < n {
                sum += value * stamp[(y2, x2)];
            }
        }
        sum
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn equals_the_plain_definition_for_all_sizes_and_dirty_scratch() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for n in [3, 5, 8, 11, 19, 23, 29, 32, 48] {
            let plan = Autocorrelation::new(n);
            let mut scratch = plan.scratch();
            scratch.columns.fill(Complex32::new(1e9, -1e9));
            let stamp = Array2::from_shape_fn((n, n), |_| rng.random_range(0.0..1.0));
            let single: Vec<f32> = stamp.iter().map(|&v: &f64| v as f32).collect();
            let mut found = vec![f32::NAN; plan.len()];
            plan.compute(&single, &mut scratch, &mut found);
            let expected = autocorrelation_naive(&stamp);
            let peak = expected.iter().copied().fold(0.0, f64::max);
            for (a, b) in found.iter().zip(&expected) {
                // f32 transforms: a few times 1e-7 of the largest value.
                assert!((f64::from(*a) - b).abs() < 1e-6 * peak, "n {n}");
            }
        }
    }
}
