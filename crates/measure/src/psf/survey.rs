//! A look at the stars of an image before its galaxies are measured.

use std::sync::Arc;

use shearq_submissions::PsfCut;

use super::common::{CommonProfile, Sums};
use super::shrink::Shrinker;
use crate::psfs::Psfs;

/// Fewest noisy stars that tell what they have in common. See docs/constants.md.
const FEWEST: usize = 30;

/// Looks at stars of an image, one per galaxy: buffers for one thread.
#[derive(Debug)]
pub struct StarLooker {
    cut: PsfCut,
    full: usize,
    shrinker: Shrinker,
}

/// What one star shows: nothing if it has no noise or cannot be used.
#[derive(Debug)]
pub struct StarLook(Option<Sums>);

impl StarLooker {
    /// For stars of which `cut` is used, and galaxies on stamps of `full` pixels a side.
    pub(crate) fn new(cut: PsfCut, full: usize) -> Self {
        StarLooker {
            cut,
            full,
            shrinker: Shrinker::default(),
        }
    }

    /// Looks at the star of galaxy `k`. Formulas and PSFs for all galaxies show nothing.
    pub fn look(&mut self, psfs: &Psfs<'_>, k: usize) -> StarLook {
        if !matches!(psfs, Psfs::Stars(_)) {
            return StarLook(None);
        }
        let star = psfs.at(k, self.cut, self.full).ok();
        StarLook(star.and_then(|star| self.shrinker.left(star.psf.view())))
    }
}

/// What stars of an image show together, before galaxies are measured.
#[derive(Debug, Default)]
pub struct StarSurvey {
    looked_at: usize,
    noisy: usize,
    sums: Sums,
}

impl StarSurvey {
    /// Adds a star. Results depend on the order, but not on the threads that looked at the stars.
    pub fn add(&mut self, StarLook(sums): &StarLook) {
        self.looked_at += 1;
        if let Some(sums) = sums {
            self.noisy += 1;
            self.sums.add(sums);
        }
    }

    /// Whether no more stars are of use: the first ones have no noise, and stars of an image all have noise or none has.
    pub fn is_over(&self) -> bool {
        self.looked_at >= FEWEST && self.noisy == 0
    }

    /// What the stars have in common; `None` if too few of them have noise.
    pub fn common(&self) -> Option<Arc<CommonProfile>> {
        (self.noisy >= FEWEST)
            .then(|| self.sums.common().map(Arc::new))
            .flatten()
    }
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, Array3, Axis};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use shearq_quantities::{PsfProfile, Shear};

    use super::super::test_stars::{drawn, noisy, power};
    use super::*;

    const N: usize = 48;
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

    fn survey(stars: &Array3<f64>) -> StarSurvey {
        let (mut looker, mut survey) = (StarLooker::new(CUT, N), StarSurvey::default());
        let psfs = Psfs::stars(stars.view());
        (0..stars.len_of(Axis(0))).for_each(|k| survey.add(&looker.look(&psfs, k)));
        survey
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
                let wave = [0.5, 0.0];
                let pairs = noisy.outer_iter().zip(&true_ones);
                let ratios = pairs.map(|(star, psf)| {
                    power(shrinker.shrunk(star), wave) / power(psf.view(), wave) - 1.0
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
        // A PSF for all.
        let mut looker = StarLooker::new(CUT, N);
        let StarLook(none) = looker.look(&Psfs::star(noisy.index_axis(Axis(0), 0)), 0);
        assert!(none.is_none());
    }
}
