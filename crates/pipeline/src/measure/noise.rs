//! Checks of the noise of an image before it is measured.

use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;

use shearq_files::FileError;
use shearq_files::fits::ImageReader;
use shearq_measure::{MeasureError, Measurer, NoisePlan, NoiseSurvey, Survey, Warning, strip};
use shearq_submissions::NoiseSource;

use super::head::ImageHead;
use super::some_rows;
use crate::PipelineError;
use crate::data::mosaic::Mosaic;

/// Largest distance along each axis at which white noise is tested for correlation, in pixels.
const CORRELATION: usize = 2;
/// Least relative difference between NOISESIG and the measured noise that is reported.
const LEAST_DIFFERENCE: f64 = 0.01;
/// The same in units of its standard error.
const CLEAR: f64 = 5.0;

/// Surveys the stamps that `plan` chooses, and goes back to the first row; `None` if all of them have too many missing
/// pixels.
///
/// # Errors
/// If stamps cannot be read, or have no border of noise.
pub(super) fn survey(
    image: &mut ImageReader,
    path: &Path,
    mosaic: Mosaic,
    plan: &NoisePlan,
) -> Result<Option<Arc<Survey>>, PipelineError> {
    let Mosaic { columns, stamp, .. } = mosaic;
    let mut look = |mut survey: NoiseSurvey| {
        let rows = plan.rows(columns, mosaic.rows());
        some_rows::read(image, stamp, rows, |row, pixels| {
            let stamps = strip(&pixels, columns, stamp)?;
            for stamp in stamps.outer_iter().take(mosaic.of_row(row)) {
                survey.add(stamp)?;
            }
            Ok(ControlFlow::Continue(()))
        })?;
        Ok::<_, PipelineError>(survey)
    };
    let mut survey = look(plan.survey())?;
    if let Some(again) = survey.without_sky() {
        survey = look(again)?;
    }
    let found = survey.shared().map_err(|error| {
        if let MeasureError::Data(warning) = error {
            return FileError::new(path, warning);
        }
        let missing = match survey.incomplete() {
            0 => String::new(),
            count => format!(", {count} of them with missing pixels"),
        };
        let examined = survey.looked_at();
        let message = format!(
            "cannot measure the noise on the borders of {examined} stamp(s){missing} (expected two or more complete borders with pixels that differ by noise). Try: noise.source = \"border\", or \"header\" if NOISESIG is right"
        );
        FileError::new(path, message)
    })?;
    Ok(found)
}

/// A warning if the configuration treats noise as white that is correlated.
///
/// # Errors
/// As [`survey`], if the configuration measures the noise.
pub(super) fn correlation(
    image: &mut ImageReader,
    path: &Path,
    head: &ImageHead,
    measurer: &Measurer,
) -> Result<Option<Warning>, PipelineError> {
    let configuration = measurer.configuration();
    let white = match configuration.noise {
        NoiseSource::Image { correlation, .. } => correlation == 0,
        NoiseSource::Header | NoiseSource::Border { .. } => true,
    };
    if configuration.linear().is_none() || !white {
        return Ok(None);
    }
    let required = measurer.noise_plan().is_some();
    if required && head.survey.is_none() {
        return Ok(None);
    }
    // Small stamps have no border that could be surveyed.
    let found = NoisePlan::new(measurer.full(), CORRELATION)
        .map_err(PipelineError::from)
        .and_then(|plan| survey(image, path, head.mosaic, &plan));
    let found = match found {
        Ok(found) => found,
        Err(error) if required => return Err(error),
        Err(_) => None,
    };
    image.rewind();
    Ok(found
        .filter(|survey| survey.noise.is_correlated())
        .map(|survey| Warning::CorrelatedNoise {
            correlation: [
                survey.noise.correlation(1, 0),
                survey.noise.correlation(0, 1),
            ],
        }))
}

/// A warning if NOISESIG disagrees with the measured noise, which is used.
pub(super) fn disagreement(stated: Option<f64>, survey: &Survey) -> Option<Warning> {
    let (given, noise) = (stated?, &survey.noise);
    let apart = noise.sigma() / given - 1.0;
    let differs = apart.abs() > (CLEAR * noise.error()).max(LEAST_DIFFERENCE);
    // NaN if NOISESIG is zero or no number.
    (differs || apart.is_nan()).then_some(Warning::NoiseLevel {
        given,
        measured: noise.sigma(),
        used: true,
    })
}
