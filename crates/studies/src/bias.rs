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

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use shearq_bias::{BiasError, Estimate, Layout, Row, UnitSums, estimate};
use shearq_measure::{Measurement, Measurer, Worker};
use shearq_quantities::Shear;
use shearq_submissions::Calibration;

use shearq_dataset::run::nan_for_null;
use shearq_dataset::threads::Progress;
use shearq_pipeline::PipelineError;
use shearq_pipeline::engine;
use shearq_pipeline::run::SimulatedSessions;
use shearq_simulate::render::RenderScratch;
use shearq_simulate::set::{ImageFields, SetSimulator, Version};

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
    #[serde(deserialize_with = "nan_for_null")]
    pub m_error: [f64; 2],
    /// Additive bias per component.
    #[serde(deserialize_with = "nan_for_null")]
    pub c: [f64; 2],
    #[serde(deserialize_with = "nan_for_null")]
    pub c_error: [f64; 2],
    /// Additive bias along the ellipticity of the PSF, divided by this ellipticity; NaN for round PSFs.
    #[serde(deserialize_with = "nan_for_null")]
    pub leakage: f64,
    #[serde(deserialize_with = "nan_for_null")]
    pub leakage_error: f64,
}

// The versions of a galaxy: signs of its intrinsic ellipticity, of both components of shear, and of its
// noise.
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

