//! Files that appear whole or not at all.

use std::fs;
use std::io::Write;
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
        let (name, folder) = place(&target)?;
        let part = folder.join(format!(".{name}.part"));
        match fs::remove_file(&part) {
            Ok(()) => {}
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
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

    /// Gives the file its name.
    ///
    /// # Errors
    /// Where it cannot be flushed to disk or renamed.
    pub fn finish(mut self) -> Result<(), FileError> {
        let flush = fs::File::open(&self.part).and_then(|file| file.sync_data());
        flush.map_err(FileError::doing(&self.target, "cannot write the file"))?;
        fs::rename(&self.part, &self.target)
            .map_err(FileError::doing(&self.target, "cannot write the file"))?;
        self.finished = true;
        Ok(())
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

/// As [`write`], for a file that several processes may write at once with the same content: each
/// under a temporary name of its own.
///
/// # Errors
/// Where the file cannot be written.
pub fn write_shared(target: impl AsRef<Path>, bytes: &[u8]) -> Result<(), FileError> {
    let target = target.as_ref();
    let (name, folder) = place(target)?;
    let mut builder = tempfile::Builder::new();
    let (prefix, suffix) = (format!(".{name}."), ".part");
    builder.prefix(&prefix).suffix(suffix);
    // Temporary files are their owner's alone unless told otherwise; the user's mask still counts.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder
        .tempfile_in(folder)
        .and_then(|mut file| {
            file.write_all(bytes)?;
            file.as_file().sync_data()?;
            file.persist(target).map_err(|error| error.error)
        })
        .map(drop)
        .map_err(FileError::doing(target, "cannot write the file"))
}

/// Name and folder of a file to be written; the folder is made.
fn place(target: &Path) -> Result<(String, &Path), FileError> {
    let name = target
        .file_name()
        .ok_or_else(|| FileError::new(target, "this is not the name of a file"))?;
    let folder = match target.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    fs::create_dir_all(folder).map_err(FileError::doing(folder, "cannot make the folder"))?;
    Ok((name.to_string_lossy().into_owned(), folder))
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

    #[test]
    fn a_file_that_many_write_at_once_is_whole_whenever_it_is_there() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("new/shared");
        let bytes = vec![7; 1 << 16];
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    for _ in 0..10 {
                        write_shared(&target, &bytes).unwrap();
                        assert_eq!(fs::read(&target).unwrap(), bytes);
                    }
                });
            }
        });
        let folder = target.parent().unwrap();
        assert_eq!(fs::read_dir(folder).unwrap().count(), 1);
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions();
        let plain = folder.join("plain");
        fs::write(&plain, b"").unwrap();
        assert_eq!(mode(&target), mode(&plain));
    }
}
