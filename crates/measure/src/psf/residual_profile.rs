//! The residual profile of the stars of an image.
//!
//! The fit of a noisy star relies on what is expected of stars in general, because noise hides the star's wings. The mean
//! residual over many stars shows how the stars of this image differ from that expectation. Its azimuthal mean is a
//! function of the profile's own radius √s, so that stars of any width and ellipticity share it. Azimuthal terms of order 2
//! and 4 on the pixels, such as diffraction spikes, are functions of the same radius. All are in units of the amplitude.

use ndarray::{ArrayView2, ArrayViewMut2};
use shearq_quantities::linear::cholesky;

use super::moffat::Moffat;

// Resolves the rings of an Airy disc; steps of 2 beyond √s = 4 did not.
const RADII_PER_UNIT: usize = 2;
// Up to √s = 18: 36 px for a FWHM of 3.4 px, beyond the corners of stamps of 48 px. Constant beyond.
const RADII: usize = 37;
// The azimuthal mean, and cosine and sine of two and four times the angle: a halo of another ellipticity, and spikes.
const TERMS: usize = 5;
// Azimuthal terms are free at every second radius, which halves their noise; halos and spikes need no more.
const AZIMUTHAL_STRIDE: usize = 2;
// One image in a thousand has such an excess by noise.
const AZIMUTHAL_SIGNIFICANCE: f64 = 3.0;
// With fewer, the 72 values of the azimuthal terms are as uncertain as for one star.
const MIN_STARS_AZIMUTHAL: usize = 100;
// For radii that no pixel has, which get zero; far below the rounding of others.
const RELATIVE_RIDGE: f64 = 1e-9;
const PAIRS: usize = TERMS * (TERMS + 1) / 2;
const UNKNOWNS: usize = RADII * TERMS;

#[derive(Debug, Clone, PartialEq)]
pub struct ResidualProfiles {
    /// For each range of S/N its lower end and the residual profile of its stars. The first also serves fainter stars.
    pub(super) ranges: Vec<(f64, ResidualProfile)>,
}

impl ResidualProfiles {
    pub(super) fn at_snr(&self, snr: f64) -> &ResidualProfile {
        let above = self.ranges.partition_point(|(from, _)| *from <= snr);
        &self.ranges[above.saturating_sub(1)].1
    }
}

/// Functions of the radius √s of a Moffat profile, in units of its amplitude, linear between the radii.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ResidualProfile {
    values: [[f64; TERMS]; RADII],
    terms: usize,
}

impl ResidualProfile {
    /// Adds it to a star that `profile` was drawn on.
    pub(super) fn add_to(&self, mut star: ArrayViewMut2<'_, f64>, profile: &Moffat) {
        let amplitude = profile.amplitude();
        let (square, [x0, y0]) = (profile.square(), profile.centre());
        for (y, mut row) in star.rows_mut().into_iter().enumerate() {
            for (x, value) in row.iter_mut().enumerate() {
                let (x, y) = (x as f64, y as f64);
                let (at, share) = interval(square(x, y).sqrt());
                let [inner, outer] = [self.values[at], self.values[at + 1]];
                let mut sum = inner[0] + share * (outer[0] - inner[0]);
                if self.terms > 1 {
                    let terms = azimuthal_terms(x - x0, y - y0);
                    for k in 1..self.terms {
                        sum += terms[k] * (inner[k] + share * (outer[k] - inner[k]));
                    }
                }
                *value += amplitude * sum;
            }
        }
    }
}

/// Sums of the normal equations for a residual profile. Only neighbouring radii have products.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ResidualSums {
    /// Mean square and sum of the residual over all pixels of a star, in units of the noise: they show outlier stars.
    pub(super) moments: [f64; 2],
    squares: [[f64; PAIRS]; RADII],
    /// Products with the terms at the previous radius, which are symmetric.
    products: [[f64; PAIRS]; RADII],
    right: [[f64; TERMS]; RADII],
}

