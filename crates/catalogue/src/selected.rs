//! Catalogues of linear configurations with the weights of a selection, and its response to shear.

use std::path::Path;

use shearq_dataset::fingerprint::{PRINTS, verify_source};
use shearq_dataset::metadata::KEYS;
use shearq_dataset::run::{Run, Source};
use shearq_dataset::threads::ALL_CORES;
use shearq_files::frames::frame;
use shearq_files::frames::polars::{Column, DataFrame};
use shearq_files::{FileError, atomic, table};
use shearq_measure::{ShearSum, ShearedCatalogues};

use crate::own_columns::WEIGHT;
use crate::select::StatedSelection;
use crate::shapes::MeasuredShapes;

/// Writes the catalogues of the folder `from` with the weights of a `stated` selection to the folder `to`:
/// ellipticities and responses are multiplied by the weights, so that all that uses catalogues uses the selection. Galaxies
/// that are left out have an ellipticity and a response of zero. Returns the number of galaxies that are kept, and of those without a flag.
pub fn write_selected(
    run: &Run,
    from: &Path,
    to: &Path,
    stated: &StatedSelection,
) -> Result<(usize, usize), FileError> {
    // A condition alone has the weight 1, whose response is zero.
    let stated = &StatedSelection {
        weights: Some(stated.weights.clone().unwrap_or_default()),
        ..stated.clone()
    };
    verify_source(from, run, &[], ALL_CORES)?;
    // The second selection would divide by the response of the first one again.
    if let Some(earlier) = &run.selection {
        return Err(FileError::new(
            from,
            format!("these catalogues have the selection `{earlier}` already"),
        )
        .hint("the folder that they were selected from"));
    }
    let files = run.catalogues(from, &[])?;
    // Nothing is written if one of the sets has too few galaxies left.
    for set in files.wanted(&[]) {
        let mut sum = ShearSum::default();
        for (_, path) in files.of_set(set) {
            let shapes = MeasuredShapes::read(&path, Some(stated), true)?;
            let good = (0..shapes.flags.len()).filter(|row| shapes.flags[*row] == 0.0);
            good.for_each(|row| sum.add(shapes.e[row], shapes.response[row], 1.0));
        }
        if let Err(error) = sum.mean() {
            let message = format!(
                "set {set:02}: the selection leaves no galaxies with a response to shear: {error}"
            );
            return Err(FileError::new(from, message).hint("a lower threshold"));
        }
    }
    let record = Run {
        source: run.source.moved(from, to)?,
        selection: Some(stated.text.clone()),
        ..run.clone()
    };
    let claim = record.claim(to)?;
    let (mut kept, mut good) = (0, 0);
    for set in files.wanted(&[]) {
        if let Source::Simulated(_) = run.source {
            // The truth of a simulated run is in the folder of the catalogues.
            let truth = run.source.data(from)?.truth(set);
            if let (Ok(within), Ok(bytes)) = (truth.strip_prefix(from), std::fs::read(&truth)) {
                atomic::write(to.join(within), &bytes)?;
            }
        }
        for (image, path) in files.of_set(set) {
            let read = table::read(&path, None, table::MAX_ROWS)?;
            let mut shapes = MeasuredShapes::of_table(&path, &read, true)?;
            shapes.select(&path, &read, Some(stated))?;
            kept += shapes.weight.iter().filter(|own| **own > 0.0).count();
            good += shapes.e.iter().filter(|e| e[0].is_finite()).count();
            let changed = selected_table(&path, &shapes, &read)?;
            // The origin of the catalogue stays, so that it is still compared with its images.
            let mut metadata = table::read_metadata(&path, run.format, KEYS.iter().chain(&PRINTS))?;
            metadata.insert("select".into(), stated.text.clone());
            let out = record.catalogue(to, set, image);
            claim.check()?;
            table::write(&out, run.format, &changed, &metadata)?;
        }
    }
    Ok((kept, good))
}

// The catalogue `read` with weighted ellipticities and their responses.
fn selected_table(
    path: &Path,
    shapes: &MeasuredShapes,
    read: &DataFrame,
) -> Result<DataFrame, FileError> {
    let [e1, e2, r11, r22, r12, r21, weight] = shapes.columns();
    let new = [e1, e2, r11, r22, r12, r21];
    let names = ["e1", "e2", "R11", "R22", "R12", "R21"];
    // Sheared versions would not have the selection.
    let kept =
        |own: &&Column| !ShearedCatalogues::columns().any(|name| own.name().as_str() == name);
    let columns = read.columns().iter().filter(kept).map(|own| {
        match names.iter().position(|name| own.name().as_str() == *name) {
            Some(k) => Column::new(own.name().clone(), &new[k]),
            None => own.clone(),
        }
    });
    let mut columns: Vec<Column> = columns.collect();
    columns.push(Column::new(WEIGHT.into(), weight));
    frame(columns).map_err(|error| FileError::new(path, error.to_string()))
}
