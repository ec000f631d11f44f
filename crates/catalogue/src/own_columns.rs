//! Names of columns of catalogues by shearq.

use std::path::Path;

use shearq_files::FileError;
use shearq_measure::{Observables, ShearedCatalogues};

/// The columns of shapes. A selection also reads those of [`Observables`].
pub const SHAPE_COLUMNS: [&str; 7] = ["e1", "e2", "flags", "R11", "R22", "R12", "R21"];

/// The column with the weights of a selection that was applied, in catalogues of `select`.
pub const WEIGHT: &str = "selection";

/// The column of catalogues of detections with their number of pixels.
const DETECTED_PIXELS: &str = "pixels";

/// Whether shear changes a column.
pub fn changes_with_shear(name: &str) -> bool {
    let of_shape = SHAPE_COLUMNS.contains(&name) && name != "flags";
    of_shape
        || Observables::COLUMNS.contains(&name)
        || ["snr", "neighbour", "radius", DETECTED_PIXELS, WEIGHT].contains(&name)
}

/// Whether a column was measured on the stamps.
pub fn is_measured(name: &str) -> bool {
    const OTHERS: [&str; 7] = [
        "flags",
        "iterations",
        "stop",
        "updated",
        "first_energy",
        "energy",
        "noise",
    ];
    changes_with_shear(name)
        || OTHERS.contains(&name)
        || ShearedCatalogues::columns().any(|column| column == name)
}

/// Refuses catalogues of earlier versions, whose ellipticities were divided by `divisor1` and `divisor2`: Σ e / Σ R would be
/// too large by 1/R.
pub fn refuse_divided(path: &Path, names: &[String]) -> Result<(), FileError> {
    if names.iter().any(|name| name == "divisor1") {
        let message = "an earlier version of shearq measured this catalogue and divided e1 and e2 by their mean response (found the column `divisor1`; expected ellipticities before the division)";
        return Err(FileError::new(path, message).hint("shearq measure, or multiply e1 by divisor1 and e2 by divisor2 and remove these columns"));
    }
    Ok(())
}

/// Whether `detect` wrote a catalogue with columns of these names.
pub fn are_of_detections(names: &[String]) -> bool {
    [WEIGHT, DETECTED_PIXELS]
        .iter()
        .all(|own| names.iter().any(|name| name == own))
}

/// The error of a catalogue of detections that is cut or weighted by what changes with shear.
pub fn cut_of_detections(path: &Path) -> FileError {
    let message = "this catalogue is of detections, whose weights are in e and R: the response of a cut or weight by their columns is not known (expected a catalogue of measure)";
    FileError::new(path, message).hint("detect with another --threshold")
}

/// Checks that a catalogue with columns of these names has what a selection requires, and no selection yet.
pub fn require_responses(path: &Path, names: &[String]) -> Result<(), FileError> {
    refuse_divided(path, names)?;
    let has = |name: &str| names.iter().any(|own| own == name);
    if are_of_detections(names) {
        return Err(cut_of_detections(path));
    }
    if has(WEIGHT) {
        return Err(
            FileError::new(path, "this catalogue has a selection already")
                .hint("the catalogue that it was selected from"),
        );
    }
    if has(Observables::COLUMNS[2]) {
        return Ok(());
    }
    Err(FileError::new(
        path,
        "the catalogue has no responses of flux and size, so a selection cannot be corrected (expected a catalogue of a linear configuration such as 48/linear/star)",
    ))
}
