//! What the noisy stars of an image have in common beyond the profiles that fit them.
//!
//! The profile of a noisy star rests on what is expected of stars in general: noise hides its wings. What the fits leave tells, in
//! the mean over many stars, how the stars of this image differ from that expectation. Its round part is a function of the
//! profile's own radius √s, so that stars of any width and ellipticity can share it. Parts that vary with twice and four times
//! the angle on the pixels, such as diffraction spikes, are functions of the same radius. All are in units of the amplitude.

use ndarray::{ArrayView2, ArrayViewMut2};
use shearq_quantities::linear::cholesky;

use super::moffat::Moffat;

/// Steps per unit of √s between radii, between which functions are linear. See docs/constants.md.
const FINE: usize = 2;
/// Number of these radii, up to √s = 18; beyond the last one functions are constant. See docs/constants.md.
const COUNT: usize = 37;
/// Functions of the radius: one that is round, and with the cosine and sine of two and four times the angle.
const TERMS: usize = 5;
/// Radii between two at which those with angles are free. Divides the number of steps. See docs/constants.md.
const COARSE: usize = 2;
/// Standard deviations by which those with angles must lower the sum of squares. See docs/constants.md.
const CLEAR: f64 = 3.0;
/// Fewest stars for those with angles. See docs/constants.md.
const ENOUGH_TO_TURN: usize = 100;
/// Products of terms with those up to them.
const PAIRS: usize = TERMS * (TERMS + 1) / 2;
/// All unknowns.
const UNKNOWNS: usize = COUNT * TERMS;
/// Relative addition to the diagonal of the normal equations, for radii that no pixel has. See docs/constants.md.
const RIDGE: f64 = 1e-9;

/// What the noisy stars of an image have in common: [`StarSurvey::common`](crate::StarSurvey::common).
#[derive(Debug, Clone, PartialEq)]
pub struct CommonProfile {
    /// For each range of S/N its lower end, and what its stars have in common. It also serves stars below the first range.
    pub(super) ranges: Vec<(f64, Common)>,
}

/// Functions of the radius √s of profiles, in units of their amplitudes.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Common {
    /// Values at the radii, of each term.
    values: [[f64; TERMS]; COUNT],
    /// Terms that are not zero.
    terms: usize,
}

/// Sums of the normal equations for the values at the radii. Only radii next to each other have products.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Sums {
    /// Mean square of what is left, and its sum, in units of the noise.
    pub(super) left: [f64; 2],
    /// Products of the terms at each radius.
    squares: [[f64; PAIRS]; COUNT],
    /// Products with the terms at the radius before, which are symmetric.
    products: [[f64; PAIRS]; COUNT],
    right: [[f64; TERMS]; COUNT],
}

impl Default for Sums {
    fn default() -> Self {
        Sums {
            left: [0.0; 2],
            squares: [[0.0; PAIRS]; COUNT],
            products: [[0.0; PAIRS]; COUNT],
            right: [[0.0; TERMS]; COUNT],
        }
    }
}

impl Sums {
    /// Those of a star with noise `sigma`, and the profile that fits it, which is drawn in `model`.
    pub(super) fn of(
        star: ArrayView2<'_, f64>,
        model: ArrayView2<'_, f64>,
        profile: &Moffat,
        sigma: f64,
    ) -> Self {
        let mut sums = Sums::default();
        let amplitude = profile.amplitude();
        let weight = (amplitude / sigma).powi(2);
        let (square, [x0, y0]) = (profile.square(), profile.place());
        for (((y, x), value), model) in star.indexed_iter().zip(model) {
            let left = (value - model) / amplitude;
            let (x, y) = (x as f64, y as f64);
            let (at, far) = place(square(x, y).sqrt());
            let (near, terms) = (1.0 - far, terms(x - x0, y - y0));
            let parts = [near * near, near * far, far * far].map(|share| weight * share);
            for i in 0..TERMS {
                for j in 0..=i {
                    let (pair, product) = (pair(i, j), terms[i] * terms[j]);
                    sums.squares[at][pair] += parts[0] * product;
                    sums.products[at + 1][pair] += parts[1] * product;
                    sums.squares[at + 1][pair] += parts[2] * product;
                }
                sums.right[at][i] += weight * near * left * terms[i];
                sums.right[at + 1][i] += weight * far * left * terms[i];
            }
            sums.left[0] += weight * left * left;
            sums.left[1] += left * amplitude / sigma;
        }
        let pixels = star.len() as f64;
        sums.left[0] /= pixels;
        sums.left[1] /= pixels.sqrt();
        sums
    }

    /// Adds those of another star with a weight.
    pub(super) fn add(&mut self, more: &Sums, weight: f64) {
        let add = |sums: &mut [f64], more: &[f64]| {
            for (sum, more) in sums.iter_mut().zip(more) {
                *sum += weight * more;
            }
        };
        add(self.squares.as_flattened_mut(), more.squares.as_flattened());
        add(
            self.products.as_flattened_mut(),
            more.products.as_flattened(),
        );
        add(self.right.as_flattened_mut(), more.right.as_flattened());
    }

