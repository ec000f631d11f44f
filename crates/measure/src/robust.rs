//! Medians, and the scatter about them.

/// Standard deviation of Gaussian numbers in units of the median of their moduli. See
/// docs/constants.md.
pub(crate) const FROM_MODULI: f64 = 1.482_602_2;
/// Standard error of a median in units of the standard error of the mean. See docs/constants.md.
pub(crate) const OF_MEDIAN: f64 = 1.253_314;

/// The lower median; reorders the values.
pub(crate) fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len().checked_sub(1)? / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Median and scatter of the values.
pub(crate) fn scatter(values: &mut [f64]) -> Option<(f64, f64)> {
    let middle = median(values)?;
    let mut moduli: Vec<f64> = values.iter().map(|value| (value - middle).abs()).collect();
    Some((middle, FROM_MODULI * median(&mut moduli)?))
}
