//! What tests share.

/// Panics unless two numbers differ by less than a tolerance.
#[track_caller]
pub(crate) fn close(found: impl Into<f64>, expected: impl Into<f64>, tolerance: impl Into<f64>) {
    let (found, expected, tolerance) = (found.into(), expected.into(), tolerance.into());
    let is_close = (found - expected).abs() < tolerance;
    assert!(is_close, "found {found}, expected {expected} ± {tolerance}");
}
