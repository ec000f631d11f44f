//! Products of small matrices. So few modes are kept that sums over pixels, modes or lags along an axis take less time as
//! dense products than as fast transforms.

use multiversion::multiversion;

/// Columns that are summed side by side.
pub const LANES: usize = 16;
/// Multiple of the rows of a product.
pub const ROWS: usize = 8;

/// A part of a matrix in row-major order.
#[derive(Debug, Clone, Copy)]
pub struct Matrix<'a> {
    /// The numbers, from the first of the part.
    pub values: &'a [f32],
    /// Numbers between the beginnings of two rows.
    pub stride: usize,
}

impl<'a> Matrix<'a> {
    /// Rows of `stride` numbers.
    pub fn new(values: &'a [f32], stride: usize) -> Self {
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
    // A number of rows for which there are registers.
    multiversion::target::match_target! {
        "x86_64+avx512f" => product::<ROWS, true>(left, right, inner, out, width),
        "x86_64+fma" => product::<4, true>(left, right, inner, out, width),
        "aarch64" => product::<4, true>(left, right, inner, out, width),
        _ => product::<4, false>(left, right, inner, out, width),
    }
}

/// The product as [`multiply`] defines it, `R` rows at a time: public so that tests compare all of its forms on any processor.
#[doc(hidden)]
#[inline(always)]
pub fn product<const R: usize, const FUSED: bool>(
    left: Matrix<'_>,
    right: Matrix<'_>,
    inner: usize,
    out: &mut [f32],
    width: usize,
) {
    debug_assert!(width.is_multiple_of(LANES) && out.len().is_multiple_of(ROWS * width));
    match left.stride {
        16 => bands::<R, 16, FUSED>(left, right, inner, out, width),
        32 => bands::<R, 32, FUSED>(left, right, inner, out, width),
        48 => bands::<R, 48, FUSED>(left, right, inner, out, width),
        64 => bands::<R, 64, FUSED>(left, right, inner, out, width),
        _ => bands::<R, 0, FUSED>(left, right, inner, out, width),
    }
}

/// The product for a stride of `S`, or for any if it is zero, [`LANES`] columns at a time.
#[inline(always)]
fn bands<const R: usize, const S: usize, const FUSED: bool>(
    left: Matrix<'_>,
    right: Matrix<'_>,
    inner: usize,
    out: &mut [f32],
    width: usize,
) {
    let stride = if S == 0 { left.stride } else { S };
    debug_assert!(inner <= stride, "{inner} columns of {stride}");
    // No column is beyond a row, which the compiler cannot prove otherwise.
    let inner = inner.min(stride);
    // Of places instead of chunks, whose number would be a division.
    let (mut to, mut from) = (0, 0);
    while to < out.len() {
        let rows = &left.values[from..][..R * stride];
        let out = &mut out[to..][..R * width];
        (to, from) = (to + R * width, from + R * stride);
        for column in (0..width).step_by(LANES) {
            let mut sums = [[0.0f32; LANES]; R];
            for i in 0..inner {
                // A copy, which stays in a register for all rows.
                let line: [f32; LANES] = *right.values[i * right.stride + column..]
                    .first_chunk()
                    .expect("LANES columns");
                // Written out: of a loop, the compiler would make vectors across rows.
                macro_rules! rows {
                    ($($k:literal)*) => {$(
                        if $k < R {
                            add::<FUSED>(&mut sums[$k], rows[$k * stride + i], &line);
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
fn add<const FUSED: bool>(sums: &mut [f32; LANES], factor: f32, line: &[f32; LANES]) {
    for (sum, value) in sums.iter_mut().zip(line) {
        *sum = if FUSED {
            factor.mul_add(*value, *sum)
        } else {
            *sum + factor * value
        };
    }
}

/// Whether this processor has fused multiply-adds, so that [`multiply`] has the bits of fused sums.
pub fn fuses() -> bool {
    #[cfg(target_arch = "x86_64")]
    return is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
    #[cfg(not(target_arch = "x86_64"))]
    return cfg!(target_arch = "aarch64");
}
