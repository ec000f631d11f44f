//! Products of small matrices. So few modes are kept that sums over pixels, modes or lags along an axis take less time as
//! dense products than as fast transforms.

use multiversion::multiversion;

use crate::real::Real;

/// Columns that are summed side by side.
pub const LANES: usize = 16;
/// Multiple of the rows of a product.
pub const ROWS: usize = 8;

/// A part of a matrix in row-major order.
#[derive(Debug, Clone, Copy)]
pub struct Matrix<'a, T = f32> {
    /// The numbers, from the first of the part.
    pub values: &'a [T],
    /// Numbers between the beginnings of two rows.
    pub stride: usize,
}

impl<'a, T> Matrix<'a, T> {
    /// Rows of `stride` numbers.
    pub fn new(values: &'a [T], stride: usize) -> Self {
        Matrix { values, stride }
    }
}

/// Writes `left` times `right`, a sum over `inner` columns of the one and rows of the other, to rows of `width` numbers,
/// a multiple of [`LANES`]. The number of rows is a multiple of [`ROWS`]. It takes least time if the stride of `left` is
/// 16, 32, 48 or 64.
///
/// Sums run over `inner` in order, fused where the processor can: results are the same for AVX-512, AVX2 and NEON.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub fn multiply(left: Matrix<'_>, right: Matrix<'_>, inner: usize, out: &mut [f32], width: usize) {
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
pub fn product<T: Real, const R: usize, const FUSED: bool>(
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
        64 => bands::<T, R, 64, FUSED>(left, right, inner, out, width),
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
pub fn fuses() -> bool {
    #[cfg(target_arch = "x86_64")]
    return is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    #[cfg(not(target_arch = "x86_64"))]
    return cfg!(target_arch = "aarch64");
}
