//! Linear equations: Cholesky's decomposition for symmetric positive matrices, Gauss's elimination for all matrices.
//!
//! All work in place. The order of their operations is fixed, so that equal equations give equal bits.
//!
//! Real 2 × 2 matrices, by rows, are Jacobians of pixels, maps between stamps, and responses of an ellipticity to shear.
//!
//! # Products of small matrices
//!
//! So few modes are kept that sums over pixels, modes or lags along an axis take less time as
//! dense products than as fast transforms.

use std::ops::Index;

use multiversion::multiversion;

/// Solves the first `count` of N equations with a symmetric positive matrix by Cholesky's decomposition.
///
/// Only the lower triangle of `matrix` is used. The root replaces it, and the solution replaces `right`.
///
/// `pivot` receives the square of each diagonal element of the root and returns the square to use. If it returns `None`,
/// the equations are not soluble: the result is `None`, and `matrix` and `right` hold intermediate numbers.
#[inline]
pub fn cholesky<const N: usize>(
    matrix: &mut [[f64; N]; N],
    right: &mut [f64; N],
    count: usize,
    pivot: impl Fn(f64) -> Option<f64>,
) -> Option<()> {
    for i in 0..count {
        for j in 0..=i {
            let known: f64 = (0..j).map(|k| matrix[i][k] * matrix[j][k]).sum();
            let rest = matrix[i][j] - known;
            matrix[i][j] = if i == j {
                pivot(rest)?.sqrt()
            } else {
                rest / matrix[j][j]
            };
        }
        let known: f64 = (0..i).map(|k| matrix[i][k] * right[k]).sum();
        right[i] = (right[i] - known) / matrix[i][i];
    }
    for i in (0..count).rev() {
        let known: f64 = (i + 1..count).map(|k| matrix[k][i] * right[k]).sum();
        right[i] = (right[i] - known) / matrix[i][i];
    }
    Some(())
}

/// Which of the remaining equations eliminates the next unknown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pivots {
    /// The equation with the largest coefficient of this unknown: for any matrix.
    Largest,
    /// The next equation: for symmetric matrices. The last pivot is then the inverse variance of the last unknown.
    InOrder,
}

/// Eliminates one unknown after the other (Gauss), so that the equations become triangular. `rows` are n equations: n
/// coefficients, then the right-hand side. Further numbers in a row are not used.
///
/// Returns whether the equations are soluble. They are not if the modulus of a pivot is smaller than `least`.
pub fn eliminate<R: AsRef<[f64]> + AsMut<[f64]>>(
    rows: &mut [R],
    pivots: Pivots,
    least: f64,
) -> bool {
    let n = rows.len();
    for k in 0..n {
        if pivots == Pivots::Largest {
            let size = |row: &usize| rows[*row].as_ref()[k].abs();
            let largest = (k..n).max_by(|a, b| size(a).total_cmp(&size(b)));
            rows.swap(k, largest.unwrap_or(k));
        }
        let (done, rest) = rows.split_at_mut(k + 1);
        let pivot = &done[k].as_ref()[k..=n];
        if pivot[0].abs() < least {
            return false;
        }
        for row in rest {
            let row = &mut row.as_mut()[k..=n];
            let factor = row[0] / pivot[0];
            for (value, above) in row.iter_mut().zip(pivot) {
                *value -= factor * above;
            }
        }
    }
    true
}

/// Writes the solution of the triangular equations of [`eliminate`].
pub fn substitute<R: AsRef<[f64]>>(rows: &[R], out: &mut [f64]) {
    let n = rows.len();
    for k in (0..n).rev() {
        let row = rows[k].as_ref();
        let known: f64 = (k + 1..n).map(|j| row[j] * out[j]).sum();
        out[k] = (row[n] - known) / row[k];
    }
}

/// `[[m11, m12], [m21, m22]]`.
pub type Matrix2 = [[f64; 2]; 2];

/// The determinant.
pub fn determinant([[a, b], [c, d]]: Matrix2) -> f64 {
    a * d - b * c
}

/// The matrix times a column.
pub fn apply(matrix: Matrix2, [x, y]: [f64; 2]) -> [f64; 2] {
    matrix.map(|[a, b]| a * x + b * y)
}