/// Biases of each measurer on the galaxies of `images` of a set.
pub fn biases(
    set: &SetSimulator,
    images: &[u32],
    measurers: &[Measurer],
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Vec<ShearBias>, PipelineError> {
    let n = set.grid().n;
    let empty = || -> Vec<BiasSums> {
        let calibrations = measurers
            .iter()
            .map(|own| own.configuration().calibration());
        calibrations
            .map(|calibration| BiasSums::new(calibration, images.len()))
            .collect()
    };
    let mut sums = empty();
    engine::ordered(
        threads,
        |feeder| {
            for &image in images {
                // All versions have the size and noise of the galaxies of the set.
                let opened = SimulatedSessions::new(set, image, measurers, feeder.ahead())?;
                let opened = Arc::new(opened);
                for iy in 0..n {
                    if !feeder.push((Arc::clone(&opened), iy)) {
                        return Ok(());
                    }
                }
            }
            Ok(())
        },
        || {
            let workers: Vec<Worker> = measurers.iter().map(Measurer::worker).collect();
            (RenderScratch::new(), workers)
        },
        |(render, workers), (image, iy)| {
            let fields = &image.fields;
            let mut versions = Vec::with_capacity(VERSIONS.len());
            for version in VERSIONS {
                let strip = draw(set, fields, iy, version, render);
                versions.push(image.measure(workers, iy, strip)?);
            }
            let mut found = empty();
            for (k, sums) in found.iter_mut().enumerate() {
                for (ix, psf) in (0..n).map(|ix| (ix, fields.psf.at(ix, iy).shape)) {
                    let galaxy = std::array::from_fn(|v| &versions[v][k][ix]);
                    sums.add((fields.image, (iy * n + ix) as u64), galaxy, psf);
                }
            }
            Ok(found)
        },
        |row: Vec<BiasSums>| {
            progress.advance(n as u64);
            for (sums, more) in sums.iter_mut().zip(row) {
                sums.merge(more).expect("all sums have one layout");
            }
            Ok(())
        },
    )?;
    Ok(sums.into_iter().map(BiasSums::bias).collect())
}

// A strip of stamps of one version of a row's galaxies.
fn draw(
    set: &SetSimulator,
    fields: &ImageFields,
    iy: usize,
    (intrinsic, signs, noise): (f64, [f64; 2], f32),
    scratch: &mut RenderScratch,
) -> Vec<f32> {
    let shear = Shear::new(signs[0] * SHEAR, signs[1] * SHEAR);
    set.strip(|ix, stamp| {
        let e = fields.intrinsic[(ix, iy)] * intrinsic;
        let version = Version {
            intrinsic: Shear::new(e.re, e.im),
            shear,
            size: 1.0,
            noise,
        };
        set.draw_as(fields, (ix, iy), version, scratch, stamp);
    })
}

#[derive(Debug, Clone)]
struct BiasSums {
    galaxies: u64,
    dropped: u64,
    // Of all versions of each galaxy, which is a unit.
    units: UnitSums,
    // The mean ellipticity of all versions along the PSF, per ellipticity of the PSF.
    leakage: UnitSums,
    // Whether ellipticities are divided by the mean response.
    calibrated: bool,
}

impl BiasSums {
    fn new(calibration: Calibration, images: usize) -> Self {
        let sums = UnitSums::new(Layout::default(), 1, images);
        BiasSums {
            galaxies: 0,
            dropped: 0,
            leakage: sums.clone(),
            units: sums,
            calibrated: calibration == Calibration::Response,
        }
    }

    // Adds galaxy `key` of an image.
    fn add(
        &mut self,
        (image, key): (u32, u64),
        versions: [&Measurement; VERSIONS.len()],
        psf: Shear,
    ) {
        if versions.iter().any(|version| !version.flags.is_empty()) {
            self.dropped += 1;
            return;
        }
        self.galaxies += 1;
        for ((_, signs, _), version) in VERSIONS.iter().zip(versions) {
            let [r11, r22] = match self.calibrated {
                true => version.response_diagonal(),
                false => [1.0; 2],
            };
            let row = Row {
                e: [version.e1, version.e2],
                weight: 1.0,
                response: [[r11, 0.0], [0.0, r22]],
                g: signs.map(|sign| sign * SHEAR),
                ..Row::default()
            };
            self.units.add(image, key, 0, &row);
            // Regression through zero: Σ e·p over Σ R p².
            let p = [psf.e1, psf.e2];
            let along = Row {
                e: [0, 1].map(|k| (p[0] * row.e[0] + p[1] * row.e[1]) * f64::from(1 - k)),
                response: [
                    [(r11 + r22) / 2.0 * (p[0] * p[0] + p[1] * p[1]), 0.0],
                    [0.0, 1.0],
                ],
                ..row
            };
            self.leakage.add(image, key, 0, &along);
        }
    }

    fn merge(&mut self, other: Self) -> Result<(), BiasError> {
        self.galaxies += other.galaxies;
        self.dropped += other.dropped;
        self.units.merge(other.units)?;
        self.leakage.merge(other.leakage)
    }

    // The biases; NaN without an estimate.
    fn bias(self) -> ShearBias {
        let found = estimate(&self.units, 0, true).ok();
        let leakage = estimate(&self.leakage, 0, false).ok();
        let of = |found: &Option<Estimate>, key: &str| {
            let value = found.as_ref().and_then(|found| found.value(key));
            value.map_or([f64::NAN; 2], |found| [found.value, found.error])
        };
        let [m1, m2, c1, c2] = ["m1", "m2", "c1", "c2"].map(|key| of(&found, key));
        let [leakage, leakage_error] = of(&leakage, "c1");
        ShearBias {
            galaxies: self.galaxies,
            dropped: self.dropped,
            m: [m1[0], m2[0]],
            m_error: [m1[1], m2[1]],
            c: [c1[0], c2[0]],
            c_error: [c1[1], c2[1]],
            leakage,
            leakage_error,
        }
    }
}

#[cfg(test)]
mod tests {
    use shearq_submissions::Registry;

    use super::*;
    use shearq_dataset::threads::Quiet;
    use shearq_pipeline::run::measurers;
    use shearq_pipeline::simulate::simulator;
    use shearq_simulate::set::SimulationSettings;

    #[test]
    fn calibrated_ellipticities_recover_shear() {
        let registry = Registry::embedded().unwrap();
        let names = ["48/linear/star", "as-printed/23/raw/star"];
        let configurations = names.map(|name| registry.get(name).unwrap().configuration);
        let measurers = measurers(&configurations).unwrap();
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
