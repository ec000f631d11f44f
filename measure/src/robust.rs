//! Statistics that a few outliers do not move.

/// Scatter of Gaussian numbers in units of the median of their moduli.
pub(crate) const SCATTER: f32 = 1.482_602_2;

/// The lower median of finite values; reorders them. `None` of none.
pub(crate) fn median(values: &mut [f32]) -> Option<f32> {
    if values.is_empty() {
        return None;
    }
    let middle = (values.len() - 1) / 2;
    let (_, median, _) = values.select_nth_unstable_by(middle, f32::total_cmp);
    Some(*median)
}
