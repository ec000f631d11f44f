//! What the noisy stars of an image have in common beyond the profiles that fit them.
//!
//! The profile of a noisy star rests on what is expected of stars in general: noise hides its wings. What the fits leave tells, in
//! the mean over many stars, how the stars of this image differ from that expectation. It is a function of the profile's own
//! radius √s in units of its amplitude, so that stars of any width and ellipticity can share it.

use std::sync::Arc;

use ndarray::{ArrayView2, ArrayViewMut2};
use shearq_quantities::linear::cholesky;
use shearq_submissions::PsfCut;

use super::moffat::Moffat;
use super::shrink::{Shrinker, stein};
use crate::psfs::Psfs;

/// Steps per unit of √s between radii, between which the function is linear. See docs/constants.md.
const FINE: usize = 2;
/// Number of these radii; beyond the last one it is constant. See docs/constants.md.
const COUNT: usize = 18 * FINE + 1;
/// Fewest noisy stars that tell what they have in common. See docs/constants.md.
const FEWEST: usize = 30;
/// Relative addition to the diagonal of the normal equations, for radii that no pixel has. See docs/constants.md.
const RIDGE: f64 = 1e-9;

/// What the noisy stars of an image have in common: [`StarSurvey::common`].
#[derive(Debug, Clone, PartialEq)]
pub struct CommonProfile {
    /// Values at the radii.
    values: [f64; COUNT],
}

/// Looks at stars of an image, one per galaxy, before galaxies are measured.
#[derive(Debug)]
pub struct StarSurvey {
    cut: PsfCut,
    full: usize,
    shrinker: Shrinker,
    looked_at: usize,
    sums: Sums,
}

impl StarSurvey {
    /// For stars of which `cut` is used, and galaxies on stamps of `full` pixels a side.
    pub(crate) fn new(cut: PsfCut, full: usize) -> Self {
        StarSurvey {
            cut,
            full,
            shrinker: Shrinker::default(),
            looked_at: 0,
            sums: Sums::new(),
        }
    }

    /// Looks at the star of galaxy `k`. Stars without noise and stars that cannot be used are left out, as are formulas and PSFs
    /// for all galaxies.
    pub fn add(&mut self, psfs: &Psfs<'_>, k: usize) {
        if !matches!(psfs, Psfs::Stars(_)) {
            return;
        }
        self.looked_at += 1;
        if let Ok(star) = psfs.at(k, self.cut, self.full) {
            self.shrinker.survey(star.psf.view(), &mut self.sums);
        }
    }

    /// Whether no more stars are of use: the first ones have no noise, and stars of an image all have noise or none has.
    pub fn is_over(&self) -> bool {
        self.looked_at >= FEWEST && self.sums.stars == 0
    }

    /// What the stars have in common; `None` if too few of them have noise.
    pub fn common(&self) -> Option<Arc<CommonProfile>> {
        (self.sums.stars >= FEWEST)
            .then(|| self.sums.common().map(Arc::new))
            .flatten()
    }
}

/// Sums over stars of the normal equations for the values at the radii. Only radii next to each other have products.
#[derive(Debug, Clone)]
pub(super) struct Sums {
    stars: usize,
    squares: [f64; COUNT],
    /// Products with the radius before.
    products: [f64; COUNT],
    right: [f64; COUNT],
}

impl Sums {
    fn new() -> Self {
        Sums {
            stars: 0,
            squares: [0.0; COUNT],
            products: [0.0; COUNT],
            right: [0.0; COUNT],
        }
    }

