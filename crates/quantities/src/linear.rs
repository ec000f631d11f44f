//! Linear equations: Cholesky's decomposition for symmetric positive matrices, Gauss's elimination for all matrices. Eigenvectors
//! of symmetric matrices by Jacobi's rotations.
//!
//! All work in place. The order of their operations is fixed, so that equal equations give equal bits.
//!
//! Real 2 × 2 matrices, by rows, are Jacobians of pixels, maps between stamps, and responses of an ellipticity to shear.

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
