//! What catalogues state of the noise of their star: how much it changes m and c of all galaxies of an image.

use std::path::Path;

use shearq_bias::StarNoise;
use shearq_files::FileError;
use shearq_files::table::{self, FileFormat};
use shearq_pipeline::inputs::PSF;
use shearq_pipeline::measure::PSF_NOISE;

/// Largest effect on m or c that metadata can state: a star without any signal has 5.5.
const MOST: f64 = 10.0;

/// The noise of the star of a catalogue, which is named by its fingerprint or, without one, as the catalogue. `None` if the
/// catalogue does not state it.
///
/// # Errors
/// If the metadata cannot be read.
pub(crate) fn of_catalogue(
    path: &Path,
    format: FileFormat,
) -> Result<Option<StarNoise>, FileError> {
    let keys = [PSF_NOISE, PSF].map(str::to_owned);
    let mut metadata = table::read_metadata(path, format, keys.iter())?;
    let Some(text) = metadata.get(PSF_NOISE) else {
        return Ok(None);
    };
    let [m, c] = effect(path, text)?;
    let star = metadata.remove(PSF);
    let star = star.unwrap_or_else(|| path.display().to_string());
    Ok(Some(StarNoise { star, m, c }))
}

/// The scatter of m and c by the noise of a star, as the metadata state it.
fn effect(path: &Path, text: &str) -> Result<[f64; 2], FileError> {
    let numbers: Option<Vec<f64>> = text.split(' ').map(|word| word.parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[m, c]) if [m, c].iter().all(|value| (0.0..=MOST).contains(value)) => Ok([m, c]),
        _ => Err(FileError::new(
            path,
            format!(
                "the metadata `{PSF_NOISE}` are {text:?} (expected the scatter of m and of c, two numbers from 0 to {MOST} such as 2.3e-2 1.2e-2)"
            ),
        )),
    }
}