impl Default for ResidualSums {
    fn default() -> Self {
        ResidualSums {
            moments: [0.0; 2],
            squares: [[0.0; PAIRS]; RADII],
            products: [[0.0; PAIRS]; RADII],
            right: [[0.0; TERMS]; RADII],
        }
    }
}

impl ResidualSums {
    /// Of a star with noise `sigma` and the profile that fits it, which is drawn in `model`.
    pub(super) fn from_star(
        star: ArrayView2<'_, f64>,
        model: ArrayView2<'_, f64>,
        profile: &Moffat,
        sigma: f64,
    ) -> Self {
        let mut sums = ResidualSums::default();
        let amplitude = profile.amplitude();
        // Stars of equal S/N count alike whatever their width and flux.
        let weight = (amplitude / sigma).powi(2);
        let (square, [x0, y0]) = (profile.square(), profile.centre());
        for (((y, x), value), model) in star.indexed_iter().zip(model) {
            let residual = (value - model) / amplitude;
            let (x, y) = (x as f64, y as f64);
            let (at, outer) = interval(square(x, y).sqrt());
            let (inner, terms) = (1.0 - outer, azimuthal_terms(x - x0, y - y0));
            let shares = [inner * inner, inner * outer, outer * outer].map(|share| weight * share);
            for i in 0..TERMS {
                for j in 0..=i {
                    let (pair, product) = (pair(i, j), terms[i] * terms[j]);
                    sums.squares[at][pair] += shares[0] * product;
                    sums.products[at + 1][pair] += shares[1] * product;
                    sums.squares[at + 1][pair] += shares[2] * product;
                }
                sums.right[at][i] += weight * inner * residual * terms[i];
                sums.right[at + 1][i] += weight * outer * residual * terms[i];
            }
            sums.moments[0] += weight * residual * residual;
            sums.moments[1] += residual * amplitude / sigma;
        }
        let pixels = star.len() as f64;
        sums.moments[0] /= pixels;
        sums.moments[1] /= pixels.sqrt();
        sums
    }

    pub(super) fn add(&mut self, other: &ResidualSums, weight: f64) {
        for (sums, more) in [
            (
                self.squares.as_flattened_mut(),
                other.squares.as_flattened(),
            ),
            (
                self.products.as_flattened_mut(),
                other.products.as_flattened(),
            ),
            (self.right.as_flattened_mut(), other.right.as_flattened()),
        ] {
            for (sum, more) in sums.iter_mut().zip(more) {
                *sum += weight * more;
            }
        }
    }

    /// The residual profile that fits `stars` stars best.
    ///
    /// The azimuthal mean is not shrunk for its noise: that is small compared with the noise of each star, and what is
    /// missing of the mean would bias all galaxies alike. Azimuthal terms are zero unless they are significant: their noise
    /// would be an ellipticity that all galaxies of the image share.
    pub(super) fn fit(&self, stars: usize) -> Option<ResidualProfile> {
        let (values, mut previous_gain) = self.solve(1)?;
        let mut found = ResidualProfile { values, terms: 1 };
        if stars < MIN_STARS_AZIMUTHAL {
            return Some(found);
        }
        let seen = self.squares.iter().skip(1).filter(|pairs| pairs[0] > 0.0);
        let freedom = (2 * seen.count() / AZIMUTHAL_STRIDE) as f64;
        for terms in [3, TERMS] {
            let (values, gain) = self.solve(terms)?;
            // The variance of a sum of n squares of noise is 2n.
            if gain - previous_gain - freedom > AZIMUTHAL_SIGNIFICANCE * (2.0 * freedom).sqrt() {
                found = ResidualProfile { values, terms };
            }
            previous_gain = gain;
        }
        Some(found)
    }

