//! Checksums of the public folder, and the private key that belongs to them.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use shearq_files::{FileError, atomic, open};
use shearq_pipeline::{PipelineError, engine};
use shearq_results::submit::manifest::FileSum;

use crate::terms::CHALLENGE_FILE;

/// Checksums of the public files, in the format of `sha256sum`.
pub const SUMS_FILE: &str = "SHA256SUMS";
/// The private record.
pub const KEY_FILE: &str = "key.toml";

/// The private record of a challenge.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Key {
    /// Name of the challenge.
    pub name: String,
    /// Version of the challenge.
    pub version: u32,
    /// Seed as text, because TOML has no 64-bit unsigned numbers; absent for images of another simulator.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seed: Option<String>,
    /// SHA-256 of [`SUMS_FILE`] in the public folder; absent until that folder is complete.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub public: Option<String>,
    /// Q that a perfect method can expect, if it is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub expected: Option<Expected>,
}

/// Mean Q over sets of a perfect method with the smallest possible noise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Expected {
    /// Of catalogues, whose noise adds to the power.
    pub catalogues: f64,
    /// Of power spectra without the mean power of the noise.
    pub spectra: f64,
    /// Sets that are left out, because the smallest possible noise is unknown.
    #[serde(default)]
    pub without: Vec<u32>,
}

impl Key {
    /// Reads the record of a private folder; `None` if there is none.
    ///
    /// # Errors
    /// If it cannot be read.
    pub fn read(private: &Path) -> Result<Option<Self>, FileError> {
        let path = private.join(KEY_FILE);
        if !open::is_there(&path) {
            return Ok(None);
        }
        let text = open::read_to_string(&path, open::SETTINGS)
            .map_err(FileError::doing(&path, "cannot read the key"))?;
        toml::from_str(&text)
            .map(Some)
            .map_err(|e| FileError::new(&path, e.to_string().trim_end()))
    }

    /// Writes the record.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn write(&self, private: &Path) -> Result<(), FileError> {
        let path = private.join(KEY_FILE);
        let text =
            toml::to_string(self).map_err(FileError::doing(&path, "cannot write the key"))?;
        atomic::write(&path, text.as_bytes())
    }
}

/// SHA-256 of some bytes, in hexadecimal digits.
pub fn sha256(bytes: &[u8]) -> String {
    let digest = Sha256::digest(bytes);
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Writes the checksums of all files below `public` and returns the SHA-256 of their list.
///
/// # Errors
/// If a file cannot be read, or the list cannot be written.
pub fn seal(public: &Path, threads: usize) -> Result<String, PipelineError> {
    let mut files = Vec::new();
    list(public, &mut files)?;
    files.retain(|path| path.file_name().is_some_and(|name| name != SUMS_FILE));
    files.sort();
    let mut text = String::new();
    engine::ordered(
        threads,
        |feeder| {
            for path in files {
                if !feeder.push(path) {
                    break;
                }
            }
            Ok(())
        },
        || (),
        |(), path: PathBuf| {
            let sum = FileSum::of(&path)?;
            Ok((path, sum))
        },
        |(path, sum)| {
            let name = path.strip_prefix(public).unwrap_or(&path);
            let parts: Vec<_> = name.iter().map(|part| part.to_string_lossy()).collect();
            text.push_str(&format!("{}  {}\n", sum.sha256, parts.join("/")));
            Ok(())
        },
    )?;
    atomic::write(public.join(SUMS_FILE), text.as_bytes())?;
    Ok(sha256(text.as_bytes()))
}

/// All files below a folder.
pub(crate) fn list(folder: &Path, found: &mut Vec<PathBuf>) -> Result<(), FileError> {
    let entries = std::fs::read_dir(folder)
        .and_then(Iterator::collect::<std::io::Result<Vec<_>>>)
        .map_err(FileError::doing(folder, "cannot list the folder"))?;
    for entry in entries {
        let path = entry.path();
        match path.is_dir() {
            true => list(&path, found)?,
            false => found.push(path),
        }
    }
    Ok(())
}

/// Checks that the description in `public` and the key in `private` belong together. Returns the key and the SHA-256
/// that identifies the challenge.
///
/// # Errors
/// If one of them is incomplete or was changed.
pub fn verify(public: &Path, private: &Path) -> Result<(Key, String), FileError> {
    let key = Key::read(private)?.ok_or_else(|| {
        let message = format!(
            "there is no {KEY_FILE}; expected the private folder that `shearq challenge new` wrote"
        );
        FileError::new(private, message)
    })?;
    let path = public.join(SUMS_FILE);
    let sums = open::read(&path, open::DATA).map_err(FileError::doing(&path, "cannot read it"))?;
    let found = sha256(&sums);
    if key.public.as_ref() != Some(&found) {
        let expected = key.public.as_deref().unwrap_or("a complete challenge");
        let message = format!(
            "the public folder does not belong to {} (found SHA-256 {found}, expected {expected})",
            private.display()
        );
        return Err(FileError::new(&path, message));
    }
    let description = public.join(CHALLENGE_FILE);
    let sum = FileSum::of(&description)?.sha256;
    let line = format!("{sum}  {CHALLENGE_FILE}");
    if !String::from_utf8_lossy(&sums)
        .lines()
        .any(|own| own == line)
    {
        let message = format!("the file was changed (found SHA-256 {sum}, expected {SUMS_FILE}'s)");
        return Err(FileError::new(&description, message));
    }
    Ok((key, found))
}
