//! The high-pass D of the regularisation.

use shearq_quantities::real::Real;

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

/// Writes D times a row-major image of `n`×`n` pixels, zero outside, to `out`. The kernel is a·uuᵀ less a part of its
/// middle element, with u = (1, r, 1): sums along x, and then along y. `lines` has `n` zeros, room for the image, and
/// `n` zeros.
#[inline(always)]
pub(super) fn roughen<T: Real, const FUSED: bool>(
    image: &[T],
    n: usize,
    lines: &mut [T],
    out: &mut [T],
) {
    let corner = SUN_KERNEL[0][0];
    let ratio = SUN_KERNEL[0][1] / corner;
    let middle = SUN_KERNEL[1][1] - corner * ratio * ratio;
    let [corner, ratio, middle] = [corner, ratio, middle].map(T::from_f64);
    let (image, out) = (&image[..n * n], &mut out[..n * n]);
    let inner = &mut lines[n..][..n * n];
    for (out, three) in inner[1..].iter_mut().zip(image.windows(3)) {
        *out = three[0]
            .plus(three[2])
            .add_product::<FUSED>(ratio, three[1]);
    }
    // Pixels at the ends of rows have one neighbour.
    for (out, row) in inner.chunks_exact_mut(n).zip(image.chunks_exact(n)) {
        out[0] = row[1].add_product::<FUSED>(ratio, row[0]);
        out[n - 1] = row[n - 2].add_product::<FUSED>(ratio, row[n - 1]);
    }
    let above_and_below = lines[..n * n].iter().zip(&lines[2 * n..]);
    let values = lines[n..].iter().zip(above_and_below).zip(image);
    for (out, ((line, (above, below)), pixel)) in out.iter_mut().zip(values) {
        let sum = above.plus(*below).add_product::<FUSED>(ratio, *line);
        *out = corner.times(sum).add_product::<FUSED>(middle, *pixel);
    }
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
