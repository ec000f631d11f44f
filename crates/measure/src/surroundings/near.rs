//! Neighbours so near that their light overlaps the galaxy's: a pair is not the same turned by 180 degrees.
//!
//! The difference between the stamp and itself turned is compared with that of a Gaussian neighbour at places around
//! the galaxy. The galaxy's centre is known to half a pixel only. What a displacement of the galaxy changes is projected
//! out, so that it is not mistaken for a neighbour: the derivatives of a round profile that is fitted to the sum of the
//! stamp and itself turned.

use std::ops::Range;

use multiversion::multiversion;

use super::profile::solved;

/// Pixels on a side of a cell. See docs/constants.md.
const CELL: usize = 2;
/// Cells along an axis. See docs/constants.md.
const ALONG: usize = 12;
/// Cells.
const CELLS: usize = ALONG * ALONG;
/// Pixels along an axis.
const WIDE: usize = ALONG * CELL;
/// Cells that are summed side by side. See docs/constants.md.
const LANES: usize = 16;
/// σ of the Gaussian neighbour. See docs/constants.md.
const WIDTH: f32 = 3.0;
/// σ of the concentric Gaussians of the galaxy's profile. See docs/constants.md.
const PROFILE: [f32; 3] = [1.8, 2.8, 4.5];
/// Terms of that profile.
const TERMS: usize = PROFILE.len();
/// Distances of a neighbour from the galaxy: the least and the largest. See docs/constants.md.
const DISTANCES: [f32; 2] = [4.0, 10.0];
/// Least share of a template's square that a displacement of the galaxy leaves. See docs/constants.md.
const LEFT: f32 = 0.02;
/// Distance between places of a neighbour along an axis. See docs/constants.md.
const STEP: f32 = 2.0;

/// What neighbours at all places look like.
pub(super) struct Near {
    n: usize,
    /// For a turn that is even or not along x and y.
    grids: [[Grid; 2]; 2],
}

/// Cells about a centre.
struct Grid {
    templates: Vec<Template>,
    /// What the cells of a stamp and its opposite are multiplied by for the amplitudes of the galaxy's profile.
    amplitudes: [[f32; CELLS]; TERMS],
    /// The derivatives of the terms along x and y.
    moved: [[[f32; CELLS]; TERMS]; 2],
    /// Their products.
    products: [[[f32; TERMS]; TERMS]; 2],
}

/// What a neighbour of flux 1 at one place adds to the differences.
struct Template {
    cells: [f32; CELLS],
    squares: f32,
    /// Its products with the derivatives of the galaxy's profile.
    moved: [[f32; TERMS]; 2],
}

/// The neighbour that noise would explain the least.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Suspect {
    /// Its light.
    pub(super) light: f32,
    /// In units of the noise.
    pub(super) significance: f32,
}

impl Near {
    pub(super) fn new(n: usize) -> Self {
        let grids = |odd_x| [false, true].map(|odd_y| Grid::new([odd_x, odd_y]));
        Near {
            n,
            grids: [grids(false), grids(true)],
        }
    }

    /// The most significant neighbour whose light is at least `least`, in noise of level `noise`. Pixel p is opposite to
    /// `turn − p`.
    pub(super) fn suspect(
        &self,
        stamp: &[f32],
        turn: [i32; 2],
        noise: f32,
        least: f32,
    ) -> Option<Suspect> {
        let cells = self.cells(stamp, turn);
        let [odd_x, odd_y] = turn.map(|turn| turn.rem_euclid(2) as usize);
        most_significant(&self.grids[odd_x][odd_y], &cells, noise, least)
    }

