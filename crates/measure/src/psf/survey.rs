//! A look at the stars of an image before its galaxies are measured.

use std::sync::Arc;

use shearq_quantities::statistics::scatter;
use shearq_submissions::PsfCut;

use super::common::{Common, CommonProfile, Sums};
use super::shrink::Shrinker;
use crate::psfs::Psfs;

/// Fewest noisy stars that tell what they have in common. See docs/constants.md.
const FEWEST: usize = 10;
/// Stars without noise in the beginning after which no more are looked at. See docs/constants.md.
const WITHOUT_NOISE: usize = 100;
/// Least S/N of stars that show something. See docs/constants.md.
const LEAST_SNR: f64 = 5.0;
/// Stars share a function up to so many times the S/N of the faintest. See docs/constants.md.
const RANGE: f64 = 2.0;
/// Standard deviations by which what is left of a star may differ from others. See docs/constants.md.
const OUTSIDE: f64 = 5.0;

/// Looks at stars of an image, one per galaxy: buffers for one thread.
#[derive(Debug)]
pub struct StarLooker {
    cut: PsfCut,
    full: usize,
    shrinker: Shrinker,
}

/// What one star shows: nothing if it has no noise or cannot be used.
#[derive(Debug)]
pub struct StarLook(Option<(f64, Sums)>);

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
#[derive(Debug, Default, Clone)]
pub struct StarSurvey {
    looked_at: usize,
    /// S/N of each noisy star, and what is left of it.
    noisy: Vec<(f64, Sums)>,
}

impl StarSurvey {
    /// Adds a star. Results depend on the order, but not on the threads that looked at the stars.
    pub fn add(&mut self, StarLook(left): StarLook) {
        self.looked_at += 1;
        self.noisy.extend(left.filter(|(snr, _)| *snr >= LEAST_SNR));
    }

    /// Whether no more stars are of use, because the first ones have no noise.
    pub fn is_over(&self) -> bool {
        self.looked_at >= WITHOUT_NOISE && self.noisy.is_empty()
    }

    /// What the stars have in common; `None` if too few of them have noise.
    pub fn common(mut self) -> Option<Arc<CommonProfile>> {
        // Equal S/N stay in their order.
        self.noisy.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        // Copies of a star have its noise in common, and count once.
        self.noisy.dedup_by(|a, b| a == b);
        let (mut ranges, mut rest) = (Vec::new(), self.noisy.as_slice());
        while rest.len() >= FEWEST {
            let from = rest[0].0;
            let within = rest.partition_point(|(snr, _)| *snr <= RANGE * from);
            let mut count = within.max(FEWEST);
            if rest.len() - count < FEWEST {
                count = rest.len();
            }
            ranges.push((from, of_range(&rest[..count])?));
            rest = &rest[count..];
        }
        (!ranges.is_empty()).then(|| Arc::new(CommonProfile { ranges }))
    }
}

