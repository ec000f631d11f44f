//! Neighbours so near that they overlap the galaxy, or cannot be subtracted.
//!
//! The stamp is summed in cells. What usual galaxies look like is taken away, as far as noise does not hide it: the posterior mean
//! of the galaxy under the variances of [`Usual`]. If a Gaussian neighbour explains much of the rest, there is a neighbour.
//! This is the best linear test for galaxies of a normal distribution: the signal-to-noise ratio of the neighbour's light,
//! where the galaxy's own light counts as noise with the covariance of the ensemble.

use std::ops::Range;

use multiversion::multiversion;

use super::usual::{
    CELL, COMPONENTS, Components, HALF, PARITIES, QUADRANT, Quadrant, REACH, SIDES, Usual,
    mirrored, neighbour, sign,
};

/// Cells along an axis.
const ALONG: usize = 2 * HALF;
/// Cells on each side of them that have no light.
const MARGIN: usize = REACH;
/// Cells of a row with both margins, up to whole vectors.
const ROW: usize = (ALONG + 2 * MARGIN).next_multiple_of(16);
/// Distances in pixels of the middle of a neighbour's cell from the corner of pixels that is nearest to the galaxy's
/// centre: the least and the largest. See docs/constants.md.
const DISTANCES: [f32; 2] = [4.0, 15.0];
/// Difference between a galaxy and usual ones, as noise of a pixel in units of the galaxy's light. See docs/constants.md.
const UNUSUAL: f32 = 0.0014;
/// Least share of a neighbour's square that usual galaxies leave. See docs/constants.md.
const LEFT: f32 = 1e-3;

/// Cells in rows, with a margin along x.
type Rows = [[f32; ROW]; ALONG];

/// What a neighbour is looked for with, and room for it.
pub(super) struct Near {
    n: usize,
    usual: &'static Usual,
    /// Places of a neighbour in a quadrant.
    places: Vec<usize>,
    /// Weights of the cells beside a neighbour's middle along an axis, from the middle on.
    weights: [f32; REACH + 1],
    cells: Box<Rows>,
    smoothed: Box<Rows>,
}

/// The neighbour that noise and usual galaxies would explain the least.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Suspect {
    /// Its light.
    pub(super) light: f32,
    /// In units of its error.
    pub(super) significance: f32,
}

/// What a stamp is compared with.
#[derive(Debug, Clone, Copy)]
pub(super) struct Known {
    /// Noise of a pixel, on large scales.
    pub(super) noise: f32,
    /// The galaxy's light.
    pub(super) light: f32,
    /// Least light of a neighbour.
    pub(super) least: f32,
}

impl Known {
    /// Noise of a cell, or the difference between a galaxy and usual ones: the larger one, with a smooth transition.
    fn of_a_cell(self) -> f32 {
        let squares = [self.noise, UNUSUAL * self.light].map(|noise| noise * noise);
        CELL as f32 * squares[0].hypot(squares[1]).sqrt()
    }
}

impl Near {
    pub(super) fn new(n: usize) -> Self {
        // The cells of a galaxy up to two pixels off the middle are on the stamp.
        let usual = Usual::of((n / 2).saturating_sub(2) / CELL);
        let distance = |at: usize| {
            let middle = |cell: usize| CELL as f32 * (cell as f32 + 0.5);
            middle(at % HALF).hypot(middle(at / HALF))
        };
        let on = |at: usize| at % HALF < usual.half && at / HALF < usual.half;
        let range = DISTANCES[0]..=DISTANCES[1];
        Near {
            n,
            usual,
            places: (0..HALF * HALF)
                .filter(|&at| on(at) && range.contains(&distance(at)))
                .collect(),
            weights: std::array::from_fn(|step| neighbour(step as i32) as f32),
            cells: Box::new([[0.0; ROW]; ALONG]),
            smoothed: Box::new([[0.0; ROW]; ALONG]),
        }
    }

    /// Distance from the middle, in pixels, to which the cells reach.
    pub(super) fn reach(&self) -> f32 {
        (CELL * self.usual.half) as f32
    }