    /// The values that fit best if only the first `terms` are not zero, and by how much they lower χ².
    fn solve(&self, terms: usize) -> Option<([[f64; TERMS]; RADII], f64)> {
        let squares = self.squares.iter().map(|pairs| pairs[0]);
        let ridge = RELATIVE_RIDGE * squares.fold(0.0, f64::max);
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
        for at in 0..RADII {
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
            row[k] += ridge;
        }
        let mut solution = right;
        let positive = |pivot: f64| (pivot > 0.0 && pivot.is_finite()).then_some(pivot);
        cholesky(&mut matrix, &mut solution, RADII * terms, positive)?;
        let gain = solution.iter().zip(right).map(|(a, b)| a * b).sum();
        let values = std::array::from_fn(|at| {
            std::array::from_fn(|term| {
                let parts = knots(at, term, terms);
                parts.map(|(row, share)| share * solution[row]).sum()
            })
        });
        Some((values, gain))
    }
}

#[inline(always)]
fn pair(i: usize, j: usize) -> usize {
    let (low, high) = (i.min(j), i.max(j));
    high * (high + 1) / 2 + low
}

/// The unknowns from which the value of a term at a radius is interpolated, with their shares. At the centre there is no
/// angle, so that azimuthal terms are zero there.
fn knots(at: usize, term: usize, terms: usize) -> impl Iterator<Item = (usize, f64)> {
    let stride = if term == 0 { 1 } else { AZIMUTHAL_STRIDE };
    let (before, after) = (at / stride * stride, at % stride);
    let share = after as f64 / stride as f64;
    let parts = [(before, 1.0 - share), (before + stride, share)];
    parts.into_iter().filter_map(move |(knot, share)| {
        let is_free = term < terms && share > 0.0 && (term == 0 || knot > 0);
        is_free.then_some((knot * terms + term, share))
    })
}

/// The radius at or before √s, and the share of the next one in the interpolation.
#[inline(always)]
fn interval(radius: f64) -> (usize, f64) {
    let steps = RADII_PER_UNIT as f64 * radius;
    let at = (steps as usize).min(RADII - 2);
    (at, (steps - at as f64).min(1.0))
}

/// One, and cosine and sine of two and four times the position angle; zero at the centre.
#[inline(always)]
fn azimuthal_terms(dx: f64, dy: f64) -> [f64; TERMS] {
    let square = dx * dx + dy * dy;
    let share = if square > 0.0 { 1.0 / square } else { 0.0 };
    let (cos, sin) = (share * (dx * dx - dy * dy), share * 2.0 * dx * dy);
    [1.0, cos, sin, cos * cos - sin * sin, 2.0 * cos * sin]
}

#[cfg(test)]
impl ResidualProfile {
    pub(super) fn terms(&self) -> usize {
        self.terms
    }

    /// Largest difference to another one, in units of the largest value of that one.
    pub(super) fn difference(&self, other: &Self) -> f64 {
        let largest = |largest: f64, value: f64| largest.max(value.abs());
        let [own, other] = [self, other].map(|profile| profile.values.as_flattened());
        let difference = own.iter().zip(other).map(|(a, b)| a - b).fold(0.0, largest);
        difference / other.iter().copied().fold(0.0, largest)
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};

    use super::super::testing::drawn;
    use super::super::width::noise_equivalent_area;
    use super::*;

    const MOFFAT: PsfProfile = PsfProfile::Moffat { beta: 3.0 };
    const N: usize = 48;

