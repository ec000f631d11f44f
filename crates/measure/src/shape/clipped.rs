//! Ellipticity of the network's stamp from its clipped autocorrelation (Nurbaeva et al. 2015, Sects. 3.2 and 3.3).

use shearq_quantities::Distortion;
use shearq_submissions::{AcfKind, Background, ClippedShape, ShareOf};

use crate::error::{MeasureError, length};
use crate::measurement::Flag;
use crate::transform::{LagsScratch, Plane, Spectrum, ToLags, ToModes, TransformScratch};

// Chosen by hand.
const BORDER_PX: usize = 3;

/// Quadrupole moments of the clipped autocorrelation (Eq. 14), in px² relative to its light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moments {
    /// Qxx.
    pub xx: f64,
    /// Qyy.
    pub yy: f64,
    /// Qxy.
    pub xy: f64,
    /// Radius of the clipping in pixels.
    pub radius: f64,
}

impl Moments {
    /// (Qxx − Qyy)/(Qxx + Qyy) and 2Qxy/(Qxx + Qyy) (Eq. 13): a distortion χ.
    ///
    /// # Errors
    /// Where Qxx + Qyy is not positive.
    pub fn distortion(&self) -> Result<Distortion, Flag> {
        let size = self.xx + self.yy;
        if !(size > 0.0 && size.is_finite()) {
            return Err(Flag::NoExtent);
        }
        Ok(Distortion::new(
            (self.xx - self.yy) / size,
            2.0 * self.xy / size,
        ))
    }
}

/// One lag of the half plane kept.
#[derive(Debug, Clone, Copy)]
struct Lag {
    at: u32,
    dx: i32,
    dy: i32,
    square: i32,
    /// 2 for a lag that stands for its opposite too, 1 for zero lag; half of it for each component of n/2
    /// where lags wrap around and −n/2 is the same lag.
    weight: f32,
}

/// Autocorrelation A(dx, dy) = Σ v(x, y)·v(x + dx, y + dy) of n×n stamps, zero outside the stamp or the stamp again, and its
/// moments inside the radius that encloses a share of its light.
///
/// Lags are kept for dy = 0…R, dx = −R…R, as `[dy·(2R+1) + dx + R]`; the other half follows from A(−dx, −dy) = A(dx, dy).
/// R is n − 1, or n/2 where the stamp goes on beyond its edges as it begins: what a transform without padding gives.
#[derive(Debug, Clone)]
pub struct ClippedAcf {
    n: usize,
    settings: ClippedShape,
    plane: Plane,
    to_modes: ToModes,
    to_lags: ToLags,
    reach: usize,
    /// By distance. Lags of equal distance are taken or left together, so that the clipped region is as round as the
    /// pixel grid allows and has no preferred direction.
    lags: Vec<Lag>,
    /// Number of lags, of both half planes.
    count: f64,
}

/// Buffers for one thread. Their content between calls does not matter.
#[derive(Debug, Clone)]
pub struct ClippedAcfScratch {
    stamp: Vec<f32>,
    transform: TransformScratch,
    spectrum: Spectrum,
    power: Vec<f32>,
    lags: LagsScratch,
    acf: Vec<f32>,
}

impl ClippedAcfScratch {
    /// The autocorrelation last measured, laid out as [`ClippedAcf`] has it.
    pub fn acf(&self) -> &[f32] {
        &self.acf
    }
}

impl ClippedAcf {
    /// Plans for n×n stamps.
    pub fn new(n: usize, settings: &ClippedShape) -> Self {
        let circular = settings.acf == AcfKind::Circular;
        // At 2n − 1 pixels no lag wraps onto another.
        let (period, reach) = if circular {
            (n, n / 2)
        } else {
            (2 * n - 1, n - 1)
        };
        let plane = Plane::with_all_modes(period);
        let side = reach as i32;
        // −n/2 and n/2 are one lag of a circular autocorrelation, which both components share.
        let half = |d: i32| {
            if circular && 2 * d.unsigned_abs() as usize == n {
                0.5
            } else {
                1.0
            }
        };
        let places = (0..=side).flat_map(|dy| (-side..=side).map(move |dx| (dy, dx)));
        let mut lags: Vec<Lag> = places
            .enumerate()
            .filter(|(_, (dy, dx))| *dy > 0 || *dx >= 0)
            .map(|(at, (dy, dx))| {
                let both = if dx == 0 && dy == 0 { 1.0 } else { 2.0 };
                Lag {
                    at: at as u32,
                    dx,
                    dy,
                    square: dx * dx + dy * dy,
                    weight: both * half(dx) * half(dy),
                }
            })
            .collect();
        lags.sort_by_key(|lag| (lag.square, lag.dy, lag.dx));
        ClippedAcf {
            n,
            settings: settings.clone(),
            to_modes: ToModes::new(n, &plane, false),
            to_lags: ToLags::new(reach, period, &plane, 1.0 / (period * period) as f64),
            plane,
            reach,
            count: lags.iter().map(|lag| f64::from(lag.weight)).sum(),
            lags,
        }
    }

