//! The network written as its equations: dense matrices, f64, no short cuts.
//!
//! It is the oracle of the working kernel, and far too slow for anything else: H alone has n⁴
//! elements.

use ndarray::{Array1, Array2, ArrayView2, arr2};
use shearq_submissions::{Clipping, Kept, Start};

use super::descent::{Descent, Stop};
use super::rule::{Rule, Step};
use super::sun::SUN_KERNEL;
use crate::error::MeasureError;

/// The n²×n² matrix of the convolution of an n×n image with `kernel` under a zero boundary: a block
/// Toeplitz matrix of Toeplitz blocks (Sect. 2.1, Fig. 1).
fn toeplitz(n: usize, kernel: ArrayView2<'_, f64>) -> Array2<f64> {
    let (cy, cx) = (kernel.nrows() / 2, kernel.ncols() / 2);
    let mut matrix = Array2::zeros((n * n, n * n));
    for y in 0..n {
        for x in 0..n {
            for ((j, i), &value) in kernel.indexed_iter() {
                // (Hv)[y, x] takes v[y − (j − c), x − (i − c)].
                let (sy, sx) = ((y + cy).wrapping_sub(j), (x + cx).wrapping_sub(i));
                if sy < n && sx < n {
                    matrix[(y * n + x, sy * n + sx)] = value;
                }
            }
        }
    }
    matrix
}

/// The same convolution without the matrix: Hv of a square image, zero outside it.
pub fn convolve(image: ArrayView2<'_, f64>, kernel: ArrayView2<'_, f64>) -> Array2<f64> {
    let (cy, cx) = (kernel.nrows() / 2, kernel.ncols() / 2);
    Array2::from_shape_fn(image.dim(), |(y, x)| {
        let mut sum = 0.0;
        for ((j, i), &value) in kernel.indexed_iter() {
            let at = ((y + cy).wrapping_sub(j), (x + cx).wrapping_sub(i));
            sum += value * image.get(at).copied().unwrap_or(0.0);
        }
        sum
    })
}

/// D: the same matrix for Sun's 3×3 high-pass kernel (Sect. 3.1).
fn high_pass(n: usize) -> Array2<f64> {
    toeplitz(n, arr2(&SUN_KERNEL).view())
}

/// The matrices of one stamp size and PSF.
#[derive(Debug, Clone)]
pub struct Matrices {
    n: usize,
    h: Array2<f64>,
    /// W + λG, with W = HᵀH and G = DᵀD (Eq. 8).
    weights: Array2<f64>,
    /// TH_i = ½|W_ii + λG_ii| (Eq. 9).
    thresholds: Array1<f64>,
}

impl Matrices {
    /// Builds H, W, G and the thresholds for n×n stamps.
    pub fn new(n: usize, psf: ArrayView2<'_, f64>, lambda: f64) -> Self {
        let h = toeplitz(n, psf);
        let mut weights = h.t().dot(&h);
        if lambda != 0.0 {
            let d = high_pass(n);
            weights.scaled_add(lambda, &d.t().dot(&d));
        }
        let thresholds = weights.diag().mapv(|w| 0.5 * w.abs());
        Matrices {
            n,
            h,
            weights,
            thresholds,
        }
    }

    /// Thresholds TH_i in row-major order, for a unit of brightness of one.
    pub fn thresholds(&self) -> &Array1<f64> {
        &self.thresholds
    }

    /// E(v) (Eq. 7).
    fn energy(&self, q: &Array1<f64>, v: &Array1<f64>) -> f64 {
        0.5 * v.dot(&self.weights.dot(v)) - q.dot(v)
    }

    /// Runs the network on the n×n stamp `u0` and returns its last state.
    ///
    /// # Errors
    /// Where the stamp has other sizes.
    pub fn deconvolve(
        &self,
        rule: &Rule,
        u0: ArrayView2<'_, f64>,
    ) -> Result<(Array2<f64>, Descent), MeasureError> {
        let n = self.n;
        if u0.dim() != (n, n) {
            let expected = format!("{n} × {n}");
            return Err(MeasureError::square("a stamp", u0.dim(), expected));
        }
        let u0: Array1<f64> = u0.iter().copied().collect();
        let q = self.h.t().dot(&u0);
        let mut v = match rule.start {
            Start::Data => u0.clone(),
            Start::ClippedData => u0.mapv(|u| u.max(0.0)),
            Start::Flat => Array1::from_elem(n * n, (u0.sum() / (n * n) as f64).max(0.0)),
            Start::Zero => Array1::zeros(n * n),
        };
        let first_energy = self.energy(&q, &v);
        let mut descent = Descent {
            iterations: 0,
            stop: Stop::MaxIterations,
            first_energy,
            energy: first_energy,
            updated: 0,
        };
        // With momentum: the update of the iteration before, and Nesterov's t.
        let mut last = v.clone();
        let mut momentum: f64 = 1.0;
        for _ in 0..rule.max_iterations {
            // Eq. 11.
            let f = &q - &self.weights.dot(&v);
            let mut moved = v.clone();
            descent.updated = 0;
            for i in 0..n * n {
                let threshold = self.thresholds[i] * rule.unit;
                let change = match rule.step {
                    Step::Adaptive(c) | Step::Accelerated(c) => c * f[i].abs(),
                    Step::Constant(delta) => delta,
                };
                // Eq. 6.
                if f[i] < -threshold {
                    moved[i] -= change;
                    descent.updated += 1;
                } else if f[i] > threshold {
                    moved[i] += change;
                    descent.updated += 1;
                }
                // Eq. 12.
                if rule.clipping == Clipping::BeforeTest {
                    moved[i] = moved[i].max(0.0);
                }
            }
            if descent.updated == 0 {
                descent.stop = Stop::Stable;
                break;
            }
            let mut next = moved.clone();
            let mut beta: f64 = 0.0;
            if let Step::Accelerated(_) = rule.step {
                let on = &moved - &last;
                if (&v - &moved).dot(&on) > 0.0 {
                    momentum = 1.0;
                }
                let grown = 0.5 * (1.0 + (1.0 + 4.0 * momentum * momentum).sqrt());
                beta = (momentum - 1.0) / grown;
                momentum = grown;
                next = &moved + &(on * beta);
                if rule.clipping == Clipping::BeforeTest {
                    next.mapv_inplace(|v| v.max(0.0));
                }
            }
            let mut energy = self.energy(&q, &next);
            if beta > 0.0 && (energy.is_nan() || energy >= descent.energy) {
                momentum = 1.0;
                next = moved.clone();
                energy = self.energy(&q, &next);
            }
            if energy.is_nan() || energy >= descent.energy {
                descent.stop = Stop::EnergyRise;
                if rule.kept == Kept::Last {
                    v = next;
                    descent.energy = energy;
                    descent.iterations += 1;
                }
                break;
            }
            if rule.clipping == Clipping::AfterTest {
                next.mapv_inplace(|v| v.max(0.0));
                energy = self.energy(&q, &next);
            }
            v = next;
            last = moved;
            descent.energy = energy;
            descent.iterations += 1;
        }
        let stamp = Array2::from_shape_fn((n, n), |(y, x)| v[y * n + x]);
        Ok((stamp, descent))
    }
}
