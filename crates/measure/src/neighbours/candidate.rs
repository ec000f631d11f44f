//! Candidate neighbours so near that they overlap the galaxy, or cannot be subtracted.
//!
//! The stamp is summed in cells. The galaxy is removed as far as noise does not hide it: its posterior mean under the
//! variances of the [`GalaxyBasis`]. If a Gaussian neighbour explains much of the residual, it is a candidate. This is the
//! best linear test for galaxies of a normal distribution: the signal-to-noise ratio of the candidate's light, where the
//! galaxy's own light counts as noise with the covariance of the reference population.

use std::ops::Range;

use multiversion::multiversion;

use super::galaxy_basis::{
    CELL_SIDE, COMPONENTS, Components, GalaxyBasis, HALF_SIDE, NEIGHBOUR_HALF_SIDE, PARITIES,
    QUADRANT, QUADRANT_SIGNS, Quadrant, mirrored, neighbour_light, parity_sign,
};

const SIDE: usize = 2 * HALF_SIDE;
/// Cells on each side of a row that have no light.
const MARGIN: usize = NEIGHBOUR_HALF_SIDE;
/// Cells of a row with both margins, up to whole vectors.
const ROW: usize = (SIDE + 2 * MARGIN).next_multiple_of(16);
// Least and largest distance in pixels of a candidate's cell from the corner of pixels nearest to the galaxy's centre.
// Below 4 px, a displacement of the galaxy explains all of a candidate's light. At 16.0, m of neighbours at 16 to 24 px is
// −3.1 instead of −2.3 (10⁻³, seed 61125, 16,000 measurements).
const DISTANCES: [f32; 2] = [4.0, 15.0];
// Difference between a galaxy and the reference population, as noise of a pixel in units of the galaxy's light.
// The noise of a galaxy at S/N 65. At 0.0017, 5 % fewer blends at 5 to 7 px are found at S/N 100, and two thirds as many
// galaxies with knots are flagged.
const POPULATION_MISMATCH: f32 = 0.0014;
// Share of a candidate's square that the galaxy basis must leave: keeps a division finite.
const MIN_RESIDUAL_SQUARE: f32 = 1e-3;
// The lanes of AVX-512; divides the number of cells of a quadrant.
const LANES: usize = 16;

/// Cells in rows, with a margin along x.
type Rows = [[f32; ROW]; SIDE];

/// Finds candidates on stamps of one size.
pub(super) struct CandidateFinder {
    n: usize,
    basis: &'static GalaxyBasis,
    /// Cells of candidates in a quadrant.
    places: Vec<usize>,
    /// Light of a neighbour along an axis, from its middle on.
    weights: [f32; NEIGHBOUR_HALF_SIDE + 1],
    cells: Box<Rows>,
    smoothed: Box<Rows>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Candidate {
    pub(super) light: f32,
    /// Light in units of its error.
    pub(super) significance: f32,
}

/// Noise of a pixel on large scales, light of the galaxy, and least light of a candidate.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scale {
    pub(super) noise: f32,
    pub(super) light: f32,
    pub(super) min_light: f32,
}

impl Scale {
    /// Noise of a cell, or the mismatch of the population: the larger one, with a smooth transition.
    fn cell_noise(self) -> f32 {
        let squares = [self.noise, POPULATION_MISMATCH * self.light].map(|noise| noise * noise);
        CELL_SIDE as f32 * squares[0].hypot(squares[1]).sqrt()
    }
}

impl CandidateFinder {
    pub(super) fn new(n: usize) -> Self {
        // The cells of a galaxy up to two pixels off the centre are on the stamp.
        let basis = GalaxyBasis::for_half_side((n / 2).saturating_sub(2) / CELL_SIDE);
        let distance = |at: usize| {
            let middle = |cell: usize| CELL_SIDE as f32 * (cell as f32 + 0.5);
            middle(at % HALF_SIDE).hypot(middle(at / HALF_SIDE))
        };
        let on_cells =
            |at: usize| at % HALF_SIDE < basis.half_side && at / HALF_SIDE < basis.half_side;
        let range = DISTANCES[0]..=DISTANCES[1];
        CandidateFinder {
            n,
            basis,
            places: (0..HALF_SIDE * HALF_SIDE)
                .filter(|&at| on_cells(at) && range.contains(&distance(at)))
                .collect(),
            weights: std::array::from_fn(|step| neighbour_light(step as i32) as f32),
            cells: Box::new([[0.0; ROW]; SIDE]),
            smoothed: Box::new([[0.0; ROW]; SIDE]),
        }
    }