    /// Buffers that fit this plan.
    pub fn scratch(&self) -> ClippedAcfScratch {
        ClippedAcfScratch {
            stamp: vec![0.0; self.n * self.n],
            transform: self.to_modes.scratch(),
            spectrum: self.plane.spectrum(),
            power: vec![0.0; 2 * self.plane.quarter()],
            lags: self.to_lags.scratch(),
            acf: vec![0.0; self.to_lags.len()],
        }
    }

    /// Largest component R of a lag in pixels.
    pub fn reach(&self) -> usize {
        self.reach
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
        let level = self.autocorrelate(stamp, scratch)?;
        let light = light - level * (self.n * self.n) as f64;
        Ok(self.moments(&scratch.acf, light))
    }

    /// Writes the autocorrelation of `stamp` less the level of its background to [`ClippedAcfScratch::acf`]; returns the level.
    ///
    /// # Errors
    /// Where the stamp or the buffers have other sizes than planned.
    pub fn autocorrelate(
        &self,
        stamp: &[f32],
        scratch: &mut ClippedAcfScratch,
    ) -> Result<f64, MeasureError> {
        length("a stamp", stamp.len(), self.n * self.n)?;
        let what = "buffers for an autocorrelation";
        length(what, scratch.acf.len(), self.to_lags.len())?;
        length(what, scratch.stamp.len(), stamp.len())?;
        let level = match self.settings.background {
            Background::StampFrame => frame_mean(stamp, self.n),
            Background::None | Background::AcfEdge => 0.0,
        };
        let ClippedAcfScratch {
            stamp: above,
            transform,
            spectrum,
            power,
            lags,
            acf,
        } = scratch;
        for (above, value) in above.iter_mut().zip(stamp) {
            *above = value - level as f32;
        }
        self.to_modes.transform(above, transform, spectrum);
        spectrum.power(power);
        self.to_lags.lags(power, lags, acf);
        Ok(level)
    }

    /// Moments of an autocorrelation; `light` is the sum of the stamp, whose square is the sum of the autocorrelation.
    ///
    /// # Errors
    /// Where there is no light.
    pub fn moments(&self, acf: &[f32], light: f64) -> Result<Moments, Flag> {
        if !(light > 0.0 && light.is_finite()) {
            return Err(Flag::NoLight);
        }
        // The squared light less the background of every lag is the sum of the lags.
        let background = self.background(acf);
        let wanted = self.settings.acf_share
            * match self.settings.share_of {
                ShareOf::Total => light * light - background * self.count,
                ShareOf::Maximum => self.most_enclosed(acf, background),
            };
        let mut sum = 0.0;
        let mut radius_square = None;
        let mut q = [0.0f64; 3];
        for lag in &self.lags {
            if radius_square.is_some_and(|square| lag.square > square) {
                break;
            }
            let value = light_of(lag, acf, background);
            sum += value;
            q[0] += value * f64::from(lag.dx * lag.dx);
            q[1] += value * f64::from(lag.dy * lag.dy);
            q[2] += value * f64::from(lag.dx * lag.dy);
            if radius_square.is_none() && sum >= wanted {
                radius_square = Some(lag.square);
            }
        }
        if sum.is_nan() || sum <= 0.0 {
            return Err(Flag::NoLight);
        }
        // A share of 1 may be missed by rounding: then everything is inside.
        let square = radius_square.or(self.lags.last().map(|lag| lag.square));
        Ok(Moments {
            xx: q[0] / sum,
            yy: q[1] / sum,
            xy: q[2] / sum,
            radius: f64::from(square.unwrap_or(0)).sqrt(),
        })
    }

    // Mean of the outermost lags, where it is to be subtracted: a pedestal of the deconvolved stamp, which clipping at zero
    // makes of noise, would enter the circle of 90 % of the light and make the shape rounder.
    fn background(&self, acf: &[f32]) -> f64 {
        if self.settings.background != Background::AcfEdge {
            return 0.0;
        }
        let (mut sum, mut count) = (0.0, 0.0);
        for lag in &self.lags {
            if lag.dx.abs().max(lag.dy) == self.reach as i32 {
                sum += light_of(lag, acf, 0.0);
                count += f64::from(lag.weight);
            }
        }
        sum / count
    }

