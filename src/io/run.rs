//! What made a folder of results: `run.json`, written before the first result.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shearq_submissions::Submission;

use super::atomic;
use super::error::FileError;
use super::layout::Layout;
use super::table::Format;

/// Name of the record in a folder of results.
pub const RUN_FILE: &str = "run.json";

/// Settings of a measurement, as stored with its catalogues.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// Version of shearq.
    pub version: String,
    /// Data folder as given.
    pub data: PathBuf,
    /// Its layout.
    pub layout: Layout,
    /// All settings of the submission.
    pub submission: Submission,
    /// Format of the catalogues.
    pub format: Format,
}

impl Run {
    /// Reads the record of a folder; `None` where there is none.
    ///
    /// # Errors
    /// Where it exists and cannot be read.
    pub fn read(folder: &Path) -> Result<Option<Self>, FileError> {
        let path = folder.join(RUN_FILE);
        let text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(FileError::new(&path, error)),
        };
        serde_json::from_str(&text)
            .map(Some)
            .map_err(|error| FileError::new(&path, format!("not a record of a run: {error}")))
    }

    /// The catalogue of an image.
    pub fn catalogue(&self, folder: &Path, set: u32, image: u32) -> PathBuf {
        let name = format!(
            "set{set:02}/catalogue-{image:03}.{}",
            self.format.extension()
        );
        folder.join(name)
    }
}

impl Run {
    /// Catalogues of a set that are there, by image number.
    pub fn catalogues(&self, folder: &Path, set: u32) -> Vec<(u32, PathBuf)> {
        (1..=999)
            .map(|image| (image, self.catalogue(folder, set, image)))
            .take_while(|(_, path)| path.parent().is_some_and(Path::is_dir))
            .filter(|(_, path)| path.is_file())
            .collect()
    }
}

/// Writes any record as indented JSON.
///
/// # Errors
/// Where it cannot be written.
pub fn write_record(path: &Path, record: &impl Serialize) -> Result<(), FileError> {
    let mut text = serde_json::to_string_pretty(record)
        .map_err(FileError::doing(path, "cannot write the record"))?;
    text.push('\n');
    atomic::write(path, text.as_bytes())
}

/// Makes the folder of `path` that of `record`: writes it where there is none, and refuses a folder
/// with a different one, showing the differences.
///
/// # Errors
/// Where the folder belongs to other settings, or the record cannot be read or written.
pub fn claim<R: Serialize + serde::de::DeserializeOwned>(
    path: &Path,
    record: &R,
) -> Result<(), FileError> {
    let text = match std::fs::read_to_string(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            return write_record(path, record);
        }
        Err(error) => return Err(FileError::new(path, error)),
        Ok(text) => text,
    };
    let earlier: R = serde_json::from_str(&text)
        .map_err(|error| FileError::new(path, format!("not a record of this kind: {error}")))?;
    let differences = differences(&earlier, record)
        .map_err(|error| FileError::new(path, format!("cannot compare records: {error}")))?;
    if differences.is_empty() {
        return Ok(());
    }
    Err(FileError::new(
        path.parent().unwrap_or(path),
        format!(
            "this folder holds results of other settings (earlier ≠ now):\n  {}\nuse another folder, or remove this one",
            differences.join("\n  ")
        ),
    ))
}

/// Lines in which two records differ, as `key: first ≠ second`.
fn differences(
    first: &impl Serialize,
    second: &impl Serialize,
) -> Result<Vec<String>, serde_json::Error> {
    let (first, second) = (serde_json::to_value(first)?, serde_json::to_value(second)?);
    let mut found = Vec::new();
    compare("", &first, &second, &mut found);
    Ok(found)
}

fn compare(key: &str, a: &serde_json::Value, b: &serde_json::Value, found: &mut Vec<String>) {
    match (a, b) {
        (serde_json::Value::Object(a), serde_json::Value::Object(b)) => {
            let keys: std::collections::BTreeSet<&String> = a.keys().chain(b.keys()).collect();
            for name in keys {
                let null = serde_json::Value::Null;
                let path = if key.is_empty() {
                    name.clone()
                } else {
                    format!("{key}.{name}")
                };
                compare(
                    &path,
                    a.get(name).unwrap_or(&null),
                    b.get(name).unwrap_or(&null),
                    found,
                );
            }
        }
        _ if a != b => found.push(format!("{key}: {a} ≠ {b}")),
        _ => {}
    }
}