    /// Differences between the cells and their opposites, and their sums.
    fn cells(&self, stamp: &[f32], turn: [i32; 2]) -> [[f32; CELLS]; 2] {
        let first = turn.map(|turn| turn.div_euclid(2) + 1 - (ALONG * CELL / 2) as i32);
        let mut cells = [[0.0; CELLS]; 2];
        let [columns, lines] = [0, 1].map(|axis| compared(self.n, turn[axis], first[axis]));
        if columns.is_empty() || lines.is_empty() {
            return cells;
        }
        let from = (first[0] + columns.start as i32) as usize;
        let other = (turn[0] + 1) as usize - from - columns.len();
        let row = |j: usize| (first[1] + j as i32) as usize;
        let pairs = Pairs {
            stamp,
            n: self.n,
            here: [from, row(lines.start)],
            there: [other, turn[1] as usize - row(lines.start)],
        };
        add_pairs(&pairs, columns, lines, &mut cells);
        cells
    }
}

/// Pixels and their opposites.
struct Pairs<'a> {
    stamp: &'a [f32],
    n: usize,
    /// Column and row of the first pixel, and of the last column and first row of the opposites.
    here: [usize; 2],
    there: [usize; 2],
}

/// Adds differences and sums of pixels and opposites in columns and lines of the cells.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_pairs(
    pairs: &Pairs<'_>,
    columns: Range<usize>,
    lines: Range<usize>,
    cells: &mut [[f32; CELLS]; 2],
) {
    let count = columns.len();
    for (step, j) in lines.enumerate() {
        let here = &pairs.stamp[(pairs.here[1] + step) * pairs.n + pairs.here[0]..][..count];
        let there = &pairs.stamp[(pairs.there[1] - step) * pairs.n + pairs.there[0]..][..count];
        let line = j / CELL * ALONG;
        if let (Ok(here), Ok(there)) = (here.try_into(), there.try_into()) {
            // A length that is known.
            add_line(here, there, line, cells);
        } else {
            let mut both = [[0.0; WIDE]; 2];
            both[0][columns.clone()].copy_from_slice(here);
            both[1][WIDE - columns.end..WIDE - columns.start].copy_from_slice(there);
            add_line(&both[0], &both[1], line, cells);
        }
    }
}

/// Adds a line of pixels and of their opposites, which are in the other order, to the cells from `first` on.
#[inline(always)]
fn add_line(here: &[f32; WIDE], there: &[f32; WIDE], first: usize, cells: &mut [[f32; CELLS]; 2]) {
    let mut both = [[0.0; ALONG]; 2];
    let [differences, sums] = &mut both;
    for (i, (difference, sum)) in differences.iter_mut().zip(sums).enumerate() {
        let (mut own, mut other) = (0.0, 0.0);
        for k in CELL * i..CELL * (i + 1) {
            own += here[k];
            other += there[WIDE - 1 - k];
        }
        (*difference, *sum) = (own - other, own + other);
    }
    for (cells, both) in cells.iter_mut().zip(both) {
        for (cell, value) in cells[first..].iter_mut().zip(both) {
            *cell += value;
        }
    }
}

/// Of the pixels that cells cover along an axis, beginning at pixel `first`, those that are on a stamp of `n` pixels a side
/// and have their opposite there.
fn compared(n: usize, turn: i32, first: i32) -> Range<usize> {
    // Pixel p with 0 ≤ p < n and 0 ≤ turn − p < n.
    let start = 0.max(turn + 1 - n as i32) - first;
    let end = (n as i32).min(turn + 1) - first;
    let on = |at: i32| at.clamp(0, (ALONG * CELL) as i32) as usize;
    on(start)..on(end).max(on(start))
}