/// The product, whose right factor acts first.
pub fn product(left: Matrix2, right: Matrix2) -> Matrix2 {
    left.map(|[a, b]| [0, 1].map(|k| a * right[0][k] + b * right[1][k]))
}

/// The inverse; infinities or NaN of a singular matrix.
pub fn inverse(matrix: Matrix2) -> Matrix2 {
    let [[a, b], [c, d]] = matrix;
    [[d, -b], [-c, a]].map(|row| row.map(|value| value / determinant(matrix)))
}

/// The vector that the matrix maps to `to`; infinities or NaN of a singular matrix.
// One division per component: as exact as the product with the inverse, which rounds four quotients first.
pub fn solve(matrix: Matrix2, to: [f64; 2]) -> [f64; 2] {
    let [[a, b], [c, d]] = matrix;
    apply([[d, -b], [-c, a]], to).map(|value| value / determinant(matrix))
}

/// A symmetric matrix, such as the mean products of N quantities with each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Symmetric<const N: usize, T = f64>([[T; N]; N]);

impl<const N: usize, T: Copy + Default> Symmetric<N, T> {
    /// Takes `of(a, b)` for each pair a ≤ b, once.
    pub fn from_fn(of: impl Fn(usize, usize) -> T) -> Self {
        let mut values = [[T::default(); N]; N];
        for (a, b) in (0..N).flat_map(|a| (a..N).map(move |b| (a, b))) {
            let value = of(a, b);
            (values[a][b], values[b][a]) = (value, value);
        }
        Symmetric(values)
    }
}

impl<const N: usize> Symmetric<N> {
    /// J C Jᵀ: the mean products of quantities that change by `rows` J times the changes of these.
    #[must_use]
    pub fn transformed<const M: usize>(&self, rows: &[[f64; N]; M]) -> Symmetric<M> {
        let dot = |a: &[f64; N], b: &[f64; N]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let right = rows.map(|row| self.0.map(|of| dot(&of, &row)));
        Symmetric::from_fn(|a, b| dot(&rows[a], &right[b]))
    }
}

impl<const N: usize, T: Copy + Default> Default for Symmetric<N, T> {
    fn default() -> Self {
        Symmetric([[T::default(); N]; N])
    }
}

impl<const N: usize, T> Index<[usize; 2]> for Symmetric<N, T> {
    type Output = T;

    fn index(&self, [a, b]: [usize; 2]) -> &T {
        &self.0[a][b]
    }
}

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
        "x86_64+avx512f" => multiply_rows::<ROWS, true>(left, right, inner, out, width),
        "x86_64+fma" => multiply_rows::<4, true>(left, right, inner, out, width),
        "aarch64" => multiply_rows::<4, true>(left, right, inner, out, width),
        _ => multiply_rows::<4, false>(left, right, inner, out, width),
    }
}

