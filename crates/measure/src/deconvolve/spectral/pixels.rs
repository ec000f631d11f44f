//! From the pixels of an image to its modes.
//!
//! The image is folded about its middle along both axes, into sums and differences of opposite pixels. Each is then
//! multiplied by cosines or sines along x, and along y.

use multiversion::multiversion;

use super::plane::{Plane, Quarters};
use super::product::{Matrix, ROWS, multiply};

/// Places that are folded side by side. See docs/constants.md.
const SIDE: usize = 8;

/// Tables for images of one size.
#[derive(Debug, Clone)]
pub(super) struct Pixels {
    n: usize,
    /// Pixels from the middle to the edge; the middle one of an odd number is the first.
    half: usize,
    /// Rows of a folded image, filled up.
    band: usize,
    width: usize,
    /// Of each place along x from the middle: cos and x·s of each mode, for sums of opposite pixels.
    sums: Vec<f32>,
    /// The same, s and x·cos, for differences.
    differences: Vec<f32>,
    /// Of each mode along y, for each place: cos, s, y·cos and y·s.
    down: [Vec<f32>; 4],
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub(super) struct PixelsScratch {
    /// Sums and differences along x of opposite pixels, each of sums and then of differences along y.
    pub(super) folded: [Vec<f32>; 2],
    /// The same, transformed along x.
    lines: [Vec<f32>; 2],
}

impl Pixels {
    /// For images of n×n pixels.
    pub(super) fn new(n: usize, plane: &Plane) -> Self {
        let half = n.div_ceil(2);
        let middle = if n.is_multiple_of(2) { 0.5 } else { 0.0 };
        let at = |place: usize| place as f64 + middle;
        // The middle pixel is its own opposite: folding doubles it.
        let count = |place: usize| if at(place) == 0.0 { 0.5 } else { 1.0 };
        let (modes, width) = (plane.modes, plane.width);
        let cos = |k: usize, place: usize| count(place) * (plane.wave(k) * at(place)).cos();
        let s = |k: usize, place: usize| -(plane.wave(k) * at(place)).sin();
        let across = |first: &dyn Fn(usize, usize) -> f64, second: &dyn Fn(usize, usize) -> f64| {
            let mut table = vec![0.0; half * 2 * width];
            for (place, line) in table.chunks_exact_mut(2 * width).enumerate() {
                for k in 0..=modes {
                    line[k] = first(k, place) as f32;
                    line[width + k] = (at(place) * second(k, place)) as f32;
                }
            }
            table
        };
        let down = |value: &dyn Fn(usize, usize) -> f64| {
            let mut table = vec![0.0; plane.rows * half];
            for (k, line) in table.chunks_exact_mut(half).take(modes + 1).enumerate() {
                for (place, out) in line.iter_mut().enumerate() {
                    *out = value(k, place) as f32;
                }
            }
            table
        };
        Pixels {
            n,
            half,
            band: half.next_multiple_of(ROWS / 2),
            width,
            sums: across(&cos, &s),
            differences: across(&s, &cos),
            down: [
                down(&cos),
                down(&s),
                down(&|k, place| at(place) * cos(k, place)),
                down(&|k, place| at(place) * s(k, place)),
            ],
        }
    }

    /// Pixels a side.
    pub(super) fn side(&self) -> usize {
        self.n
    }

    /// Buffers that fit.
    pub(super) fn scratch(&self) -> PixelsScratch {
        PixelsScratch {
            folded: std::array::from_fn(|_| vec![0.0; 2 * self.band * self.half]),
            lines: std::array::from_fn(|_| vec![0.0; 2 * self.band * 2 * self.width]),
        }
    }