impl Grid {
    /// For a turn that is odd or not along x and y.
    fn new(odd: [bool; 2]) -> Self {
        // Middle of a cell from the centre: one between pixels is in the middle of the cells.
        let middle = |k: usize, odd: bool| {
            (k as f32 - (ALONG as f32 - 1.0) / 2.0) * CELL as f32 + if odd { 0.0 } else { 0.5 }
        };
        let field = |light: &dyn Fn(f32, f32) -> f32| -> [f32; CELLS] {
            std::array::from_fn(|at| light(middle(at % ALONG, odd[0]), middle(at / ALONG, odd[1])))
        };
        let round = PROFILE.map(|width| field(&|x, y| gaussian(x, y, width)));
        let moved = [0, 1].map(|axis| {
            PROFILE
                .map(|width| field(&|x, y| [x, y][axis] / (width * width) * gaussian(x, y, width)))
        });
        let products = |fields: &[[f32; CELLS]; TERMS]| {
            std::array::from_fn(|i| std::array::from_fn(|j| dot(&fields[i], &fields[j])))
        };
        let matrix: [[f32; TERMS]; TERMS] = products(&round);
        let matrix = matrix.map(|row| row.map(f64::from));
        let mut amplitudes = [[0.0; CELLS]; TERMS];
        for at in 0..CELLS {
            let right = std::array::from_fn(|k| f64::from(round[k][at]));
            let column: [f64; TERMS] = solved(matrix, right);
            for (row, value) in amplitudes.iter_mut().zip(column) {
                row[at] = value as f32;
            }
        }
        let mut grid = Grid {
            templates: Vec::new(),
            amplitudes,
            products: [products(&moved[0]), products(&moved[1])],
            moved,
        };
        let steps = (DISTANCES[1] / STEP).ceil() as i32;
        for j in 0..=steps {
            for i in -steps..=steps {
                let (x0, y0) = (i as f32 * STEP, j as f32 * STEP);
                let twice = j == 0 && i < 0;
                if twice || !(DISTANCES[0]..=DISTANCES[1]).contains(&x0.hypot(y0)) {
                    continue;
                }
                let area = (CELL * CELL) as f32 / (2.0 * std::f32::consts::PI * WIDTH * WIDTH);
                let cells = field(&|x, y| {
                    area * (gaussian(x - x0, y - y0, WIDTH) - gaussian(x + x0, y + y0, WIDTH))
                });
                grid.templates.push(Template {
                    cells,
                    squares: dot(&cells, &cells),
                    moved: [0, 1]
                        .map(|axis| std::array::from_fn(|k| dot(&cells, &grid.moved[axis][k]))),
                });
            }
        }
        grid
    }
}

/// The most significant neighbour whose light is at least `least`, of cells' differences and sums.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn most_significant(
    grid: &Grid,
    cells: &[[f32; CELLS]; 2],
    noise: f32,
    least: f32,
) -> Option<Suspect> {
    let [differences, sums] = cells;
    let profile = std::array::from_fn(|k| dot(&grid.amplitudes[k], sums));
    // Of the derivative along each axis: its product with the differences, and its square.
    let moved = [0, 1].map(|axis| {
        let products = std::array::from_fn(|k| dot(&grid.moved[axis][k], differences));
        let rows = grid.products[axis].map(|row| short(&row, &profile));
        (short(&products, &profile), short(&rows, &profile))
    });
    // A difference repeats the noise of its opposite with the other sign: twice the amplitude.
    let noise = 2.0 * CELL as f32 * noise;
    let mut most: Option<Suspect> = None;
    for template in &grid.templates {
        let mut product = dot(&template.cells, differences);
        let mut squares = template.squares;
        for (axis, (with, square)) in moved.into_iter().enumerate() {
            let shared = short(&template.moved[axis], &profile);
            if square > 0.0 {
                product -= shared * with / square;
                squares -= shared * shared / square;
            }
        }
        let squares = squares.max(LEFT * template.squares);
        let suspect = Suspect {
            light: product.abs() / squares,
            significance: product.abs() / (noise * squares.sqrt()),
        };
        let more = most.is_none_or(|most| suspect.significance > most.significance);
        if suspect.light >= least && more {
            most = Some(suspect);
        }
    }
    most
}

fn gaussian(x: f32, y: f32, width: f32) -> f32 {
    (-0.5 * (x * x + y * y) / (width * width)).exp()
}

