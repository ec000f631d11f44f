//! The convolution H with its transpose, the regularisation λ, and the thresholds they imply.

use ndarray::ArrayView2;
use shearq_submissions::limits::MAX_PSF;

use super::convolution::Convolution;
use super::sun::SUN_KERNEL;
use crate::error::MeasureError;
use crate::pixel::check_sizes;
use shearq_quantities::product::LANES;
use shearq_quantities::real::Real;

/// H, λ and thresholds of one stamp size and PSF.
#[derive(Debug, Clone)]
pub struct Operator<T> {
    pub(super) n: usize,
    pub(super) p: usize,
    /// λ.
    pub(super) lambda: T,
    /// H.
    pub(super) convolution: Convolution<T>,
    /// TH_i for a unit of brightness of one, row-major n×n (Eq. 9), and infinite behind them.
    pub(super) thresholds: Vec<T>,
}

impl<T: Real> Operator<T> {
    pub(super) fn new(n: usize, p: usize, lambda: f64) -> Result<Self, MeasureError> {
        check_sizes(n, p)?;
        Ok(Operator {
            n,
            p,
            lambda: T::from_f64(lambda),
            convolution: Convolution::new(n, p),
            thresholds: vec![T::from_f64(f64::INFINITY); padded(n)],
        })
    }

    /// Takes `factor` times a PSF of the planned size. Allocates nothing.
    #[inline(always)]
    pub(super) fn set_psf<const R: usize, const FUSED: bool>(
        &mut self,
        psf: ArrayView2<'_, f64>,
        factor: f64,
    ) {
        self.convolution.set_psf::<R, FUSED>(psf, factor);
        self.set_thresholds(psf, factor * factor);
    }

    /// TH_i = ½|W_ii + λG_ii|: W_ii is the sum of h² over the part of the PSF that falls inside the
    /// stamp when centred on pixel i, times `square`, and G_ii the same for d.
    fn set_thresholds(&mut self, psf: ArrayView2<'_, f64>, square: f64) {
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
                let w = square * (at(j1, i1) - at(j0, i1) - at(j1, i0) + at(j0, i0));
                let (di0, di1) = window(x, 3);
                let mut g = 0.0;
                for row in &SUN_KERNEL[dj0..dj1] {
                    for value in &row[di0..di1] {
                        g += value * value;
                    }
                }
                self.thresholds[y * n + x] = T::from_f64(0.5 * (w + lambda * g).abs());
            }
        }
    }
}

/// Pixels of a stamp of side `n`, filled up to whole lanes.
pub(super) fn padded(n: usize) -> usize {
    (n * n).next_multiple_of(LANES)
}
