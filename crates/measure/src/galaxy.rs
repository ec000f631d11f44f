//! Plans of measurements.

use std::fmt;
use std::sync::Arc;

use shearq_submissions::{Configuration, ConfigurationError, NoiseSource, Registry};

use crate::denoise::WaveletWiener;
use crate::error::MeasureError;
use crate::method::MethodPlan;
use crate::noise::{NoisePlan, Survey};
use crate::plan::Plan;
use crate::psf::StarLooker;
use crate::sky::Subtraction;
use crate::worker::Worker;

/// The plan of a measurement, for one configuration and one size of stamps. Measuring does not change it, so it serves
/// all threads. Each thread has a [`Worker`]. Clones share the plan.
#[derive(Clone)]
pub struct Measurer {
    plan: Arc<Plan>,
}

impl fmt::Debug for Measurer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Measurer")
            .field("configuration", &self.plan.configuration)
            .field("full", &self.plan.full)
            .finish_non_exhaustive()
    }
}

impl Measurer {
    /// Plans for full stamps of `full` pixels a side.
    ///
    /// If the stamps are odd and the configuration's stamp size is even, or the reverse, the linear method takes a pixel
    /// more of the stamps and a pixel less of PSFs. So galaxies stay in the middle of its window.
    ///
    /// # Errors
    /// If a setting is out of its range, or the stamps are smaller than the configuration needs.
    pub fn new(configuration: &Configuration, full: usize) -> Result<Self, MeasureError> {
        configuration.validate().map_err(ConfigurationError::from)?;
        let n = configuration.stamp.size;
        if full < n {
            let expected = format!(
                "at least {n} × {n}, as submission {} needs",
                configuration.name
            );
            return Err(MeasureError::square("stamps", (full, full), expected));
        }
        let mut configuration = configuration.clone();
        if configuration.linear().is_some() && full % 2 != n % 2 {
            configuration.stamp.size += 1;
            configuration.psf.size -= 1;
            configuration.validate().map_err(ConfigurationError::from)?;
        }
        let (configuration, n) = (&configuration, configuration.stamp.size);
        let plan = Plan {
            full,
            n,
            denoise: configuration
                .wavelet()
                .map(|settings| WaveletWiener::new(full, settings)),
            method: MethodPlan::new(configuration, n)?,
            noise: match configuration.noise {
                NoiseSource::Image { correlation, sky } => {
                    Some(NoisePlan::new(full, correlation)?.with_sky(sky))
                }
                NoiseSource::Header | NoiseSource::Border { .. } => None,
            },
            configuration: configuration.clone(),
        };
        Ok(Measurer {
            plan: Arc::new(plan),
        })
    }

    /// The same for the name of a configuration or the path of a settings file.
    ///
    /// # Errors
    /// If there is no such configuration, it is not valid, or as [`Measurer::new`].
    pub fn named(configuration: &str, full: usize) -> Result<Self, MeasureError> {
        Measurer::new(
            &Registry::embedded()?.get(configuration)?.configuration,
            full,
        )
    }

    /// The configuration.
    pub fn configuration(&self) -> &Configuration {
        &self.plan.configuration
    }

    /// The plan for measuring the noise of an image on its stamps, if the configuration requires that.
    pub(crate) fn noise_plan(&self) -> Option<&NoisePlan> {
        self.plan.noise.as_ref()
    }

    /// What is subtracted from stamps of an image with this survey.
    pub(crate) fn subtraction(&self, survey: Option<&Survey>) -> Subtraction {
        self.plan.subtraction(survey)
    }

    /// Buffers to examine the stars of an image with one per galaxy; `None` if the configuration uses stars as they are.
    pub(crate) fn star_looker(&self) -> Option<StarLooker> {
        let configuration = self.configuration();
        configuration.linear()?;
        Some(StarLooker::new(configuration.psf_cut(), self.full()))
    }

    /// Pixels a side of the full stamps.
    pub fn full(&self) -> usize {
        self.plan.full
    }