    #[test]
    fn radii_have_the_mean_residual_of_profiles() {
        let psf = FunctionalPsf::new(PsfProfile::Kolmogorov, 3.4, Shear::new(0.04, -0.03));
        let star = psf.unwrap().stamp(N);
        let area = noise_equivalent_area(star.view());
        let profile = Moffat::fit(star.view(), [23.5; 2], area, 1e-4).unwrap();
        // Any functions that are linear between the radii are found again.
        let wave = |term: usize, k: usize| match (term, k) {
            (1.., 0) => 0.0,
            _ => 0.01 * ((2 * term + 1) as f64 * k as f64 / 6.0).sin(),
        };
        let values = std::array::from_fn(|k| {
            std::array::from_fn(|term| {
                let between = if term == 0 { 0 } else { k % 2 };
                0.5 * (wave(term, k - between) + wave(term, k + between))
            })
        });
        let residual = ResidualProfile {
            values,
            terms: TERMS,
        };
        let mut model = Array2::zeros((N, N));
        profile.draw(model.view_mut());
        let mut star = model.clone();
        residual.add_to(star.view_mut(), &profile);
        let sums = ResidualSums::from_star(star.view(), model.view(), &profile, 1e-7);
        let found = sums.fit(MIN_STARS_AZIMUTHAL).unwrap();
        let farthest = profile.square()(0.0, 0.0).sqrt() * RADII_PER_UNIT as f64;
        let seen = (farthest as usize).min(RADII - 1);
        assert!(seen > 20, "{seen}");
        for (k, (found, value)) in found.values.iter().zip(&values).enumerate().take(seen) {
            for (term, (found, value)) in found.iter().zip(value).enumerate() {
                // Few pixels are nearer than √s = 2: their angles do not separate the terms.
                if term == 0 || k >= 4 {
                    // The relative addition to the equations, and radii with few pixels.
                    assert!((found - value).abs() < 1e-4, "{k} {term} {found} {value}");
                }
            }
        }
        assert_eq!(interval(0.75), (1, 0.5));
        assert_eq!(interval(17.75), (35, 0.5));
        assert_eq!(interval(40.0), (35, 1.0));
    }

    #[test]
    fn azimuthal_terms_are_free_at_every_second_radius() {
        let all = (0..RADII).flat_map(|at| (1..TERMS).map(move |term| (at, term)));
        let mut free: Vec<usize> = all
            .flat_map(|(at, term)| knots(at, term, TERMS).map(|(unknown, _)| unknown))
            .collect();
        free.sort_unstable();
        free.dedup();
        // Eighteen radii beyond the centre, of two orders with cosine and sine.
        assert_eq!(free.len(), 72);
    }

    #[test]
    fn azimuthal_terms_of_three_standard_deviations_are_kept() {
        let star = drawn(MOFFAT, 3.4, Shear::ZERO, N);
        let area = noise_equivalent_area(star.view());
        let profile = Moffat::fit(star.view(), [23.5; 2], area, 1e-4).unwrap();
        let halo = Array2::from_shape_fn((N, N), |(y, x)| {
            let (x, y) = (x as f64 - 23.5, y as f64 - 23.5);
            star[(23, 23)] * 1e-3 * azimuthal_terms(x, y)[1] * (-(x * x + y * y) / 72.0).exp()
        });
        let sums = ResidualSums::from_star((&star + &halo).view(), star.view(), &profile, 1e-4);
        let gain = sums.solve(3).unwrap().1 - sums.solve(1).unwrap().1;
        // Both terms of order 2 at every second of the radii with pixels.
        let seen = sums.squares.iter().skip(1).filter(|pairs| pairs[0] > 0.0);
        let freedom = seen.count() as f64;
        let terms = |deviations: f64| {
            let mut scaled = ResidualSums::default();
            scaled.add(
                &sums,
                (freedom + deviations * (2.0 * freedom).sqrt()) / gain,
            );
            scaled.fit(MIN_STARS_AZIMUTHAL).unwrap().terms
        };
        assert_eq!([terms(2.5), terms(3.5)], [1, 3]);
    }

    #[test]
    fn azimuthal_terms_have_orders_two_and_four() {
        let angle = 0.3f64;
        let found = azimuthal_terms(5.0 * angle.cos(), 5.0 * angle.sin());
        let wave = |order: f64| [(order * angle).cos(), (order * angle).sin()];
        let expected = [[1.0].as_slice(), &wave(2.0), &wave(4.0)].concat();
        for (found, expected) in found.iter().zip(expected) {
            // Rounding.
            assert!((found - expected).abs() < 1e-14, "{found} {expected}");
        }
        assert_eq!(azimuthal_terms(0.0, 0.0), [1.0, 0.0, 0.0, 0.0, 0.0]);
    }
}
