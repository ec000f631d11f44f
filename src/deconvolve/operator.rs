//! The convolution H, its transpose and D as small kernels, with the thresholds they imply.

use ndarray::ArrayView2;
use thiserror::Error;

use super::kernel::{Kernel, LANES, Real};

/// Sun's high-pass kernel d (Sect. 3.1); its elements sum to zero.
pub const SUN_KERNEL: [[f64; 3]; 3] = [
    [0.007, 0.010, 0.007],
    [0.010, -0.068, 0.010],
    [0.007, 0.010, 0.007],
];

/// Largest stamp side the kernel accepts.
pub const MAX_STAMP: usize = 64;
/// Largest PSF side the kernel accepts.
pub const MAX_PSF: usize = 48;

/// A PSF or stamp size that cannot make an operator.
#[derive(Debug, Error, PartialEq)]
pub enum OperatorError {
    /// A stamp side out of range.
    #[error("the stamp has {found} pixels a side; expected 3 to {MAX_STAMP}")]
    StampSize {
        /// Side found.
        found: usize,
    },
    /// A PSF that is not square or of a side out of range.
    #[error("the PSF stamp has {rows} × {columns} pixels; expected a square of 2 to {MAX_PSF}")]
    PsfSize {
        /// Rows found.
        rows: usize,
        /// Columns found.
        columns: usize,
    },
    /// A PSF pixel that is not finite.
    #[error("pixel ({x}, {y}) of the PSF stamp, counted from 1, is not a finite number")]
    PsfNotFinite {
        /// Column, 1-based.
        x: usize,
        /// Row, 1-based.
        y: usize,
    },
}

/// H, Hᵀ and D of one stamp size and PSF, laid out for the kernel.
#[derive(Debug, Clone)]
pub(super) struct Operator<T> {
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
    pub(super) fn new(n: usize, p: usize, lambda: f64) -> Result<Self, OperatorError> {
        if !(3..=MAX_STAMP).contains(&n) {
            return Err(OperatorError::StampSize { found: n });
        }
        if !(2..=MAX_PSF).contains(&p) {
            return Err(OperatorError::PsfSize {
                rows: p,
                columns: p,
            });
        }
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

    /// Takes a PSF of the planned size. Allocates nothing.
    pub(super) fn set_psf(&mut self, psf: ArrayView2<'_, f64>) -> Result<(), OperatorError> {
        let p = self.p;
        if psf.dim() != (p, p) {
            return Err(OperatorError::PsfSize {
                rows: psf.nrows(),
                columns: psf.ncols(),
            });
        }
        for ((y, x), value) in psf.indexed_iter() {
            if !value.is_finite() {
                return Err(OperatorError::PsfNotFinite { x: x + 1, y: y + 1 });
            }
            let value = T::from_f64(*value);
            self.forward.set(y, x, value);
            self.turned.set(p - 1 - y, p - 1 - x, value);
        }
        self.set_thresholds(psf);
        Ok(())
    }

    /// TH_i = ½|W_ii + λG_ii|: W_ii is the sum of h² over the part of the PSF that falls inside the
    /// stamp when centred on pixel i, and G_ii the same for d.
    fn set_thresholds(&mut self, psf: ArrayView2<'_, f64>) {
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
                let w = at(j1, i1) - at(j0, i1) - at(j1, i0) + at(j0, i0);
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
