//! The stars of an image and their mean residual profiles.

use std::sync::Arc;

use shearq_quantities::statistics::scatter;
use shearq_submissions::PsfCut;

use super::denoised_star::StarDenoiser;
use super::psfs::Psfs;
use super::residual_profile::{ResidualProfile, ResidualProfiles, ResidualSums};

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
mod tests {
    use ndarray::{Array2, Array3, Axis};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use shearq_quantities::{PsfProfile, Shear};

    use super::super::testing::{drawn, noisy, power};
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
