//! Files that appear whole or not at all.

use std::fs;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use super::error::FileError;

/// A file on its way: written under a temporary name in the same folder, renamed by
/// [`PartFile::finish`], removed if dropped before.
///
/// The temporary name is fixed (`.NAME.part`), so that a killed run leaves at most one such file per
/// result and the next run overwrites it.
#[derive(Debug)]
pub struct PartFile {
    part: PathBuf,
    target: PathBuf,
    finished: bool,
}

impl PartFile {
    /// Makes the folder and removes what an earlier run may have left.
    ///
    /// # Errors
    /// Where the folder cannot be made or the leftover cannot be removed.
    pub fn new(target: impl AsRef<Path>) -> Result<Self, FileError> {
        let target = target.as_ref().to_owned();
        let name = target
            .file_name()
            .ok_or_else(|| FileError::new(&target, "this is not the name of a file"))?;
        let folder = target.parent().unwrap_or(Path::new(""));
        if !folder.as_os_str().is_empty() {
            fs::create_dir_all(folder)
                .map_err(FileError::doing(folder, "cannot make the folder"))?;
        }
        let part = folder.join(format!(".{}.part", name.to_string_lossy()));
        match fs::remove_file(&part) {
            Ok(()) => {}
            Err(error) if error.kind() == ErrorKind::NotFound => {}
            Err(error) => {
                return Err(FileError::new(
                    &part,
                    format!("cannot remove the leftover: {error}"),
                ));
            }
        }
        Ok(PartFile {
            part,
            target,
            finished: false,
        })
    }

    /// Where to write.
    pub fn path(&self) -> &Path {
        &self.part
    }

    /// What it will be called.
    pub fn target(&self) -> &Path {
        &self.target
    }

    /// Gives the file its name, for good: the content is on disk before the name, and the name before
    /// anything that is written after it.
    ///
    /// # Errors
    /// Where it cannot be flushed to disk or renamed.
    pub fn finish(mut self) -> Result<(), FileError> {
        let cannot = || FileError::doing(&self.target, "cannot write the file");
        let flush = fs::File::open(&self.part).and_then(|file| file.sync_data());
        flush.map_err(cannot())?;
        fs::rename(&self.part, &self.target).map_err(cannot())?;
        self.finished = true;
        sync_names(&self.target).map_err(cannot())
    }
}

impl Drop for PartFile {
    fn drop(&mut self) {
        if !self.finished {
            // Nothing more can be done about a leftover here; the next run removes it.
            let _ = fs::remove_file(&self.part);
        }
    }
}

/// Flushes the names in the folder of `file` to disk, so that even a power failure cannot keep later
/// results without the record that was written before them.
#[cfg(unix)]
fn sync_names(file: &Path) -> std::io::Result<()> {
    let folder = match file.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let folder = match fs::File::open(folder) {
        // A folder that may be written to but not read.
        Err(error) if error.kind() == ErrorKind::PermissionDenied => return Ok(()),
        folder => folder?,
    };
    match folder.sync_all() {
        // Some network file systems cannot flush folders; they order names themselves.
        Err(error) if error.kind() == ErrorKind::InvalidInput => Ok(()),
        result => result,
    }
}

/// Elsewhere a folder cannot be opened as a file.
#[cfg(not(unix))]
fn sync_names(_file: &Path) -> std::io::Result<()> {
    Ok(())
}

/// Writes `bytes` to `target`, whole or not at all.
///
/// # Errors
/// Where the file cannot be written.
pub fn write(target: impl AsRef<Path>, bytes: &[u8]) -> Result<(), FileError> {
    let part = PartFile::new(target)?;
    let mut file = fs::File::create(part.path())
        .map_err(FileError::doing(part.target(), "cannot write the file"))?;
    file.write_all(bytes)
        .map_err(FileError::doing(part.target(), "cannot write the file"))?;
    drop(file);
    part.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_abandoned_file_leaves_nothing_and_a_finished_one_only_itself() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("new/result.csv");
        let part = PartFile::new(&target).unwrap();
        fs::write(part.path(), "half").unwrap();
        drop(part);
        let count = || fs::read_dir(target.parent().unwrap()).unwrap().count();
        assert_eq!(count(), 0);
        write(&target, b"whole").unwrap();
        assert_eq!(fs::read(&target).unwrap(), b"whole");
        assert_eq!(count(), 1);
    }
}
