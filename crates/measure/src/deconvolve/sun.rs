//! The high-pass of the regularisation.

/// High-pass kernel of the regularisation; its elements sum to zero. See docs/constants.md.
pub(super) const SUN_KERNEL: [[f64; 3]; 3] = [
    [0.007, 0.010, 0.007],
    [0.010, -0.068, 0.010],
    [0.007, 0.010, 0.007],
];

/// Its transform, which is real.
pub(super) fn high_pass(kx: f64, ky: f64) -> f64 {
    let (cx, cy) = (kx.cos(), ky.cos());
    SUN_KERNEL[1][1]
        + 2.0 * SUN_KERNEL[1][0] * cx
        + 2.0 * SUN_KERNEL[0][1] * cy
        + 4.0 * SUN_KERNEL[0][0] * cx * cy
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_limit_of_settings_is_the_largest_square_of_its_transform() {
        let waves = || (0..=64).map(|k| std::f64::consts::PI * f64::from(k) / 64.0);
        let squares = waves().flat_map(|kx| waves().map(move |ky| high_pass(kx, ky).powi(2)));
        let largest = squares.fold(0.0, f64::max);
        let limit = shearq_submissions::limits::MAX_ROUGHNESS;
        assert!(largest <= limit && limit < 1.01 * largest, "{largest}");
    }
}