    /// Buffers for one thread.
    pub fn worker(&self) -> Worker {
        Worker::new(Arc::clone(&self.plan))
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use shearq_submissions::{Method, Neighbours};

    use super::*;
    use crate::flag::Flag;
    use crate::worker::ImageNoise;

    const N: usize = 48;

    /// A Gaussian of covariance (xx, yy) and flux one, about the middle of the stamp.
    fn gaussian(n: usize, xx: f64, yy: f64) -> Array2<f64> {
        let middle = (n as f64 - 1.0) / 2.0;
        Array2::from_shape_fn((n, n), |(y, x)| {
            let (x, y) = (x as f64 - middle, y as f64 - middle);
            (-0.5 * (x * x / xx + y * y / yy)).exp() / (std::f64::consts::TAU * (xx * yy).sqrt())
        })
    }

    #[test]
    fn neighbours_flag_a_galaxy_or_are_kept() {
        let named = Measurer::named("48/linear/star", N).unwrap();
        let mut configuration = named.configuration().clone();
        let Method::Linear(linear) = &mut configuration.method else {
            panic!("a linear configuration");
        };
        linear.shape.neighbours = Neighbours::Keep;
        let keeping = Measurer::new(&configuration, N).unwrap();
        let psf = gaussian(32, 2.0, 2.0);
        let psf = &psf / psf.sum();
        let galaxy = gaussian(N, 8.0, 8.0) * 100.0;
        // The same galaxy once more, 8 px to the left.
        let pair = Array2::from_shape_fn((N, N), |(y, x)| {
            galaxy[(y, x)] + galaxy.get((y, x + 8)).unwrap_or(&0.0)
        });
        let measure = |measurer: &Measurer, stamp: &Array2<f64>| {
            let mut worker = measurer.worker();
            let mut image = worker.image(ImageNoise::Level(0.1));
            let mut worker = image.psf(psf.view()).unwrap();
            worker.measure(stamp.view()).unwrap()
        };
        assert!(measure(&named, &pair).flags.contains(Flag::Neighbour));
        let kept = measure(&keeping, &pair);
        // The pair counts as one galaxy along x.
        assert!(kept.flags.is_empty() && kept.e1 > 0.2, "{kept:?}");
        // Without a neighbour both are the same.
        let [one, other] = [&named, &keeping].map(|measurer| measure(measurer, &galaxy));
        assert!(one.flags.is_empty() && one.e1 == other.e1 && one.e2 == other.e2);
    }

    #[test]
    fn noise_of_an_elliptical_psf_leaves_round_galaxies_round() {
        // Covariances in px²: a PSF of |e| = 0.05, along x and along y, and a small galaxy.
        let (long, short, own) = (2.31, 1.89, 3.0);
        let e = (long - short) / (long + short) / 2.0;
        let measurer = Measurer::named("48/linear/star", N).unwrap();
        let sides = [(long, short), (short, long)].map(|(xx, yy)| {
            let psf = gaussian(32, xx, yy);
            let psf = &psf / psf.sum();
            let galaxy = gaussian(N, own + xx, own + yy);
            let strength = galaxy.iter().map(|v| v * v).sum::<f64>().sqrt();
            // S/N 10.
            (psf, galaxy * (10.0 / strength))
        });
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let half = 3f64.sqrt();
        let [first, second] = sides;
        let mut worker = measurer.worker();
        let mut leaks = Vec::new();
        let mut response = 0.0;
        for _ in 0..3000 {
            let noise = Array2::from_shape_fn((N, N), |_| rng.random_range(-half..half));
            let mut mean = |(psf, galaxy): &(Array2<f64>, Array2<f64>)| {
                let mut image = worker.image(ImageNoise::Level(1.0));
                let mut worker = image.psf(psf.view()).unwrap();
                // Noise of both signs leaves the even part of its effect.
                let [a, b] = [1.0, -1.0].map(|sign| {
                    let stamp = &*galaxy + &(&noise * sign);
                    worker.measure(stamp.view()).unwrap()
                });
                response += 0.25 * (a.response_diagonal()[0] + b.response_diagonal()[0]);
                0.5 * (a.e1 + b.e1)
            };
            leaks.push(0.5 * (mean(&first) - mean(&second)));
        }
        let count = leaks.len() as f64;
        let scale = e * response / count;
        let mean = leaks.iter().sum::<f64>() / count;
        let square = leaks.iter().map(|leak| (leak - mean).powi(2)).sum::<f64>();
        let (leak, error) = (mean / scale, square.sqrt() / count / scale);
        // Without looking at the field of the turned PSF it is −0.014.
        assert!(
            error < 2.5e-3 && leak.abs() < 2.5 * error,
            "{leak} ± {error}"
        );
    }
}
