//! Folders of catalogues that `measure` or `run` wrote, with the true shear of their data.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use shearq_dataset::run::{RUN_FILE, Run};
use shearq_files::FileError;
use shearq_files::open::is_there;

use super::positions::Positions;
use super::truth::Truth;
use super::{BiasFailure, Input};

/// Replaces folders of results by their catalogues, in the order of sets and images. Unless `truth` states the true
/// shear, it is read from the data folders, if they have one.
///
/// # Errors
/// If a folder is no folder of results, or only some of the data have a true shear.
pub fn expand(paths: &[PathBuf], truth: Truth) -> Result<(Vec<Input>, Truth), BiasFailure> {
    let (mut truth, mut catalogues) = (truth, Vec::new());
    let mut found = match &mut truth {
        Truth::Data(found) => std::mem::take(found),
        _ => BTreeMap::new(),
    };
    let mut without: Option<&Path> = None;
    for path in paths {
        if !path.is_dir() {
            catalogues.push(path.clone().into());
            continue;
        }
        let Some(run) = Run::read(path)? else {
            let message = format!(
                "this folder has no {RUN_FILE} (expected catalogues, or a folder that `measure` or `run` wrote). Try: {}/*",
                path.display()
            );
            return Err(FileError::new(path, message).into());
        };
        let files = run.catalogues(path, &[])?;
        if files.is_empty() {
            return Err(FileError::new(path, "there is no catalogue in this folder").into());
        }
        for set in files.sets() {
            let own: Vec<PathBuf> = files
                .of_set(set)
                .into_iter()
                .map(|(_, file)| file)
                .collect();
            if matches!(truth, Truth::Columns | Truth::Data(_)) {
                match of_data(&run, path, set)? {
                    None => without = Some(path),
                    Some(positions) => {
                        let positions = Arc::new(positions);
                        found.extend(own.iter().map(|file| (file.clone(), positions.clone())));
                    }
                }
            }
            catalogues.extend(own.into_iter().map(Input::from));
        }
    }
    if found.is_empty() {
        return Ok((catalogues, truth));
    }
    if let Some(path) = without {
        let message = "its data have no true shear, but the data of other folders have one. Try: separate commands, or --truth FILE";
        return Err(FileError::new(path, message).into());
    }
    Ok((catalogues, Truth::Data(found)))
}

/// The true shear of the data of a run; `None` if they have none.
fn of_data(run: &Run, folder: &Path, set: u32) -> Result<Option<Positions>, FileError> {
    let data = run.source.data(folder).map_err(|error| {
        let message = format!(
            "the data with the true shear are gone ({error}). Try: --truth FILE, or the catalogues themselves without a true shear"
        );
        FileError::new(folder, message)
    })?;
    let path = data.truth(set);
    if !is_there(&path) {
        return Ok(None);
    }
    Positions::read(&path, data.truth_sign(set)?).map(Some)
}
