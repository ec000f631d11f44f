//! The manifest of a submission: its files with their sums, and what they are.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};
use sha2::{Digest, Sha256};
use shearq_catalogue::foreign::Foreign;
use shearq_dataset::fingerprint::hex;
use shearq_dataset::run::{Run, read_record};
use shearq_files::FileError;
use shearq_files::open::open;
use shearq_scoring::SpectrumCovariance;
use shearq_submissions::{check_name, checked_name};

pub const MANIFEST_FILE: &str = "manifest.json";

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Contents {
    #[default]
    Catalogues,
    /// Power spectra of the ellipticities averaged over the images, noise included.
    Spectra,
    /// Shear power spectra from cross-spectra between groups of images; their noise averages to zero.
    CrossSpectra,
}

impl Contents {
    /// Whether the files are power spectra.
    pub fn is_spectra(self) -> bool {
        self != Contents::Catalogues
    }
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    #[serde(deserialize_with = "checked_name")]
    pub challenge: String,
    #[serde(deserialize_with = "checked_name")]
    pub team: String,
    /// One line about the entry; may be empty.
    #[serde(default, deserialize_with = "checked_line")]
    pub title: String,
    /// Address for questions of the organiser; may be empty. It is not published.
    #[serde(default, deserialize_with = "checked_line")]
    pub contact: String,
}

// For `#[serde(deserialize_with)]`: reads a name that may be empty.
fn checked_line<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    let line = String::deserialize(deserializer)?;
    match line.is_empty() {
        true => Ok(line),
        false => check_name(&line).map(|()| line).map_err(D::Error::custom),
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    pub version: String,
    /// Name of the method in file names.
    #[serde(deserialize_with = "checked_name")]
    pub method: String,
    pub contents: Contents,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub entry: Option<Entry>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub run: Option<Run>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub foreign: Option<Foreign>,
    /// The files by name, without the manifest.
    pub files: BTreeMap<String, FileSum>,
    /// Noise covariance of the bandpowers of each cross-spectrum, by file name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub covariances: BTreeMap<String, SpectrumCovariance>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileSum {
    pub bytes: u64,
    /// SHA-256 in hexadecimal digits.
    pub sha256: String,
}

impl FileSum {
    pub fn copying(from: &mut impl Read, to: &mut impl Write) -> std::io::Result<Self> {
        let mut hasher = Sha256::new();
        let mut bytes = 0;
        let mut buffer = vec![0; 1 << 16];
        loop {
            let read = match from.read(&mut buffer) {
                Ok(0) => break,
                Ok(read) => read,
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => continue,
                Err(error) => return Err(error),
            };
            hasher.update(&buffer[..read]);
            to.write_all(&buffer[..read])?;
            bytes += read as u64;
        }
        Ok(FileSum {
            bytes,
            sha256: hex(&hasher.finalize()),
        })
    }

    /// The checksums of files with their names below `folder`.
    pub fn of_files(folder: &Path, files: &[PathBuf]) -> Result<Vec<(String, Self)>, FileError> {
        let sum = |file: &PathBuf| {
            let name = file.strip_prefix(folder).unwrap_or(file).to_string_lossy();
            Ok((name.into_owned(), FileSum::of(file)?))
        };
        files.iter().map(sum).collect()
    }

    pub fn of(path: &Path) -> Result<Self, FileError> {
        open(path)
            .and_then(|mut file| FileSum::copying(&mut file, &mut std::io::sink()))
            .map_err(FileError::doing(path, "cannot read the file"))
    }
}

impl Manifest {
    /// Reads the manifest of a folder; `None` if there is none.
    pub fn read(folder: &Path) -> Result<Option<Self>, FileError> {
        read_record(&folder.join(MANIFEST_FILE))
    }

    pub(super) fn verify(
        &self,
        found: &BTreeMap<String, FileSum>,
        whole: &Path,
    ) -> Result<(), FileError> {
        let faults = self.faults(found);
        if faults.is_empty() {
            return Ok(());
        }
        let lines = faults.iter();
        let lines: String = lines
            .map(|(name, message)| format!("\n  {name}: {message}"))
            .collect();
        let message = format!("the files disagree with {MANIFEST_FILE}:{lines}");
        Err(FileError::new(whole, message))
    }

    /// Files that disagree with the manifest: names and messages.
    pub fn faults(&self, found: &BTreeMap<String, FileSum>) -> Vec<(String, String)> {
        let listed = self.files.iter().filter_map(|(name, sum)| {
            let message = match found.get(name) {
                None => format!("the file is missing, but {MANIFEST_FILE} lists it"),
                Some(there) if there.bytes != sum.bytes => format!(
                    "the file was changed (found {} bytes, expected {} as in {MANIFEST_FILE})",
                    there.bytes, sum.bytes
                ),
                Some(there) if there != sum => format!(
                    "the file was changed (found SHA-256 {}, expected {} as in {MANIFEST_FILE})",
                    there.sha256, sum.sha256
                ),
                Some(_) => return None,
            };
            Some((name.clone(), message))
        });
        let extra = found
            .keys()
            .filter(|name| !self.files.contains_key(*name))
            .map(|name| {
                (
                    name.clone(),
                    format!("{MANIFEST_FILE} does not list this file"),
                )
            });
        listed.chain(extra).collect()
    }
}