    /// The most significant neighbour of a galaxy centred at `centre`, (x, y) in pixels from the middle of the stamp.
    pub(super) fn suspect(
        &mut self,
        stamp: &[f32],
        centre: [f32; 2],
        known: Known,
    ) -> Option<Suspect> {
        let noise = known.of_a_cell();
        if !known.noise.is_finite() || !known.light.is_finite() || noise <= 0.0 {
            return None;
        }
        // The galaxy's light in units of the noise of a cell.
        let strength = (known.light / noise).max(1.0);
        // The corner of pixels that is nearest to the centre.
        let corner = centre.map(|c| (c + self.n as f32 / 2.0).round() as i32);
        add_cells(stamp, self.n, corner, self.usual.half, &mut self.cells);
        smooth(&self.cells, &self.weights, &mut self.smoothed);
        let tests = compare(self.usual, &self.cells, &self.smoothed, strength * strength);
        let mut most: Option<Suspect> = None;
        for &place in &self.places {
            let square = tests.squares[place];
            // Nothing of a neighbour is left beside what usual galaxies explain.
            if square <= LEFT * self.usual.squares[place] {
                continue;
            }
            for light in &tests.lights {
                let suspect = Suspect {
                    light: light[place] / square,
                    significance: light[place] / (noise * square.sqrt()),
                };
                let more = most.is_none_or(|most| suspect.significance > most.significance);
                if suspect.light >= known.least && more {
                    most = Some(suspect);
                }
            }
        }
        most
    }
}

/// Writes sums of 2 × 2 pixels around a corner of pixels. Beyond the stamp there is no light.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_cells(stamp: &[f32], n: usize, corner: [i32; 2], half: usize, cells: &mut Rows) {
    let range = |axis: usize| -> (i32, Range<usize>) {
        let first = corner[axis] - (CELL * half) as i32;
        let on = |at: i32| at.clamp(0, n as i32) as usize;
        (first, on(first)..on(first + (2 * CELL * half) as i32))
    };
    let ((left, columns), (top, _)) = (range(0), range(1));
    let skipped = (columns.start as i32 - left).clamp(0, (CELL * ALONG) as i32) as usize;
    for (down, row) in cells.iter_mut().enumerate() {
        row.fill(0.0);
        let down = down as i32 - (HALF - half) as i32;
        if !(0..2 * half as i32).contains(&down) {
            continue;
        }
        let mut line = [0.0; CELL * ALONG];
        for step in 0..CELL as i32 {
            let y = top + CELL as i32 * down + step;
            if (0..n as i32).contains(&y) {
                let pixels = &stamp[y as usize * n..][columns.clone()];
                for (sum, pixel) in line[skipped..].iter_mut().zip(pixels) {
                    *sum += pixel;
                }
            }
        }
        let row = &mut row[MARGIN + HALF - half..][..2 * half];
        for (cell, pair) in row.iter_mut().zip(line.chunks_exact(CELL)) {
            *cell = pair[0] + pair[1];
        }
    }
}

/// The light of all cells under a neighbour in the middle of each cell.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn smooth(cells: &Rows, weights: &[f32; REACH + 1], out: &mut Rows) {
    for (down, out) in out.iter_mut().enumerate() {
        let mut line = [0.0; ROW];
        for step in 0..=2 * REACH {
            let Some(row) = (down + step).checked_sub(REACH).and_then(|y| cells.get(y)) else {
                continue;
            };
            let weight = weights[step.abs_diff(REACH)];
            for (sum, light) in line.iter_mut().zip(row) {
                *sum += weight * light;
            }
        }
        let mut sums = [0.0; ALONG];
        for step in 0..=2 * REACH {
            let weight = weights[step.abs_diff(REACH)];
            for (sum, light) in sums.iter_mut().zip(&line[step..step + ALONG]) {
                *sum += weight * light;
            }
        }
        out[MARGIN..MARGIN + ALONG].copy_from_slice(&sums);
    }
}

/// Tests of neighbours in the middle of each cell, in quadrants of the signs (+, +), (−, +), (+, −) and (−, −).
struct Tests {
    /// What is left of the light under the neighbour.
    lights: [Quadrant; 4],
    /// What the same is for a neighbour of flux 1, and the square of its noise in units of a cell's.
    squares: Quadrant,
}

/// Takes away what usual galaxies explain; `ratio` is the square of the galaxy's light over the noise of a cell.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn compare(usual: &Usual, cells: &Rows, smoothed: &Rows, ratio: f32) -> Tests {
    let quadrants = folded(cells);
    let mut tests = Tests {
        lights: [[0.0; QUADRANT]; 4],
        squares: usual.squares,
    };
    unfold(smoothed, &mut tests.lights);
    for ((components, light), odd) in usual.components.iter().zip(&quadrants).zip(PARITIES) {
        let galaxy = explain(components, light, ratio, &mut tests.squares);
        for (out, side) in tests.lights.iter_mut().zip(SIDES) {
            let sign = sign(odd, side) as f32;
            for (out, light) in out.iter_mut().zip(&galaxy) {
                *out -= sign * light;
            }
        }
    }
    tests
}

