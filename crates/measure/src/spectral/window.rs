//! Images times a function that is the product of an even one of x and one of y, mode by mode.

use shearq_quantities::linear::{Matrix, multiply};

use crate::transform::{Plane, Spectrum, table};

// Share of a squared window along an axis that n pixels hold: beyond is no noise.
pub(super) fn inside(n: usize, sigma: f64) -> f64 {
    let share = |from: i32, to: i32| {
        let middle = (n as f64 - 1.0) / 2.0;
        let squares = (from..to).map(|at| (-((f64::from(at) - middle) / sigma).powi(2)).exp());
        squares.sum::<f64>()
    };
    let side = n as i32;
    share(0, side) / share(-side, 2 * side)
}

// Transform of an even function along an axis, over the plane's period, at modes 0, 1, … 2·`modes`.
pub(super) fn even_modes(function: impl Fn(f64) -> f64, plane: &Plane) -> Vec<f64> {
    let period = plane.period as f64;
    let places = (0..plane.period).map(|at| at as f64 - (plane.period / 2) as f64);
    let window: Vec<[f64; 2]> = places.map(|x| [x, function(x) / period]).collect();
    let mode = |j: usize| {
        let terms = window.iter();
        terms.map(|[x, w]| w * (plane.wave(j) * x).cos()).sum()
    };
    (0..=2 * plane.modes).map(mode).collect()
}

/// What multiplying an image by a function that is the product of an even one of x and the same one of y does to its modes:
/// a convolution along both axes.
#[derive(Debug, Clone)]
pub(super) struct Smoothing {
    modes: usize,
    width: usize,
    /// For cosines and for sines along y: a row for each mode that results.
    down: [Vec<f32>; 2],
    /// The same along x: a column for each mode that results.
    across: [Vec<f32>; 2],
}

impl Smoothing {
    // A convolution along each axis with `kernel`, by the distance of modes.
    pub(super) fn new(kernel: impl Fn(usize) -> f64, plane: &Plane) -> Self {
        // What mode q, with its opposite for cosines and less it for sines, adds to mode k.
        let added = |k: usize, q: usize, sign: f64| {
            if q == 0 {
                0.5 * (1.0 + sign) * kernel(k)
            } else {
                kernel(k.abs_diff(q)) + sign * kernel(k + q)
            }
        };
        let used = [plane.modes + 1; 2];
        let stored = [plane.rows, plane.width];
        Smoothing {
            modes: plane.modes + 1,
            width: plane.width,
            down: [1.0, -1.0].map(|sign| table(used, stored, |k, q| added(k, q, sign))),
            across: [1.0, -1.0].map(|sign| table(used, stored, |q, k| added(k, q, sign))),
        }
    }

    // Convolves a spectrum. The content of `scratch`, as large as a quarter, does not matter.
    pub(super) fn apply(&self, spectrum: &mut Spectrum, scratch: &mut [f32]) {
        for (part, quarter) in spectrum.quarters_mut().into_iter().enumerate() {
            self.quarter(quarter, [part / 2, part % 2], scratch);
        }
    }

    // The same for a real even spectrum: cc and ss.
    pub(super) fn apply_even(&self, spectrum: &mut [f32], scratch: &mut [f32]) {
        let (cc, ss) = spectrum.split_at_mut(spectrum.len() / 2);
        self.quarter(cc, [0, 0], scratch);
        self.quarter(ss, [1, 1], scratch);
    }

    // The same for a quarter of cosines (0) or sines (1) along x and y.
    fn quarter(&self, quarter: &mut [f32], [x, y]: [usize; 2], scratch: &mut [f32]) {
        let (modes, width) = (self.modes, self.width);
        let (down, across) = (&self.down[y], &self.across[x]);
        let from = Matrix::new(quarter, width);
        multiply(Matrix::new(down, width), from, modes, scratch, width);
        let across = Matrix::new(across, width);
        multiply(Matrix::new(scratch, width), across, modes, quarter, width);
    }
}
