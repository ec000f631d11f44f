//! Whether a PSF image is what the measurement requires: background subtracted, enough light over the noise, sampled with
//! the pixels of the galaxies.
//!
//! Everything is measured on the pixels that are used, of sum one. The border of a PSF holds its wings, so that its level is
//! no background by itself: wings are not negative and fall at least like r^(−2.5), and only what lies outside these bounds
//! counts as a background. Noise is measured by second differences along the border, where wings are smooth.

use ndarray::ArrayView2;
use shearq_quantities::statistics::{SCATTER, median, upper_median};

use super::effect::of_noise;
use super::{breadth, star};
use crate::extent::{Core, core_of_psf};
use crate::warning::{Of, Warning};

/// Width of the PSF stamp's border. See docs/constants.md.
const BORDER: usize = 2;
/// Distances from the middle, in units of half the side, of the pixels with which the border is compared.
const HALFWAY: std::ops::Range<f64> = 0.5..0.65;
/// Slowest fall of a PSF's wings, as a power of the radius. See docs/constants.md.
const FALL: f64 = 2.5;
/// Significance that every warning requires. See docs/constants.md.
const CLEAR: f64 = 5.0;
/// Light of a background, in units of the star's, above which |m| may exceed 2·10⁻³. See
/// docs/constants.md.
const BACKGROUND: f64 = 0.1;
/// Highest level that is stated, in units of the peak: of stamps without a star. See docs/constants.md.
const MOST_LEVEL: f64 = 100.0;
/// Light of a gradient extrapolated from the brighter edge, above which a warning is due. See
/// docs/constants.md.
const GRADIENT: f64 = 0.3;
/// S/N of the one star below which its noise makes |m| exceed 5·10⁻³. See docs/constants.md.
const ENOUGH_SNR: f64 = 1000.0;
/// The same limit for a star per galaxy, whose noise averages out. See docs/constants.md.
const ENOUGH_SNR_EACH: f64 = 100.0;
/// Noise-equivalent area of the narrowest PSF that pixels can show. See docs/constants.md.
const LEAST_AREA: f64 = 6.0;
/// Mean square of the PSF's core in units of the galaxies', above which a warning is due. See
/// docs/constants.md.
const AS_BROAD: f64 = 0.83;
/// The same ratio above which an error is due. See docs/constants.md.
const BROADER: f64 = 1.02;
/// Share of the PSFs of an image that a warning requires. See docs/constants.md.
const MANY: f64 = 0.1;

/// What one PSF shows.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PsfLook {
    /// Pixels a side.
    side: usize,
    /// S/N of the star; infinite without noise.
    snr: f64,
    /// Level of the background in units of the peak, and its light in units of the star's.
    level: f64,
    background: f64,
    /// Change of the background per pixel in units of the peak, and its light in units of the star's.
    slope: [f64; 2],
    gradient: f64,
    /// Noise-equivalent area in px².
    area: f64,
    core: Option<Core>,
    moved: Option<[f64; 2]>,
}

impl PsfLook {
    /// S/N of the star; infinite without noise.
    pub(super) fn snr(&self) -> f64 {
        self.snr
    }

    /// Standard deviations of m and c by the noise of the star, if all galaxies share it.
    pub(crate) fn effect_of_noise(&self) -> [f64; 2] {
        of_noise(self.snr, self.side)
    }