/// What components of one parity explain of the light under neighbours, in the positive quadrant. Takes from the squares what
/// they explain of a neighbour itself.
#[inline(always)]
fn explain(
    components: &Components,
    light: &Quadrant,
    ratio: f32,
    squares: &mut Quadrant,
) -> Quadrant {
    let mut explained = [0.0; QUADRANT];
    for k in 0..COMPONENTS {
        let share = 1.0 / (1.0 + 1.0 / (components.variances[k] * ratio));
        let amplitude = share * dot(&components.shapes[k], light);
        let smoothed = &components.smoothed[k];
        for ((out, square), value) in explained.iter_mut().zip(squares.iter_mut()).zip(smoothed) {
            *out += amplitude * value;
            *square -= share * value * value;
        }
    }
    explained
}

/// Parts of the cells that are even or odd along the axes, in the positive quadrant: half of the sums of four, so that noise
/// stays as it is.
#[inline(always)]
fn folded(cells: &Rows) -> [Quadrant; 4] {
    let mut lights = [[0.0; QUADRANT]; 4];
    unfold(cells, &mut lights);
    let [mut even, mut turned, mut x, mut y] = [[0.0; QUADRANT]; 4];
    for at in 0..QUADRANT {
        let [a, b, c, d] = [0, 1, 2, 3].map(|side: usize| 0.5 * lights[side][at]);
        even[at] = (a + b) + (c + d);
        turned[at] = (a - b) - (c - d);
        x[at] = (a - b) + (c - d);
        y[at] = (a + b) - (c + d);
    }
    [even, turned, x, y]
}

/// Cells of the four quadrants, each from the centre on.
#[inline(always)]
fn unfold(cells: &Rows, quadrants: &mut [Quadrant; 4]) {
    for j in 0..HALF {
        for (quadrant, side) in quadrants.iter_mut().zip(SIDES) {
            let row = &cells[mirrored(HALF, j, side[1])];
            let line = &mut quadrant[j * HALF..][..HALF];
            for (i, out) in line.iter_mut().enumerate() {
                *out = row[MARGIN + mirrored(HALF, i, side[0])];
            }
        }
    }
}

/// Sum of products, several side by side.
#[inline(always)]
fn dot(a: &Quadrant, b: &Quadrant) -> f32 {
    const LANES: usize = 16;
    let mut lanes = [0.0; LANES];
    for (a, b) in a.chunks_exact(LANES).zip(b.chunks_exact(LANES)) {
        for l in 0..LANES {
            lanes[l] += a[l] * b[l];
        }
    }
    lanes.iter().sum()
}

#[cfg(test)]
mod tests {
    use std::f32::consts::PI;

    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const N: usize = 48;

    fn blob(stamp: &mut [f32], n: usize, [x, y]: [f32; 2], width: f32, flux: f32) {
        let peak = flux / (2.0 * PI * width * width);
        let middle = (n as f32 - 1.0) / 2.0;
        for (at, value) in stamp.iter_mut().enumerate() {
            let (dx, dy) = ((at % n) as f32 - middle - x, (at / n) as f32 - middle - y);
            *value += peak * (-(dx * dx + dy * dy) / (2.0 * width * width)).exp();
        }
    }

    /// A stamp of noise of variance 1.
    fn noise(n: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
        let normal = StandardNormal.sample_iter(rng);
        normal.take(n * n).collect()
    }

    fn known(noise: f32, light: f32) -> Known {
        Known {
            noise,
            light,
            least: f32::NEG_INFINITY,
        }
    }

