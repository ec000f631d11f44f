//! The clipped autocorrelation of a deconvolved stamp, as a submission's settings read Sect. 3.2.

use shearq_submissions::{AcfKind, Background, ClippedShape};

use super::acf::{AcfScratch, Autocorrelation};
use super::moments::{ClippedMoments, Moments};
use crate::error::MeasureError;
use crate::measurement::Flag;

/// Width of the border whose mean is a stamp's background. See docs/constants.md.
const BORDER: usize = 3;

/// Autocorrelation, background and moments of n×n stamps. Allocates nothing per stamp.
#[derive(Debug, Clone)]
pub struct ClippedAcf {
    n: usize,
    background: Background,
    acf: Autocorrelation,
    moments: ClippedMoments,
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub struct ClippedAcfScratch {
    acf: AcfScratch,
    lags: Vec<f32>,
}

impl ClippedAcfScratch {
    /// The autocorrelation last measured, laid out as [`Autocorrelation`] writes it.
    pub fn lags(&self) -> &[f32] {
        &self.lags
    }
}

impl ClippedAcf {
    /// Plans for n×n stamps.
    pub fn new(n: usize, settings: &ClippedShape) -> Self {
        ClippedAcf {
            n,
            background: settings.background,
            acf: match settings.acf {
                AcfKind::Full => Autocorrelation::new(n),
                AcfKind::Circular => Autocorrelation::circular(n),
            },
            moments: ClippedMoments::of(n, settings),
        }
    }

    /// Buffers that fit this plan.
    pub fn scratch(&self) -> ClippedAcfScratch {
        ClippedAcfScratch {
            acf: self.acf.scratch(),
            lags: vec![0.0; self.acf.len()],
        }
    }

    /// The autocorrelation.
    pub fn autocorrelation(&self) -> &Autocorrelation {
        &self.acf
    }

    /// What takes moments of it.
    pub fn moments(&self) -> &ClippedMoments {
        &self.moments
    }