    /// At a PSF of sum one, which was `moved` by so much to be in the middle; `None` if its sides are too short to tell
    /// anything, or a pixel is not finite.
    pub(crate) fn of(psf: ArrayView2<'_, f64>, moved: Option<[f64; 2]>) -> Option<PsfLook> {
        let n = psf.nrows();
        if n != psf.ncols() || n < 4 * BORDER || psf.iter().any(|value| !value.is_finite()) {
            return None;
        }
        let middle = (n as f64 - 1.0) / 2.0;
        let (mut outer, mut inner, mut edges) =
            (Mean::default(), Mean::default(), [Mean::default(); 4]);
        let mut peak = f64::NEG_INFINITY;
        for ((y, x), &value) in psf.indexed_iter() {
            let away = (x as f64 - middle).abs().max((y as f64 - middle).abs());
            for (edge, at) in edges.iter_mut().zip([x, n - 1 - x, y, n - 1 - y]) {
                if at < BORDER {
                    edge.add(value, away);
                }
            }
            if away > middle - BORDER as f64 {
                outer.add(value, away);
            } else if HALFWAY.contains(&(away / (middle + 0.5))) {
                inner.add(value, away);
            }
            peak = peak.max(value);
        }
        let sigma = noise(psf);
        let share = (inner.radius() / outer.radius()).powf(FALL);
        let least = (outer.mean() - share * inner.mean()) / (1.0 - share);
        let level = if least > 0.0 {
            least
        } else {
            outer.mean().min(0.0)
        };
        let error =
            sigma * (1.0 / outer.count + share * share / inner.count).sqrt() / (1.0 - share);
        let level = if level.abs() > CLEAR * error {
            level
        } else {
            0.0
        };
        let pixels = (n * n) as f64;
        let star = (1.0 - level * pixels).max(f64::MIN_POSITIVE);
        let [left, right, bottom, top] = edges.map(|edge| edge.mean());
        let across = (n - BORDER) as f64;
        let error = sigma * 2f64.sqrt() / (edges[0].count.sqrt() * across);
        let slope = [(right - left) / across, (top - bottom) / across];
        let steep = slope[0].hypot(slope[1]);
        let steep = if steep > CLEAR * error { steep } else { 0.0 };
        // Without the outer pixels, which hold more noise than light.
        let (mut power, mut count) = (0.0, 0.0);
        for ((y, x), &value) in psf.indexed_iter() {
            let away = (x as f64 - middle).abs().max((y as f64 - middle).abs());
            if away < HALFWAY.start * (middle + 0.5) {
                power += (value - outer.mean()).powi(2);
                count += 1.0;
            }
        }
        let bright = (peak - outer.mean()).max(f64::MIN_POSITIVE);
        let area = breadth::area(psf);
        Some(PsfLook {
            side: n,
            snr: (power - count * sigma * sigma).max(0.0).sqrt() / sigma,
            level: (level / bright).clamp(-MOST_LEVEL, MOST_LEVEL),
            background: level * pixels / star,
            slope: slope.map(|slope| slope / bright),
            gradient: steep * 0.5 * n as f64 * pixels / star,
            // More noise than light, or light without end, has no area.
            area: if area > 0.0 && area < pixels {
                area
            } else {
                f64::INFINITY
            },
            core: core_of_psf(psf, star::place(psf), outer.mean(), sigma),
            moved,
        })
    }
}

/// Of pixels: their mean, and their mean distance from the middle.
#[derive(Debug, Clone, Copy, Default)]
struct Mean {
    sum: f64,
    radii: f64,
    count: f64,
}

impl Mean {
    fn add(&mut self, value: f64, radius: f64) {
        self.sum += value;
        self.radii += radius;
        self.count += 1.0;
    }

    fn mean(&self) -> f64 {
        self.sum / self.count
    }

    fn radius(&self) -> f64 {
        self.radii / self.count
    }
}

/// Noise of a pixel, from second differences along the border.
fn noise(psf: ArrayView2<'_, f64>) -> f64 {
    let n = psf.nrows();
    let mut moduli = Vec::with_capacity(4 * BORDER * n);
    for k in (0..BORDER).flat_map(|k| [k, n - 1 - k]) {
        for line in [psf.row(k), psf.column(k)] {
            let differences = line
                .iter()
                .zip(line.iter().skip(1))
                .zip(line.iter().skip(2));
            moduli.extend(differences.map(|((a, b), c)| (a - 2.0 * b + c).abs() as f32));
        }
    }
    // A second difference has the variance of 1 + 4 + 1 pixels.
    f64::from(median(&mut moduli).unwrap_or(0.0) * SCATTER) / 6f64.sqrt()
}

