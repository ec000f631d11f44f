//! Inputs that the benchmarks share.

use shearq_submissions::{Configuration, Registry};

/// An embedded submission.
///
/// # Panics
/// Where there is none of that name.
pub fn configuration(name: &str) -> Configuration {
    let entry = Registry::embedded().and_then(|registry| registry.get(name));
    entry.expect("an embedded submission").configuration
}

/// A galaxy-like n×n stamp with noise of σ = 1 from a fixed generator.
pub fn stamp(n: usize) -> Vec<f32> {
    let mut state = 1u64;
    let mut next = || {
        state = state
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1u64 << 24) as f32 - 0.5
    };
    let centre = (n as f32 - 1.0) / 2.0;
    (0..n * n)
        .map(|k| {
            let (y, x) = ((k / n) as f32 - centre, (k % n) as f32 - centre);
            5.0 * (-(x * x + y * y - 0.4 * x * y) / 16.0).exp() + 3.46 * next()
        })
        .collect()
}