/// The product as [`multiply`] defines it, `R` rows at a time: public so that tests compare all of its forms on any processor.
#[doc(hidden)]
#[inline(always)]
pub fn multiply_rows<const R: usize, const FUSED: bool>(
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Symmetric and positive.
    const MATRIX: [[f64; 3]; 3] = [[4.0, 1.0, -2.0], [1.0, 3.0, 0.5], [-2.0, 0.5, 5.0]];
    const SOLUTION: [f64; 3] = [1.0, -2.0, 3.0];

    fn product(matrix: &[[f64; 3]; 3]) -> [f64; 3] {
        matrix.map(|row| row.iter().zip(SOLUTION).map(|(a, x)| a * x).sum())
    }

    fn close(found: &[f64], expected: &[f64]) {
        for (found, expected) in found.iter().zip(expected) {
            // A few roundings of numbers of order one.
            assert!((found - expected).abs() < 1e-14, "{found} {expected}");
        }
    }

    #[test]
    fn mean_products_of_sums_follow_from_those_of_their_terms() {
        let of = Symmetric::from_fn(|a, b| MATRIX[a][b]);
        let found = of.transformed(&[SOLUTION, [0.0, 2.0, 0.0]]);
        let own = product(&MATRIX);
        let expected: f64 = own.iter().zip(SOLUTION).map(|(a, b)| a * b).sum();
        close(
            &[found[[0, 0]], found[[0, 1]], found[[1, 0]], found[[1, 1]]],
            &[expected, 2.0 * own[1], 2.0 * own[1], 12.0],
        );
    }

    #[test]
    fn cholesky_uses_the_lower_triangle() {
        let (mut matrix, mut right) = (MATRIX, product(&MATRIX));
        for (i, row) in matrix.iter_mut().enumerate() {
            row[i + 1..].fill(f64::NAN);
        }
        assert_eq!(cholesky(&mut matrix, &mut right, 3, Some), Some(()));
        close(&right, &SOLUTION);
        for i in 0..3 {
            for j in 0..=i {
                let product: f64 = (0..=j).map(|k| matrix[i][k] * matrix[j][k]).sum();
                close(&[product], &[MATRIX[i][j]]);
            }
        }
    }

    #[test]
    fn fewer_equations_leave_the_other_numbers() {
        let (mut matrix, mut right) = (MATRIX, [6.0, 7.0, f64::NAN]);
        cholesky(&mut matrix, &mut right, 2, Some).unwrap();
        // 4 x + y = 6, x + 3 y = 7.
        close(&right[..2], &[1.0, 2.0]);
        assert!(right[2].is_nan() && matrix[2] == MATRIX[2]);
    }

    #[test]
    fn the_caller_decides_about_pivots() {
        let singular = [[1.0, 0.0], [1.0, 1.0]];
        let positive = |square: f64| (square > 0.0).then_some(square);
        let (mut matrix, mut right) = (singular, [1.0, 1.0]);
        assert_eq!(cholesky(&mut matrix, &mut right, 2, positive), None);
        let (mut matrix, mut right) = (singular, [1.0, 1.0]);
        let raised = |square: f64| Some(square.max(0.25));
        assert_eq!(cholesky(&mut matrix, &mut right, 2, raised), Some(()));
        assert_eq!(matrix[1][1], 0.5);
    }

    #[test]
    fn elimination_solves_any_matrix_if_rows_are_exchanged() {
        // Without exchange the first pivot is zero.
        let matrix = [[0.0, 2.0, 1.0], [1.0, -1.0, 0.5], [3.0, 0.5, -2.0]];
        let right = product(&matrix);
        let rows: Vec<[f64; 4]> = matrix
            .iter()
            .zip(right)
            .map(|(row, right)| [row[0], row[1], row[2], right])
            .collect();
        let mut exchanged = rows.clone();
        assert!(eliminate(&mut exchanged, Pivots::Largest, 1e-9));
        let mut found = [0.0; 3];
        substitute(&exchanged, &mut found);
        close(&found, &SOLUTION);
        assert!(!eliminate(&mut rows.clone(), Pivots::InOrder, 1e-9));
        let mut dependent = [[1.0, 2.0, 1.0], [2.0, 4.0, 2.0]];
        assert!(!eliminate(&mut dependent, Pivots::Largest, 1e-9));
    }

    #[test]
    fn the_last_pivot_in_order_is_an_inverse_variance() {
        let mut rows = MATRIX.map(|[a, b, c]| [a, b, c, 0.0]);
        assert!(eliminate(&mut rows, Pivots::InOrder, 1e-9));
        let (mut matrix, mut right) = (MATRIX, [0.0, 0.0, 1.0]);
        cholesky(&mut matrix, &mut right, 3, Some).unwrap();
        close(&[rows[2][2] * right[2]], &[1.0]);
    }

    #[test]
    fn an_inverse_undoes_the_matrix() {
        let matrix = [[0.5, -0.25], [2.0, 3.0]];
        assert_eq!(determinant(matrix), 2.0);
        assert_eq!(
            super::product(inverse(matrix), matrix),
            [[1.0, 0.0], [0.0, 1.0]]
        );
        assert_eq!(apply(matrix, [1.0, 2.0]), [0.0, 8.0]);
        assert_eq!(solve(matrix, [0.0, 8.0]), [1.0, 2.0]);
        assert_eq!(
            super::product(matrix, [[0.0, 1.0], [1.0, 0.0]]),
            [[-0.25, 0.5], [3.0, 2.0]]
        );
    }
}
