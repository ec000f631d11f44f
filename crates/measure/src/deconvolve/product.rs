//! Products of small matrices. So few modes are kept that sums over pixels, modes or lags along an axis take less time as
//! dense products than as fast transforms.

use multiversion::multiversion;

use super::real::Real;

/// Columns that are summed side by side. See docs/constants.md.
pub(super) const LANES: usize = 16;
/// Multiple of the rows of a product. See docs/constants.md.
pub(super) const ROWS: usize = 8;

/// A matrix in row-major order.
#[derive(Debug, Clone, Copy)]
pub(super) struct Matrix<'a, T = f32> {
    pub(super) values: &'a [T],
    /// Numbers between the beginnings of two rows.
    pub(super) stride: usize,
}

impl<'a, T> Matrix<'a, T> {
    pub(super) fn new(values: &'a [T], stride: usize) -> Self {
        Matrix { values, stride }
    }
}

/// Writes `left` times `right`, a sum over `inner` columns of the one and rows of the other, to rows of `width` numbers,
/// a multiple of [`LANES`]. The number of rows is a multiple of [`ROWS`]. It takes least time if the stride of `left` is
/// 16, 32 or 48.
///
/// Sums run over `inner` in order, fused where the processor can: results are the same for AVX-512, AVX2 and NEON.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn multiply(
    left: Matrix<'_>,
    right: Matrix<'_>,
    inner: usize,
    out: &mut [f32],
    width: usize,
) {
    // As many rows at a time as there are registers for.
    multiversion::target::match_target! {
        "x86_64+avx512f" => product::<_, ROWS, true>(left, right, inner, out, width),
        "x86_64+fma" => product::<_, 4, true>(left, right, inner, out, width),
        "aarch64" => product::<_, 4, true>(left, right, inner, out, width),
        _ => product::<_, 4, false>(left, right, inner, out, width),
    }
}

/// The product as [`multiply`] defines it, `R` rows at a time, for callers that are compiled for an instruction set
/// themselves.
#[inline(always)]
pub(super) fn product<T: Real, const R: usize, const FUSED: bool>(
    left: Matrix<'_, T>,
    right: Matrix<'_, T>,
    inner: usize,
    out: &mut [T],
    width: usize,
) {
    debug_assert!(width.is_multiple_of(LANES) && out.len().is_multiple_of(ROWS * width));
    match left.stride {
        16 => bands::<T, R, 16, FUSED>(left, right, inner, out, width),
        32 => bands::<T, R, 32, FUSED>(left, right, inner, out, width),
        48 => bands::<T, R, 48, FUSED>(left, right, inner, out, width),
        _ => bands::<T, R, 0, FUSED>(left, right, inner, out, width),
    }
}

/// The product for a stride of `S`, or for any if it is zero, [`LANES`] columns at a time.
#[inline(always)]
fn bands<T: Real, const R: usize, const S: usize, const FUSED: bool>(
    left: Matrix<'_, T>,
    right: Matrix<'_, T>,
    inner: usize,
    out: &mut [T],
    width: usize,
) {
    let stride = if S == 0 { left.stride } else { S };
    debug_assert!(inner <= stride, "{inner} columns of {stride}");
    // No column is beyond a row, which the compiler does not know otherwise.
    let inner = inner.min(stride);
    // Of places instead of chunks, whose number would be a division.
    let (mut to, mut from) = (0, 0);
    while to < out.len() {
        let rows = &left.values[from..][..R * stride];
        let out = &mut out[to..][..R * width];
        (to, from) = (to + R * width, from + R * stride);
        for column in (0..width).step_by(LANES) {
            let mut sums = [[T::ZERO; LANES]; R];
            for i in 0..inner {
                // A copy, which stays in a register for all rows.
                let line: [T; LANES] = *right.values[i * right.stride + column..]
                    .first_chunk()
                    .expect("LANES columns");
                // Written out: of a loop, the compiler would make vectors across rows.
                macro_rules! rows {
                    ($($k:literal)*) => {$(
                        if $k < R {
                            add::<T, FUSED>(&mut sums[$k], rows[$k * stride + i], &line);
                        }
                    )*};
                }
                rows!(0 1 2 3 4 5 6 7);
            }
            for (k, sums) in sums.iter().enumerate() {
                out[k * width + column..][..LANES].copy_from_slice(sums);
            }
        }
    }
}

#[inline(always)]
fn add<T: Real, const FUSED: bool>(sums: &mut [T; LANES], factor: T, line: &[T; LANES]) {
    for (sum, value) in sums.iter_mut().zip(line) {
        *sum = sum.add_product::<FUSED>(factor, *value);
    }
}

/// Whether this processor has fused multiply-adds, so that [`multiply`] has the bits of fused sums.
#[cfg(test)]
pub(super) fn fuses() -> bool {
    #[cfg(target_arch = "x86_64")]
    return is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    #[cfg(not(target_arch = "x86_64"))]
    return cfg!(target_arch = "aarch64");
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// The product as a plain sum, and the sum of moduli.
    fn plain(left: Matrix<'_>, right: Matrix<'_>, inner: usize, at: [usize; 2]) -> [f64; 2] {
        let terms = (0..inner).map(|i| {
            let (a, b) = (
                left.values[at[0] * left.stride + i],
                right.values[i * right.stride + at[1]],
            );
            f64::from(a) * f64::from(b)
        });
        terms.fold([0.0; 2], |[sum, size], term| {
            [sum + term, size + term.abs()]
        })
    }

    #[test]
    fn products_are_plain_sums_for_all_sizes_and_strides_and_dirty_results() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for (rows, inner, width, more) in [
            (8, 1, 16, 0),
            (16, 24, 16, 16),
            (48, 24, 32, 8),
            (8, 0, 16, 1),
            (24, 17, 48, 5),
            (16, 12, 16, 4),
            (8, 16, 32, 0),
            (8, 45, 16, 3),
        ] {
            let mut numbers = |count: usize| -> Vec<f32> {
                (0..count).map(|_| rng.random_range(-1.0..1.0)).collect()
            };
            let (a, b) = (
                numbers(rows * (inner + more)),
                numbers(inner * (width + more) + width),
            );
            let left = Matrix::new(&a, inner + more);
            let right = Matrix::new(&b, width + more);
            let mut all = vec![vec![f32::NAN; rows * width]; 4];
            multiply(left, right, inner, &mut all[0], width);
            product::<_, ROWS, true>(left, right, inner, &mut all[1], width);
            product::<_, 4, true>(left, right, inner, &mut all[2], width);
            product::<_, 4, false>(left, right, inner, &mut all[3], width);
            // The number of rows at a time does not matter.
            assert_eq!(all[1], all[2]);
            if fuses() {
                assert_eq!(all[0], all[1]);
            }
            for (found, at) in all.iter().flat_map(|all| all.iter().zip(0..)) {
                let [sum, size] = plain(left, right, inner, [at / width, at % width]);
                // As many roundings as terms, of half a bit of 24 each.
                let tolerance = (inner as f64 + 1.0) * size * f64::from(f32::EPSILON) / 2.0;
                assert!(
                    (f64::from(*found) - sum).abs() <= tolerance,
                    "{found} {sum}"
                );
            }
        }
    }
}