    /// Transforms of a row-major image, and of it times x and y from its middle.
    pub(super) fn transform(
        &self,
        image: &[f32],
        scratch: &mut PixelsScratch,
        out: &mut [Quarters; 3],
    ) {
        let PixelsScratch {
            folded: [sums, differences],
            lines: [of_sums, of_differences],
        } = scratch;
        let below = self.band * self.half;
        {
            let (sums, differences) = (sums.split_at_mut(below), differences.split_at_mut(below));
            let folded = [sums.0, sums.1, differences.0, differences.1];
            fold(image, self.n, folded);
        }
        let (half, width) = (self.half, 2 * self.width);
        for (folded, table, lines) in [
            (&*sums, &self.sums, &mut *of_sums),
            (&*differences, &self.differences, &mut *of_differences),
        ] {
            let (folded, table) = (Matrix::new(folded, half), Matrix::new(table, width));
            multiply(folded, table, half, lines, width);
        }
        let lower = self.band * width;
        let [cos, s, y_cos, y_s] = &self.down;
        // Of sums and of differences along y, the one transformed along x, and times x.
        let take = |lines: &[f32], with: usize, table: &[f32], out: &mut [f32]| {
            let lines = Matrix::new(&lines[with * self.width..], width);
            multiply(Matrix::new(table, half), lines, half, out, self.width);
        };
        let [u, x, y] = out;
        let [cc, cs, sc, ss] = u.each();
        take(of_sums, 0, cos, cc);
        take(&of_sums[lower..], 0, s, cs);
        take(of_differences, 0, cos, sc);
        take(&of_differences[lower..], 0, s, ss);
        let [cc, cs, sc, ss] = x.each();
        take(of_differences, 1, cos, cc);
        take(&of_differences[lower..], 1, s, cs);
        take(of_sums, 1, cos, sc);
        take(&of_sums[lower..], 1, s, ss);
        let [cc, cs, sc, ss] = y.each();
        take(&of_sums[lower..], 0, y_cos, cc);
        take(of_sums, 0, y_s, cs);
        take(&of_differences[lower..], 0, y_cos, sc);
        take(of_differences, 0, y_s, ss);
    }

    /// Transforms of [`ROWS`] lines of real numbers, `n` each: real and imaginary parts, in rows of the plane's width.
    pub(super) fn transform_lines(
        &self,
        lines: &[f32],
        scratch: &mut PixelsScratch,
        [re, im]: [&mut [f32]; 2],
    ) {
        let (half, width) = (self.half, self.width);
        let [sums, differences] = &mut scratch.folded;
        // There is room for it: a stamp has at least eight pixels a side.
        let folded = sums
            .chunks_exact_mut(half)
            .zip(differences.chunks_exact_mut(half));
        for (line, (sums, differences)) in lines.chunks_exact(self.n).zip(folded) {
            fold_line(line, sums, differences);
        }
        let across = |table| Matrix::new(table, 2 * width);
        multiply(Matrix::new(sums, half), across(&self.sums), half, re, width);
        multiply(
            Matrix::new(differences, half),
            across(&self.differences),
            half,
            im,
            width,
        );
    }

    /// Columns of what [`Pixels::transform_lines`] writes.
    pub(super) fn columns(&self) -> usize {
        self.width
    }
}

/// Sums and differences along x of sums of opposite rows, of differences, and so on: first letter x, second y.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn fold(image: &[f32], n: usize, folded: [&mut [f32]; 4]) {
    let half = n.div_ceil(2);
    let whole = half / SIDE * SIDE;
    for y in 0..half {
        // From the middle on, and opposite.
        let upper = &image[(n / 2 + y) * n..][..n];
        let lower = &image[(half - 1 - y) * n..][..n];
        for x in (0..whole).step_by(SIDE) {
            let (right, left) = (n / 2 + x, half - SIDE - x);
            let (upper_right, lower_right) = (side(upper, right), side(lower, right));
            let (upper_left, lower_left) = (side(upper, left), side(lower, left));
            let mut out = [[0.0f32; SIDE]; 4];
            for k in 0..SIDE {
                let sums = (
                    upper_right[k] + lower_right[k],
                    upper_left[SIDE - 1 - k] + lower_left[SIDE - 1 - k],
                );
                let differences = (
                    upper_right[k] - lower_right[k],
                    upper_left[SIDE - 1 - k] - lower_left[SIDE - 1 - k],
                );
                out[0][k] = sums.0 + sums.1;
                out[1][k] = differences.0 + differences.1;
                out[2][k] = sums.0 - sums.1;
                out[3][k] = differences.0 - differences.1;
            }
            for k in 0..4 {
                folded[k][y * half + x..][..SIDE].copy_from_slice(&out[k]);
            }
        }
        for x in whole..half {
            let (right, left) = (n / 2 + x, half - 1 - x);
            let sums = (upper[right] + lower[right], upper[left] + lower[left]);
            let differences = (upper[right] - lower[right], upper[left] - lower[left]);
            let at = y * half + x;
            folded[0][at] = sums.0 + sums.1;
            folded[1][at] = differences.0 + differences.1;
            folded[2][at] = sums.0 - sums.1;
            folded[3][at] = differences.0 - differences.1;
        }
    }
}

#[inline(always)]
fn side(line: &[f32], first: usize) -> &[f32; SIDE] {
    line[first..].first_chunk().expect("pixels of a line")
}

fn fold_line(line: &[f32], sums: &mut [f32], differences: &mut [f32]) {
    let half = sums.len();
    let (left, right) = (&line[..half], &line[line.len() - half..]);
    for x in 0..half {
        sums[x] = right[x] + left[half - 1 - x];
        differences[x] = right[x] - left[half - 1 - x];
    }
}
