//! Plans of Fourier transforms in double precision, and the complex numbers of all crates.
//!
//! rustfft is generic over the number type. Every crate that makes a plan would compile its transforms again.
//! These functions have concrete types, so the transforms are compiled in this crate only. A plan is a trait
//! object: its transforms run through a table of functions.
//!
//! Forward transforms multiply by exp(−2πi jk/n), inverse transforms by exp(+2πi jk/n). Neither divides by n.
use std::sync::Arc;

use rustfft::FftPlanner;

pub use rustfft::Fft;
pub use rustfft::num_complex::{Complex32, Complex64};

/// A shared plan of complex transforms in double precision.
pub type Plan64 = Arc<dyn Fft<f64>>;

/// Makes plans in double precision. Plans from one planner share their tables.
// Single precision has no planner here: the only transforms of f32 are those of `measure`, which are not plans of rustfft.
pub struct Planner64(FftPlanner<f64>);

impl std::fmt::Debug for Planner64 {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Planner64").finish_non_exhaustive()
    }
}

impl Planner64 {
    /// An empty planner.
    // As for the plans below: inlined, rustfft's transforms would be compiled where it is called.
    #[inline(never)]
    pub fn new() -> Self {
        Planner64(FftPlanner::new())
    }

    /// The forward transform of `n` complex numbers.
    #[inline(never)]
    pub fn forward(&mut self, n: usize) -> Plan64 {
        self.0.plan_fft_forward(n)
    }

    /// The inverse transform of `n` complex numbers.
    #[inline(never)]
    pub fn inverse(&mut self, n: usize) -> Plan64 {
        self.0.plan_fft_inverse(n)
    }
}

impl Default for Planner64 {
    fn default() -> Self {
        Self::new()
    }
}
