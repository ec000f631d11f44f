//! Real 2 × 2 matrices, by rows: Jacobians of pixels, maps between stamps, and responses of an ellipticity to shear.

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

    #[test]
    fn an_inverse_undoes_the_matrix() {
        let matrix = [[0.5, -0.25], [2.0, 3.0]];
        assert_eq!(determinant(matrix), 2.0);
        assert_eq!(product(inverse(matrix), matrix), [[1.0, 0.0], [0.0, 1.0]]);
        assert_eq!(apply(matrix, [1.0, 2.0]), [0.0, 8.0]);
        assert_eq!(solve(matrix, [0.0, 8.0]), [1.0, 2.0]);
        assert_eq!(
            product(matrix, [[0.0, 1.0], [1.0, 0.0]]),
            [[-0.25, 0.5], [3.0, 2.0]]
        );
    }
}
