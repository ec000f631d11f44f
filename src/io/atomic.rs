//! Files that appear whole or not at all.

use std::fs;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use super::error::FileError;

/// A file on its way: written under a temporary name in the same folder, renamed by
/// [`PartFile::finish`], removed if dropped before.
///
/// Each has a temporary name of its own (`.NAME.RANDOM.part`), so that processes that write the same
/// file do not meet in it: the last one gives it its content. What a killed process leaves is removed
/// by [`remove_leftovers`].
#[derive(Debug)]
pub struct PartFile {
    part: PathBuf,
    target: PathBuf,
    finished: bool,
}

impl PartFile {
    /// Makes the folder and chooses a temporary name.
    ///
    /// # Errors
    /// Where the folder cannot be made.
    pub fn new(target: impl AsRef<Path>) -> Result<Self, FileError> {
        let target = target.as_ref().to_owned();
        let part = part_of(&target)?;
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
        self.flush()
            .and_then(|()| fs::rename(&self.part, &self.target))
            .map_err(FileError::doing(&self.target, "cannot write the file"))?;
        self.finished = true;
        sync_names(&self.target).map_err(FileError::doing(&self.target, "cannot write the file"))
    }

    /// Gives the file its name unless a file has it by now, of which nothing changes then.
    ///
    /// # Errors
    /// Where it cannot be flushed to disk or named.
    pub fn finish_if_absent(self) -> Result<(), FileError> {
        let named = self
            .flush()
            .and_then(|()| fs::hard_link(&self.part, &self.target));
        match named {
            Ok(()) => sync_names(&self.target)
                .map_err(FileError::doing(&self.target, "cannot write the file")),
            Err(_) if self.target.exists() => Ok(()),
            // Some file systems have no links. Then the last of several processes wins.
            Err(_) => self.finish(),
        }
    }

    fn flush(&self) -> std::io::Result<()> {
        fs::File::open(&self.part).and_then(|file| file.sync_data())
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

/// A folder on its way, like a [`PartFile`].
#[derive(Debug)]
pub struct PartFolder {
    part: PathBuf,
    target: PathBuf,
    finished: bool,
}

impl PartFolder {
    /// Makes the folder under a temporary name.
    ///
    /// # Errors
    /// Where it cannot be made, or `target` exists and is no empty folder.
    pub fn new(target: impl AsRef<Path>) -> Result<Self, FileError> {
        let target = target.as_ref().to_owned();
        if target.exists() && !(target.is_dir() && list(&target)?.is_empty()) {
            let message = "this exists already; expected a new or an empty folder";
            return Err(FileError::new(&target, message));
        }
        let part = part_of(&target)?;
        fs::create_dir(&part).map_err(FileError::doing(&target, "cannot make the folder"))?;
        Ok(PartFolder {
            part,
            target,
            finished: false,
        })
    }

    /// Where to put the files.
    pub fn path(&self) -> &Path {
        &self.part
    }

    /// Gives the folder its name, its files being on disk.
    ///
    /// # Errors
    /// Where a file cannot be flushed or the folder cannot be renamed.
    pub fn finish(mut self) -> Result<(), FileError> {
        for path in list(&self.part)? {
            fs::File::open(&path)
                .and_then(|file| file.sync_data())
                .map_err(FileError::doing(&self.target, "cannot write the files"))?;
        }
        fs::rename(&self.part, &self.target)
            .and_then(|()| sync_names(&self.target))
            .map_err(FileError::doing(&self.target, "cannot make the folder"))?;
        self.finished = true;
        Ok(())
    }
}

impl Drop for PartFolder {
    fn drop(&mut self) {
        if !self.finished {
            let _ = fs::remove_dir_all(&self.part);
        }
    }
}

/// A temporary name for `target` in its folder, which is made.
fn part_of(target: &Path) -> Result<PathBuf, FileError> {
    let name = target
        .file_name()
        .ok_or_else(|| FileError::new(target, "this is not the name of a file"))?;
    let folder = target.parent().unwrap_or(Path::new(""));
    if !folder.as_os_str().is_empty() {
        fs::create_dir_all(folder).map_err(FileError::doing(folder, "cannot make the folder"))?;
    }
    let own: u64 = rand::random();
    Ok(folder.join(format!(".{}.{own:016x}{PART}", name.to_string_lossy())))
}

/// Ending of temporary names.
const PART: &str = ".part";

/// Removes the temporary files that killed processes left in `folder` and the folders in it. No other
/// process may be writing there.
///
/// # Errors
/// Where a folder cannot be listed or a leftover cannot be removed.
pub fn remove_leftovers(folder: &Path) -> Result<(), FileError> {
    for path in list(folder)? {
        if path.is_dir() {
            list(&path)?.iter().try_for_each(|path| remove_part(path))?;
        } else {
            remove_part(&path)?;
        }
    }
    Ok(())
}

fn list(folder: &Path) -> Result<Vec<PathBuf>, FileError> {
    fs::read_dir(folder)
        .and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect())
        .map_err(FileError::doing(folder, "cannot list the folder"))
}

/// Removes a file with a temporary name.
fn remove_part(path: &Path) -> Result<(), FileError> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    if name.starts_with('.') && name.ends_with(PART) && path.is_file() {
        fs::remove_file(path).map_err(FileError::doing(path, "cannot remove the leftover"))?;
    }
    Ok(())
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
    written(target, bytes)?.finish()
}

/// The same unless `target` exists, of which nothing changes then.
///
/// # Errors
/// Where the file cannot be written.
pub fn write_if_absent(target: impl AsRef<Path>, bytes: &[u8]) -> Result<(), FileError> {
    written(target, bytes)?.finish_if_absent()
}

fn written(target: impl AsRef<Path>, bytes: &[u8]) -> Result<PartFile, FileError> {
    let part = PartFile::new(target)?;
    fs::File::create(part.path())
        .and_then(|mut file| file.write_all(bytes))
        .map_err(FileError::doing(part.target(), "cannot write the file"))?;
    Ok(part)
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
    fn processes_that_write_the_same_file_do_not_meet_in_it() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("set01/truth.csv");
        let (one, two) = (
            PartFile::new(&target).unwrap(),
            PartFile::new(&target).unwrap(),
        );
        fs::write(one.path(), "one").unwrap();
        fs::write(two.path(), "two").unwrap();
        one.finish().unwrap();
        two.finish().unwrap();
        assert_eq!(fs::read(&target).unwrap(), b"two");
        write_if_absent(&target, b"three").unwrap();
        assert_eq!(fs::read(&target).unwrap(), b"two");
        let killed = PartFile::new(&target).unwrap();
        fs::write(killed.path(), "half").unwrap();
        std::mem::forget(killed);
        remove_leftovers(folder.path()).unwrap();
        assert_eq!(fs::read_dir(target.parent().unwrap()).unwrap().count(), 1);
    }
}