    /// Adds a star with noise `sigma`, and the profile that fits it, which is drawn in `model`.
    pub(super) fn add(
        &mut self,
        star: ArrayView2<'_, f64>,
        model: ArrayView2<'_, f64>,
        profile: &Moffat,
        sigma: f64,
    ) {
        let amplitude = profile.amplitude();
        let weight = (amplitude / sigma).powi(2);
        let square = profile.square();
        for (((y, x), value), model) in star.indexed_iter().zip(model) {
            let left = (value - model) / amplitude;
            let (at, far) = place(square(x as f64, y as f64).sqrt());
            let near = 1.0 - far;
            self.squares[at] += weight * near * near;
            self.squares[at + 1] += weight * far * far;
            self.products[at + 1] += weight * near * far;
            self.right[at] += weight * near * left;
            self.right[at + 1] += weight * far * left;
        }
        self.stars += 1;
    }

    /// The function that fits best, less what noise adds to it (Stein).
    fn common(&self) -> Option<CommonProfile> {
        let most = self.squares.iter().copied().fold(0.0, f64::max);
        let mut matrix = [[0.0; COUNT]; COUNT];
        for (k, row) in matrix.iter_mut().enumerate() {
            row[k] = self.squares[k] + RIDGE * most;
            if k > 0 {
                row[k - 1] = self.products[k];
            }
        }
        let mut values = self.right;
        let positive = |pivot: f64| (pivot > 0.0 && pivot.is_finite()).then_some(pivot);
        cholesky(&mut matrix, &mut values, COUNT, positive)?;
        let square: f64 = values.iter().zip(self.right).map(|(a, b)| a * b).sum();
        let factor = stein(square, COUNT as f64, 1.0);
        Some(CommonProfile {
            values: values.map(|value| factor * value),
        })
    }
}

