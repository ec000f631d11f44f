//! Autocorrelation of a stamp by zero-padded FFT.

use shearq_fourier::Complex32;

use crate::error::{MeasureError, length};
use crate::fft::{FftScratch, StampFft};

/// Autocorrelation of n×n stamps: A(dx, dy) = Σ v(x, y)·v(x + dx, y + dy), zero outside the stamp, or
/// the stamp again.
///
/// Lags are kept for dy = 0…n−1 and dx = −(n−1)…n−1; the other half follows from
/// A(−dx, −dy) = A(dx, dy).
#[derive(Debug, Clone)]
pub struct Autocorrelation {
    n: usize,
    /// At least 2n − 1 a side, so that no lag wraps onto another.
    fft: StampFft,
    circular: bool,
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub struct AcfScratch {
    spectrum: Vec<Complex32>,
    fft: FftScratch,
    /// Lags without wrapping, where they are wrapped afterwards.
    plain: Vec<f32>,
}

impl Autocorrelation {
    /// Plans for n×n stamps.
    pub fn new(n: usize) -> Self {
        Autocorrelation {
            n,
            fft: StampFft::new(2 * n - 1),
            circular: false,
        }
    }

    /// Plans for n×n stamps that go on beyond their edges as they begin: what a transform without padding
    /// gives, on lags up to n/2.
    pub fn circular(n: usize) -> Self {
        Autocorrelation {
            circular: true,
            ..Autocorrelation::new(n)
        }
    }

    /// Buffers that fit this plan.
    pub fn scratch(&self) -> AcfScratch {
        AcfScratch {
            spectrum: self.fft.spectrum(),
            fft: self.fft.scratch(),
            plain: vec![0.0; if self.circular { self.len() } else { 0 }],
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

    /// Writes A(dx, dy) of the row-major `stamp` to `out[dy·(2n−1) + dx + n−1]`; zero at lags beyond n/2
    /// where it is circular.
    ///
    /// # Errors
    /// Where a length is not that of the plan.
    pub fn compute(
        &self,
        stamp: &[f32],
        scratch: &mut AcfScratch,
        out: &mut [f32],
    ) -> Result<(), MeasureError> {
        self.compute_above(0.0, stamp, scratch, out)
    }

    /// The same of the stamp less `level` in every pixel.
    pub(super) fn compute_above(
        &self,
        level: f32,
        stamp: &[f32],
        scratch: &mut AcfScratch,
        out: &mut [f32],
    ) -> Result<(), MeasureError> {
        let (n, size) = (self.n, self.fft.size);
        length("a stamp", stamp.len(), n * n)?;
        length("an autocorrelation", out.len(), self.len())?;
        let room = self.fft.spectrum_len();
        length(
            "buffers for an autocorrelation",
            scratch.spectrum.len(),
            room,
        )?;
        let wrapped = if self.circular { self.len() } else { 0 };
        length(
            "buffers for an autocorrelation",
            scratch.plain.len(),
            wrapped,
        )?;
        let AcfScratch {
            spectrum,
            fft,
            plain,
        } = scratch;
        let rows = stamp
            .chunks_exact(n)
            .map(|row| row.iter().map(|value| value - level));
        self.fft.rows(rows, fft, spectrum);
        self.fft.columns(fft, spectrum);
        for value in spectrum.iter_mut() {
            *value = Complex32::new(value.norm_sqr(), 0.0);
        }
        self.fft.columns_back(fft, spectrum);
        let scale = 1.0 / (size * size) as f32;
        let unwrapped: &mut [f32] = if self.circular { plain } else { out };
        for (dy, lags) in unwrapped.chunks_exact_mut(2 * n - 1).enumerate() {
            let line = self.fft.row_back(spectrum, dy, fft);
            // lag = dx + n − 1; negative dx lie at the end of the line.
            let negative = line[size + 1 - n..].iter().chain(&line[..n]);
            for (value, lag) in lags.iter_mut().zip(negative) {
                *value = lag * scale;
            }
        }
        if self.circular {
            wrap(n, plain, out);
        }
        Ok(())
    }
}

/// Adds up the lags that a period of n pixels makes one: A(dx, dy) and its neighbours n pixels off along
/// either axis, those with dy < 0 from A(−dx, −dy) = A(dx, dy).
fn wrap(n: usize, plain: &[f32], out: &mut [f32]) {
    let (side, half) = (2 * n - 1, n / 2);
    out.fill(0.0);
    for dy in 0..=half {
        for at in n - 1 - half..=n - 1 + half {
            // Place of dx − n or dx + n; there is none at zero lag, n pixels off.
            let other = if at >= n {
                Some(at - n)
            } else {
                (at < n - 1).then_some(at + n)
            };
            let mut sum = plain[dy * side + at] + other.map_or(0.0, |x| plain[dy * side + x]);
            if dy > 0 {
                let opposite = &plain[(n - dy) * side..][..side];
                let turned = |x: usize| opposite[side - 1 - x];
                sum += turned(at) + other.map_or(0.0, turned);
            }
            out[dy * side + at] = sum;
        }
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// The same lags by the plain definition in f64.
    fn autocorrelation_naive(stamp: &Array2<f64>) -> Array2<f64> {
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

    #[test]
    fn equals_the_plain_definition_for_all_sizes_and_dirty_scratch() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for n in [3, 5, 8, 11, 19, 23, 29, 32, 48] {
            let plan = Autocorrelation::new(n);
            let mut scratch = plan.scratch();
            scratch.spectrum.fill(Complex32::new(1e9, -1e9));
            let stamp = Array2::from_shape_fn((n, n), |_| rng.random_range(0.0..1.0));
            let single: Vec<f32> = stamp.iter().map(|&v: &f64| v as f32).collect();
            let mut found = vec![f32::NAN; plan.len()];
            plan.compute(&single, &mut scratch, &mut found).unwrap();
            assert!(
                plan.compute(&single[1..], &mut scratch, &mut found)
                    .is_err()
            );
            let expected = autocorrelation_naive(&stamp);
            let peak = expected.iter().copied().fold(0.0, f64::max);
            for (a, b) in found.iter().zip(&expected) {
                // f32 transforms: a few times 1e-7 of the largest value.
                assert!((f64::from(*a) - b).abs() < 1e-6 * peak, "n {n}");
            }
        }
    }
}
