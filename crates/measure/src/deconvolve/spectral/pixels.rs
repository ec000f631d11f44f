//! From the pixels of an image to its modes.
//!
//! The image is folded about its middle along both axes, into sums and differences of opposite pixels. Each is then
//! multiplied by cosines or sines along x, and along y.

use multiversion::multiversion;

use super::plane::{Plane, Quarters};
use crate::deconvolve::fold::Folding;
use shearq_quantities::product::{Matrix, multiply};

/// Tables for images of one size.
#[derive(Debug, Clone)]
pub(super) struct Pixels {
    folding: Folding,
    /// Columns of a quarter.
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
        let folding = Folding::new(n);
        let Folding { half, places, .. } = folding;
        let at = |place: usize| folding.distance(place);
        let (modes, width) = (plane.modes, plane.width);
        let cos = |k: usize, place: usize| folding.share(place) * (plane.wave(k) * at(place)).cos();
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
            let mut table = vec![0.0; plane.rows * places];
            let lines = table.chunks_exact_mut(places).take(modes + 1);
            for (k, line) in lines.enumerate() {
                for (place, out) in line[..half].iter_mut().enumerate() {
                    *out = value(k, place) as f32;
                }
            }
            table
        };
        Pixels {
            folding,
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
        self.folding.n
    }

    /// Buffers that fit.
    pub(super) fn scratch(&self) -> PixelsScratch {
        PixelsScratch {
            folded: std::array::from_fn(|_| vec![0.0; self.folding.len()]),
            lines: std::array::from_fn(|_| vec![0.0; 2 * self.folding.band * 2 * self.width]),
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
        fold_image(&self.folding, image, sums, differences);
        let Folding {
            half, places, band, ..
        } = self.folding;
        let width = 2 * self.width;
        for (folded, table, lines) in [
            (&*sums, &self.sums, &mut *of_sums),
            (&*differences, &self.differences, &mut *of_differences),
        ] {
            let (folded, table) = (Matrix::new(folded, places), Matrix::new(table, width));
            multiply(folded, table, half, lines, width);
        }
        let lower = band * width;
        let [cos, s, y_cos, y_s] = &self.down;
        // Of sums and of differences along y, the one transformed along x, and times x.
        let take = |lines: &[f32], with: usize, table: &[f32], out: &mut [f32]| {
            let lines = Matrix::new(&lines[with * self.width..], width);
            multiply(Matrix::new(table, places), lines, half, out, self.width);
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
        let Folding {
            n, half, places, ..
        } = self.folding;
        let width = self.width;
        let [sums, differences] = &mut scratch.folded;
        // There is room for it: two parts have at least eight rows.
        let folded = sums
            .chunks_exact_mut(places)
            .zip(differences.chunks_exact_mut(places));
        for (line, (sums, differences)) in lines.chunks_exact(n).zip(folded) {
            fold_line(line, &mut sums[..half], &mut differences[..half]);
        }
        let across = |table| Matrix::new(table, 2 * width);
        for (lines, table, out) in [
            (&*sums, &self.sums, re),
            (&*differences, &self.differences, im),
        ] {
            multiply(Matrix::new(lines, places), across(table), half, out, width);
        }
    }

    /// Columns of what [`Pixels::transform_lines`] writes.
    pub(super) fn columns(&self) -> usize {
        self.width
    }
}

#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn fold_image(folding: &Folding, image: &[f32], sums: &mut [f32], differences: &mut [f32]) {
    folding.fold(image, sums, differences);
}

fn fold_line(line: &[f32], sums: &mut [f32], differences: &mut [f32]) {
    let half = sums.len();
    let (left, right) = (&line[..half], &line[line.len() - half..]);
    for x in 0..half {
        sums[x] = right[x] + left[half - 1 - x];
        differences[x] = right[x] - left[half - 1 - x];
    }
}