impl CommonProfile {
    /// Adds it to a profile that was drawn.
    pub(super) fn add(&self, profile: &Moffat, mut star: ArrayViewMut2<'_, f64>) {
        let (amplitude, square) = (profile.amplitude(), profile.square());
        for (y, mut row) in star.rows_mut().into_iter().enumerate() {
            for (x, value) in row.iter_mut().enumerate() {
                let (at, share) = place(square(x as f64, y as f64).sqrt());
                let [near, far] = [self.values[at], self.values[at + 1]];
                *value += amplitude * (near + share * (far - near));
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

#[cfg(test)]
mod tests {
    use ndarray::{Array2, Array3, Axis};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};
    use shearq_quantities::{FunctionalPsf, PsfProfile, Shear};

    use super::super::breadth;
    use super::*;

    const N: usize = 48;

    fn drawn(profile: PsfProfile, fwhm: f64, e1: f64) -> Array2<f64> {
        let psf = FunctionalPsf::new(profile, fwhm, Shear::new(e1, -0.03));
        let stamp = psf.unwrap().stamp(N);
        let sum = stamp.sum();
        stamp / sum
    }

    /// Stars of different widths and ellipticities with an S/N, and the same without noise.
    fn stars(profile: PsfProfile, snr: f64, count: usize) -> (Array3<f64>, Vec<Array2<f64>>) {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let true_ones: Vec<_> = (0..count)
            .map(|k| drawn(profile, 2.8 + 0.25 * (k % 5) as f64, 0.04 * (k % 3) as f64))
            .collect();
        let mut stars = Array3::zeros((count, N, N));
        for (psf, mut star) in true_ones.iter().zip(stars.outer_iter_mut()) {
            let sigma = psf.iter().map(|v| v * v).sum::<f64>().sqrt() / snr;
            star.assign(psf);
            star.mapv_inplace(|value| {
                let noise: f64 = StandardNormal.sample(&mut rng);
                value + sigma * noise
            });
        }
        (stars, true_ones)
    }

    fn survey(stars: &Array3<f64>) -> StarSurvey {
        let cut = PsfCut {
            size: N,
            least: 32,
            centred: false,
        };
        let mut survey = StarSurvey::new(cut, N);
        let psfs = Psfs::stars(stars.view());
        (0..stars.len_of(Axis(0))).for_each(|k| survey.add(&psfs, k));
        survey
    }

    /// Power at a wave of 0.5 along x, in units of the square of the light.
    fn power(psf: ArrayView2<'_, f64>) -> f64 {
        let (mut re, mut im) = (0.0, 0.0);
        for ((_, x), value) in psf.indexed_iter() {
            let (sin, cos) = (0.5 * x as f64).sin_cos();
            re += value * cos;
            im += value * sin;
        }
        (re * re + im * im) / psf.sum().powi(2)
    }

    #[test]
    fn stars_share_the_wings_that_noise_hides() {
        for (profile, without) in [
            (PsfProfile::Kolmogorov, 0.03..0.06),
            (PsfProfile::Moffat { beta: 3.0 }, -0.02..0.01),
        ] {
            let (noisy, true_ones) = stars(profile, 100.0, 300);
            let common = survey(&noisy).common();
            // Mean of what is left of the power, by its true value.
            let mean = |common: Option<&Arc<CommonProfile>>| {
                let mut shrinker = Shrinker::default();
                shrinker.set_common(common);
                let pairs = noisy.outer_iter().zip(&true_ones);
                let ratios = pairs.map(|(star, psf)| {
                    let sum = star.sum();
                    let star = &star / sum;
                    power(shrinker.shrunk(star.view())) / power(psf.view()) - 1.0
                });
                ratios.sum::<f64>() / true_ones.len() as f64
            };
            let (plain, shared) = (mean(None), mean(common.as_ref()));
            assert!(without.contains(&plain), "{profile:?} {plain}");
            // Powers of single stars scatter by 4/(S/N); this is four errors of their mean.
            assert!(shared.abs() < 0.01, "{profile:?} {shared}");
        }
    }

    #[test]
    fn radii_have_the_means_of_what_profiles_leave() {
        let (noisy, _) = stars(PsfProfile::Kolmogorov, 100.0, 1);
        let star = noisy.index_axis(Axis(0), 0);
        let area = breadth::area(star);
        let profile = Moffat::fit(star, [23.5; 2], area, 1e-4).unwrap();
        // Any function that is linear between the radii is found again.
        let values = std::array::from_fn(|k| 0.01 * (k as f64).sin());
        let common = CommonProfile { values };
        let (mut model, mut sums) = (Array2::zeros((N, N)), Sums::new());
        profile.draw(model.view_mut());
        let mut star = model.clone();
        common.add(&profile, star.view_mut());
        sums.add(star.view(), model.view(), &profile, 1e-7);
        let found = sums.common().unwrap();
        let reach = profile.square()(0.0, 0.0).sqrt() * FINE as f64;
        let seen = (reach as usize).min(COUNT - 1);
        assert!(seen > 20, "{seen}");
        for (k, (found, value)) in found.values.iter().zip(&values).enumerate().take(seen) {
            // The relative addition to the equations, and radii with few pixels.
            assert!((found - value).abs() < 1e-5, "{k} {found} {value}");
        }
        assert_eq!(place(0.75), (1, 0.5));
        assert_eq!(place(17.75), (35, 0.5));
        assert_eq!(place(40.0), (35, 1.0));
    }

    #[test]
    fn few_stars_and_stars_without_noise_share_nothing() {
        let (noisy, true_ones) = stars(PsfProfile::Kolmogorov, 100.0, FEWEST);
        let some = |count: usize| noisy.slice(ndarray::s![..count, .., ..]).to_owned();
        assert_eq!(survey(&some(FEWEST - 1)).common(), None);
        assert!(survey(&some(FEWEST)).common().is_some());
        let mut clean = some(FEWEST);
        for (psf, mut star) in true_ones.iter().zip(clean.outer_iter_mut()) {
            star.assign(psf);
        }
        let clean = survey(&clean);
        assert!(clean.is_over() && clean.common().is_none());
        assert!(!survey(&some(FEWEST)).is_over());
        // A PSF for all, and formulas.
        let mut none = survey(&some(0));
        none.add(&Psfs::star(noisy.index_axis(Axis(0), 0)), 0);
        assert!(!none.is_over() && none.looked_at == 0);
    }
}
