//! Multiplicative and additive bias of calibrated ellipticities, from pairs of simulated galaxies.
//!
//! Every galaxy of an image is drawn eight times: with its intrinsic ellipticity e under shears of
//! (γ, γ) and (−γ, −γ), with −e under (γ, −γ) and (−γ, γ), each with the same noise added and taken away.
//! Intrinsic shapes and noise cancel to second order, so that for each component
//!
//! ```text
//! m_i = (⟨e_i⟩₊ − ⟨e_i⟩₋)/2γ_i − 1,   c_i = (⟨e_i⟩₊ + ⟨e_i⟩₋)/2,
//! ```
//!
//! The error of m is far smaller than the scatter of a galaxy suggests. One component of shear also changes the other
//! component of an elliptical galaxy. This effect is the same for e and −e, so it cancels too.
//!
//! As in the simulated sets, lensing does not change the flux of a galaxy.

use serde::{Deserialize, Serialize};
use shearq_measure::{Measurement, Measurer, Worker};
use shearq_quantities::Shear;
use shearq_submissions::Calibration;

use shearq_pipeline::PipelineError;
use shearq_pipeline::data::run::nan_for_null;
use shearq_pipeline::engine::{self, Progress};
use shearq_pipeline::run::{RowJob, feed, measure_strip};
use shearq_pipeline::simulate::place;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{ImageFields, STAMP, SetSimulator, Version};

/// Shear of each component.
pub const SHEAR: f64 = 0.02;

/// Biases of a configuration on one kind of set.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ShearBias {
    /// Galaxies of which all versions were measured.
    pub galaxies: u64,
    /// Other galaxies, which m and c leave out.
    pub dropped: u64,
    /// Multiplicative bias per component.
    #[serde(deserialize_with = "nan_for_null")]
    pub m: [f64; 2],
    /// Standard errors.
    #[serde(deserialize_with = "nan_for_null")]
    pub m_error: [f64; 2],
    /// Additive bias per component.
    #[serde(deserialize_with = "nan_for_null")]
    pub c: [f64; 2],
    /// Standard errors.
    #[serde(deserialize_with = "nan_for_null")]
    pub c_error: [f64; 2],
    /// Additive bias along the ellipticity of the PSF, divided by this ellipticity; NaN for round PSFs.
    #[serde(deserialize_with = "nan_for_null")]
    pub leakage: f64,
    /// Standard error of the leakage.
    #[serde(deserialize_with = "nan_for_null")]
    pub leakage_error: f64,
}

/// The versions of a galaxy: signs of its intrinsic ellipticity, of both components of shear, and of its
/// noise.
const VERSIONS: [(f64, [f64; 2], f32); 8] = [
    (1.0, [1.0, 1.0], 1.0),
    (1.0, [-1.0, -1.0], 1.0),
    (-1.0, [1.0, -1.0], 1.0),
    (-1.0, [-1.0, 1.0], 1.0),
    (1.0, [1.0, 1.0], -1.0),
    (1.0, [-1.0, -1.0], -1.0),
    (-1.0, [1.0, -1.0], -1.0),
    (-1.0, [-1.0, 1.0], -1.0),
];
/// Their number.
const COUNT: f64 = VERSIONS.len() as f64;

