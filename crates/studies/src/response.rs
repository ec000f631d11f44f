//! Regression of measured on true ellipticities, galaxy by galaxy.

use serde::{Deserialize, Serialize};
use shearq_measure::Measurement;
use shearq_quantities::Shear;

use shearq_dataset::run::nan_for_null;

/// Least squares of measured against true ellipticities, component by component:
/// e = slope·ε + offset + noise.
#[derive(Debug, Clone, Copy, Default)]
pub struct Regression {
    galaxies: u64,
    flagged: u64,
    components: [PairSums; 2],
}

#[derive(Debug, Clone, Copy, Default)]
struct PairSums {
    t: f64,
    e: f64,
    tt: f64,
    te: f64,
    ee: f64,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Response {
    pub galaxies: u64,
    /// Galaxies left out because they are flagged.
    pub flagged: u64,
    /// Slope of the reported ellipticity against the true shear-type one, per component.
    #[serde(deserialize_with = "nan_for_null")]
    pub slope: [f64; 2],
    #[serde(deserialize_with = "nan_for_null")]
    pub slope_error: [f64; 2],
    /// Reported ellipticity of a round galaxy.
    #[serde(deserialize_with = "nan_for_null")]
    pub offset: [f64; 2],
    #[serde(deserialize_with = "nan_for_null")]
    pub offset_error: [f64; 2],
    /// Standard deviation of the ellipticity about the line, divided by the slope: the scatter of a
    /// calibrated ε.
    #[serde(deserialize_with = "nan_for_null")]
    pub scatter: [f64; 2],
}

impl Regression {
    pub fn add<'a>(&mut self, galaxies: impl Iterator<Item = (Shear, &'a Measurement)>) {
        for (truth, measured) in galaxies {
            if !measured.flags.is_empty() {
                self.flagged += 1;
                continue;
            }
            self.galaxies += 1;
            let pairs = [(truth.e1, measured.e1), (truth.e2, measured.e2)];
            for (sums, (t, e)) in self.components.iter_mut().zip(pairs) {
                sums.t += t;
                sums.e += e;
                sums.tt += t * t;
                sums.te += t * e;
                sums.ee += e * e;
            }
        }
    }

    /// Divides the measured ellipticities by a response, which is known only after the last galaxy.
    pub fn divide(&mut self, response: [f64; 2]) {
        for (sums, response) in self.components.iter_mut().zip(response) {
            sums.e /= response;
            sums.te /= response;
            sums.ee /= response * response;
        }
    }

    /// The fit; not a number if there are too few galaxies.
    pub fn response(&self) -> Response {
        let n = self.galaxies as f64;
        let mut response = Response {
            galaxies: self.galaxies,
            flagged: self.flagged,
            ..Response::default()
        };
        for (k, s) in self.components.iter().enumerate() {
            let (mean_t, mean_e) = (s.t / n, s.e / n);
            let tt = s.tt / n - mean_t * mean_t;
            let te = s.te / n - mean_t * mean_e;
            let ee = s.ee / n - mean_e * mean_e;
            let slope = te / tt;
            let noise = ((ee - slope * te) * n / (n - 2.0)).max(0.0).sqrt();
            response.slope[k] = slope;
            response.offset[k] = mean_e - slope * mean_t;
            response.slope_error[k] = noise / (n * tt).sqrt();
            response.offset_error[k] = noise / n.sqrt();
            response.scatter[k] = noise / slope.abs();
        }
        response
    }
}

impl Response {
    /// Root mean square over the components of the calibrated scatter.
    pub fn rms_scatter(&self) -> f64 {
        (self.scatter.iter().map(|v| v * v).sum::<f64>() / 2.0).sqrt()
    }

    /// Standard error of [`Response::rms_scatter`] for Gaussian noise.
    ///
    /// The scatter of a component is noise/|slope|, and the errors of the two are independent in a regression:
    /// that of the noise is 1/√(2N) of itself. Both components together have, squared and relative to the
    /// rms, 1/(4N) + (relative error of the slope)²/2.
    pub fn rms_scatter_error(&self) -> f64 {
        let of_noise = 1.0 / (2.0 * self.galaxies as f64);
        let variance = |k: usize| {
            let of_slope = (self.slope_error[k] / self.slope[k]).powi(2);
            self.scatter[k].powi(4) * (of_noise + of_slope)
        };
        (variance(0) + variance(1)).sqrt() / (2.0 * self.rms_scatter())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};
    use shearq_measure::{Flag, Flags};

