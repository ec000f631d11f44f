//! Clipping of the autocorrelation and its quadrupole moments.

use shearq_quantities::Distortion;
use shearq_submissions::{AcfKind, Background, ClippedShape, ShareOf};

use crate::measurement::Flag;

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
    /// Place in the autocorrelation.
    at: u32,
    dx: i32,
    dy: i32,
    /// dx² + dy².
    square: i32,
    /// 2 for a lag that stands for its opposite too, 1 for zero lag; half of it for each component of n/2
    /// where lags wrap around, of which −n/2 is the same.
    weight: f32,
}

/// How the light of the ACF is read.
#[derive(Clone, Copy)]
struct ReadAs {
    acf: AcfKind,
    background: Background,
    share_of: ShareOf,
}

/// Moments of the ACF of n×n stamps inside the radius that encloses a share of its light.
///
/// Lags of equal distance are taken or left together, so that the clipped region is as round as the
/// pixel grid allows and has no preferred direction.
#[derive(Debug, Clone)]
pub struct ClippedMoments {
    share: f64,
    share_of: ShareOf,
    lags: Vec<Lag>,
    /// Number of lags, of both half planes.
    count: f64,
    /// Largest component of a lag whose mean is subtracted from all, where it is.
    edge: Option<i32>,
}

impl ClippedMoments {
    /// Plans for n×n stamps and a `share`, above 0 and at most 1, of all the light of the full ACF.
    pub fn new(n: usize, share: f64) -> Self {
        let full = ReadAs {
            acf: AcfKind::Full,
            background: Background::None,
            share_of: ShareOf::Total,
        };
        Self::read(n, share, full)
    }

    /// Plans for n×n stamps and a submission's settings.
    pub(super) fn of(n: usize, settings: &ClippedShape) -> Self {
        let &ClippedShape {
            acf,
            background,
            acf_share,
            share_of,
            ellipticity: _,
        } = settings;
        let reading = ReadAs {
            acf,
            background,
            share_of,
        };
        Self::read(n, acf_share, reading)
    }

    fn read(n: usize, share: f64, reading: ReadAs) -> Self {
        let side = n as i32;
        let circular = reading.acf == AcfKind::Circular;
        let reach = if circular { side / 2 } else { side - 1 };
        let mut lags = Vec::with_capacity(n * (2 * n - 1));
        for dy in 0..=reach {
            for dx in -reach..=reach {
                if dy == 0 && dx < 0 {
                    continue;
                }
                let half = |d: i32| {
                    if circular && 2 * d.abs() == side {
                        0.5
                    } else {
                        1.0
                    }
                };
                let both = if dx == 0 && dy == 0 { 1.0 } else { 2.0 };
                lags.push(Lag {
                    at: (dy * (2 * side - 1) + dx + side - 1) as u32,
                    dx,
                    dy,
                    square: dx * dx + dy * dy,
                    weight: both * half(dx) * half(dy),
                });
            }
        }
        lags.sort_by_key(|lag| (lag.square, lag.dy, lag.dx));
        ClippedMoments {
            share,
            share_of: reading.share_of,
            count: lags.iter().map(|lag| f64::from(lag.weight)).sum(),
            edge: (reading.background == Background::AcfEdge).then_some(reach),
            lags,
        }
    }

    /// Mean of the outermost lags, where it is to be subtracted.
    fn background(&self, acf: &[f32]) -> f64 {
        let Some(edge) = self.edge else { return 0.0 };
        let (mut sum, mut count) = (0.0, 0.0);
        for lag in &self.lags {
            if lag.dx.abs().max(lag.dy) == edge {
                sum += f64::from(acf[lag.at as usize] * lag.weight);
                count += f64::from(lag.weight);
            }
        }
        sum / count
    }

    /// The most light that any radius encloses.
    fn most_enclosed(&self, acf: &[f32], background: f64) -> f64 {
        let (mut sum, mut most) = (0.0, 0.0f64);
        for ring in self.lags.chunk_by(|a, b| a.square == b.square) {
            for lag in ring {
                sum += f64::from(lag.weight) * (f64::from(acf[lag.at as usize]) - background);
            }
            most = most.max(sum);
        }
        most
    }