    fn most_enclosed(&self, acf: &[f32], background: f64) -> f64 {
        let (mut sum, mut most) = (0.0, 0.0f64);
        for ring in self.lags.chunk_by(|a, b| a.square == b.square) {
            for lag in ring {
                sum += light_of(lag, acf, background);
            }
            most = most.max(sum);
        }
        most
    }
}

fn light_of(lag: &Lag, acf: &[f32], background: f64) -> f64 {
    f64::from(acf[lag.at as usize] * lag.weight) - background * f64::from(lag.weight)
}

// Mean of the frame of an n×n stamp; of all its pixels where it is too small to have an inside.
fn frame_mean(stamp: &[f32], n: usize) -> f64 {
    let inside = BORDER_PX..n.saturating_sub(BORDER_PX);
    let (mut sum, mut count) = (0.0, 0);
    for (at, &value) in stamp.iter().enumerate() {
        if !(inside.contains(&(at / n)) && inside.contains(&(at % n))) {
            sum += f64::from(value);
            count += 1;
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

    fn settings(acf: AcfKind, background: Background, acf_share: f64) -> ClippedShape {
        ClippedShape {
            acf,
            background,
            acf_share,
            share_of: ShareOf::Total,
            ellipticity: EllipticityType::Distortion,
        }
    }

    /// Every lag (dx, dy) with its value and how often it counts, by plain sums: a lag of n/2 of a circular one is its own
    /// opposite.
    fn lags_naive(kind: AcfKind, stamp: &Array2<f64>) -> Vec<(i64, i64, f64, f64)> {
        let n = stamp.nrows() as i64;
        let mut lags = Vec::new();
        let reach = match kind {
            AcfKind::Full => n - 1,
            AcfKind::Circular => n / 2,
        };
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let mut sum = 0.0;
                for ((y, x), value) in stamp.indexed_iter() {
                    let (mut y, mut x) = (y as i64 + dy, x as i64 + dx);
                    if kind == AcfKind::Circular {
                        (y, x) = (y.rem_euclid(n), x.rem_euclid(n));
                    }
                    let other = stamp.get((y as usize, x as usize));
                    sum += value * other.copied().unwrap_or(0.0);
                }
                let twice = |d: i64| kind == AcfKind::Circular && 2 * d.abs() == n;
                let weight = [dx, dy].map(|d| if twice(d) { 0.5 } else { 1.0 });
                lags.push((dx, dy, sum, weight[0] * weight[1]));
            }
        }
        lags
    }

    /// The moments by plain sums over all pairs of pixels, in f64, with the autocorrelation as an image of its
    /// own. `None` where there is no light.
    fn moments_naive(settings: &ClippedShape, stamp: &Array2<f64>) -> Option<Moments> {
        let n = stamp.nrows() as i64;
        let mut stamp = stamp.clone();
        if settings.background == Background::StampFrame {
            let frame = |y: usize, x: usize| {
                let edge = |k: usize| k < BORDER_PX || k + BORDER_PX >= n as usize;
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
        let mut lags = lags_naive(settings.acf, &stamp);
        let reach = lags.iter().map(|lag| lag.0).max()?;
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
        for n in [8, 11, 16, 19, 23, 32] {
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
                                share_of,
                                ..settings(acf, background, acf_share)
                            };
                            let plan = ClippedAcf::new(n, &settings);
                            let mut scratch = plan.scratch();
                            scratch.acf.fill(f32::NAN);
                            scratch.power.fill(f32::NAN);
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
                share_of: ShareOf::Maximum,
                ..settings(acf, background, 0.9)
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

    #[test]
    fn moments_without_light_have_no_distortion() {
        let plan = ClippedAcf::new(5, &settings(AcfKind::Full, Background::None, 0.9));
        assert_eq!(plan.moments(&[0.0; 45], 0.0), Err(Flag::NoLight));
        assert_eq!(plan.moments(&[0.0; 45], f64::NAN), Err(Flag::NoLight));
        let mut acf = [0.0; 45];
        acf[4] = 1.0;
        let point = plan.moments(&acf, 1.0).unwrap();
        assert_eq!(point.distortion(), Err(Flag::NoExtent));
        let elongated = Moments {
            xx: 5.0,
            yy: 3.0,
            xy: -1.0,
            radius: 4.0,
        };
        assert_eq!(elongated.distortion(), Ok(Distortion::new(0.25, -0.25)));
    }
}
