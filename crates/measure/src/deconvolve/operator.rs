//! The convolution H, its transpose and D as small kernels, with the thresholds they imply.

use ndarray::ArrayView2;
use shearq_submissions::limits::MAX_PSF;

use super::real::Real;
use super::slide::{Kernel, LANES};
use super::sun::SUN_KERNEL;
use crate::error::MeasureError;
use crate::sizes::{check_psf, check_sizes};

/// H, Hᵀ and D of one stamp size and PSF, laid out for the kernel.
#[derive(Debug, Clone)]
pub struct Operator<T> {
    pub(super) n: usize,
    pub(super) p: usize,
    /// λ.
    pub(super) lambda: T,
    /// h: what Hᵀ slides over the residual.
    pub(super) forward: Kernel<T>,
    /// h turned by 180°: what H slides over the state.
    pub(super) turned: Kernel<T>,
    /// d.
    pub(super) sun: Kernel<T>,
    /// TH_i for a unit of brightness of one, row-major n×n (Eq. 9).
    pub(super) thresholds: Vec<T>,
    /// The same in rows of whole vectors, infinite behind their ends.
    pub(super) wide_thresholds: Vec<T>,
    /// One for each pixel of a row, zero behind its end.
    pub(super) inside: Vec<T>,
}

impl<T: Real> Operator<T> {
    pub(super) fn new(n: usize, p: usize, lambda: f64) -> Result<Self, MeasureError> {
        check_sizes(n, p)?;
        let wide = n.next_multiple_of(LANES);
        let mut inside = vec![T::ZERO; wide];
        inside[..n].fill(T::from_f64(1.0));
        let mut sun = Kernel::new(3, 1);
        for (j, row) in SUN_KERNEL.iter().enumerate() {
            for (i, &value) in row.iter().enumerate() {
                sun.set(j, i, T::from_f64(value));
            }
        }
        Ok(Operator {
            n,
            p,
            lambda: T::from_f64(lambda),
            // A PSF's centre is its pixel p/2; turned, p − 1 − p/2.
            forward: Kernel::new(p, p / 2),
            turned: Kernel::new(p, p - 1 - p / 2),
            sun,
            thresholds: vec![T::ZERO; n * n],
            wide_thresholds: vec![T::from_f64(f64::INFINITY); n * wide],
            inside,
        })
    }

    /// Takes `factor` times a PSF of the planned size. Allocates nothing.
    pub(super) fn set_psf(
        &mut self,
        psf: ArrayView2<'_, f64>,
        factor: f64,
    ) -> Result<(), MeasureError> {
        let p = self.p;
        check_psf(psf, p)?;
        for ((y, x), value) in psf.indexed_iter() {
            let value = T::from_f64(*value * factor);
            self.forward.set(y, x, value);
            self.turned.set(p - 1 - y, p - 1 - x, value);
        }
        self.set_thresholds(psf, factor * factor);
        Ok(())
    }

    /// TH_i = ½|W_ii + λG_ii|: W_ii is the sum of h² over the part of the PSF that falls inside the
    /// stamp when centred on pixel i, times `factor`, and G_ii the same for d.
    fn set_thresholds(&mut self, psf: ArrayView2<'_, f64>, factor: f64) {
        // Sums over all rectangles from the corner, so that any window costs four look-ups.
        let mut sums = [0.0; (MAX_PSF + 1) * (MAX_PSF + 1)];
        let stride = self.p + 1;
        for y in 0..self.p {
            let mut row = 0.0;
            for x in 0..self.p {
                row += psf[(y, x)] * psf[(y, x)];
                sums[(y + 1) * stride + x + 1] = sums[y * stride + x + 1] + row;
            }
        }
        let n = self.n;
        // Kernel rows j with 0 ≤ y + j − c < n.
        let window = |at: usize, side: usize| {
            let c = side / 2;
            (c.saturating_sub(at), side.min(n + c - at))
        };
        let lambda = self.lambda.to_f64();
        for y in 0..n {
            let (j0, j1) = window(y, self.p);
            let (dj0, dj1) = window(y, 3);
            for x in 0..n {
                let (i0, i1) = window(x, self.p);
                let at = |j: usize, i: usize| sums[j * stride + i];
                let w = factor * (at(j1, i1) - at(j0, i1) - at(j1, i0) + at(j0, i0));
                let (di0, di1) = window(x, 3);
                let mut g = 0.0;
                for row in &SUN_KERNEL[dj0..dj1] {
                    for value in &row[di0..di1] {
                        g += value * value;
                    }
                }
                let threshold = T::from_f64(0.5 * (w + lambda * g).abs());
                self.thresholds[y * n + x] = threshold;
                self.wide_thresholds[y * n.next_multiple_of(LANES) + x] = threshold;
            }
        }
    }
}