    /// The functions that fit best, to `stars` stars. The round one is not reduced for its noise: that is small compared with
    /// the noise of each star, and what is missing of the mean would bias all images alike. The others are zero unless they
    /// are significant: their noise would be an ellipticity that all galaxies of the image share.
    pub(super) fn common(&self, stars: usize) -> Option<Common> {
        let (mut values, gain) = self.solved(1)?;
        let mut found = Common { values, terms: 1 };
        if stars < ENOUGH_TO_TURN {
            return Some(found);
        }
        let seen = self.squares.iter().skip(1).filter(|pairs| pairs[0] > 0.0);
        let more = (2 * seen.count() / COARSE) as f64;
        let mut before = gain;
        for terms in [3, TERMS] {
            let gain;
            (values, gain) = self.solved(terms)?;
            // The sum of so many squares of noise has twice their number as variance.
            if gain - before - more > CLEAR * (2.0 * more).sqrt() {
                found = Common { values, terms };
            }
            before = gain;
        }
        Some(found)
    }

    /// The functions that fit best, if only the first `terms` are not zero, and by how much they lower the sum of squares.
    fn solved(&self, terms: usize) -> Option<([[f64; TERMS]; COUNT], f64)> {
        let most = self
            .squares
            .iter()
            .map(|pairs| pairs[0])
            .fold(0.0, f64::max);
        let mut matrix: Box<[[f64; UNKNOWNS]; UNKNOWNS]> =
            vec![[0.0; UNKNOWNS]; UNKNOWNS].try_into().ok()?;
        let mut right = [0.0; UNKNOWNS];
        let mut add = |(at, i): (usize, usize), (before, j): (usize, usize), sum: f64| {
            for (row, first) in knots(at, i, terms) {
                for (column, second) in knots(before, j, terms) {
                    matrix[row][column] += first * second * sum;
                }
            }
        };
        for at in 0..COUNT {
            for i in 0..terms {
                for j in 0..terms {
                    let pair = pair(i, j);
                    add((at, i), (at, j), self.squares[at][pair]);
                    if at > 0 {
                        let sum = self.products[at][pair];
                        add((at, i), (at - 1, j), sum);
                        add((at - 1, j), (at, i), sum);
                    }
                }
                for (row, share) in knots(at, i, terms) {
                    right[row] += share * self.right[at][i];
                }
            }
        }
        for (k, row) in matrix.iter_mut().enumerate() {
            row[k] += RIDGE * most;
        }
        let mut found = right;
        let positive = |pivot: f64| (pivot > 0.0 && pivot.is_finite()).then_some(pivot);
        cholesky(&mut matrix, &mut found, COUNT * terms, positive)?;
        let gain = found.iter().zip(right).map(|(a, b)| a * b).sum();
        let mut values = [[0.0; TERMS]; COUNT];
        for (at, values) in values.iter_mut().enumerate() {
            for (term, value) in values.iter_mut().enumerate() {
                let parts = knots(at, term, terms);
                *value = parts.map(|(row, share)| share * found[row]).sum();
            }
        }
        Some((values, gain))
    }
}

/// Place of a product of two terms among the `PAIRS`.
#[inline(always)]
fn pair(i: usize, j: usize) -> usize {
    let (low, high) = (i.min(j), i.max(j));
    high * (high + 1) / 2 + low
}

/// The unknowns on which the value of a term at a radius rests, with their shares: that at the radius, or for terms with
/// angles those at the multiples of `COARSE` before and after. At the centre there is no angle.
fn knots(at: usize, term: usize, terms: usize) -> impl Iterator<Item = (usize, f64)> {
    let step = if term == 0 { 1 } else { COARSE };
    let (before, after) = (at / step * step, at % step);
    let share = after as f64 / step as f64;
    let parts = [(before, 1.0 - share), (before + step, share)];
    parts.into_iter().filter_map(move |(knot, share)| {
        let free = term < terms && share > 0.0 && (term == 0 || knot > 0);
        free.then_some((knot * terms + term, share))
    })
}

impl CommonProfile {
    /// What stars of an S/N have in common.
    pub(super) fn of(&self, snr: f64) -> &Common {
        let above = self.ranges.partition_point(|(from, _)| *from <= snr);
        &self.ranges[above.saturating_sub(1)].1
    }
}

impl Common {
    /// Terms that are not zero.
    #[cfg(test)]
    pub(super) fn terms(&self) -> usize {
        self.terms
    }

    /// Largest difference to another one, in units of the largest value of that one.
    #[cfg(test)]
    pub(super) fn unlike(&self, other: &Self) -> f64 {
        let pairs = self
            .values
            .as_flattened()
            .iter()
            .zip(other.values.as_flattened());
        let most = |sum: f64, value: f64| sum.max(value.abs());
        let off = pairs.map(|(a, b)| a - b).fold(0.0, most);
        off / other.values.as_flattened().iter().copied().fold(0.0, most)
    }

