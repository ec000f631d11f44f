//! Short names for contents: what tells whether two results were made from the same data.

use std::io::Read;
use std::path::Path;

use sha2::{Digest, Sha256};

use super::error::FileError;
use super::layout::{DataFolder, MAX_SET};
use super::open;
use super::run::Source;

/// Bytes at the beginning of an image that count: its headers and some of its noise.
const HEAD: u64 = 16 * 1024;

/// A SHA-256 on its way, of parts that cannot run into each other.
#[derive(Default)]
pub struct Fingerprint(Sha256);

impl Fingerprint {
    /// Adds a part.
    pub fn add(&mut self, part: impl AsRef<[u8]>) {
        let part = part.as_ref();
        self.0.update((part.len() as u64).to_le_bytes());
        self.0.update(part);
    }

    /// Its first 64 bits in hexadecimal: of a million contents, two are alike by chance once in
    /// forty million cases.
    pub fn finish(self) -> String {
        let digest = self.0.finalize();
        digest[..8]
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect()
    }
}

/// Fingerprint of some bytes.
pub fn of_bytes(bytes: &[u8]) -> String {
    let mut print = Fingerprint::default();
    print.add(bytes);
    print.finish()
}

/// Fingerprint of one set: its true shear, the settings it is simulated from, and the size and the
/// beginning of those of `images` that are there.
///
/// # Errors
/// Where a file cannot be read.
pub fn of_set(
    source: &Source,
    data: &DataFolder,
    set: u32,
    images: &[u32],
) -> Result<String, FileError> {
    let mut print = Fingerprint::default();
    if let Source::Simulated(_) = source {
        print.add(of_source(source, data)?);
    }
    print.add(read(&data.truth(set))?);
    for &image in images {
        let path = data.galaxies(set, image);
        if open::is_there(&path) {
            let (length, head) = beginning(&path)?;
            print.add(image.to_le_bytes());
            print.add(length.to_le_bytes());
            print.add(head);
        }
    }
    Ok(print.finish())
}

/// Fingerprint of all data of a source, whichever sets are scored: the settings of a simulation, or
/// the true shear of every set of a folder.
///
/// # Errors
/// Where a file cannot be read.
pub fn of_source(source: &Source, data: &DataFolder) -> Result<String, FileError> {
    let mut print = Fingerprint::default();
    match source {
        Source::Simulated(settings) => {
            let text = serde_json::to_vec(settings)
                .map_err(FileError::doing(data.root(), "cannot store the settings"))?;
            print.add(text);
        }
        Source::Folder { .. } => {
            for set in 1..=MAX_SET {
                let path = data.truth(set);
                if open::is_there(&path) {
                    print.add(set.to_le_bytes());
                    print.add(read(&path)?);
                }
            }
        }
    }
    Ok(print.finish())
}

fn read(path: &Path) -> Result<Vec<u8>, FileError> {
    open::read(path).map_err(FileError::doing(path, "cannot read the file"))
}

/// Length of a file and its first bytes.
fn beginning(path: &Path) -> Result<(u64, Vec<u8>), FileError> {
    let mut head = Vec::new();
    let length = open::open(path)
        .and_then(|file| {
            let length = file.metadata()?.len();
            file.take(HEAD).read_to_end(&mut head)?;
            Ok(length)
        })
        .map_err(FileError::doing(path, "cannot read the file"))?;
    Ok((length, head))
}
