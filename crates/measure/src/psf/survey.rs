//! A look at the stars of an image before its galaxies are measured.

use std::sync::Arc;

use shearq_submissions::PsfCut;

use super::common::{CommonProfile, Sums};
use super::shrink::Shrinker;
use crate::psfs::Psfs;

/// Fewest noisy stars that tell what they have in common. See docs/constants.md.
const FEWEST: usize = 30;

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
    /// for all galaxies. Costs nothing once the survey is over.
    pub fn add(&mut self, psfs: &Psfs<'_>, k: usize) {
        if !matches!(psfs, Psfs::Stars(_)) || self.is_over() {
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

#[cfg(test)]
mod tests {
    use ndarray::{Array2, Array3, Axis};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use shearq_quantities::{PsfProfile, Shear};

    use super::super::test_stars::{drawn, noisy, power};
    use super::*;

    const N: usize = 48;

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
        // A PSF for all, and formulas.
        let mut none = survey(&some(0));
        none.add(&Psfs::star(noisy.index_axis(Axis(0), 0)), 0);
        assert!(!none.is_over() && none.looked_at == 0);
    }
}
