//! Measuring one row of stamps, and the warnings of an image.

use std::sync::Arc;

use ndarray::{ArrayView3, Axis, Slice};
use shearq_measure::{
    EXAMINED_PSFS, Examination, Measurement, Warning, Worker, examined_rows, strip,
};

use super::head::{ImageHead, StampRow};
use crate::PipelineError;

/// Measurements of one row of stamps.
#[derive(Debug, Clone)]
pub struct MeasuredRow {
    /// The image.
    pub head: Arc<ImageHead>,
    /// Row of the mosaic, from 0.
    pub iy: usize,
    /// One per galaxy.
    pub galaxies: Vec<Measurement>,
    /// Examination of the stamps, for some rows of an image.
    pub examination: Option<Examination>,
}

impl AsRef<[Measurement]> for MeasuredRow {
    fn as_ref(&self) -> &[Measurement] {
        &self.galaxies
    }
}

impl AsMut<[Measurement]> for MeasuredRow {
    fn as_mut(&mut self) -> &mut [Measurement] {
        &mut self.galaxies
    }
}

/// Measures every galaxy of a row, before calibration.
///
/// # Errors
/// If the stamps have other sizes than planned.
pub fn measure_row(worker: &mut Worker, row: &StampRow) -> Result<MeasuredRow, PipelineError> {
    let head = &row.head;
    let (columns, count) = (head.mosaic.columns, head.mosaic.of_row(row.iy));
    let stamps = strip(&row.pixels, columns, head.mosaic.stamp)?;
    // The last row may be shorter.
    let stamps = stamps.slice_axis(Axis(0), Slice::from(..count));
    let galaxies = head.prepare(worker).measure_each(stamps, &row.psfs)?;
    Ok(MeasuredRow {
        head: Arc::clone(head),
        iy: row.iy,
        galaxies,
        examination: examine(worker, row, stamps)?,
    })
}

/// Examines the stamps of a row, if it is one of the rows that are examined.
fn examine(
    worker: &Worker,
    row: &StampRow,
    stamps: ArrayView3<'_, f32>,
) -> Result<Option<Examination>, PipelineError> {
    let mosaic = row.head.mosaic;
    let rows = examined_rows(mosaic.columns, mosaic.rows());
    if !rows.contains(&row.iy) {
        return Ok(None);
    }
    let mut examination =
        Examination::new(mosaic.stamp, mosaic.columns).without(worker.subtraction());
    for stamp in stamps.outer_iter() {
        examination.add(stamp)?;
    }
    // A PSF for all galaxies is examined once.
    if row.psfs.count().is_some() || rows.first() == Some(&row.iy) {
        let cut = worker.configuration().psf_cut();
        let most = EXAMINED_PSFS.div_ceil(rows.len());
        examination.add_psfs(&row.psfs, cut, most);
    }
    Ok(Some(examination))
}

/// The effect of the noise of the star of an image on m and c, if all galaxies share it.
pub(super) fn psf_noise(rows: &[MeasuredRow]) -> Option<[f64; 2]> {
    let examinations = rows.iter().filter_map(|row| row.examination.as_ref());
    examinations.filter_map(Examination::psf_noise).next()
}

/// The warnings about an image whose rows have been measured and calibrated.
pub(super) fn warnings(rows: &[MeasuredRow]) -> Vec<Warning> {
    let Some(head) = rows.first().map(|row| &row.head) else {
        return Vec::new();
    };
    let mut found = head.warnings.clone();
    let mut examinations = rows.iter().filter_map(|row| row.examination.as_ref());
    if let Some(first) = examinations.next() {
        let mut all = first.clone();
        examinations.for_each(|more| all.join(more));
        found.extend(all.warnings());
        let stated = head.stated_noise.and_then(|noise| all.given_noise(noise));
        found.extend(stated.map(of_header));
    }
    found.extend(Warning::of_galaxies(rows));
    found
}

/// A warning about a given noise, which is NOISESIG.
fn of_header(warning: Warning) -> Warning {
    match warning {
        Warning::GivenNoise { given, measured } => Warning::NoiseLevel {
            given,
            measured,
            used: false,
        },
        other => other,
    }
}