    /// The same by the covariance of all cells: galaxy and noise.
    fn plain(near: &Near, stamp: &[f32], corner: [i32; 2], known: Known) -> Option<Suspect> {
        let half = near.usual.half as i32;
        let along = 2 * near.usual.half;
        let count = along * along;
        let place = |at: usize| [at % along, at / along].map(|cell| cell as i32 - half);
        let cells: Vec<f64> = (0..count)
            .map(|at| {
                let [x, y] = place(at);
                let mut sum = 0.0;
                for pixel in 0..CELL * CELL {
                    let x = corner[0] + CELL as i32 * x + (pixel % CELL) as i32;
                    let y = corner[1] + CELL as i32 * y + (pixel / CELL) as i32;
                    let on = |at: i32| (0..near.n as i32).contains(&at);
                    if on(x) && on(y) {
                        sum += f64::from(stamp[y as usize * near.n + x as usize]);
                    }
                }
                sum
            })
            .collect();
        let unusual = f64::from(UNUSUAL * known.light);
        let noise = (f64::from(known.noise).powi(4) + unusual.powi(4)).powf(0.25);
        let noise = CELL as f64 * noise;
        let light = f64::from(known.light).max(noise);
        let mirror = |cell: i32| if cell < 0 { -1 - cell } else { cell } as usize;
        // The inverse covariance times a vector, by the components.
        let weighted = |vector: &[f64]| -> Vec<f64> {
            let mut out = vector.to_vec();
            for (components, odd) in near.usual.components.iter().zip(PARITIES) {
                for k in 0..COMPONENTS {
                    let value = |at: usize| {
                        let [x, y] = place(at);
                        let minus = (odd[0] && x < 0) != (odd[1] && y < 0);
                        let shape = components.shapes[k][mirror(y) * HALF + mirror(x)];
                        f64::from(shape) * if minus { -0.5 } else { 0.5 }
                    };
                    let variance = f64::from(components.variances[k]) * light * light;
                    let share = 1.0 / (1.0 + noise * noise / variance);
                    let along: f64 = (0..count).map(|at| value(at) * vector[at]).sum();
                    for (at, out) in out.iter_mut().enumerate() {
                        *out -= share * along * value(at);
                    }
                }
            }
            out
        };
        let left = weighted(&cells);
        let mut most: Option<Suspect> = None;
        for at in 0..count {
            let [x0, y0] = place(at);
            let middle = |cell: i32| CELL as f32 * (cell as f32 + 0.5);
            let distance = middle(x0).hypot(middle(y0));
            if !(DISTANCES[0]..=DISTANCES[1]).contains(&distance) {
                continue;
            }
            let template: Vec<f64> = (0..count)
                .map(|at| {
                    let [x, y] = place(at);
                    let reach = REACH as i32;
                    let near = (x - x0).abs() <= reach && (y - y0).abs() <= reach;
                    if near {
                        neighbour(x - x0) * neighbour(y - y0)
                    } else {
                        0.0
                    }
                })
                .collect();
            let sum = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let square = sum(&template, &weighted(&template));
            let light = sum(&template, &left);
            let significance = (light / (noise * square.sqrt())) as f32;
            if most.is_none_or(|most| significance > most.significance) {
                most = Some(Suspect {
                    light: (light / square) as f32,
                    significance,
                });
            }
        }
        most
    }