    /// Moments of `acf`, laid out as [`super::Autocorrelation`] writes it; `light` is the sum of the
    /// stamp, whose square is the sum of the ACF.
    ///
    /// # Errors
    /// Where there is no light.
    pub fn measure(&self, acf: &[f32], light: f64) -> Result<Moments, Flag> {
        if !(light > 0.0 && light.is_finite()) {
            return Err(Flag::NoLight);
        }
        let background = self.background(acf);
        let wanted = match self.share_of {
            ShareOf::Total => self.share * light * light - self.share * background * self.count,
            ShareOf::Maximum => self.share * self.most_enclosed(acf, background),
        };
        let mut sum = 0.0;
        let mut radius_square = None;
        let mut q = [0.0f64; 3];
        for lag in &self.lags {
            match radius_square {
                Some(square) if lag.square > square => break,
                _ => {}
            }
            let value = f64::from(acf[lag.at as usize] * lag.weight);
            let value = value - background * f64::from(lag.weight);
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
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shape::Autocorrelation;

    /// Gaussian blob of the given second moments on an n×n stamp, off centre.
    fn blob(n: usize, qxx: f64, qyy: f64, qxy: f64) -> Vec<f32> {
        let det = qxx * qyy - qxy * qxy;
        let (cx, cy) = ((n as f64 - 1.0) / 2.0 + 0.4, (n as f64 - 1.0) / 2.0 - 0.2);
        (0..n * n)
            .map(|k| {
                let (y, x) = ((k / n) as f64 - cy, (k % n) as f64 - cx);
                (-(x * x * qyy + y * y * qxx - 2.0 * x * y * qxy) / (2.0 * det)).exp() as f32
            })
            .collect()
    }

    fn measure(n: usize, share: f64, stamp: &[f32]) -> Moments {
        let plan = Autocorrelation::new(n);
        let mut acf = vec![0.0; plan.len()];
        plan.compute(stamp, &mut plan.scratch(), &mut acf).unwrap();
        let light = stamp.iter().map(|&v| f64::from(v)).sum();
        ClippedMoments::new(n, share).measure(&acf, light).unwrap()
    }

    #[test]
    fn unclipped_moments_are_twice_those_of_the_stamp() {
        let n = 32;
        let moments = measure(n, 1.0, &blob(n, 5.0, 3.0, 1.0));
        // Sampling and truncation at five sigma: 1e-4.
        assert!((moments.xx / 10.0 - 1.0).abs() < 1e-4);
        assert!((moments.yy / 6.0 - 1.0).abs() < 1e-4);
        assert!((moments.xy / 2.0 - 1.0).abs() < 1e-4);
        let chi = moments.distortion().unwrap();
        assert!((chi.e1 - 0.25).abs() < 1e-4 && (chi.e2 - 0.25).abs() < 1e-4);
    }

    #[test]
    fn signs_and_axes_are_those_of_the_stamp() {
        for share in [0.5, 0.9] {
            let along_x = measure(23, share, &blob(23, 6.0, 3.0, 0.0))
                .distortion()
                .unwrap();
            assert!(along_x.e1 > 0.05 && along_x.e2.abs() < 1e-5);
            let diagonal = measure(23, share, &blob(23, 4.0, 4.0, 1.5))
                .distortion()
                .unwrap();
            assert!(diagonal.e2 > 0.05 && diagonal.e1.abs() < 1e-5);
        }
    }

    #[test]
    fn the_radius_encloses_the_share_of_the_light() {
        // The ACF of a round Gaussian is one of twice the variance: 1 − exp(−r²/2σ²) inside r.
        let sigma_square: f64 = 6.0;
        let moments = measure(32, 0.9, &blob(32, 3.0, 3.0, 0.0));
        let expected = (-2.0 * sigma_square * 0.1f64.ln()).sqrt();
        assert!(
            (moments.radius - expected).abs() < 0.5,
            "{}",
            moments.radius
        );
    }

    #[test]
    fn stamps_without_light_are_refused() {
        let moments = ClippedMoments::new(5, 0.9);
        assert_eq!(moments.measure(&[0.0; 45], 0.0), Err(Flag::NoLight));
        assert_eq!(moments.measure(&[0.0; 45], f64::NAN), Err(Flag::NoLight));
        let mut acf = [0.0; 45];
        acf[4] = 1.0;
        let point = moments.measure(&acf, 1.0).unwrap();
        assert_eq!(point.distortion(), Err(Flag::NoExtent));
    }
}
