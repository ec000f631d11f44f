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

/// The examples of README.md.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