    #[test]
    fn records_of_nothing_measured_can_be_read_back() {
        let empty = Regression::default().response();
        let text = serde_json::to_string(&empty).unwrap();
        let read: Response = serde_json::from_str(&text).unwrap();
        assert!(read.slope[0].is_nan() && read.scatter[1].is_nan());
        assert_eq!(serde_json::to_string(&read).unwrap(), text);
    }

    // A galaxy without flags.
    fn measured(e1: f64, e2: f64) -> Measurement {
        let mut galaxy = Measurement::flagged(Flags::NONE);
        (galaxy.e1, galaxy.e2) = (e1, e2);
        galaxy
    }

    #[test]
    fn the_error_of_the_scatter_covers_repeated_draws() {
        const DRAWS: usize = 600;
        const GALAXIES: usize = 2_000;
        const SHAPES: f64 = 0.14;
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut normal = |scale: f64| -> f64 {
            let draw: f64 = StandardNormal.sample(&mut rng);
            scale * draw
        };
        // Scatter as at S/N 10, 20 and 40, and slopes that differ between the components.
        for scatter in [0.38, 0.18, 0.07] {
            let (mut sum, mut squares, mut variances) = (0.0, 0.0, 0.0);
            for _ in 0..DRAWS {
                let mut regression = Regression::default();
                for _ in 0..GALAXIES {
                    let truth = Shear::new(normal(SHAPES), normal(SHAPES));
                    let e1 = 0.5 * (truth.e1 + normal(scatter));
                    let e2 = 0.8 * (truth.e2 + normal(scatter));
                    regression.add([(truth, &measured(e1, e2))].into_iter());
                }
                let found = regression.response();
                sum += found.rms_scatter();
                squares += found.rms_scatter().powi(2);
                variances += found.rms_scatter_error().powi(2);
            }
            let (n, galaxies) = (DRAWS as f64, GALAXIES as f64);
            let spread = (squares / n - (sum / n).powi(2)).sqrt();
            let stated = (variances / n).sqrt();
            // Three errors of the spread of 600 draws, which is known to 2.9 %.
            assert!(
                (stated / spread - 1.0).abs() < 0.09,
                "{scatter}: {stated} {spread}"
            );
            let expected = (0.25 / galaxies + (scatter / SHAPES).powi(2) / (2.0 * galaxies)).sqrt();
            assert!(
                (stated / scatter / expected - 1.0).abs() < 0.05,
                "{scatter}: {stated}"
            );
        }
    }

    #[test]
    fn a_line_with_noise_is_found_and_flagged_galaxies_are_left_out() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut normal = |scale: f64| -> f64 {
            let draw: f64 = StandardNormal.sample(&mut rng);
            scale * draw
        };
        let mut regression = Regression::default();
        let galaxies: Vec<(Shear, Measurement)> = (0..40_000)
            .map(|k| {
                let truth = Shear::new(normal(0.14), normal(0.14));
                let mut galaxy = measured(
                    0.5 * truth.e1 + 0.01 + normal(0.06),
                    0.8 * truth.e2 - 0.02 + normal(0.06),
                );
                if k % 10 == 0 {
                    galaxy.flags = Flag::NoLight.into();
                }
                (truth, galaxy)
            })
            .collect();
        regression.add(galaxies.iter().map(|(t, m)| (*t, m)));
        let found = regression.response();
        assert_eq!((found.galaxies, found.flagged), (36_000, 4_000));
        for (k, (slope, offset)) in [(0.5, 0.01), (0.8, -0.02)].into_iter().enumerate() {
            // Five of the errors that the fit itself states, and 1 % on them and on the scatter
            // (1/√(2·36000) is 0.4 %).
            assert!((found.slope[k] - slope).abs() < 5.0 * found.slope_error[k]);
            assert!((found.offset[k] - offset).abs() < 5.0 * found.offset_error[k]);
            let expected = 0.06 / (0.14 * 36_000f64.sqrt());
            assert!((found.slope_error[k] / expected - 1.0).abs() < 0.02);
            assert!((found.scatter[k] / (0.06 / slope) - 1.0).abs() < 0.02);
        }
    }
}
