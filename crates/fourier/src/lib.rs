//! Plans of Fourier transforms in single and double precision.
//!
//! rustfft is generic over the number type. Every crate that makes a plan would compile its transforms again.
//! These functions have concrete types, so the transforms are compiled in this crate only. A plan is a trait
//! object: its transforms run through a table of functions.
//!
//! Forward transforms multiply by exp(−2πi jk/n), inverse transforms by exp(+2πi jk/n). Neither divides by n.
#![forbid(unsafe_code)]

use std::sync::Arc;

use realfft::RealFftPlanner;
use rustfft::FftPlanner;

pub use realfft::{ComplexToReal, RealToComplex};
pub use rustfft::Fft;
pub use rustfft::num_complex::{Complex32, Complex64};

/// A shared plan of complex transforms in single precision.
pub type Plan32 = Arc<dyn Fft<f32>>;
/// A shared plan of complex transforms in double precision.
pub type Plan64 = Arc<dyn Fft<f64>>;

/// Makes plans in single precision. Plans from one planner share their tables.
pub struct Planner32 {
    complex: FftPlanner<f32>,
    real: RealFftPlanner<f32>,
}

impl std::fmt::Debug for Planner32 {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Planner32").finish_non_exhaustive()
    }
}

impl Planner32 {
    /// An empty planner.
    #[inline(never)]
    pub fn new() -> Self {
        Planner32 {
            complex: FftPlanner::new(),
            real: RealFftPlanner::new(),
        }
    }

    /// The forward transform of `n` complex numbers.
    #[inline(never)]
    pub fn forward(&mut self, n: usize) -> Plan32 {
        self.complex.plan_fft_forward(n)
    }

    /// The inverse transform of `n` complex numbers.
    #[inline(never)]
    pub fn inverse(&mut self, n: usize) -> Plan32 {
        self.complex.plan_fft_inverse(n)
    }

    /// The forward transform of `n` real numbers into `n/2 + 1` complex numbers.
    #[inline(never)]
    pub fn real_forward(&mut self, n: usize) -> Arc<dyn RealToComplex<f32>> {
        self.real.plan_fft_forward(n)
    }

    /// The inverse transform of `n/2 + 1` complex numbers into `n` real numbers.
    #[inline(never)]
    pub fn real_inverse(&mut self, n: usize) -> Arc<dyn ComplexToReal<f32>> {
        self.real.plan_fft_inverse(n)
    }
}

impl Default for Planner32 {
    fn default() -> Self {
        Self::new()
    }
}

/// Makes plans in double precision. Plans from one planner share their tables.
pub struct Planner64 {
    complex: FftPlanner<f64>,
}

impl std::fmt::Debug for Planner64 {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Planner64").finish_non_exhaustive()
    }
}

impl Planner64 {
    /// An empty planner.
    #[inline(never)]
    pub fn new() -> Self {
        Planner64 {
            complex: FftPlanner::new(),
        }
    }

    /// The forward transform of `n` complex numbers.
    #[inline(never)]
    pub fn forward(&mut self, n: usize) -> Plan64 {
        self.complex.plan_fft_forward(n)
    }

    /// The inverse transform of `n` complex numbers.
    #[inline(never)]
    pub fn inverse(&mut self, n: usize) -> Plan64 {
        self.complex.plan_fft_inverse(n)
    }
}

impl Default for Planner64 {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Σ_j exp(sign · 2πi jk/n) x_j.
    fn slow(values: &[Complex64], sign: f64) -> Vec<Complex64> {
        let n = values.len();
        let turn =
            |j: usize, k: usize| sign * std::f64::consts::TAU * ((j * k) % n) as f64 / n as f64;
        (0..n)
            .map(|k| (0..n).map(|j| values[j] * Complex64::cis(turn(j, k))).sum())
            .collect()
    }

    fn values(n: usize) -> Vec<Complex64> {
        (0..n)
            .map(|j| Complex64::new((j * j % 7) as f64 - 3.0, (j % 5) as f64))
            .collect()
    }

    /// Rounding of sums of `n` numbers below 8 in units of `epsilon`, with a margin of ten.
    fn tolerance(n: usize, epsilon: f64) -> f64 {
        10.0 * 8.0 * n as f64 * epsilon
    }

    #[test]
    fn complex_plans_have_the_stated_sign_and_scale() {
        for n in [1, 2, 3, 8, 15, 20, 48] {
            let given = values(n);
            let mut planner = Planner64::new();
            for (plan, sign) in [(planner.forward(n), -1.0), (planner.inverse(n), 1.0)] {
                let mut found = given.clone();
                plan.process(&mut found);
                for (a, b) in found.iter().zip(slow(&given, sign)) {
                    assert!((a - b).norm() < tolerance(n, f64::EPSILON), "{n} {sign}");
                }
            }
            let mut planner = Planner32::new();
            for (plan, sign) in [(planner.forward(n), -1.0), (planner.inverse(n), 1.0)] {
                let mut found: Vec<Complex32> = given
                    .iter()
                    .map(|v| Complex32::new(v.re as f32, v.im as f32))
                    .collect();
                plan.process(&mut found);
                for (a, b) in found.iter().zip(slow(&given, sign)) {
                    let apart = Complex64::new(f64::from(a.re), f64::from(a.im)) - b;
                    assert!(
                        apart.norm() < tolerance(n, f64::from(f32::EPSILON)),
                        "{n} {sign}"
                    );
                }
            }
        }
    }

    #[test]
    fn real_plans_are_halves_of_the_complex_ones() {
        for n in [2, 6, 15, 48] {
            let real: Vec<f32> = (0..n).map(|j| (j * 3 % 11) as f32 - 5.0).collect();
            let whole: Vec<Complex64> = real
                .iter()
                .map(|&v| Complex64::from(f64::from(v)))
                .collect();
            let mut planner = Planner32::new();
            let mut half = vec![Complex32::ZERO; n / 2 + 1];
            planner
                .real_forward(n)
                .process(&mut real.clone(), &mut half)
                .unwrap();
            for (a, b) in half.iter().zip(slow(&whole, -1.0)) {
                let apart = Complex64::new(f64::from(a.re), f64::from(a.im)) - b;
                assert!(apart.norm() < tolerance(n, f64::from(f32::EPSILON)), "{n}");
            }
            let mut back = vec![0.0; n];
            planner
                .real_inverse(n)
                .process(&mut half, &mut back)
                .unwrap();
            for (a, b) in back.iter().zip(&real) {
                let apart = (a / n as f32 - b).abs();
                assert!(
                    f64::from(apart) < tolerance(n, f64::from(f32::EPSILON)),
                    "{n}"
                );
            }
        }
    }
}

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