/// Biases of each measurer on the galaxies of `images` of a set.
///
/// # Errors
/// If threads cannot be started.
pub fn biases(
    set: &SetSimulator,
    images: &[u32],
    measurers: &[Measurer],
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Vec<ShearBias>, PipelineError> {
    let n = set.grid().n;
    let mut sums = vec![BiasSums::default(); measurers.len()];
    engine::ordered(
        threads,
        |feeder| {
            // All versions have the size and noise of the galaxies of the set.
            feed(set, images, measurers, feeder)
        },
        || {
            let workers: Vec<Worker> = measurers.iter().map(Measurer::worker).collect();
            (RenderScratch::new(), workers)
        },
        |(render, workers), job| {
            let RowJob { fields, iy, .. } = &job;
            let mut versions = Vec::with_capacity(VERSIONS.len());
            for version in VERSIONS {
                let strip = draw(set, fields, *iy, version, render);
                versions.push(measure_strip(set, &job, strip, workers)?);
            }
            let found = (0..measurers.len()).map(|k| {
                let mut sums = BiasSums::default();
                for ix in 0..n {
                    let psf = fields.psf.at(ix, *iy).shape;
                    let galaxy = std::array::from_fn(|v| &versions[v][k].galaxies[ix]);
                    sums.add(galaxy, psf);
                }
                sums
            });
            Ok(found.collect())
        },
        |row: Vec<BiasSums>| {
            progress.advance(n as u64);
            for (sums, more) in sums.iter_mut().zip(row) {
                sums.merge(&more);
            }
            Ok(())
        },
    )?;
    Ok(sums
        .iter()
        .zip(measurers)
        .map(|(sums, measurer)| sums.bias(measurer.configuration().calibration()))
        .collect())
}

/// A strip of stamps of one version of a row's galaxies.
fn draw(
    set: &SetSimulator,
    fields: &ImageFields,
    iy: usize,
    (intrinsic, signs, noise): (f64, [f64; 2], f32),
    scratch: &mut RenderScratch,
) -> Vec<f32> {
    let n = set.grid().n;
    let gamma = Shear::new(signs[0] * SHEAR, signs[1] * SHEAR);
    let mut strip = vec![0.0; n * STAMP * STAMP];
    let mut stamp = vec![0.0; STAMP * STAMP];
    for ix in 0..n {
        let e = fields.intrinsic[(ix, iy)] * intrinsic;
        let version = Version {
            intrinsic: Shear::new(e.re, e.im),
            shear: gamma,
            noise,
        };
        set.draw_as(fields, (ix, iy), version, scratch, &mut stamp);
        place(&stamp, STAMP, ix, n, &mut strip);
    }
    strip
}

/// Mean and its error from sums.
#[derive(Debug, Clone, Copy, Default)]
struct Mean {
    sum: f64,
    square: f64,
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.sum += value;
        self.square += value * value;
    }

    fn merge(&mut self, other: &Self) {
        self.sum += other.sum;
        self.square += other.square;
    }

    fn value(&self, count: f64) -> f64 {
        self.sum / count
    }

    fn error(&self, count: f64) -> f64 {
        let mean = self.value(count);
        ((self.square / count - mean * mean).max(0.0) / (count - 1.0)).sqrt()
    }
}

/// Sums over galaxies.
#[derive(Debug, Clone, Default)]
struct BiasSums {
    galaxies: u64,
    dropped: u64,
    /// Derivative of the ellipticity with shear: half the difference between +γ and −γ, divided by γ.
    shear_response: [Mean; 2],
    /// The same minus the mean response over versions.
    surplus: [Mean; 2],
    /// Mean of all versions.
    offset: [Mean; 2],
    /// Offset times the PSF's ellipticity, over components.
    along: Mean,
    /// Square of the PSF's ellipticity.
    psf: Mean,
    /// Mean response over versions, per component.
    response: [Mean; 2],
}

impl BiasSums {
    fn add(&mut self, versions: [&Measurement; VERSIONS.len()], psf: Shear) {
        if versions.iter().any(|version| !version.flags.is_empty()) {
            self.dropped += 1;
            return;
        }
        self.galaxies += 1;
        let mut along = 0.0;
        for (k, psf) in [psf.e1, psf.e2].into_iter().enumerate() {
            let e = versions.map(|version| [version.e1, version.e2][k]);
            let with_shear = VERSIONS
                .iter()
                .zip(e)
                .map(|((_, signs, _), e)| signs[k] * e);
            let shear_response = with_shear.sum::<f64>() / (COUNT * SHEAR);
            let responses = versions
                .iter()
                .map(|version| version.response_diagonal()[k]);
            let response = responses.sum::<f64>() / COUNT;
            self.shear_response[k].add(shear_response);
            self.surplus[k].add(shear_response - response);
            self.response[k].add(response);
            let offset = e.iter().sum::<f64>() / COUNT;
            self.offset[k].add(offset);
            along += offset * psf;
        }
        self.along.add(along);
        self.psf.add(psf.e1 * psf.e1 + psf.e2 * psf.e2);
    }