    /// Moments of the autocorrelation of `stamp`, whose pixels sum to `light`, or why there are none.
    ///
    /// # Errors
    /// Where the stamp or the buffers have other sizes than planned.
    pub fn measure(
        &self,
        stamp: &[f32],
        light: f64,
        scratch: &mut ClippedAcfScratch,
    ) -> Result<Result<Moments, Flag>, MeasureError> {
        let level = match self.background {
            Background::StampFrame => frame_mean(stamp, self.n),
            Background::None | Background::AcfEdge => 0.0,
        };
        self.acf
            .compute_above(level as f32, stamp, &mut scratch.acf, &mut scratch.lags)?;
        let light = light - level * (self.n * self.n) as f64;
        Ok(self.moments.measure(&scratch.lags, light))
    }
}

/// Mean of the frame of an n×n stamp; of all its pixels where it is too small to have an inside.
fn frame_mean(stamp: &[f32], n: usize) -> f64 {
    let inside = BORDER..n.saturating_sub(BORDER);
    let (mut sum, mut count) = (0.0, 0);
    for (y, row) in stamp.chunks_exact(n).enumerate() {
        for (x, &value) in row.iter().enumerate() {
            if !(inside.contains(&y) && inside.contains(&x)) {
                sum += f64::from(value);
                count += 1;
            }
        }
    }
    sum / f64::from(count.max(1))
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use shearq_submissions::{EllipticityType, ShareOf};

    use super::*;

    /// The moments by plain sums over all pairs of pixels, in f64, with the autocorrelation as an image of its
    /// own. `None` where there is no light.
    fn moments_naive(settings: &ClippedShape, stamp: &Array2<f64>) -> Option<Moments> {
        let n = stamp.nrows() as i64;
        let mut stamp = stamp.clone();
        if settings.background == Background::StampFrame {
            let frame = |y: usize, x: usize| {
                let edge = |k: usize| k < BORDER || k + BORDER >= n as usize;
                edge(y) || edge(x)
            };
            let all: Vec<f64> = stamp
                .indexed_iter()
                .filter(|((y, x), _)| frame(*y, *x))
                .map(|(_, v)| *v)
                .collect();
            stamp -= all.iter().sum::<f64>() / all.len() as f64;
        }
        if stamp.sum() <= 0.0 {
            return None;
        }
        // Every lag with its value and how often it counts: a lag of n/2 of a circular one is its own opposite.
        let mut lags = Vec::new();
        let reach = match settings.acf {
            AcfKind::Full => n - 1,
            AcfKind::Circular => n / 2,
        };
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let mut sum = 0.0;
                for ((y, x), value) in stamp.indexed_iter() {
                    let (mut y, mut x) = (y as i64 + dy, x as i64 + dx);
                    if settings.acf == AcfKind::Circular {
                        (y, x) = (y.rem_euclid(n), x.rem_euclid(n));
                    }
                    let other = stamp.get((y as usize, x as usize));
                    sum += value * other.copied().unwrap_or(0.0);
                }
                let twice = |d: i64| settings.acf == AcfKind::Circular && 2 * d.abs() == n;
                let weight = [dx, dy].map(|d| if twice(d) { 0.5 } else { 1.0 });
                lags.push((dx, dy, sum, weight[0] * weight[1]));
            }
        }
        if settings.background == Background::AcfEdge {
            let outermost = |l: &&mut (i64, i64, f64, f64)| l.0.abs().max(l.1.abs()) == reach;
            let (mut sum, mut count) = (0.0, 0.0);
            for lag in lags.iter_mut().filter(outermost) {
                sum += lag.2 * lag.3;
                count += lag.3;
            }
            lags.iter_mut().for_each(|lag| lag.2 -= sum / count);
        }
        let square = |lag: &(i64, i64, f64, f64)| lag.0 * lag.0 + lag.1 * lag.1;
        let mut squares: Vec<i64> = lags.iter().map(square).collect();
        squares.sort_unstable();
        squares.dedup();
        let inside = |of: i64, what: fn(&(i64, i64, f64, f64)) -> f64| -> f64 {
            let lags = lags.iter().filter(|lag| square(lag) <= of);
            lags.map(|lag| what(lag) * lag.2 * lag.3).sum()
        };
        let enclosed: Vec<f64> = squares.iter().map(|s| inside(*s, |_| 1.0)).collect();
        let whole = match settings.share_of {
            ShareOf::Total => *enclosed.last()?,
            ShareOf::Maximum => enclosed.iter().copied().fold(0.0, f64::max),
        };
        let at = enclosed
            .iter()
            .position(|e| *e >= settings.acf_share * whole)?;
        let of = squares[at];
        let moment = |what| inside(of, what) / enclosed[at];
        Some(Moments {
            xx: moment(|lag| (lag.0 * lag.0) as f64),
            yy: moment(|lag| (lag.1 * lag.1) as f64),
            xy: moment(|lag| (lag.0 * lag.1) as f64),
            radius: (of as f64).sqrt(),
        })
    }

    #[test]
    fn every_reading_equals_plain_sums_on_dirty_scratch() {
        let mut rng = ChaCha8Rng::seed_from_u64(15);
        for n in [8, 11, 16, 19] {
            let centre = (n as f64 - 1.0) / 2.0 + 0.3;
            let stamp = Array2::from_shape_fn((n, n), |(y, x)| {
                let (dy, dx) = (y as f64 - centre, x as f64 - centre);
                let noise: f64 = rng.random_range(-0.5..1.0);
                0.3 * noise.max(0.0) + 4.0 * (-(dx * dx + dy * dy - 0.6 * dx * dy) / 7.0).exp()
            });
            let single: Vec<f32> = stamp.iter().map(|v| *v as f32).collect();
            let stamp = Array2::from_shape_fn((n, n), |(y, x)| f64::from(single[y * n + x]));
            for acf in [AcfKind::Full, AcfKind::Circular] {
                for background in [
                    Background::None,
                    Background::AcfEdge,
                    Background::StampFrame,
                ] {
                    for share_of in [ShareOf::Total, ShareOf::Maximum] {
                        for acf_share in [0.5, 0.9] {
                            let settings = ClippedShape {
                                acf,
                                background,
                                acf_share,
                                share_of,
                                ellipticity: EllipticityType::Distortion,
                            };
                            let plan = ClippedAcf::new(n, &settings);
                            let mut scratch = plan.scratch();
                            scratch.lags.fill(f32::NAN);
                            let dirt: Vec<f32> = single.iter().rev().map(|v| 9.0 * v).collect();
                            plan.measure(&dirt, 1.0, &mut scratch).unwrap().ok();
                            let light = stamp.sum();
                            let found = plan.measure(&single, light, &mut scratch).unwrap();
                            let expected = moments_naive(&settings, &stamp);
                            let (Ok(found), Some(expected)) = (found, expected) else {
                                panic!("{settings:?}: no light");
                            };
                            // f32 transforms: 1e-6 of the peak in each of up to 10³ lags, whose r² are up to
                            // 10², over a sum of some ten peaks.
                            let label = format!("n {n}, {settings:?}: {found:?} {expected:?}");
                            assert!((found.radius - expected.radius).abs() < 1e-12, "{label}");
                            for (a, b) in [
                                (found.xx, expected.xx),
                                (found.yy, expected.yy),
                                (found.xy, expected.xy),
                            ] {
                                assert!((a - b).abs() <= 1e-4 * expected.xx.abs(), "{label}");
                            }
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn backgrounds_take_a_pedestal_away() {
        let n = 23;
        let stamp = |pedestal: f32| -> Vec<f32> {
            let at = |k: usize| k as f32 - 11.0;
            (0..n * n)
                .map(|k| {
                    let (y, x) = (at(k / n), at(k % n));
                    pedestal + (-(x * x / 4.0 + y * y / 2.0) / 2.0).exp()
                })
                .collect()
        };
        let distortion = |acf, background, pedestal| {
            let settings = ClippedShape {
                acf,
                background,
                acf_share: 0.9,
                share_of: ShareOf::Maximum,
                ellipticity: EllipticityType::Distortion,
            };
            let plan = ClippedAcf::new(n, &settings);
            let stamp = stamp(pedestal);
            let light = stamp.iter().map(|&v| f64::from(v)).sum();
            let moments = plan.measure(&stamp, light, &mut plan.scratch()).unwrap();
            moments.unwrap().distortion().unwrap().e1
        };
        let clean = distortion(AcfKind::Full, Background::None, 0.0);
        assert!(distortion(AcfKind::Full, Background::None, 0.05) < 0.6 * clean);
        // A constant adds a constant to the circular autocorrelation.
        for (acf, background) in [
            (AcfKind::Full, Background::StampFrame),
            (AcfKind::Circular, Background::StampFrame),
            (AcfKind::Circular, Background::AcfEdge),
        ] {
            let [without, with] = [0.0, 0.05].map(|level| distortion(acf, background, level));
            assert!((with - without).abs() < 1e-4, "{with} {without}");
            assert!((without / clean - 1.0).abs() < 0.02, "{without} {clean}");
        }
    }
}
