//! The manifest of a packed submission: its files with checksums, and what made them.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::path::Path;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use shearq_scoring::SpectrumCovariance;
use shearq_submissions::checked_name;

use crate::foreign::Foreign;
use shearq_files::{FileError, open};
use shearq_pipeline::data::run::{Run, read_record};

/// Name of the manifest beside the files.
pub const MANIFEST_FILE: &str = "manifest.json";

/// What the files of a submission hold.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Contents {
    /// Ellipticity catalogues.
    #[default]
    Catalogues,
    /// Power spectra of the ellipticities averaged over the images, noise included.
    Spectra,
    /// Shear power spectra from cross-spectra between groups of images, in which noise has no mean.
    CrossSpectra,
}

/// A packed submission.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// Version of shearq that packed it.
    pub version: String,
    /// Method's name in the file names.
    #[serde(deserialize_with = "checked_name")]
    pub method: String,
    /// What the files hold.
    pub contents: Contents,
    /// What the catalogues were measured from, by which settings and version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub run: Option<Run>,
    /// Description of the catalogues of another program.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub foreign: Option<Foreign>,
    /// The files by name, but for the manifest.
    pub files: BTreeMap<String, FileSum>,
    /// Covariance of the bandpowers of each cross-spectrum under noise, by the name of its file.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub covariances: BTreeMap<String, SpectrumCovariance>,
}

/// Size and checksum of a file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileSum {
    /// Number of bytes.
    pub bytes: u64,
    /// SHA-256 in hexadecimal digits.
    pub sha256: String,
}

impl FileSum {
    /// Of all that `from` has, copied to `to` on the way.
    ///
    /// # Errors
    /// Where reading or writing fails.
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
        let digits = |byte: &u8| format!("{byte:02x}");
        Ok(FileSum {
            bytes,
            sha256: hasher.finalize().iter().map(digits).collect(),
        })
    }

    /// Of a file.
    ///
    /// # Errors
    /// Where it cannot be read.
    pub fn of(path: &Path) -> Result<Self, FileError> {
        open::open(path)
            .and_then(|mut file| FileSum::copying(&mut file, &mut std::io::sink()))
            .map_err(FileError::doing(path, "cannot read the file"))
    }
}

impl Manifest {
    /// Reads that of a folder; `None` where there is none.
    ///
    /// # Errors
    /// Where it exists and cannot be read.
    pub fn read(folder: &Path) -> Result<Option<Self>, FileError> {
        read_record(&folder.join(MANIFEST_FILE))
    }

    /// Names of files that are not as the manifest says, with what was found and what was expected.
    pub fn faults(&self, found: &BTreeMap<String, FileSum>) -> Vec<(String, String)> {
        let listed = self.files.iter().filter_map(|(name, sum)| {
            let message = match found.get(name) {
                None => format!("the file is missing; {MANIFEST_FILE} lists it"),
                Some(own) if own.bytes != sum.bytes => format!(
                    "the file was changed: {} bytes; {MANIFEST_FILE} says {}",
                    own.bytes, sum.bytes
                ),
                Some(own) if own != sum => format!(
                    "the file was changed: its SHA-256 is {}; {MANIFEST_FILE} says {}",
                    own.sha256, sum.sha256
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