    /// Half the side of all cells, in pixels.
    pub(super) fn half_side(&self) -> f32 {
        (CELL_SIDE * self.basis.half_side) as f32
    }

    /// The most significant candidate beside a galaxy centred at `centre`, (x, y) in pixels from the centre of the stamp.
    pub(super) fn most_significant(
        &mut self,
        stamp: &[f32],
        centre: [f32; 2],
        scale: Scale,
    ) -> Option<Candidate> {
        let noise = scale.cell_noise();
        if !scale.noise.is_finite() || !scale.light.is_finite() || noise <= 0.0 {
            return None;
        }
        let snr = (scale.light / noise).max(1.0);
        // Cells meet at the corner of pixels that is nearest to the centre, about which they are even and odd.
        let corner = centre.map(|c| (c + self.n as f32 / 2.0).round() as i32);
        add_cells(stamp, self.n, corner, self.basis.half_side, &mut self.cells);
        smooth(&self.cells, &self.weights, &mut self.smoothed);
        let tests = compare(self.basis, &self.cells, &self.smoothed, snr * snr);
        let mut most: Option<Candidate> = None;
        for &place in &self.places {
            let square = tests.squares[place];
            if square <= MIN_RESIDUAL_SQUARE * self.basis.squares[place] {
                continue;
            }
            for light in &tests.lights {
                let candidate = Candidate {
                    light: light[place] / square,
                    significance: light[place] / (noise * square.sqrt()),
                };
                let is_more = most.is_none_or(|most| candidate.significance > most.significance);
                if candidate.light >= scale.min_light && is_more {
                    most = Some(candidate);
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
        let first = corner[axis] - (CELL_SIDE * half) as i32;
        let on = |at: i32| at.clamp(0, n as i32) as usize;
        (first, on(first)..on(first + (2 * CELL_SIDE * half) as i32))
    };
    let ((left, columns), (top, _)) = (range(0), range(1));
    let skipped = (columns.start as i32 - left).clamp(0, (CELL_SIDE * SIDE) as i32) as usize;
    for (down, row) in cells.iter_mut().enumerate() {
        row.fill(0.0);
        let down = down as i32 - (HALF_SIDE - half) as i32;
        if !(0..2 * half as i32).contains(&down) {
            continue;
        }
        let mut line = [0.0; CELL_SIDE * SIDE];
        for step in 0..CELL_SIDE as i32 {
            let y = top + CELL_SIDE as i32 * down + step;
            if (0..n as i32).contains(&y) {
                let pixels = &stamp[y as usize * n..][columns.clone()];
                for (sum, pixel) in line[skipped..].iter_mut().zip(pixels) {
                    *sum += pixel;
                }
            }
        }
        let row = &mut row[MARGIN + HALF_SIDE - half..][..2 * half];
        for (cell, pair) in row.iter_mut().zip(line.chunks_exact(CELL_SIDE)) {
            *cell = pair[0] + pair[1];
        }
    }
}

/// The light under a neighbour in the middle of each cell: a convolution along both axes.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn smooth(cells: &Rows, weights: &[f32; NEIGHBOUR_HALF_SIDE + 1], out: &mut Rows) {
    for (down, out) in out.iter_mut().enumerate() {
        let mut line = [0.0; ROW];
        for step in 0..=2 * NEIGHBOUR_HALF_SIDE {
            let Some(row) = (down + step)
                .checked_sub(NEIGHBOUR_HALF_SIDE)
                .and_then(|y| cells.get(y))
            else {
                continue;
            };
            let weight = weights[step.abs_diff(NEIGHBOUR_HALF_SIDE)];
            for (sum, light) in line.iter_mut().zip(row) {
                *sum += weight * light;
            }
        }
        // The margin of zeros keeps the kernel from the next row.
        let mut sums = [0.0; SIDE];
        for step in 0..=2 * NEIGHBOUR_HALF_SIDE {
            let weight = weights[step.abs_diff(NEIGHBOUR_HALF_SIDE)];
            for (sum, light) in sums.iter_mut().zip(&line[step..step + SIDE]) {
                *sum += weight * light;
            }
        }
        out[MARGIN..MARGIN + SIDE].copy_from_slice(&sums);
    }
}

/// Tests of neighbours in the middle of each cell.
struct Tests {
    /// Residual light under the neighbour, in the quadrants of [`QUADRANT_SIGNS`].
    lights: [Quadrant; 4],
    /// The same of a neighbour of flux 1, which is also the square of its noise in units of a cell's.
    squares: Quadrant,
}

/// Subtracts the galaxy; `snr2` is the square of its light over the noise of a cell.
#[multiversion(targets("x86_64+avx512f+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn compare(basis: &GalaxyBasis, cells: &Rows, smoothed: &Rows, snr2: f32) -> Tests {
    let parities = fold(cells);
    let mut tests = Tests {
        lights: [[0.0; QUADRANT]; 4],
        squares: basis.squares,
    };
    unfold(smoothed, &mut tests.lights);
    for ((components, light), odd) in basis.components.iter().zip(&parities).zip(PARITIES) {
        let galaxy = explained_light(components, light, snr2, &mut tests.squares);
        for (out, negative) in tests.lights.iter_mut().zip(QUADRANT_SIGNS) {
            let sign = parity_sign(odd, negative) as f32;
            for (out, light) in out.iter_mut().zip(&galaxy) {
                *out -= sign * light;
            }
        }
    }
    tests
}

/// The light under neighbours that components of one parity explain, in the positive quadrant. Subtracts from the squares
/// the part of a neighbour that they explain.
#[inline(always)]
fn explained_light(
    components: &Components,
    light: &Quadrant,
    snr2: f32,
    squares: &mut Quadrant,
) -> Quadrant {
    let mut explained = [0.0; QUADRANT];
    for k in 0..COMPONENTS {
        let share = 1.0 / (1.0 + 1.0 / (components.variances[k] * snr2));
        let amplitude = share * dot(&components.shapes[k], light);
        let smoothed = &components.smoothed[k];
        for ((out, square), value) in explained.iter_mut().zip(squares.iter_mut()).zip(smoothed) {
            *out += amplitude * value;
            *square -= share * value * value;
        }
    }
    explained
}

/// Parts of the cells of each of [`PARITIES`], in the positive quadrant: half of the sums of four, so that noise stays the
/// same.
#[inline(always)]
fn fold(cells: &Rows) -> [Quadrant; 4] {
    let mut lights = [[0.0; QUADRANT]; 4];
    unfold(cells, &mut lights);
    let [mut even, mut odd, mut x, mut y] = [[0.0; QUADRANT]; 4];
    for at in 0..QUADRANT {
        let [a, b, c, d] = [0, 1, 2, 3].map(|side: usize| 0.5 * lights[side][at]);
        even[at] = (a + b) + (c + d);
        odd[at] = (a - b) - (c - d);
        x[at] = (a - b) + (c - d);
        y[at] = (a + b) - (c + d);
    }
    [even, odd, x, y]
}

/// Cells of the quadrants of [`QUADRANT_SIGNS`], each from the centre on.
#[inline(always)]
fn unfold(cells: &Rows, quadrants: &mut [Quadrant; 4]) {
    for j in 0..HALF_SIDE {
        for (quadrant, side) in quadrants.iter_mut().zip(QUADRANT_SIGNS) {
            let row = &cells[mirrored(HALF_SIDE, j, side[1])];
            let line = &mut quadrant[j * HALF_SIDE..][..HALF_SIDE];
            for (i, out) in line.iter_mut().enumerate() {
                *out = row[MARGIN + mirrored(HALF_SIDE, i, side[0])];
            }
        }
    }
}

#[inline(always)]
fn dot(a: &Quadrant, b: &Quadrant) -> f32 {
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

    fn scale(noise: f32, light: f32) -> Scale {
        Scale {
            noise,
            light,
            min_light: f32::NEG_INFINITY,
        }
    }

    /// The same by the covariance of all cells: galaxy and noise.
    fn plain(
        finder: &CandidateFinder,
        stamp: &[f32],
        corner: [i32; 2],
        scale: Scale,
    ) -> Option<Candidate> {
        let half = finder.basis.half_side as i32;
        let along = 2 * finder.basis.half_side;
        let count = along * along;
        let place = |at: usize| [at % along, at / along].map(|cell| cell as i32 - half);
        let cells: Vec<f64> = (0..count)
            .map(|at| {
                let [x, y] = place(at);
                let mut sum = 0.0;
                for pixel in 0..CELL_SIDE * CELL_SIDE {
                    let x = corner[0] + CELL_SIDE as i32 * x + (pixel % CELL_SIDE) as i32;
                    let y = corner[1] + CELL_SIDE as i32 * y + (pixel / CELL_SIDE) as i32;
                    let on = |at: i32| (0..finder.n as i32).contains(&at);
                    if on(x) && on(y) {
                        sum += f64::from(stamp[y as usize * finder.n + x as usize]);
                    }
                }
                sum
            })
            .collect();
        let mismatch = f64::from(POPULATION_MISMATCH * scale.light);
        let noise = (f64::from(scale.noise).powi(4) + mismatch.powi(4)).powf(0.25);
        let noise = CELL_SIDE as f64 * noise;
        let light = f64::from(scale.light).max(noise);
        let mirror = |cell: i32| if cell < 0 { -1 - cell } else { cell } as usize;
        // The inverse covariance times a vector, by the components.
        let weighted = |vector: &[f64]| -> Vec<f64> {
            let mut out = vector.to_vec();
            for (components, odd) in finder.basis.components.iter().zip(PARITIES) {
                for k in 0..COMPONENTS {
                    let value = |at: usize| {
                        let [x, y] = place(at);
                        let minus = (odd[0] && x < 0) != (odd[1] && y < 0);
                        let shape = components.shapes[k][mirror(y) * HALF_SIDE + mirror(x)];
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
        let mut most: Option<Candidate> = None;
        for at in 0..count {
            let [x0, y0] = place(at);
            let middle = |cell: i32| CELL_SIDE as f32 * (cell as f32 + 0.5);
            let distance = middle(x0).hypot(middle(y0));
            if !(DISTANCES[0]..=DISTANCES[1]).contains(&distance) {
                continue;
            }
            let template: Vec<f64> = (0..count)
                .map(|at| {
                    let [x, y] = place(at);
                    let reach = NEIGHBOUR_HALF_SIDE as i32;
                    let near = (x - x0).abs() <= reach && (y - y0).abs() <= reach;
                    if near {
                        neighbour_light(x - x0) * neighbour_light(y - y0)
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
                most = Some(Candidate {
                    light: (light / square) as f32,
                    significance,
                });
            }
        }
        most
    }

    #[test]
    fn the_fast_test_is_that_of_the_full_covariance() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        for n in [24, 29, 40, 48, 64] {
            // Its buffers hold the last stamp.
            let mut finder = CandidateFinder::new(n);
            for centre in [[0.0, 0.0], [0.4, -1.3], [-6.2, 3.0]] {
                let mut stamp = noise(n, &mut rng);
                blob(&mut stamp, n, centre, 2.8, 200.0);
                blob(&mut stamp, n, [centre[0] + 6.0, centre[1] - 4.0], 3.0, 60.0);
                let corner = centre.map(|c| (c + n as f32 / 2.0).round() as i32);
                for scale in [scale(1.0, 250.0), scale(0.0, 100.0), scale(3.0, -1.0)] {
                    let fast = finder.most_significant(&stamp, centre, scale);
                    let slow = plain(&finder, &stamp, corner, scale);
                    // Without noise and light there is nothing to compare with.
                    assert_eq!(fast.is_some(), scale.noise > 0.0 || scale.light > 0.0);
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
    fn a_candidate_has_the_light_of_its_neighbour() {
        let mut finder = CandidateFinder::new(N);
        for middle in [[0.0, 0.0], [0.5, 0.0], [-0.5, 1.0]] {
            for away in [[9.0, 3.0], [-1.0, -9.0], [-7.0, 7.0], [11.0, 7.0]] {
                let mut stamp = vec![0.0; N * N];
                blob(&mut stamp, N, middle, 2.5, 200.0);
                let place = [middle[0] + away[0], middle[1] + away[1]];
                blob(&mut stamp, N, place, 3.0, 100.0);
                let found = finder
                    .most_significant(&stamp, middle, scale(1.0, 300.0))
                    .unwrap();
                // The reference population explains a part of it, the less the farther away it is.
                assert!(
                    (found.light - 100.0).abs() < 20.0,
                    "{found:?} {middle:?} {away:?}"
                );
            }
        }
    }

    #[test]
    fn isolated_galaxies_have_no_candidates() {
        let mut finder = CandidateFinder::new(N);
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
                let found = finder
                    .most_significant(&stamp, middle, scale(1.0, 400.0))
                    .unwrap();
                // Displacements at the limit of the population are not fully explained: less than half of what flags a galaxy.
                assert!(found.significance < 2.3, "{found:?} {width} {middle:?}");
            }
        }
    }

    #[test]
    fn significances_of_the_population_have_variance_one() {
        let finder = CandidateFinder::new(N);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        // A galaxy whose light is 50 times the noise of a cell.
        let strength = 50.0;
        let mut rows = [Box::new([[0.0; ROW]; SIDE]), Box::new([[0.0; ROW]; SIDE])];
        let [cells, smoothed] = &mut rows;
        let mut squares = vec![0.0; finder.places.len()];
        let count = 1000;
        for _ in 0..count {
            let stamp = noise(N, &mut rng);
            add_cells(&stamp, N, [24, 24], HALF_SIDE, cells);
            for (components, odd) in finder.basis.components.iter().zip(PARITIES) {
                let finite = |k: &usize| components.variances[*k].is_finite();
                for k in (0..COMPONENTS).filter(finite) {
                    let normal: f32 = StandardNormal.sample(&mut rng);
                    let noise = CELL_SIDE as f32;
                    let amplitude = noise * strength * components.variances[k].sqrt() * normal;
                    for at in 0..HALF_SIDE * HALF_SIDE {
                        for side in QUADRANT_SIGNS {
                            let light =
                                0.5 * parity_sign(odd, side) as f32 * components.shapes[k][at];
                            cells[mirrored(HALF_SIDE, at / HALF_SIDE, side[1])]
                                [MARGIN + mirrored(HALF_SIDE, at % HALF_SIDE, side[0])] +=
                                amplitude * light;
                        }
                    }
                }
            }
            smooth(cells, &finder.weights, smoothed);
            let tests = compare(finder.basis, cells, smoothed, strength * strength);
            for (sum, &place) in squares.iter_mut().zip(&finder.places) {
                let noise = (CELL_SIDE as f32).powi(2) * tests.squares[place];
                *sum += tests
                    .lights
                    .iter()
                    .map(|l| l[place].powi(2) / noise)
                    .sum::<f32>();
            }
        }
        for (sum, place) in squares.iter().zip(&finder.places) {
            // Four thousand values have an error of 2.2 %; the worst of the places may be 4 σ.
            let variance = sum / (4.0 * count as f32);
            assert!((variance - 1.0).abs() < 0.09, "{variance} {place}");
        }
    }

    #[test]
    fn small_stamps_and_galaxies_off_the_stamp_have_none() {
        assert_eq!(
            CandidateFinder::new(4).most_significant(&[1.0; 16], [0.0; 2], scale(1.0, 1.0)),
            None
        );
        let mut finder = CandidateFinder::new(N);
        let found = finder.most_significant(&[1.0; N * N], [-60.0, 90.0], scale(1.0, 10.0));
        assert_eq!(found.unwrap().light, 0.0);
    }
}