    #[test]
    fn the_fast_test_is_that_of_the_covariance_of_all_cells() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        for n in [24, 29, 40, 48, 64] {
            // Its room is used again, with what the last stamp left there.
            let mut near = Near::new(n);
            for centre in [[0.0, 0.0], [0.4, -1.3], [-6.2, 3.0]] {
                let mut stamp = noise(n, &mut rng);
                blob(&mut stamp, n, centre, 2.8, 200.0);
                blob(&mut stamp, n, [centre[0] + 6.0, centre[1] - 4.0], 3.0, 60.0);
                let corner = centre.map(|c| (c + n as f32 / 2.0).round() as i32);
                for known in [known(1.0, 250.0), known(0.0, 100.0), known(3.0, -1.0)] {
                    let fast = near.suspect(&stamp, centre, known);
                    let slow = plain(&near, &stamp, corner, known);
                    // Without noise and light there is nothing to compare with.
                    assert_eq!(fast.is_some(), known.noise > 0.0 || known.light > 0.0);
                    let (Some(fast), Some(slow)) = (fast, slow) else {
                        continue;
                    };
                    // Sums of a thousand terms in f32 lose 1e-5 of the largest one, and the galaxy cancels to a tenth.
                    let scale = slow.significance.abs().max(1.0);
                    let difference = (fast.significance - slow.significance).abs();
                    assert!(
                        difference < 2e-4 * scale,
                        "{n} {centre:?} {fast:?} {slow:?}"
                    );
                    assert!((fast.light - slow.light).abs() < 2e-3 * slow.light.abs().max(1.0));
                }
            }
        }
    }

    #[test]
    fn a_neighbour_has_its_own_light() {
        let mut near = Near::new(N);
        for middle in [[0.0, 0.0], [0.5, 0.0], [-0.5, 1.0]] {
            for away in [[9.0, 3.0], [-1.0, -9.0], [-7.0, 7.0], [11.0, 7.0]] {
                let mut stamp = vec![0.0; N * N];
                blob(&mut stamp, N, middle, 2.5, 200.0);
                let place = [middle[0] + away[0], middle[1] + away[1]];
                blob(&mut stamp, N, place, 3.0, 100.0);
                let found = near.suspect(&stamp, middle, known(1.0, 300.0)).unwrap();
                // The ensemble explains a part of it, the less the farther away it is.
                assert!(
                    (found.light - 100.0).abs() < 20.0,
                    "{found:?} {middle:?} {away:?}"
                );
            }
        }
    }

    #[test]
    fn galaxies_alone_are_no_neighbours() {
        let mut near = Near::new(N);
        for width in [1.5, 2.0, 3.0, 4.5, 7.0] {
            for middle in [[0.0, 0.0], [0.45, 0.0], [-0.2, 0.45]] {
                let mut stamp = vec![0.0; N * N];
                // A core with wings, as a disc behind a PSF.
                blob(&mut stamp, N, middle, 0.8 * width, 240.0);
                blob(&mut stamp, N, middle, 1.5 * width, 160.0);
                // A sky with a gradient, and noise that is much less.
                for (at, value) in stamp.iter_mut().enumerate() {
                    *value += 0.5 + 0.02 * (at % N) as f32;
                }
                let found = near.suspect(&stamp, middle, known(1.0, 400.0)).unwrap();
                // Displacements at the end of the ensemble's are not fully explained: less than half of what flags a galaxy.
                assert!(found.significance < 2.3, "{found:?} {width} {middle:?}");
            }
        }
    }

    #[test]
    fn significances_have_a_variance_of_one_for_galaxies_of_the_ensemble_in_noise() {
        let near = Near::new(N);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        // A galaxy whose light is 50 times the noise of a cell.
        let strength = 50.0;
        let mut rows = [Box::new([[0.0; ROW]; ALONG]), Box::new([[0.0; ROW]; ALONG])];
        let [cells, smoothed] = &mut rows;
        let mut squares = vec![0.0; near.places.len()];
        let count = 1000;
        for _ in 0..count {
            let stamp = noise(N, &mut rng);
            add_cells(&stamp, N, [24, 24], HALF, cells);
            for (components, odd) in near.usual.components.iter().zip(PARITIES) {
                let finite = |k: &usize| components.variances[*k].is_finite();
                for k in (0..COMPONENTS).filter(finite) {
                    let normal: f32 = StandardNormal.sample(&mut rng);
                    let noise = CELL as f32;
                    let amplitude = noise * strength * components.variances[k].sqrt() * normal;
                    for at in 0..HALF * HALF {
                        for side in SIDES {
                            let light = 0.5 * sign(odd, side) as f32 * components.shapes[k][at];
                            cells[mirrored(HALF, at / HALF, side[1])]
                                [MARGIN + mirrored(HALF, at % HALF, side[0])] += amplitude * light;
                        }
                    }
                }
            }
            smooth(cells, &near.weights, smoothed);
            let tests = compare(near.usual, cells, smoothed, strength * strength);
            for (sum, &place) in squares.iter_mut().zip(&near.places) {
                let noise = (CELL as f32).powi(2) * tests.squares[place];
                *sum += tests
                    .lights
                    .iter()
                    .map(|l| l[place].powi(2) / noise)
                    .sum::<f32>();
            }
        }
        for (sum, place) in squares.iter().zip(&near.places) {
            // Four thousand values have an error of 2.2 %; the worst of the places may be 4 σ.
            let variance = sum / (4.0 * count as f32);
            assert!((variance - 1.0).abs() < 0.09, "{variance} {place}");
        }
    }

    #[test]
    fn stamps_without_room_and_galaxies_beyond_the_stamp_have_none() {
        assert_eq!(
            Near::new(4).suspect(&[1.0; 16], [0.0; 2], known(1.0, 1.0)),
            None
        );
        let mut near = Near::new(N);
        let found = near.suspect(&[1.0; N * N], [-60.0, 90.0], known(1.0, 10.0));
        assert_eq!(found.unwrap().light, 0.0);
    }
}
