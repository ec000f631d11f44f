//! Brightness of pixels and levels of noise that single precision can hold.

use std::ops::RangeInclusive;

use multiversion::multiversion;

/// Brightest pixels, in image units, whose autocorrelation keeps single precision: its squares stay
/// away from the smallest and largest numbers there are.
pub(crate) const PEAKS: RangeInclusive<f32> = 1e-18..=1e17;
/// Noise levels other than zero, in image units, whose squares keep single precision beside those of [`PEAKS`].
const LEVELS: RangeInclusive<f64> = 1e-30..=1e18;

/// Whether a noise level can be used.
pub(crate) fn is_level(sigma: f64) -> bool {
    sigma == 0.0 || LEVELS.contains(&sigma)
}

/// The largest pixel, or zero if none is positive. 64 running maxima let vector instructions take several at a time.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn highest(pixels: &[f32]) -> f32 {
    /// Numbers that are compared side by side. See docs/constants.md.
    const LANES: usize = 64;
    let mut lanes = [0.0f32; LANES];
    let chunks = pixels.chunks_exact(LANES);
    let rest = chunks.remainder().iter().copied().fold(0.0, f32::max);
    for chunk in chunks {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            // Not a number is not larger.
            *lane = if *value > *lane { *value } else { *lane };
        }
    }
    lanes.into_iter().fold(rest, f32::max)
}

/// Whether all pixels are finite.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn all_finite(pixels: &[f32]) -> bool {
    // No early exit, so that several pixels are tested at a time.
    let largest = pixels
        .iter()
        .fold(0, |most: u32, value| most.max(value.abs().to_bits()));
    largest < f32::INFINITY.to_bits()
}