    /// Adds it to a profile that was drawn.
    pub(super) fn add(&self, profile: &Moffat, mut star: ArrayViewMut2<'_, f64>) {
        let amplitude = profile.amplitude();
        let (square, [x0, y0]) = (profile.square(), profile.place());
        for (y, mut row) in star.rows_mut().into_iter().enumerate() {
            for (x, value) in row.iter_mut().enumerate() {
                let (x, y) = (x as f64, y as f64);
                let (at, far) = place(square(x, y).sqrt());
                let [near, next] = [self.values[at], self.values[at + 1]];
                let mut sum = near[0] + far * (next[0] - near[0]);
                if self.terms > 1 {
                    let terms = terms(x - x0, y - y0);
                    for k in 1..self.terms {
                        sum += terms[k] * (near[k] + far * (next[k] - near[k]));
                    }
                }
                *value += amplitude * sum;
            }
        }
    }
}

/// The last radius that is not beyond this one, but for the last of all, and the share of the next.
#[inline(always)]
fn place(radius: f64) -> (usize, f64) {
    let steps = FINE as f64 * radius;
    let at = (steps as usize).min(COUNT - 2);
    (at, (steps - at as f64).min(1.0))
}

/// One, and the cosines and sines of two and four times the angle of a place; those are zero at the centre.
#[inline(always)]
fn terms(dx: f64, dy: f64) -> [f64; TERMS] {
    let square = dx * dx + dy * dy;
    let share = if square > 0.0 { 1.0 / square } else { 0.0 };
    let (cos, sin) = (share * (dx * dx - dy * dy), share * 2.0 * dx * dy);
    [1.0, cos, sin, cos * cos - sin * sin, 2.0 * cos * sin]
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};

    use super::super::breadth;
    use super::*;

    const N: usize = 48;

    #[test]
    fn radii_have_the_means_of_what_profiles_leave() {
        let psf = FunctionalPsf::new(PsfProfile::Kolmogorov, 3.4, Shear::new(0.04, -0.03));
        let star = psf.unwrap().stamp(N);
        let area = breadth::area(star.view());
        let profile = Moffat::fit(star.view(), [23.5; 2], area, 1e-4).unwrap();
        // Any functions that are linear between the radii are found again.
        let wave = |term: usize, k: usize| match (term, k) {
            (1.., 0) => 0.0,
            _ => 0.01 * ((2 * term + 1) as f64 * k as f64 / 6.0).sin(),
        };
        let values = std::array::from_fn(|k| {
            std::array::from_fn(|term| {
                let (knot, after) = match term {
                    0 => (k, 0),
                    _ => (k / COARSE * COARSE, k % COARSE),
                };
                let [from, to] = [knot, knot + COARSE].map(|knot| wave(term, knot));
                from + (to - from) * after as f64 / COARSE as f64
            })
        });
        let common = Common {
            values,
            terms: TERMS,
        };
        let mut model = Array2::zeros((N, N));
        profile.draw(model.view_mut());
        let mut star = model.clone();
        common.add(&profile, star.view_mut());
        let sums = Sums::of(star.view(), model.view(), &profile, 1e-7);
        let found = sums.common(ENOUGH_TO_TURN).unwrap();
        let reach = profile.square()(0.0, 0.0).sqrt() * FINE as f64;
        let seen = (reach as usize).min(COUNT - 1);
        assert!(seen > 20, "{seen}");
        for (k, (found, value)) in found.values.iter().zip(&values).enumerate().take(seen) {
            for (term, (found, value)) in found.iter().zip(value).enumerate() {
                // Few pixels are nearer than √s = 2: their angles do not tell the terms apart.
                if term == 0 || k >= 4 {
                    // The relative addition to the equations, and radii with few pixels.
                    assert!((found - value).abs() < 1e-4, "{k} {term} {found} {value}");
                }
            }
        }
        assert_eq!(place(0.75), (1, 0.5));
        assert_eq!(place(17.75), (35, 0.5));
        assert_eq!(place(40.0), (35, 1.0));
    }

    #[test]
    fn terms_turn_with_twice_and_four_times_the_angle() {
        let angle = 0.3f64;
        let found = terms(5.0 * angle.cos(), 5.0 * angle.sin());
        let turned = |times: f64| [(times * angle).cos(), (times * angle).sin()];
        let expected = [[1.0].as_slice(), &turned(2.0), &turned(4.0)].concat();
        for (found, expected) in found.iter().zip(expected) {
            // Rounding.
            assert!((found - expected).abs() < 1e-14, "{found} {expected}");
        }
        assert_eq!(terms(0.0, 0.0), [1.0, 0.0, 0.0, 0.0, 0.0]);
    }
}
