//! The survey of the noisy stars of an image, and their mean residual profile beyond the Moffat profiles that fit them.
//!
//! The fit of a noisy star relies on what is expected of stars in general, because noise hides the star's wings. The mean
//! residual over many stars shows how the stars of this image differ from that expectation. Its azimuthal mean is a
//! function of the profile's own radius √s, so that stars of any width and ellipticity share it. Azimuthal terms of order 2
//! and 4 on the pixels, such as diffraction spikes, are functions of the same radius. All are in units of the amplitude.

use std::sync::Arc;

use ndarray::{ArrayView2, ArrayViewMut2};
use shearq_quantities::linear::cholesky;
use shearq_quantities::statistics::scatter;
use shearq_submissions::PsfCut;

use super::Psfs;
use super::denoised_star::{Moffat, StarDenoiser};

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

// 12 stars of S/N 50 per image: m1, m2 = +1.6, +2.0 ± 0.2 (10⁻³); they are −7 without a residual profile.
const MIN_STARS: usize = 10;
// Measuring 1,000 stars without noise takes a quarter of the time of an image of 3,600 galaxies.
const MAX_NOISELESS_STARS: usize = 100;
// Fainter fits are of noise. Chosen by hand.
const MIN_SNR: f64 = 5.0;
// Obscured Airy discs of S/N 30 to 300 in one image: m = −0.02 if all share one residual profile.
const SNR_RATIO: f64 = 2.0;
// At most one of 1,000 good stars is rejected by chance. Stars with a neighbour or a background are beyond it.
const OUTLIER_SIGNIFICANCE: f64 = 5.0;

/// The stars of an image, one per galaxy, and buffers to measure them. Threads measure parts of the stars in surveys of
/// their own, which are joined in the order of the stars.
#[derive(Debug)]
pub struct StarSurvey {
    cut: PsfCut,
    full: usize,
    denoiser: StarDenoiser,
    surveyed: usize,
    /// S/N and residual of each noisy star, with its number.
    noisy: Vec<(usize, f64, ResidualSums)>,
}

impl StarSurvey {
    /// Of stars that `cut` cuts, for galaxies on stamps of `full` pixels a side.
    pub(crate) fn new(cut: PsfCut, full: usize) -> Self {
        StarSurvey {
            cut,
            full,
            denoiser: StarDenoiser::default(),
            surveyed: 0,
            noisy: Vec::new(),
        }
    }

    /// Measures the star of galaxy `k`. Stars that cannot be used, and formulas, have no noise.
    pub fn add(&mut self, psfs: &Psfs<'_>, k: usize) {
        let star = psfs.at(k, self.cut, self.full).ok();
        let found = star.and_then(|star| self.denoiser.residual(star.psf.view()));
        self.push(found);
    }

    fn push(&mut self, found: Option<(f64, ResidualSums)>) {
        let found = found.filter(|(snr, _)| *snr >= MIN_SNR);
        let number = self.surveyed;
        self.noisy
            .extend(found.map(|(snr, sums)| (number, snr, sums)));
        self.surveyed += 1;
    }

    /// Adds the stars of a later part, up to the star after which no more are needed: the result does not depend on how
    /// threads divide the stars.
    pub fn join(&mut self, part: StarSurvey) {
        let mut noisy = part.noisy.into_iter().peekable();
        for number in 0..part.surveyed {
            if self.is_over() {
                return;
            }
            let found = noisy.next_if(|(at, ..)| *at == number);
            self.push(found.map(|(_, snr, sums)| (snr, sums)));
        }
    }

    pub fn is_over(&self) -> bool {
        self.surveyed >= MAX_NOISELESS_STARS && self.noisy.is_empty()
    }