/// What is wrong with the PSFs of an image, `shared` by all galaxies or not, whose galaxies have the core `galaxies`.
pub(crate) fn warnings(looks: &[PsfLook], shared: bool, galaxies: Option<Core>) -> Vec<Warning> {
    let mut found = Vec::new();
    let mut with = |is: &dyn Fn(&PsfLook) -> bool, warn: &dyn Fn(&[PsfLook], Of) -> Warning| {
        let those: Vec<PsfLook> = looks.iter().copied().filter(is).collect();
        let (count, of) = (those.len(), looks.len());
        if count > 0 && count as f64 >= MANY * of as f64 {
            found.push(warn(&those, Of { count, of }));
        }
    };
    let middle = |those: &[PsfLook], of: &dyn Fn(&PsfLook) -> f64| {
        let mut all: Vec<f64> = those.iter().map(of).collect();
        upper_median(&mut all).unwrap_or(f64::NAN)
    };
    with(&|look| look.moved.is_some(), &|those, of| {
        let off = |k: usize| middle(those, &|look| look.moved.map_or(0.0, |moved| moved[k]));
        Warning::PsfOffCentre {
            offset: [off(0), off(1)],
            of,
        }
    });
    with(&|look| look.background.abs() > BACKGROUND, &|those, of| {
        Warning::PsfBackground {
            level: middle(those, &|look| look.level),
            share: middle(those, &|look| look.background),
            of,
        }
    });
    with(&|look| look.gradient > GRADIENT, &|those, of| {
        Warning::PsfGradient {
            slope: [0, 1].map(|k| middle(those, &|look| look.slope[k])),
            of,
        }
    });
    let enough = if shared { ENOUGH_SNR } else { ENOUGH_SNR_EACH };
    with(&|look| look.snr < enough, &|those, of| Warning::PsfNoise {
        snr: middle(those, &|look| look.snr),
        enough,
        effect: shared.then(|| [0, 1].map(|k| middle(those, &|look| look.effect_of_noise()[k]))),
        of,
    });
    with(&|look| look.area < LEAST_AREA, &|those, of| {
        Warning::PsfNarrow {
            area: middle(those, &|look| look.area),
            of,
        }
    });
    found.extend(galaxies.and_then(|galaxies| broad(looks, galaxies)));
    found
}