    fn merge(&mut self, other: &Self) {
        self.galaxies += other.galaxies;
        self.dropped += other.dropped;
        for (mine, other) in [
            (&mut self.shear_response, &other.shear_response),
            (&mut self.surplus, &other.surplus),
            (&mut self.offset, &other.offset),
            (&mut self.response, &other.response),
        ] {
            mine[0].merge(&other[0]);
            mine[1].merge(&other[1]);
        }
        self.along.merge(&other.along);
        self.psf.merge(&other.psf);
    }

    fn bias(&self, calibration: Calibration) -> ShearBias {
        let count = self.galaxies as f64;
        let response = match calibration {
            Calibration::None => [1.0; 2],
            Calibration::Response => self.response.map(|mean| mean.value(count)),
        };
        let of = |means: &[Mean; 2]| {
            (
                [0, 1].map(|k| means[k].value(count) / response[k]),
                [0, 1].map(|k| means[k].error(count) / response[k]),
            )
        };
        let surplus = match calibration {
            Calibration::None => &self.shear_response,
            Calibration::Response => &self.surplus,
        };
        let ((mut m, m_error), (c, c_error)) = (of(surplus), of(&self.offset));
        if calibration == Calibration::None {
            m = m.map(|response| response - 1.0);
        }
        let psf = self.psf.value(count) * (response[0] + response[1]) / 2.0;
        ShearBias {
            galaxies: self.galaxies,
            dropped: self.dropped,
            m,
            m_error,
            c,
            c_error,
            leakage: self.along.value(count) / psf,
            leakage_error: self.along.error(count) / psf,
        }
    }
}

#[cfg(test)]
mod tests {
    use shearq_submissions::Registry;

    use super::*;
    use shearq_pipeline::engine::Quiet;
    use shearq_pipeline::run::measurers;
    use shearq_pipeline::simulate::simulator;
    use shearq_simulate::set::SimulationSettings;

    #[test]
    fn calibrated_ellipticities_recover_shear() {
        let registry = Registry::embedded().unwrap();
        let names = ["48/linear/star", "as-printed/23/raw/star"];
        let submissions = names.map(|name| registry.get(name).unwrap().configuration);
        let measurers = measurers(&submissions).unwrap();
        let simulator = simulator(2, SimulationSettings::new(19, 32)).unwrap();
        let found = biases(&simulator, &[1], &measurers, 2, &mut Quiet).unwrap();
        let (calibrated, raw) = (&found[0], &found[1]);
        assert_eq!((calibrated.galaxies, calibrated.dropped), (1024, 0));
        for k in 0..2 {
            // A thousand galaxies determine m to 0.002 and c to 0.0005. The response of the wrong component or of
            // distortions differs far more.
            assert!(calibrated.m_error[k] < 0.004, "{calibrated:?}");
            assert!(calibrated.c_error[k] < 0.001, "{calibrated:?}");
            let (m, c) = (calibrated.m[k], calibrated.c[k]);
            assert!(m.abs() < 4.0 * calibrated.m_error[k], "{calibrated:?}");
            assert!(c.abs() < 4.0 * calibrated.c_error[k], "{calibrated:?}");
            // The printed response is about a half, and not corrected.
            assert!((-0.7..-0.3).contains(&raw.m[k]), "{raw:?}");
        }
        assert!(calibrated.leakage.abs() < 4.0 * calibrated.leakage_error);
    }
}