/// What stars have in common, the faintest of which is the first. Stars of which much more or less is left than of the others
/// have faults of their own, and are left out.
fn of_range(stars: &[(f64, Sums)]) -> Option<Common> {
    let usual = |which: usize| {
        let mut left: Vec<f64> = stars.iter().map(|(_, sums)| sums.left[which]).collect();
        let (middle, scatter) = scatter(&mut left)?;
        Some(move |sums: &Sums| (sums.left[which] - middle).abs() <= OUTSIDE * scatter)
    };
    let (of_square, of_sum) = (usual(0)?, usual(1)?);
    let kept = |(_, sums): &&(f64, Sums)| of_square(sums) && of_sum(sums);
    let brightest = RANGE * stars[0].0;
    let mut all = Sums::default();
    for (snr, sums) in stars.iter().filter(kept) {
        // The few stars beyond the range would outweigh the others.
        all.add(sums, (brightest / snr).powi(2).min(1.0));
    }
    all.common(stars.len())
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
        (0..stars.len_of(Axis(0))).for_each(|k| survey.add(looker.look(&psfs, k)));
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
    fn a_star_with_a_fault_is_left_out() {
        let (noisy, _) = stars(PsfProfile::Kolmogorov, 100.0, 40);
        let without = survey(&noisy.slice(ndarray::s![..39, .., ..]).to_owned());
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
            assert_eq!(with.common(), without.clone().common(), "{name}");
        }
    }

    #[test]
    fn copies_of_a_star_count_once() {
        let (noisy, _) = stars(PsfProfile::Kolmogorov, 100.0, 20);
        let twice = ndarray::concatenate![Axis(0), noisy, noisy];
        assert_eq!(survey(&twice).common(), survey(&noisy).common());
        let one = noisy.slice(ndarray::s![..1, .., ..]);
        let copies = ndarray::concatenate(Axis(0), &[one; 40]).unwrap();
        assert_eq!(survey(&copies).common(), None);
    }

    #[test]
    fn many_stars_share_what_turns_if_it_is_significant() {
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
            survey(&noisy).common().unwrap().of(100.0).terms()
        };
        assert_eq!([terms(2.0, 120), terms(4.0, 120)], [3, 5]);
        // Too few stars, and three times the angle, which is no term.
        assert_eq!([terms(4.0, 99), terms(3.0, 120)], [1, 1]);
    }

    #[test]
    fn stars_share_with_those_of_their_signal_to_noise() {
        let (mut both, _) = stars(PsfProfile::Kolmogorov, 50.0, 60);
        let (bright, _) = stars(PsfProfile::Kolmogorov, 300.0, 30);
        let faint = survey(&both.slice(ndarray::s![..30, .., ..]).to_owned());
        let bright_ones = survey(&bright);
        // One faint, one bright, and so on.
        for k in 0..30 {
            let star = both.index_axis(Axis(0), k).to_owned();
            both.index_axis_mut(Axis(0), 30 + k).assign(&star);
        }
        for k in 0..30 {
            let star = both.index_axis(Axis(0), 30 + k).to_owned();
            both.index_axis_mut(Axis(0), 2 * k).assign(&star);
            let star = bright.index_axis(Axis(0), k).to_owned();
            both.index_axis_mut(Axis(0), 2 * k + 1).assign(&star);
        }
        let both = survey(&both).common().unwrap();
        let [(low, first), (high, second)] = &both.ranges[..] else {
            panic!("{} ranges", both.ranges.len());
        };
        // The faintest of thirty of different widths.
        assert!(
            (30.0..50.0).contains(low) && (230.0..300.0).contains(high),
            "{low} {high}"
        );
        assert_eq!(first, &faint.common().unwrap().ranges[0].1);
        assert_eq!(second, &bright_ones.common().unwrap().ranges[0].1);
        for (snr, function) in [
            (20.0, first),
            (60.0, first),
            (200.0, first),
            (400.0, second),
        ] {
            assert_eq!(both.of(snr), function, "{snr}");
        }
        assert_ne!(first, second);
        // A bright star gets the function of bright ones.
        let star = bright.index_axis(Axis(0), 0);
        let shrunk = |common: CommonProfile| {
            let mut shrinker = Shrinker::default();
            shrinker.set_common(Some(&Arc::new(common)));
            shrinker.shrunk(star).to_owned()
        };
        let ranges = vec![both.ranges[1].clone()];
        assert_eq!(shrunk((*both).clone()), shrunk(CommonProfile { ranges }));
    }

    #[test]
    fn a_few_bright_stars_count_as_some_more() {
        let (noisy, _) = stars(PsfProfile::Kolmogorov, 50.0, 40);
        let (bright, _) = stars(PsfProfile::Moffat { beta: 3.0 }, 400.0, 3);
        let with = ndarray::concatenate![Axis(0), noisy, bright];
        let (with, without) = (survey(&with).common(), survey(&noisy).common());
        let [with, without] = [with.unwrap(), without.unwrap()];
        assert_eq!(with.ranges.len(), 1);
        // Three of S/N 90 next to forty of 50. Without a limit the bright ones would have 83 % of the weight.
        let share = with.of(50.0).unlike(without.of(50.0));
        assert!(share > 0.0 && share < 0.4, "{share}");
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
        assert!(clean.noisy.is_empty() && clean.common().is_none());
        // Without noise in the beginning.
        let mut late = StarSurvey::default();
        (0..WITHOUT_NOISE - 1).for_each(|_| late.add(StarLook(None)));
        assert!(!late.is_over());
        late.add(StarLook(Some((50.0, Sums::default()))));
        assert!(!late.is_over());
        let mut none = StarSurvey::default();
        (0..WITHOUT_NOISE).for_each(|_| none.add(StarLook(None)));
        assert!(none.is_over());
        let (faint, _) = stars(PsfProfile::Kolmogorov, 4.0, 30);
        assert!(
            survey(&faint)
                .noisy
                .iter()
                .all(|(snr, _)| *snr >= LEAST_SNR)
        );
        // A PSF for all.
        let mut looker = StarLooker::new(CUT, N);
        let StarLook(none) = looker.look(&Psfs::star(noisy.index_axis(Axis(0), 0)), 0);
        assert!(none.is_none());
    }
}
