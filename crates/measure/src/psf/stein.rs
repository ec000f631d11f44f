//! How much of values is kept beside their noise (James and Stein 1961).

/// Stein's factor for `count` values of the sum of squares `square`, with noise `sigma` each.
pub(super) fn stein(square: f64, count: f64, sigma: f64) -> f64 {
    if square > 0.0 {
        (1.0 - (count - 2.0) * sigma * sigma / square).max(0.0)
    } else {
        0.0
    }
}
