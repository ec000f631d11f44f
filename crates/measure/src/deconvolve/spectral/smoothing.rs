//! What multiplying an image by a function that is the product of an even one of x and the same one of y does to its modes:
//! a convolution along both axes.

use super::plane::{Plane, Quarters};
use shearq_quantities::product::{Matrix, multiply};

/// A convolution of the kept modes.
#[derive(Debug, Clone)]
pub(super) struct Smoothing {
    count: usize,
    rows: usize,
    width: usize,
    /// For cosines and for sines along y: a row for each mode that results.
    down: [Vec<f32>; 2],
    /// The same along x: a column for each mode that results.
    across: [Vec<f32>; 2],
}

impl Smoothing {
    /// A convolution along each axis with `kernel`, by the distance of modes.
    pub(super) fn new(kernel: impl Fn(usize) -> f64, plane: &Plane) -> Self {
        let modes = 0..=plane.modes;
        // What mode q, with its opposite for cosines and less it for sines, adds to mode k.
        let added = |k: usize, q: usize, sign: f64| {
            if q == 0 {
                0.5 * (1.0 + sign) * kernel(k)
            } else {
                kernel(k.abs_diff(q)) + sign * kernel(k + q)
            }
        };
        let table = |rows: usize, columns: usize, value: &dyn Fn(usize, usize) -> f64| {
            let mut table = vec![0.0; rows * columns];
            for row in modes.clone() {
                for column in modes.clone() {
                    table[row * columns + column] = value(row, column) as f32;
                }
            }
            table
        };
        let (rows, width) = (plane.rows, plane.width);
        Smoothing {
            count: plane.modes + 1,
            rows,
            width,
            down: [1.0, -1.0].map(|sign| table(rows, width, &|k, q| added(k, q, sign))),
            across: [1.0, -1.0].map(|sign| table(rows, width, &|q, k| added(k, q, sign))),
        }
    }

    /// Convolves a spectrum. The content of `scratch`, as large as a quarter, does not matter.
    pub(super) fn apply(&self, spectrum: &mut Quarters, scratch: &mut [f32]) {
        let [cc, cs, sc, ss] = spectrum.each();
        self.quarter(cc, [0, 0], scratch);
        self.quarter(cs, [0, 1], scratch);
        self.quarter(sc, [1, 0], scratch);
        self.quarter(ss, [1, 1], scratch);
    }

    /// The same for a real even spectrum: cc and ss.
    pub(super) fn apply_even(&self, spectrum: &mut [f32], scratch: &mut [f32]) {
        let (cc, ss) = spectrum.split_at_mut(self.rows * self.width);
        self.quarter(cc, [0, 0], scratch);
        self.quarter(ss, [1, 1], scratch);
    }

    /// The same for a quarter of cosines (0) or sines (1) along x and y.
    fn quarter(&self, quarter: &mut [f32], [x, y]: [usize; 2], scratch: &mut [f32]) {
        let width = self.width;
        let down = Matrix::new(&self.down[y], width);
        multiply(
            down,
            Matrix::new(quarter, width),
            self.count,
            scratch,
            width,
        );
        let across = Matrix::new(&self.across[x], width);
        multiply(
            Matrix::new(scratch, width),
            across,
            self.count,
            quarter,
            width,
        );
    }
}