/// Sum of products, several side by side.
#[inline(always)]
fn dot(a: &[f32; CELLS], b: &[f32; CELLS]) -> f32 {
    let mut lanes = [0.0; LANES];
    for (a, b) in a.chunks_exact(LANES).zip(b.chunks_exact(LANES)) {
        for l in 0..LANES {
            lanes[l] += a[l] * b[l];
        }
    }
    lanes.iter().sum()
}

/// Sum of products over the terms of the profile.
#[inline(always)]
fn short(a: &[f32; TERMS], b: &[f32; TERMS]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    const N: usize = 48;

    fn blob(stamp: &mut [f32], [x, y]: [f32; 2], width: f32, flux: f32) {
        let peak = flux / (2.0 * std::f32::consts::PI * width * width);
        for (at, value) in stamp.iter_mut().enumerate() {
            let (dx, dy) = ((at % N) as f32 - 23.5 - x, (at / N) as f32 - 23.5 - y);
            *value += peak * (-(dx * dx + dy * dy) / (2.0 * width * width)).exp();
        }
    }

    #[test]
    fn a_neighbour_of_the_templates_width_has_its_own_light() {
        let near = Near::new(N);
        for (turn, middle) in [
            ([47, 47], [0.0, 0.0]),
            ([48, 47], [0.5, 0.0]),
            ([46, 49], [-0.5, 1.0]),
        ] {
            for away in [[6.0, 0.0], [0.0, -8.0], [-4.0, 6.0], [4.0, 4.0]] {
                let mut stamp = vec![0.0; N * N];
                blob(&mut stamp, middle, 2.5, 200.0);
                blob(
                    &mut stamp,
                    [middle[0] + away[0], middle[1] + away[1]],
                    WIDTH,
                    100.0,
                );
                let found = near.suspect(&stamp, turn, 1.0, 0.0).unwrap();
                // Of pixels and cells, sums replace integrals, and light beyond the cells is lost.
                assert!(
                    (found.light - 100.0).abs() < 12.0,
                    "{found:?} {turn:?} {away:?}"
                );
            }
        }
    }

    #[test]
    fn a_displaced_galaxy_is_no_neighbour() {
        let near = Near::new(N);
        for width in [2.0, 3.0, 4.0] {
            for middle in [[0.25, 0.0], [-0.2, 0.25]] {
                let mut stamp = vec![0.0; N * N];
                blob(&mut stamp, middle, width, 1000.0);
                let found = near.suspect(&stamp, [47, 47], 1.0, 0.0).unwrap();
                // The difference itself is 5 to 25 % of the galaxy's light.
                assert!(found.light < 20.0, "{found:?} {width} {middle:?}");
            }
        }
    }

    #[test]
    fn significances_of_noise_are_those_of_a_normal_distribution() {
        let near = Near::new(N);
        let mut state = 1u32;
        let mut uniform = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        for turn in [[47, 47], [48, 46]] {
            let template = &near.grids[turn[0] as usize % 2][turn[1] as usize % 2].templates[7];
            let (mut squares, count) = (0.0, 1000);
            for _ in 0..count {
                // Variance 1.
                let stamp: Vec<f32> = (0..N * N)
                    .map(|_| 12.0f32.sqrt() * (uniform() - 0.5))
                    .collect();
                let [cells, _] = near.cells(&stamp, turn);
                let product = dot(&template.cells, &cells);
                squares += (product / (2.0 * CELL as f32)).powi(2) / template.squares;
            }
            // A variance of a thousand has an error of 4.5 %; cells of an even turn are not opposite to cells.
            let variance = squares / count as f32;
            assert!((variance - 1.0).abs() < 0.2, "{variance} {turn:?}");
        }
    }

    #[test]
    fn a_galaxy_at_the_edge_of_the_stamp_is_compared_as_far_as_there_are_pixels() {
        let near = Near::new(N);
        let stamp = vec![1.0; N * N];
        let found = near.suspect(&stamp, [5, 90], 1.0, 0.0).unwrap();
        assert_eq!(found.light, 0.0);
    }
}