/// A warning if the PSF is too broad for galaxies with the core `galaxies`.
fn broad(looks: &[PsfLook], galaxies: Core) -> Option<Warning> {
    let mut cores: Vec<Core> = looks.iter().filter_map(|look| look.core).collect();
    cores.sort_by(|a, b| a.extent.total_cmp(&b.extent));
    let psf = cores.get(cores.len() / 2)?;
    let beyond = |ratio: f64| {
        let error = psf.error.hypot(ratio * galaxies.error);
        psf.extent - ratio * galaxies.extent > CLEAR * error
    };
    beyond(AS_BROAD).then(|| Warning::PsfBroad {
        psf: psf.fwhm(),
        galaxies: galaxies.fwhm(),
        fatal: beyond(BROADER),
    })
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};
    use shearq_quantities::Shear;

    use super::*;
    use crate::psf::star_psf;
    use shearq_quantities::{FunctionalPsf, PsfProfile};

    const MOFFAT: PsfProfile = PsfProfile::Moffat { beta: 3.0 };

    fn drawn(profile: PsfProfile, fwhm: f64, side: usize) -> Array2<f64> {
        let psf = FunctionalPsf::new(profile, fwhm, Shear::new(0.05, -0.03));
        psf.unwrap().stamp(side)
    }

    /// Kinds of warnings about a PSF of any sum.
    fn kinds(stamp: &Array2<f64>) -> Vec<&'static str> {
        let psf = star_psf(stamp.view(), stamp.nrows()).unwrap();
        let look = PsfLook::of(psf.view(), None).unwrap();
        let found = warnings(&[look], true, None);
        found.iter().map(Warning::kind).collect()
    }

    /// An Airy disc, (2 J₁(x)/x)² at pixel centres.
    fn airy(fwhm: f64, side: usize) -> Array2<f64> {
        let middle = (side as f64 - 1.0) / 2.0;
        Array2::from_shape_fn((side, side), |(y, x)| {
            let r = (x as f64 - middle).hypot(y as f64 - middle);
            let x = 3.2327 * r / fwhm;
            (2.0 * puruspe::bessel::Jn(1, x) / x).powi(2)
        })
    }

    #[test]
    fn wings_are_neither_background_nor_noise() {
        for side in [32, 48, 64] {
            for fwhm in [1.6, 2.4, 3.4, 6.0] {
                for profile in [
                    MOFFAT,
                    PsfProfile::Moffat { beta: 2.2 },
                    PsfProfile::Kolmogorov,
                ] {
                    let found = kinds(&drawn(profile, fwhm, side));
                    assert!(found.is_empty(), "{profile:?} {fwhm} {side}: {found:?}");
                }
            }
            for fwhm in [2.4, 3.4] {
                let found = kinds(&airy(fwhm, side));
                assert!(found.is_empty(), "Airy {fwhm} {side}: {found:?}");
            }
        }
        for side in [15, 23] {
            let found = kinds(&drawn(MOFFAT, 3.4, side));
            assert!(found.is_empty(), "{side}: {found:?}");
        }
    }

    #[test]
    fn wrong_psfs_have_their_warning() {
        let good = drawn(MOFFAT, 3.4, 48);
        let peak = good.iter().copied().fold(0.0, f64::max);
        for (share, expected) in [(0.01, 1), (0.05, 1), (-0.002, 1), (0.0003, 0)] {
            let found = kinds(&(&good + share * peak));
            assert_eq!(found, vec!["psf-background"; expected], "{share}");
        }
        let slope = |y: f64| {
            let gradient = |(_, x): (usize, usize)| y * peak * (x as f64 - 23.5) / 23.5;
            &good + &Array2::from_shape_fn((48, 48), gradient)
        };
        assert_eq!(kinds(&slope(0.005)), ["psf-gradient"]);
        assert!(kinds(&slope(0.0005)).is_empty());
        let mut delta = Array2::zeros((48, 48));
        delta[(24, 23)] = 3.0;
        assert_eq!(kinds(&delta), ["psf-narrow"]);
        assert_eq!(kinds(&drawn(MOFFAT, 0.3, 48)), ["psf-narrow"]);
    }

    #[test]
    fn stamps_without_a_star_have_numbers_that_can_be_read() {
        let look = PsfLook::of(Array2::from_elem((48, 48), 1.0 / 2304.0).view(), None).unwrap();
        let found = warnings(&[look], true, None);
        let text: Vec<String> = found.iter().map(ToString::to_string).collect();
        assert!(
            !text.is_empty() && text.iter().all(|line| line.len() < 300),
            "{text:?}"
        );
    }

    #[test]
    fn the_noise_of_a_star_is_measured_and_is_not_taken_for_more() {
        let good = drawn(MOFFAT, 3.4, 48);
        let power = good.iter().map(|value| value * value).sum::<f64>().sqrt();
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        for snr in [20.0, 50.0, 100.0, 500.0, 3000.0] {
            for _ in 0..20 {
                let star = good.mapv(|value| {
                    let noise: f64 = StandardNormal.sample(&mut rng);
                    100.0 * (value + power / snr * noise)
                });
                let psf = star_psf(star.view(), 48).unwrap();
                let look = PsfLook::of(psf.view(), None).unwrap();
                // 370 pixels know σ to 6 %, and Σ p² is known to 2/(S/N).
                assert!((look.snr / snr - 1.0).abs() < 0.25 + 10.0 / snr, "{look:?}");
                let found = kinds(&star);
                let expected = vec!["psf-noise"; usize::from(snr < 1000.0)];
                assert_eq!(found, expected, "{look:?}");
            }
        }
    }
}