    /// The mean residual profiles of the stars; `None` if too few of them have noise.
    pub fn residual_profiles(self) -> Option<Arc<ResidualProfiles>> {
        let mut noisy: Vec<_> = self
            .noisy
            .into_iter()
            .map(|(_, snr, sums)| (snr, sums))
            .collect();
        // A stable sort, so that stars of equal S/N stay in their order.
        noisy.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        // Copies of a star have their noise in common.
        noisy.dedup_by(|a, b| a == b);
        let (mut ranges, mut rest) = (Vec::new(), noisy.as_slice());
        while rest.len() >= MIN_STARS {
            let lowest = rest[0].0;
            let within = rest.partition_point(|(snr, _)| *snr <= SNR_RATIO * lowest);
            let mut count = within.max(MIN_STARS);
            if rest.len() - count < MIN_STARS {
                count = rest.len();
            }
            ranges.push((lowest, mean_residual(&rest[..count])?));
            rest = &rest[count..];
        }
        (!ranges.is_empty()).then(|| Arc::new(ResidualProfiles { ranges }))
    }
}

/// The mean residual of stars in the order of their S/N, without outlier stars.
fn mean_residual(stars: &[(f64, ResidualSums)]) -> Option<ResidualProfile> {
    let is_typical = |moment: usize| {
        let mut moments: Vec<f64> = stars.iter().map(|(_, sums)| sums.moments[moment]).collect();
        let (median, scatter) = scatter(&mut moments)?;
        Some(move |sums: &ResidualSums| {
            (sums.moments[moment] - median).abs() <= OUTLIER_SIGNIFICANCE * scatter
        })
    };
    // The mean square shows neighbours and bad pixels, the sum a background far below the noise of a pixel.
    let (in_square, in_sum) = (is_typical(0)?, is_typical(1)?);
    let highest = SNR_RATIO * stars[0].0;
    let mut all = ResidualSums::default();
    for (snr, sums) in stars {
        if in_square(sums) && in_sum(sums) {
            // The few stars beyond the range would outweigh the others.
            all.add(sums, (highest / snr).powi(2).min(1.0));
        }
    }
    all.fit(stars.len())
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
    use ndarray::{Array2, Array3, Axis};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};

    use super::super::test_stars::{drawn, noisy, power};
    use super::*;

    const N: usize = 48;

    #[test]
    fn radii_have_the_mean_residual_of_profiles() {
        let psf = FunctionalPsf::new(PsfProfile::Kolmogorov, 3.4, Shear::new(0.04, -0.03));
        let star = psf.unwrap().stamp(N);
        let area = super::super::noise_equivalent_area(star.view());
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
                    _ => (
                        k / AZIMUTHAL_STRIDE * AZIMUTHAL_STRIDE,
                        k % AZIMUTHAL_STRIDE,
                    ),
                };
                let [from, to] = [knot, knot + AZIMUTHAL_STRIDE].map(|knot| wave(term, knot));
                from + (to - from) * after as f64 / AZIMUTHAL_STRIDE as f64
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

    const CUT: PsfCut = PsfCut {
        size: N,
        least: 32,
        centred: false,
    };

    /// Stars of different widths and ellipticities with an S/N, and the same without noise.
    fn stars(profile: PsfProfile, snr: f64, count: usize) -> (Array3<f64>, Vec<Array2<f64>>) {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let true_ones: Vec<_> = (0..count)
            .map(|k| {
                let shear = Shear::new(0.04 * (k % 3) as f64, -0.03);
                drawn(profile, 2.8 + 0.25 * (k % 5) as f64, shear, N)
            })
            .collect();
        let mut stars = Array3::zeros((count, N, N));
        for (psf, mut star) in true_ones.iter().zip(stars.outer_iter_mut()) {
            star.assign(&noisy(psf, snr, &mut rng));
        }
        (stars, true_ones)
    }

    fn profiles(stars: &Array3<f64>) -> Option<Arc<ResidualProfiles>> {
        survey(stars).residual_profiles()
    }

    fn survey(stars: &Array3<f64>) -> StarSurvey {
        let (mut survey, psfs) = (StarSurvey::new(CUT, N), Psfs::stars(stars.view()));
        (0..stars.len_of(Axis(0))).for_each(|k| survey.add(&psfs, k));
        survey
    }

    #[test]
    fn residual_profiles_restore_wings_that_noise_hides() {
        for (profile, without) in [
            (PsfProfile::Kolmogorov, 0.03..0.06),
            (PsfProfile::Moffat { beta: 3.0 }, -0.02..0.01),
        ] {
            let (noisy, true_ones) = stars(profile, 100.0, 300);
            let found = profiles(&noisy);
            // Mean of the relative error of the power.
            let mean = |profiles: Option<&Arc<ResidualProfiles>>| {
                let mut denoiser = StarDenoiser::default();
                denoiser.set_residual_profiles(profiles);
                let wave = [0.5, 0.0];
                let pairs = noisy.outer_iter().zip(&true_ones);
                let ratios = pairs.map(|(star, psf)| {
                    power(denoiser.denoised(star), wave) / power(psf.view(), wave) - 1.0
                });
                ratios.sum::<f64>() / true_ones.len() as f64
            };
            let (plain, shared) = (mean(None), mean(found.as_ref()));
            assert!(without.contains(&plain), "{profile:?} {plain}");
            // Powers of single stars scatter by 4/(S/N); this is four errors of their mean.
            assert!(shared.abs() < 0.01, "{profile:?} {shared}");
        }
    }

    #[test]
    fn outlier_stars_are_rejected() {
        let (noisy, _) = stars(PsfProfile::Kolmogorov, 100.0, 40);
        let without = profiles(&noisy.slice(ndarray::s![..39, .., ..]).to_owned());
        let [mut hot, mut level] = [&noisy, &noisy].map(Clone::clone);
        hot[(39, 20, 30)] += 0.5;
        // A background of half the noise, which changes the square by a fraction of the noise's own.
        let one = noisy.index_axis(Axis(0), 39);
        let background = 0.005 * one.iter().map(|v| v * v).sum::<f64>().sqrt();
        level
            .index_axis_mut(Axis(0), 39)
            .map_inplace(|value| *value += background);
        // Stripes of twice the noise change the square and not the sum.
        let mut stripes = noisy.clone();
        let mut last = stripes.index_axis_mut(Axis(0), 39);
        for ((y, x), value) in last.indexed_iter_mut() {
            let far = y.abs_diff(24).max(x.abs_diff(24));
            if (14..20).contains(&far) {
                *value += if x % 2 == 0 { 4.0 } else { -4.0 } * background;
            }
        }
        for (name, stars) in [("hot", hot), ("level", level), ("stripes", stripes)] {
            let with = survey(&stars);
            assert_eq!(with.noisy.len(), 40, "{name}");
            assert_eq!(with.residual_profiles(), without, "{name}");
        }
    }

    #[test]
    fn copies_of_a_star_count_once() {
        let (noisy, _) = stars(PsfProfile::Kolmogorov, 100.0, 20);
        let twice = ndarray::concatenate![Axis(0), noisy, noisy];
        assert_eq!(profiles(&twice), profiles(&noisy));
        let one = noisy.slice(ndarray::s![..1, .., ..]);
        let copies = ndarray::concatenate(Axis(0), &[one; 40]).unwrap();
        assert_eq!(profiles(&copies), None);
    }

    #[test]
    fn significant_azimuthal_terms_of_many_stars_are_kept() {
        // Terms of stars with light that varies with the angle, in units of the peak.
        let terms = |times: f64, count: usize| {
            let (mut noisy, _) = stars(PsfProfile::Moffat { beta: 3.0 }, 100.0, count);
            for mut star in noisy.outer_iter_mut() {
                let peak = star.iter().copied().fold(0.0, f64::max);
                for ((y, x), value) in star.indexed_iter_mut() {
                    let (dx, dy) = (x as f64 - 23.5, y as f64 - 23.5);
                    let fall = (-(dx * dx + dy * dy) / 72.0).exp();
                    *value += 0.01 * peak * fall * (times * dy.atan2(dx)).cos();
                }
            }
            profiles(&noisy).unwrap().at_snr(100.0).terms()
        };
        assert_eq!([terms(2.0, 120), terms(4.0, 120)], [3, 5]);
        // Too few stars, and three times the angle, which is no term.
        assert_eq!([terms(4.0, 99), terms(3.0, 120)], [1, 1]);
    }

    #[test]
    fn stars_share_the_residual_of_their_signal_to_noise() {
        let (faint, _) = stars(PsfProfile::Kolmogorov, 50.0, 30);
        let (bright, _) = stars(PsfProfile::Kolmogorov, 300.0, 30);
        let both = Array3::from_shape_fn((60, N, N), |(k, y, x)| {
            let stars = [&faint, &bright][k % 2];
            stars[(k / 2, y, x)]
        });
        let [faint, bright_ones] = [&faint, &bright].map(profiles);
        let both = profiles(&both).unwrap();
        let [(low, first), (high, second)] = &both.ranges[..] else {
            panic!("{} ranges", both.ranges.len());
        };
        // The faintest of thirty of different widths.
        assert!(
            (30.0..50.0).contains(low) && (230.0..300.0).contains(high),
            "{low} {high}"
        );
        assert_eq!(first, &faint.unwrap().ranges[0].1);
        assert_eq!(second, &bright_ones.unwrap().ranges[0].1);
        for (snr, function) in [
            (20.0, first),
            (60.0, first),
            (200.0, first),
            (400.0, second),
        ] {
            assert_eq!(both.at_snr(snr), function, "{snr}");
        }
        assert_ne!(first, second);
        // A bright star gets the function of bright ones.
        let star = bright.index_axis(Axis(0), 0);
        let denoised = |profiles: ResidualProfiles| {
            let mut denoiser = StarDenoiser::default();
            denoiser.set_residual_profiles(Some(&Arc::new(profiles)));
            denoiser.denoised(star).to_owned()
        };
        let ranges = vec![both.ranges[1].clone()];
        assert_eq!(
            denoised((*both).clone()),
            denoised(ResidualProfiles { ranges })
        );
    }

    #[test]
    fn a_few_bright_stars_do_not_outweigh_the_others() {
        let (noisy, _) = stars(PsfProfile::Kolmogorov, 50.0, 40);
        let (bright, _) = stars(PsfProfile::Moffat { beta: 3.0 }, 400.0, 3);
        let with = ndarray::concatenate![Axis(0), noisy, bright];
        let (with, without) = (profiles(&with), profiles(&noisy));
        let [with, without] = [with.unwrap(), without.unwrap()];
        assert_eq!(with.ranges.len(), 1);
        // Three of S/N 90 next to forty of 50. Without a limit the bright ones would have 83 % of the weight.
        let share = with.at_snr(50.0).difference(without.at_snr(50.0));
        assert!(share > 0.0 && share < 0.4, "{share}");
    }

    #[test]
    fn few_or_noiseless_stars_have_no_residual_profile() {
        let (noisy, true_ones) = stars(PsfProfile::Kolmogorov, 100.0, MIN_STARS);
        let some = |count: usize| noisy.slice(ndarray::s![..count, .., ..]).to_owned();
        assert_eq!(profiles(&some(MIN_STARS - 1)), None);
        assert!(profiles(&some(MIN_STARS)).is_some());
        let mut clean = some(MIN_STARS);
        for (psf, mut star) in true_ones.iter().zip(clean.outer_iter_mut()) {
            star.assign(psf);
        }
        let clean = survey(&clean);
        assert!(clean.noisy.is_empty() && clean.residual_profiles().is_none());
        let (faint, _) = stars(PsfProfile::Kolmogorov, 4.0, 30);
        assert!(
            survey(&faint)
                .noisy
                .iter()
                .all(|(_, snr, _)| *snr >= MIN_SNR)
        );
    }

    #[test]
    fn a_survey_ends_after_noiseless_stars_however_it_is_divided() {
        let star = |snr: f64| Some((snr, ResidualSums::default()));
        let mut stars = vec![None; MAX_NOISELESS_STARS];
        stars.push(star(50.0));
        // A noisy star among the first ones, and after them.
        let mut early = stars.clone();
        early[MAX_NOISELESS_STARS - 1] = star(40.0);
        for (stars, expected) in [(stars, 0), (early, 2)] {
            for size in [1, 7, 60, 200] {
                let mut survey = StarSurvey::new(CUT, N);
                for part in stars.chunks(size) {
                    let mut own = StarSurvey::new(CUT, N);
                    part.iter().for_each(|found| own.push(found.clone()));
                    survey.join(own);
                }
                assert_eq!(survey.noisy.len(), expected, "{size}");
                assert_eq!(survey.is_over(), expected == 0, "{size}");
            }
        }
    }
}
