//! Multiplicative and additive bias of calibrated ellipticities, from pairs of simulated galaxies.
//!
//! Every galaxy of an image is drawn four times with the same noise: with a shear of +γ and −γ on
//! both components, and with its intrinsic ellipticity e and −e. Between +γ and −γ intrinsic shapes
//! and noise cancel but for second order, so that
//!
//! ```text
//! m_i = (⟨e_i⟩₊ − ⟨e_i⟩₋)/2γ − 1,   c_i = (⟨e_i⟩₊ + ⟨e_i⟩₋)/2,
//! ```
//!
//! with m far better known than the scatter of one galaxy suggests.

use serde::{Deserialize, Serialize};
use shearq_scoring::Shear;
use shearq_submissions::Calibration;

use crate::pipeline::PipelineError;
use crate::pipeline::engine::{self, Progress};
use crate::pipeline::galaxy::{MeasureScratch, Measurement, Measurer};
use crate::pipeline::run::{RowJob, feed, measure_strip};
use crate::pipeline::simulate::place;
use crate::simulate::render::RenderScratch;
use crate::simulate::set::{ImageFields, STAMP, SetSimulator};

/// Shear of each component.
pub const SHEAR: f64 = 0.02;

/// Biases of a submission on one kind of set.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Bias {
    /// Galaxies whose four versions were all measured.
    pub galaxies: u64,
    /// Multiplicative bias per component.
    pub m: [f64; 2],
    /// Standard errors.
    pub m_error: [f64; 2],
    /// Additive bias per component.
    pub c: [f64; 2],
    /// Standard errors.
    pub c_error: [f64; 2],
    /// Additive bias along the ellipticity of the PSF, in units of it; NaN for round PSFs.
    pub leakage: f64,
    /// Its standard error.
    pub leakage_error: f64,
}

/// The four versions of a galaxy: factors of its intrinsic ellipticity and of the shear.
const VERSIONS: [(f64, f64); 4] = [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)];

/// Biases of each measurer on the galaxies of `images` of a set.
///
/// # Errors
/// Threads that cannot be started.
pub fn biases(
    set: &SetSimulator,
    images: &[u32],
    measurers: &[Measurer],
    threads: usize,
    progress: &mut dyn Progress,
) -> Result<Vec<Bias>, PipelineError> {
    let n = set.grid().n;
    let mut sums = vec![Sums::default(); measurers.len()];
    engine::ordered(
        threads,
        |feeder| {
            feed(set, images, feeder);
            Ok(())
        },
        || {
            let scratch: Vec<MeasureScratch> = measurers.iter().map(Measurer::scratch).collect();
            (RenderScratch::new(), scratch)
        },
        |(render, scratch), RowJob { fields, iy }| {
            let versions = VERSIONS.map(|version| {
                let strip = draw(set, &fields, iy, version, render);
                measure_strip(set, &fields, iy, strip, measurers, scratch)
            });
            let found = (0..measurers.len()).map(|k| {
                let mut sums = Sums::default();
                for ix in 0..n {
                    let psf = fields.psf.at(ix, iy).shape;
                    let galaxy = versions.each_ref().map(|rows| &rows[k].galaxies[ix]);
                    sums.add(galaxy, psf);
                }
                sums
            });
            Ok(found.collect())
        },
        |row: Vec<Sums>| {
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
        .map(|(sums, measurer)| sums.bias(measurer.submission().shape.calibration))
        .collect())
}

/// A strip of stamps of one version of a row's galaxies.
fn draw(
    set: &SetSimulator,
    fields: &ImageFields,
    iy: usize,
    (intrinsic, shear): (f64, f64),
    scratch: &mut RenderScratch,
) -> Vec<f32> {
    let n = set.grid().n;
    let gamma = Shear::new(shear * SHEAR, shear * SHEAR);
    let mut strip = vec![0.0; n * STAMP * STAMP];
    let mut stamp = vec![0.0; STAMP * STAMP];
    for ix in 0..n {
        let e = fields.intrinsic[(ix, iy)] * intrinsic;
        let lensed = (Shear::new(e.re, e.im), gamma);
        set.draw_as(fields, (ix, iy), lensed, scratch, &mut stamp);
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
struct Sums {
    galaxies: u64,
    /// Half the difference between +γ and −γ, over γ.
    slope: [Mean; 2],
    /// The same less the mean response over versions.
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

impl Sums {
    fn add(&mut self, versions: [&Measurement; 4], psf: Shear) {
        if versions.iter().any(|version| version.flag != 0) {
            return;
        }
        self.galaxies += 1;
        let mut along = 0.0;
        for (k, psf) in [psf.e1, psf.e2].into_iter().enumerate() {
            let e = versions.map(|version| [version.e1, version.e2][k]);
            let slope = (e[0] - e[1] + e[2] - e[3]) / (4.0 * SHEAR);
            let responses = versions.iter().map(|version| version.response[k]);
            let response = responses.sum::<f64>() / 4.0;
            self.slope[k].add(slope);
            self.surplus[k].add(slope - response);
            self.response[k].add(response);
            let offset = e.iter().sum::<f64>() / 4.0;
            self.offset[k].add(offset);
            along += offset * psf;
        }
        self.along.add(along);
        self.psf.add(psf.e1 * psf.e1 + psf.e2 * psf.e2);
    }

    fn merge(&mut self, other: &Self) {
        self.galaxies += other.galaxies;
        for (mine, other) in [
            (&mut self.slope, &other.slope),
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

    fn bias(&self, calibration: Calibration) -> Bias {
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
            Calibration::None => &self.slope,
            Calibration::Response => &self.surplus,
        };
        let ((mut m, m_error), (c, c_error)) = (of(surplus), of(&self.offset));
        if calibration == Calibration::None {
            m = m.map(|slope| slope - 1.0);
        }
        let psf = self.psf.value(count) * (response[0] + response[1]) / 2.0;
        Bias {
            galaxies: self.galaxies,
            m,
            m_error,
            c,
            c_error,
            leakage: self.along.value(count) / psf,
            leakage_error: self.along.error(count) / psf,
        }
    }
}
